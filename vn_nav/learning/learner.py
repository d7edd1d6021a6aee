"""Proximal policy optimisation (Schulman et al. 2017) with an LSTM; A2C is its one-epoch case."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.learning.returns import generalised_advantages, masked_mean, normalise
from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation
from vn_nav.policy.network import Policy, RecurrentState


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """Numbers of one update."""

    learning_rate: float = 4e-4  # at the start
    final_learning_rate: float = 4e-5
    gamma: float = 0.99  # discount
    lam: float = 0.95  # of the advantage estimator
    clip: float = 0.2
    epochs: int = 3
    minibatches: int = 8  # by environments: sequences stay whole
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.01  # at the start
    final_entropy_coefficient: float = 0.005
    max_gradient_norm: float = 0.5

    def __post_init__(self):
        positive = ('learning_rate', 'final_learning_rate', 'clip', 'max_gradient_norm', 'epochs',
                    'minibatches')
        for name in positive:
            if not getattr(self, name) > 0:
                raise UserError(f'{name} is positive', getattr(self, name), 'correct it')
        for name in ('gamma', 'lam'):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f'{name} lies in [0, 1]', getattr(self, name), 'correct it')


class Losses(NamedTuple):
    """Means over the minibatches of one update."""

    policy: float
    value: float
    entropy: float  # nats
    kl: float  # estimate of KL(behaviour || new policy)
    clipped: float  # share of frames whose ratio was clipped
    gradient_norm: float


class Learner:
    """Improves a network from rollouts.

    Args:
        network: its parameters are changed in place, its `compute_dtype` is used.
        config: numbers of the update.
        generator: source of the order of environments.
    """

    def __init__(self, network: Policy, config: LearnerConfig, generator: torch.Generator):
        self.network, self.config, self.generator = network, config, generator
        self.optimiser = torch.optim.Adam(network.parameters(), config.learning_rate, eps=1e-5)

    def update(self, rollout: Rollout, progress: float = 0.0) -> Losses:
        """Several epochs over one rollout.

        Args:
            rollout: what the present network collected.
            progress: share of the training that is over, in [0, 1], for the linear schedules.

        Raises:
            UserError: a loss or gradient is not finite; the weights are those before that step.
        """
        config = self.config
        rate = _linear(config.learning_rate, config.final_learning_rate, progress)
        for group in self.optimiser.param_groups:
            group['lr'] = rate
        entropy_coefficient = _linear(config.entropy_coefficient,
                                      config.final_entropy_coefficient, progress)
        advantage = generalised_advantages(
            rollout.reward, rollout.value, rollout.terminated, rollout.truncated,
            gamma=config.gamma, lam=config.lam)
        target = advantage + rollout.value[:-1]
        advantage = normalise(advantage, rollout.valid)
        totals, updates = torch.zeros(len(Losses._fields)), 0
        environments = rollout.action.shape[1]
        for _ in range(config.epochs):
            order = torch.randperm(environments, generator=self.generator)
            for columns in order.chunk(config.minibatches):
                totals += self._step(rollout, columns, advantage[:, columns], target[:, columns],
                                     entropy_coefficient)
                updates += 1
        return Losses(*(totals / updates).tolist())

    def _step(self, rollout: Rollout, columns: Tensor, advantage: Tensor, target: Tensor,
              entropy_coefficient: float) -> Tensor:
        """One step of Adam on the whole sequences of some environments."""
        config, valid = self.config, rollout.valid[:, columns]
        output, _ = self.network(
            select(rollout.observation, columns), rollout.starts[:-1, columns],
            RecurrentState(*(part[columns] for part in rollout.state)))
        log_all = torch.log_softmax(output.logits, dim=-1)
        log_new = log_all.gather(-1, rollout.action[:, columns].unsqueeze(-1)).squeeze(-1)
        log_ratio = log_new - rollout.log_probability[:, columns]
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
        policy_loss = -masked_mean(torch.minimum(ratio * advantage, clipped * advantage), valid)
        value_loss = masked_mean((output.value - target) ** 2, valid)
        entropy = masked_mean(-(log_all.exp() * log_all).sum(-1), valid)
        loss = (policy_loss + config.value_coefficient * value_loss
                - entropy_coefficient * entropy)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.max_gradient_norm)
        if not torch.isfinite(loss + norm):
            raise UserError(
                'losses and gradients stay finite',
                f'policy {policy_loss.item():g}, value {value_loss.item():g}, entropy '
                f'{entropy.item():g}, gradient {norm.item():g}',
                'lower the learning rate and resume from the last checkpoint')
        self.optimiser.step()
        with torch.no_grad():
            kl = masked_mean(ratio - 1 - log_ratio, valid)  # never negative
            share = masked_mean(((ratio - 1).abs() > config.clip).float(), valid)
            return torch.stack([policy_loss, value_loss, entropy, kl, share, norm])


def select(observation: Observation, columns: Tensor) -> Observation:
    """Rows 0 to T-1 of some environments, with only the goals that occur in them.

    Pictures stay channels last in memory.
    """
    image = observation.image[:-1].permute(0, 1, 3, 4, 2)[:, columns].permute(0, 1, 4, 2, 3)
    used, index = torch.unique(observation.goal_index[:-1, columns], return_inverse=True)
    return Observation(image, observation.goals[used], index,
                       observation.last_action[:-1, columns],
                       observation.last_reward[:-1, columns])


def _linear(first: float, last: float, progress: float) -> float:
    return first + (last - first) * min(max(progress, 0.0), 1.0)
