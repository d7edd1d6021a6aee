"""One learner for every preset: proximal policy optimisation with auxiliary tasks.

A2C is its case of one epoch, one batch and no clipping: at the first step the ratio of new to old
probabilities is 1 and its gradient that of the log-probability (Huang et al., arXiv 2205.09123).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.learning import auxiliary
from vn_nav.learning.batches import acting_rows, few_goals_of, own_frames, select
from vn_nav.learning.distributed import Processes
from vn_nav.learning.failed_batch import give_up
from vn_nav.learning.learner_config import TEACHERS, LearnerConfig
from vn_nav.learning.replay import Replay
from vn_nav.learning.returns import generalised_advantages, masked_mean
from vn_nav.learning.rollout import Rollout
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import IMAGE_HEADS

Losses = dict[str, float]  # means over the steps of one update
BASIC_LOSSES = ('policy_loss', 'value_loss', 'entropy', 'kl', 'clipped', 'gradient_norm')


class Learner:
    """Improves a network from rollouts.

    Args:
        network: its parameters are changed in place, its `compute_dtype` is used.
        config: numbers of the update.
        generator: source of the order of environments and of replayed samples, on the network's
            device.
        replay: the memory that `config.from_replay` learns from; fed by `update`.
        average_gradients: called with the parameters between backward and clipping, to average
            gradients in another way than `processes` does, or to look at them.
        processes: those that train together; each updates with its own rollout at a time, and
            the step is that of one process with all their batches.
        auxiliary_loss: called with every minibatch; gives a weighted loss that is added.
    """

    def __init__(self, network: Policy, config: LearnerConfig, generator: torch.Generator, *,
                 replay: Replay | None = None,
                 average_gradients: Callable[[list[nn.Parameter]], None] | None = None,
                 processes: Processes | None = None,
                 auxiliary_loss: Callable[[Rollout], Tensor] | None = None):
        missing = [name for name in config.heads if name not in network.heads]
        if missing:
            raise UserError('the network has a head for every auxiliary task', missing,
                            'add them to the heads of its configuration')
        if config.from_replay and replay is None:
            raise UserError('replayed tasks need a replay memory', config.from_replay,
                            'pass one, or set their weights to 0')
        self.network, self.config, self.generator = network, config, generator
        self.replay, self.average_gradients = replay, average_gradients
        self.auxiliary_loss = auxiliary_loss
        self.processes = processes or Processes()
        # Look at each step's loss before the step is made. On a GPU the host would wait for every
        # step: there it looks once an update.
        self.prompt = network.device.type == 'cpu'
        self.objective = self.processes.objective(
            network, self._loss, unused=set(network.heads) != set(config.heads))
        self.failed_batch: Path | None = None  # where to leave a batch whose loss is not finite
        parameters = [part for part in network.parameters() if part.requires_grad]
        self.optimiser: torch.optim.Optimizer
        if config.optimiser == 'adam':
            self.optimiser = torch.optim.Adam(parameters, config.learning_rate, eps=1e-5,
                                              fused=True)
        else:
            self.optimiser = torch.optim.RMSprop(parameters, config.learning_rate, alpha=0.99,
                                                 eps=config.rmsprop_epsilon)

    def update(self, rollout: Rollout, progress: float = 0.0, updates: int = 0) -> Losses:
        """Several epochs over one rollout, each step with every auxiliary task.

        Args:
            rollout: what the present network collected.
            progress: share of the training that is over, in [0, 1], for the linear schedules.
            updates: there were before this one.

        Returns:
            `BASIC_LOSSES` and the unweighted loss of each task, means over the steps.

        Raises:
            UserError: a loss or gradient is not finite; the weights are those before that step
                (on a GPU, where it is found at the end of the update, they are lost).
        """
        config = self.config
        rate = _linear(config.learning_rate, config.final_learning_rate, progress)
        if config.warmup_updates:
            rate *= min(1.0, (updates + 1) / config.warmup_updates)
        for group in self.optimiser.param_groups:
            group['lr'] = rate
        entropy_coefficient = _linear(config.entropy_coefficient,
                                      config.final_entropy_coefficient, progress)
        self._weights = {name: getattr(config, name) for name in config.tasks}
        if 'imitation' in self._weights:
            self._weights['imitation'] = _linear(config.imitation, 0.0,
                                                 progress / config.imitation_until)
        if self.replay is not None:
            self.replay.extend(rollout)
        terminated, truncated = rollout.terminated, rollout.truncated
        if config.truncation_is_terminal:
            terminated, truncated = terminated | truncated, torch.zeros_like(truncated)
        assert rollout.value is not None  # the network collected it
        advantage = generalised_advantages(rollout.reward, rollout.value, terminated, truncated,
                                           gamma=config.gamma, lam=config.lam)
        target = advantage + rollout.value[:-1]
        if config.normalise_advantage:
            advantage = self.processes.normalise(advantage, own_frames(rollout))
        names = (*BASIC_LOSSES, *config.tasks)
        totals, updates = torch.zeros(len(names), device=rollout.action.device), 0
        environments = rollout.action.shape[1]
        if not self.prompt:
            rollout = dataclasses.replace(rollout, observation=few_goals_of(rollout.observation))
        for _ in range(config.epochs):
            order = torch.randperm(environments, generator=self.generator,
                                   device=self.generator.device)
            for columns in order.chunk(config.minibatches):
                totals += self._step(select(rollout, columns, few_goals=self.prompt),
                                     advantage[:, columns], target[:, columns],
                                     entropy_coefficient)
                updates += 1
        losses = dict(zip(names, (totals / updates).tolist(), strict=True))
        if not self.prompt and not all(map(math.isfinite, losses.values())):
            self._give_up(rollout, advantage, target,
                          dict(zip(names, totals / updates, strict=True)))
        return losses

    def _step(self, batch: Rollout, advantage: Tensor, target: Tensor,
              entropy_coefficient: float) -> Tensor:
        """One step of the optimiser: one loss, one backward pass, one clipping of the norm."""
        self._drawn: dict[str, Rollout | dict] = {}
        with self.processes.counted_together():
            loss, figures = self.objective(batch, advantage, target, entropy_coefficient)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        parameters = [p for p in self.network.parameters() if p.grad is not None]
        if self.average_gradients is not None:
            self.average_gradients(parameters)
        norm = torch.nn.utils.clip_grad_norm_(parameters, self.config.max_gradient_norm)
        figures['gradient_norm'] = norm
        if self.prompt and not torch.isfinite(loss + norm):
            self._give_up(batch, advantage, target, figures)
        self.optimiser.step()
        return torch.stack([figures[name] for name in (*BASIC_LOSSES, *self.config.tasks)])

    def _loss(self, batch: Rollout, advantage: Tensor, target: Tensor,
              entropy_coefficient: float) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum of all losses, and by name what there is to say of them."""
        config, valid = self.config, own_frames(batch)
        latents, _ = self.network.latents(acting_rows(batch.observation), batch.starts[:-1],
                                          batch.state)
        output = self.network.read(latents)
        logits = output.logits
        if batch.filter_offsets is not None:  # the actions were chosen behind the action filter
            logits = logits + batch.filter_offsets
        log_all = torch.log_softmax(logits, dim=-1)
        log_new = log_all.gather(-1, batch.action.unsqueeze(-1)).squeeze(-1)
        assert batch.log_probability is not None  # the network collected it
        log_ratio = log_new - batch.log_probability
        ratio = log_ratio.exp()
        gain = ratio * advantage
        if config.clip is not None:
            clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
            gain = torch.minimum(gain, clipped * advantage)
        policy_loss = -masked_mean(gain, valid)
        value_loss = masked_mean((output.value - target) ** 2, valid)
        entropy = masked_mean(-(log_all.exp() * log_all).sum(-1), valid)
        loss = (policy_loss + config.value_coefficient * value_loss
                - entropy_coefficient * entropy)
        extra = {}
        for name in config.tasks:
            if name not in config.from_replay:
                extra[name] = self._rollout_loss(name, latents, batch)
            elif name not in IMAGE_HEADS:
                extra[name] = self._replayed_loss(name)
        extra |= self._replayed_image_losses()
        for name in config.tasks:
            loss = loss + self._weights[name] * extra[name]
        if self.auxiliary_loss is not None:
            extra['auxiliary'] = self.auxiliary_loss(batch)
            loss = loss + extra['auxiliary']
        with torch.no_grad():
            kl = masked_mean(ratio - 1 - log_ratio, valid)  # never negative
            share = (masked_mean(((ratio - 1).abs() > config.clip).float(), valid)
                     if config.clip is not None else kl.new_zeros(()))
        figures = {'policy_loss': policy_loss, 'value_loss': value_loss, 'entropy': entropy,
                   'kl': kl, 'clipped': share, **extra}
        return loss, {name: value.detach() for name, value in figures.items()}

    def _rollout_loss(self, name: str, latents, batch: Rollout) -> Tensor:
        """Loss of a task on the batch of the policy itself."""
        if name in IMAGE_HEADS:
            return auxiliary.image_loss(self.network, name, latents.maps, batch)
        if name == 'goal_pose':
            return auxiliary.goal_pose_loss(latents, batch)
        if name == 'imitation':
            return auxiliary.imitation_loss(self.network, latents, batch,
                                            TEACHERS[self.config.teacher][-1])
        loss = {'arrival': auxiliary.arrival_loss, 'distance': auxiliary.distance_loss}[name]
        return loss(self.network, latents, batch)

    def _replayed_image_losses(self) -> dict[str, Tensor]:
        """Losses of the image heads on one draw; they need no memory, only maps."""
        config, network = self.config, self.network
        names = [name for name in config.from_replay if name in IMAGE_HEADS]
        if not names:
            return {}
        assert self.replay is not None  # `from_replay` is refused without
        window = self.replay.windows(config.replay_batch, config.replay_length, self.generator)
        self._drawn |= dict.fromkeys(names, window)
        maps = network.maps(acting_rows(window.observation), window.starts[:-1])
        return {name: auxiliary.image_loss(network, name, maps, window) for name in names}

    def _replayed_loss(self, name: str) -> Tensor:
        """Loss of a task on a draw of its own from the replay memory."""
        config, network = self.config, self.network
        assert self.replay is not None  # `from_replay` is refused without
        if name == 'reward_prediction':
            seen, label = self.replay.reward_frames(config.replay_batch, self.generator,
                                                    unrewarded=config.unrewarded)
            self._drawn[name] = {'observation': seen._asdict(), 'label': label}
            return auxiliary.reward_prediction_loss(network, network.maps(seen), label)
        window = self.replay.windows(config.replay_batch, config.replay_length, self.generator)
        self._drawn[name] = window
        latents = network.latents(window.observation, window.starts)[0]
        if name == 'value_replay':
            return auxiliary.value_replay_loss(
                network, latents, window, gamma=config.gamma,
                truncation_is_terminal=config.truncation_is_terminal)
        return auxiliary.pixel_control_loss(network, latents, window,
                                            gamma=config.pixel_control_gamma,
                                            grey=config.pixel_change_grey)

    def _give_up(self, batch: Rollout, advantage: Tensor, target: Tensor,
                 figures: dict[str, Tensor]) -> None:
        give_up(self.failed_batch, self.network, batch, advantage, target, figures, self._drawn)


def _linear(first: float, last: float, progress: float) -> float:
    return first + (last - first) * min(max(progress, 0.0), 1.0)
