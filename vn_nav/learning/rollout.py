"""The batch that learning consumes, and how it is collected from an environment."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from vn_nav.observation import Observation
from vn_nav.policy.network import Policy, RecurrentState


@dataclasses.dataclass
class Rollout:
    """T steps of B environments, time-major."""

    observation: Observation  # [T+1,B]
    starts: Tensor  # [T+1,B] bool: an episode begins at this observation
    action: Tensor  # [T,B] int64
    reward: Tensor  # [T,B] float32, shaping included
    terminated: Tensor  # [T,B] bool
    truncated: Tensor  # [T,B] bool
    valid: Tensor  # [T,B] bool: False on reset rows (NEXT_STEP autoreset), which are no frames
    log_probability: Tensor  # [T,B] of the action when it was chosen
    value: Tensor  # [T+1,B] when it was chosen
    state: RecurrentState  # before the first step, [B,hidden]

    @property
    def frames(self) -> int:
        """Agent decisions in this batch."""
        return int(self.valid.sum())


@dataclasses.dataclass
class EpisodeEnds:
    """The episodes that ended during a rollout, in the order of their ends."""

    success: list[bool] = dataclasses.field(default_factory=list)
    decisions: list[int] = dataclasses.field(default_factory=list)
    env: list[int] = dataclasses.field(default_factory=list)


class Collector:
    """Steps an environment with a network and keeps both their states between rollouts.

    Args:
        env: a vector environment with dict observations as `NavigationEnv` makes them.
        network: acts by sampling.
        generator: source of the sampled actions.
    """

    def __init__(self, env, network: Policy, *, generator: torch.Generator):
        self.env, self.network, self.generator = env, network, generator
        self.goals = torch.from_numpy(np.ascontiguousarray(env.goals))
        self.observation = None
        self.starts = torch.ones(env.num_envs, dtype=torch.bool)
        self.state = network.initial_state(env.num_envs)
        self.collisions = 0

    def begin(self, seed: int) -> None:
        """Reset every environment."""
        self.observation, _ = self.env.reset(seed=seed)
        self.starts[:] = True
        self.state = self.network.initial_state(self.env.num_envs)

    @torch.no_grad()
    def collect(self, steps: int) -> tuple[Rollout, EpisodeEnds]:
        """Act for a number of steps."""
        batch, size = self.env.num_envs, self.goals.shape[-1]
        # Stored channels last, which is how the convolutions read them.
        images = torch.empty(steps + 1, batch, size, size, 3, dtype=torch.uint8)
        images = images.permute(0, 1, 4, 2, 3)
        goal_index = torch.empty(steps + 1, batch, dtype=torch.int64)
        last_action = torch.empty(steps + 1, batch, dtype=torch.int64)
        last_reward = torch.empty(steps + 1, batch)
        starts = torch.empty(steps + 1, batch, dtype=torch.bool)
        value = torch.empty(steps + 1, batch)
        action = torch.empty(steps, batch, dtype=torch.int64)
        log_probability = torch.empty(steps, batch)
        reward = torch.empty(steps, batch)
        terminated = torch.empty(steps, batch, dtype=torch.bool)
        truncated = torch.empty(steps, batch, dtype=torch.bool)
        valid = torch.empty(steps, batch, dtype=torch.bool)
        first_state, ends = self.state, EpisodeEnds()
        self.collisions = 0
        goal_maps = self.network.encode_goals(self.goals)
        for step in range(steps + 1):
            images[step] = torch.from_numpy(self.observation['image'])
            goal_index[step] = torch.from_numpy(self.observation['goal_index'])
            last_action[step] = torch.from_numpy(self.observation['last_action'])
            last_reward[step] = torch.from_numpy(self.observation['last_reward'])
            starts[step] = self.starts
            now = slice(step, step + 1)
            seen = Observation(images[now], self.goals, goal_index[now], last_action[now],
                               last_reward[now])
            output, state = self.network(seen, starts[now], self.state, goal_maps)
            value[step] = output.value[0]
            if step == steps:
                break  # the last observation only bootstraps; the next rollout begins with it
            self.state = state
            log_probabilities = torch.log_softmax(output.logits[0], dim=-1)
            chosen = torch.multinomial(log_probabilities.exp(), 1, generator=self.generator)
            action[step] = chosen[:, 0]
            log_probability[step] = log_probabilities.gather(1, chosen)[:, 0]
            self.observation, rewards, ended, timed_out, info = self.env.step(
                action[step].numpy())
            reward[step] = torch.from_numpy(rewards)
            terminated[step] = torch.from_numpy(ended)
            truncated[step] = torch.from_numpy(timed_out)
            reset = torch.from_numpy(info['reset'])
            valid[step] = ~reset
            self.starts = reset
            self.collisions += int(info['collided'].sum())
            for n in np.nonzero(ended | timed_out)[0]:
                ends.success.append(bool(info['success'][n]))
                ends.decisions.append(int(info['decisions'][n]))
                ends.env.append(int(n))
        observation = Observation(images, self.goals, goal_index, last_action, last_reward)
        return Rollout(observation, starts, action, reward, terminated, truncated, valid,
                       log_probability, value, first_state), ends
