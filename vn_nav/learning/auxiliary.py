"""Auxiliary tasks: losses of the network's heads, on rollouts, replayed windows or bags alike.

A task reads the latents of a batch (`vn_nav.policy.network.Latents`) and the batch itself
(`Rollout`, T+1 observations and T actions of B environments), and returns a scalar loss. A batch
that lacks the keys a task needs is an error: what a task learns from is declared, not guessed.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torch.nn import functional as F

from vn_nav.bags.dataset import MAX_DEPTH
from vn_nav.errors import UserError
from vn_nav.learning.pixel_change import (
    average_pool_target,
    label_colours,
    label_target,
    pixel_change,
)
from vn_nav.learning.returns import masked_mean, n_step_q, n_step_returns
from vn_nav.learning.rollout import Rollout
from vn_nav.policy.network import Latents, Policy

FAR = 12.0  # m, beyond which distances count as this far
POSE_OVERLAP = 0.1  # share of the goal picture that must be in view for its pose to count
WARMTH = 0.5  # decisions: an action that loses so much is a third as likely to be imitated


def image_target(network: Policy, name: str, shown: Tensor) -> Tensor:
    """What an image head shall draw: [N,c,k,k] float32 in [0, 1] (thesis, 4.4).

    Class ids become colours first and are averaged then: ids are never interpolated.

    Args:
        network: with the head.
        name: of the head.
        shown: [N,3,S,S] uint8 pictures (reconstruction), [N,S,S] depth, as float m or as uint8
            with 255 at `MAX_DEPTH`, or [N,S,S] uint8 or uint16 class ids below the network's
            `classes`.
    """
    if name == 'reconstruction':
        picture = shown.float() / 255
    elif name == 'depth':
        scaled = shown.float() / 255 if shown.dtype == torch.uint8 else shown / MAX_DEPTH
        picture = scaled.clamp(0, 1).unsqueeze(1)
    else:
        colours = _colours(shown.device, network.config.classes)
        return label_target(shown, colours, network.target_side, network.cell)
    return average_pool_target(picture, network.target_side, network.cell)


@functools.cache
def _colours(device: torch.device, count: int) -> Tensor:
    return label_colours(count).to(device)


def image_loss(network: Policy, name: str, maps: Tensor, rollout: Rollout) -> Tensor:
    """Mean squared error of depth, a segmentation or the reconstructed input (thesis, 4.4).

    `maps` are the encoder's last ones of the first T rows.
    """
    shown = (rollout.observation.image if name == 'reconstruction'
             else _privileged(rollout, name))[:len(rollout.valid)]
    target = image_target(network, name, shown.flatten(0, 1))
    error = ((network.heads[name](maps) - target) ** 2).mean(dim=(1, 2, 3))
    return masked_mean(error.view(rollout.valid.shape), rollout.valid)


def value_replay_loss(network: Policy, latents: Latents, rollout: Rollout, *, gamma: float,
                      truncation_is_terminal: bool = False) -> Tensor:
    """Off-policy critic: squared error to the n-step return of replayed windows (thesis, 5.3)."""
    value = network.critic(latents.hidden).squeeze(-1)
    target = n_step_returns(
        rollout.reward, value.detach(), rollout.terminated, rollout.truncated, rollout.valid,
        gamma=gamma, truncation_is_terminal=truncation_is_terminal)
    return masked_mean((target - value[:-1]) ** 2, rollout.valid)


def pixel_control_loss(network: Policy, latents: Latents, rollout: Rollout, *, gamma: float,
                       grey: bool = True) -> Tensor:
    """n-step Q-learning of pixel changes (thesis, 4.3.2; Jaderberg et al. 2016).

    Squared error of the value of the action taken, mean over cells and frames.
    """
    q = network.heads['pixel_control'](latents.hidden.flatten(0, 1))
    steps, batch = rollout.action.shape
    q = q.view(steps + 1, batch, *q.shape[1:])
    change = pixel_change(rollout.observation.image, cell=network.cell,
                          cells=network.target_side, grey=grey)
    # The first padded row shows a window's last picture; the memory of later ones saw it twice.
    last = q.detach()[rollout.valid.sum(0), torch.arange(batch, device=q.device)]
    target = n_step_q(change, last.amax(dim=1), rollout.terminated, rollout.valid, gamma=gamma)
    index = rollout.action.view(steps, batch, 1, 1, 1).expand(-1, -1, 1, *q.shape[-2:])
    taken = q[:-1].gather(2, index).squeeze(2)
    return masked_mean(((target - taken) ** 2).mean(dim=(2, 3)), rollout.valid)


def reward_prediction_loss(network: Policy, maps: Tensor, label: Tensor) -> Tensor:
    """Cross-entropy of the sign of the next reward (thesis, 4.3.1).

    Args:
        maps: [3*B,C,h,w], the last maps of three consecutive frames.
        label: [B] class of the reward, see `Replay.reward_frames`.
    """
    return F.cross_entropy(network.heads['reward_prediction'](maps.unflatten(0, (3, -1))), label)


def goal_pose_loss(latents: Latents, rollout: Rollout) -> Tensor:
    """Relative pose of the goal where the pictures overlap, and whether they do.

    A negative overlap is unknown: such rows teach nothing.
    """
    rows = rollout.valid.numel()
    overlap = _privileged(rollout, 'overlap')[:-1].flatten()
    assert latents.pose is not None  # this task gives the network the head
    position, heading, said = (part[:rows] for part in latents.pose)
    return pose_loss(position, heading, said,
                     _privileged(rollout, 'goal_pose')[:-1].flatten(0, 1), overlap,
                     rollout.valid.flatten() & (overlap >= 0))


def pose_loss(position: Tensor, heading: Tensor, overlap_logit: Tensor, goal_pose: Tensor,
              overlap: Tensor, valid: Tensor) -> Tensor:
    """Loss of a relative pose: Huber on position and heading, cross-entropy on the overlap.

    Args:
        position: [N,2] m; heading: [N,2] cos, sin; overlap_logit: [N]: see `heads.Pose`.
        goal_pose: [N,4] x, y [m], cos, sin; overlap: [N] share of the goal picture in view.
        valid: [N] bool.
    """
    sees = (overlap >= POSE_OVERLAP)
    error = (F.smooth_l1_loss(position, goal_pose[:, :2], reduction='none').sum(1)
             + 2 * F.smooth_l1_loss(heading, goal_pose[:, 2:], reduction='none').sum(1))
    seen = masked_mean(error, valid & sees)
    overlaps = F.binary_cross_entropy_with_logits(overlap_logit, sees.float(), reduction='none')
    return seen + masked_mean(overlaps, valid)


def arrival_loss(network: Policy, latents: Latents, rollout: Rollout) -> Tensor:
    """Cross-entropy of having arrived; the last observations of episodes count too.

    Under NEXT_STEP autoreset the observation that shows an arrival is a reset row, which is no
    frame: all T rows are learned from, because each shows a real picture. For rollouts, not for
    padded windows.
    """
    arrived = _privileged(rollout, 'arrived')[:-1].float()
    logit = network.heads['arrival'](latents.hidden[:len(arrived)])
    loss = F.binary_cross_entropy_with_logits(logit, arrived, reduction='none')
    return loss.mean()


def distance_loss(network: Policy, latents: Latents, rollout: Rollout) -> Tensor:
    """Huber loss of the logarithm of one plus the geodesic distance to the goal [m]."""
    distance = _privileged(rollout, 'distance')[:-1].clamp(0, FAR)
    said = network.heads['distance'](latents.hidden[:len(distance)])
    loss = F.smooth_l1_loss(said, torch.log1p(distance), reduction='none')
    return masked_mean(loss, rollout.valid)


def imitation_loss(network: Policy, latents: Latents, rollout: Rollout, key: str) -> Tensor:
    """Cross-entropy of a teacher's actions in the states that the policy itself comes to.

    The teacher must be one that the policy can follow: one that knows no more than a robot could
    have seen (the simulator's explorer), or, in a place known by heart, the shortest path. `key`
    names its actions among the privileged. Weighted down to nothing in the course of a training,
    so that reinforcement has the last word (Ross et al. 2011; Schmitt et al., arXiv 1803.03835).
    Of what each action loses, [T,B,A] float, it is the cross-entropy with `softened` choices.
    """
    logits = network.read(latents).logits[:len(rollout.valid)]
    told = _privileged(rollout, key)[:len(rollout.valid)]
    wanted = softened(told.flatten(0, 1)) if told.is_floating_point() else told.flatten()
    loss = F.cross_entropy(logits.flatten(0, 1), wanted, reduction='none')
    return masked_mean(loss, rollout.valid.flatten())


def softened(regrets: Tensor) -> Tensor:
    """Probabilities [N,A] of actions, the likelier the less they lose [decisions].

    The one best action jumps from pose to pose where two are about as good, and cannot be learned.
    """
    return torch.softmax(-regrets / WARMTH, dim=-1)


def _privileged(rollout: Rollout, key: str) -> Tensor:
    if key not in rollout.privileged:
        raise UserError(f'an auxiliary task of this training needs {key!r} in every batch',
                        sorted(rollout.privileged), f'let the environment provide {key} '
                        '(privileged outputs), or set the weight of that task to 0')
    return rollout.privileged[key]
