"""One PPO update (Schulman et al., "Proximal policy optimization algorithms", 2017)."""

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
    """Numbers of the update. A2C is the case of one epoch, where clipping does nothing."""

    learning_rate: float = 4e-4
    discount: float = 0.99
    trace: float = 0.95
    clip: float = 0.2
    epochs: int = 2
    minibatches: int = 4  # by environments: sequences stay whole
    value_weight: float = 0.5
    entropy_weight: float = 0.008
    max_gradient_norm: float = 0.5
    bf16: bool = True  # convolutions and matrix products in bfloat16; weights stay float32

    def __post_init__(self):
        for name in ('learning_rate', 'clip', 'max_gradient_norm'):
            if not getattr(self, name) > 0:
                raise UserError(f'{name} is positive', getattr(self, name), 'correct it')
        if self.epochs < 1 or self.minibatches < 1:
            raise UserError('there is at least one epoch and one minibatch',
                            (self.epochs, self.minibatches), 'correct them')


class Losses(NamedTuple):
    """Means over the minibatches of one update."""

    policy: float
    value: float
    entropy: float
    kl: float  # of the old policy from the new one, estimated
    gradient_norm: float


class Learner:
    """Improves a network from rollouts."""

    def __init__(self, network: Policy, config: LearnerConfig, generator: torch.Generator):
        self.network, self.config, self.generator = network, config, generator
        network.compute_dtype = torch.bfloat16 if config.bf16 else torch.float32
        self.optimiser = torch.optim.Adam(network.parameters(), config.learning_rate, eps=1e-5)

    def update(self, rollout: Rollout, *, learning_rate: float, entropy_weight: float) -> Losses:
        """Several epochs over one rollout.

        Raises:
            FloatingPointError: a loss is not finite; the weights are those before the step.
        """
        config = self.config
        for group in self.optimiser.param_groups:
            group['lr'] = learning_rate
        advantage = generalised_advantages(
            rollout.reward, rollout.value, rollout.terminated, rollout.truncated,
            gamma=config.discount, lam=config.trace)
        target = advantage + rollout.value[:-1]
        advantage = normalise(advantage, rollout.valid)
        batch = rollout.action.shape[1]
        totals, updates = torch.zeros(5), 0
        for _ in range(config.epochs):
            for columns in torch.randperm(batch, generator=self.generator).chunk(
                    config.minibatches):
                totals += self._step(rollout, columns, advantage, target, entropy_weight)
                updates += 1
        return Losses(*(totals / updates).tolist())

    def _step(self, rollout: Rollout, columns: Tensor, advantage: Tensor, target: Tensor,
              entropy_weight: float) -> Tensor:
        config = self.config
        seen = rollout.observation
        # index_select keeps the pictures channels last.
        observation = Observation(
            seen.image[:-1].permute(0, 1, 3, 4, 2)[:, columns].permute(0, 1, 4, 2, 3),
            seen.goals, *(part[:-1, columns] for part in seen[2:]))
        state = RecurrentState(*(part[columns] for part in rollout.state))
        output, _ = self.network(observation, rollout.starts[:-1, columns], state)
        valid = rollout.valid[:, columns]
        log_all = torch.log_softmax(output.logits, dim=-1)
        log_new = log_all.gather(-1, rollout.action[:, columns, None])[..., 0]
        log_ratio = log_new - rollout.log_probability[:, columns]
        ratio = log_ratio.exp()
        gain = advantage[:, columns]
        clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
        policy_loss = -masked_mean(torch.minimum(ratio * gain, clipped * gain), valid)
        value_loss = masked_mean((output.value - target[:, columns]) ** 2, valid)
        entropy = -masked_mean((log_all.exp() * log_all).sum(-1), valid)
        loss = policy_loss + config.value_weight * value_loss - entropy_weight * entropy
        if not torch.isfinite(loss):
            raise FloatingPointError(f'the loss is finite; received {loss.item()} (policy '
                                     f'{policy_loss.item()}, value {value_loss.item()}); lower '
                                     'the learning rate and resume from the last checkpoint')
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.max_gradient_norm)
        self.optimiser.step()
        with torch.no_grad():
            kl = masked_mean(ratio - 1 - log_ratio, valid)
        return torch.stack([policy_loss, value_loss, entropy, kl, norm]).detach()
