"""The network that `teach` begins with, and the weights of its own logits and of path advice."""

from __future__ import annotations

import torch

from vn_nav.learning.precision import fast_dtype
from vn_nav.learning.presets import TrainConfig
from vn_nav.policy.network import Policy
from vn_nav.robot import RobotSpec

# Factors of the policy's own logits, and of those of path advice.
OWN_LOGIT_SHARE, ADVICE_LOGIT_SHARE = 0.75, 0.9


def network_for_place(config: TrainConfig, robot: RobotSpec, size: int, seed: int,
                      given: Policy | None) -> Policy:
    """A policy with parts for the place; with the weights of the one that is given.

    Args:
        config: numbers of the training.
        robot: with the actions of the policy.
        size: side of the pictures [pixels].
        seed: of the weights that are new.
        given: the policy to begin with.
    """
    torch.set_num_threads(config.threads)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Policy(config.network(robot.action_names, size,
                                        robot.moves if config.track_goal else ()))
    if given is not None:
        network.load_state_dict(widened(given.state_dict(), network))
    network.compute_dtype = fast_dtype()
    return network


@torch.no_grad()
def blend(network: Policy, own: float) -> None:
    """Scale the logits of the policy and of path advice.

    Args:
        network: made for a place.
        own: factor of its own logits; 1 for one that was taught before.
    """
    assert network.routes is not None  # it was made for a place
    for layer, share in ((network.actor, own), (network.routes.advise, ADVICE_LOGIT_SHARE)):
        for part in layer.parameters():
            part.mul_(share)


def widened(given: dict[str, torch.Tensor], network: Policy) -> dict[str, torch.Tensor]:
    """Weights of a policy for one whose memory has places as inputs too: with weights of zero."""
    own = network.state_dict()
    for name, tensor in own.items():
        if name not in given or name.startswith(('places.', 'routes.')):  # of another place
            given[name] = tensor
        elif given[name].shape != tensor.shape:  # the inputs of the memory
            wide = torch.zeros_like(tensor)
            wide[:, :given[name].shape[1]] = given[name]
            given[name] = wide
    return {name: given[name] for name in own}
