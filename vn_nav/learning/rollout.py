"""The batch that learning consumes, and how it is collected from an environment.

Time under NEXT_STEP autoreset, for an episode that ends with the action of row t: row t+1 shows
its true last observation, whose value bootstraps a truncated episode; the environment ignores the
action of that row, so it is no frame (`valid` is False). Row t+2 begins the next episode
(`starts`).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import GoalMaps, Policy


@dataclasses.dataclass
class Rollout:
    """T steps of B environments, time-major."""

    observation: Observation  # [T+1,B]; pictures lie in memory as [T+1,B,H,W,3]
    starts: Tensor  # [T+1,B] bool: an episode begins at this observation
    action: Tensor  # [T,B] int64
    reward: Tensor  # [T,B] float32, shaping included
    terminated: Tensor  # [T,B] bool
    truncated: Tensor  # [T,B] bool
    valid: Tensor  # [T,B] bool: False on reset rows, which are no frames
    state: RecurrentState  # before the first row
    # [T+1,B,...] What a simulator knows and the network must not see: targets of losses.
    privileged: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    # When it was chosen and seen; None where nobody wrote it down (replay, bags).
    log_probability: Tensor | None = None  # [T,B] of the action
    value: Tensor | None = None  # [T+1,B]

    @property
    def frames(self) -> int:
        """Agent decisions in this batch."""
        return int(self.valid.sum())


class Episode(NamedTuple):
    """What is kept of a finished episode."""

    env: int
    number: int  # how many episodes this environment had begun before, since training began
    success: bool
    reward: float  # undiscounted return, shaping included
    decisions: int
    collisions: int  # decisions that touched something


class Collector:
    """Acts in an environment by sampling, and keeps both their states between rollouts.

    Args:
        env: a vector environment that observes as `vn_sim_bridge.env.NavigationEnv` does.
        network: the policy; it acts in its `compute_dtype`.
        generator: source of the sampled actions.
        privileged: keys of the environment's `info` to keep beside the observations.
    """

    def __init__(self, env, network: Policy, generator: torch.Generator,
                 privileged: tuple[str, ...] = ()):
        self.env, self.network, self.generator = env, network, generator
        self.privileged = privileged
        self.told: dict[str, np.ndarray] = {}  # beside the present observation
        self.goals = torch.from_numpy(np.ascontiguousarray(env.goals))
        n = env.num_envs
        self.observation: dict[str, np.ndarray] = {}
        self.starts = torch.ones(n, dtype=torch.bool)
        self.state = network.initial_state(n)
        self.number = np.zeros(n, np.int64)  # of each environment's present episode
        self._reward = np.zeros(n)
        self._decisions = np.zeros(n, np.int64)
        self._collisions = np.zeros(n, np.int64)

    def begin(self, seed: int) -> None:
        """Reset every environment."""
        self.observation, info = self.env.reset(seed=seed)
        self.told = self._tell(info)
        self.starts[:] = True
        self.number += 1
        for total in (self._reward, self._decisions, self._collisions):
            total[:] = 0

    @torch.no_grad()
    def collect(self, steps: int) -> tuple[Rollout, list[Episode]]:
        """Act for a number of steps; also the episodes that ended, in the order of their ends."""
        n, size = self.env.num_envs, self.goals.shape[-1]
        flag, real, whole = torch.bool, torch.float32, torch.int64

        def empty(length: int, dtype: torch.dtype) -> Tensor:
            return torch.empty(length, n, dtype=dtype)

        # Channels last, as the convolutions read them.
        image = torch.empty(steps + 1, n, size, size, 3, dtype=torch.uint8).permute(0, 1, 4, 2, 3)
        seen = Observation(image, self.goals, empty(steps + 1, whole), empty(steps + 1, whole),
                           empty(steps + 1, real))
        told = {key: torch.empty(steps + 1, *rows.shape, dtype=torch.from_numpy(rows).dtype)
                for key, rows in self.told.items()}
        rollout = Rollout(
            seen, empty(steps + 1, flag), empty(steps, whole), empty(steps, real),
            empty(steps, flag), empty(steps, flag), empty(steps, flag), self.state, told,
            empty(steps, real), empty(steps + 1, real))
        goal_maps = GoalMaps(self.network)
        episodes: list[Episode] = []
        for t in range(steps + 1):
            for name, rows in seen._asdict().items():
                if name != 'goals':
                    rows[t] = torch.from_numpy(self.observation[name])
            for key, rows in told.items():
                rows[t] = torch.from_numpy(self.told[key])
            rollout.starts[t] = self.starts
            now = slice(t, t + 1)
            row = Observation(image[now], None, None, *(part[now] for part in seen[3:]))
            output, state = self.network(row, rollout.starts[now], self.state,
                                         goal_maps.of(self.goals, seen.goal_index[t]))
            rollout.value[t] = output.value[0]
            if t == steps:
                break  # this observation only bootstraps; the next rollout begins with it
            self.state = state
            log_probability = torch.log_softmax(output.logits[0], dim=-1)
            action = torch.multinomial(log_probability.exp(), 1, generator=self.generator)
            rollout.action[t] = action[:, 0]
            rollout.log_probability[t] = log_probability.gather(1, action)[:, 0]
            self._step(rollout, t, episodes)
        return rollout, episodes

    def _tell(self, info: dict) -> dict[str, np.ndarray]:
        missing = [key for key in self.privileged if key not in info]
        if missing:
            raise UserError('the environment tells everything that the auxiliary tasks need',
                            missing, 'list it among its privileged outputs, or set the weight of '
                            'those tasks to 0')
        return {key: np.array(info[key]) for key in self.privileged}

    def _step(self, rollout: Rollout, t: int, episodes: list[Episode]) -> None:
        """Step the environment with row t's actions and write down what came of it."""
        self.observation, reward, terminated, truncated, info = self.env.step(
            rollout.action[t].numpy())
        self.told = self._tell(info)
        reset = np.asarray(info['reset'])
        rollout.reward[t] = torch.from_numpy(np.asarray(reward, np.float32))
        rollout.terminated[t] = torch.from_numpy(terminated)
        rollout.truncated[t] = torch.from_numpy(truncated)
        self.starts = torch.from_numpy(reset.copy())
        rollout.valid[t] = ~self.starts
        self.number += reset
        for total in (self._reward, self._decisions, self._collisions):
            total[reset] = 0
        self._reward += np.where(reset, 0.0, reward)
        self._decisions += ~reset
        self._collisions += info['collided'] & ~reset
        for e in np.nonzero(terminated | truncated)[0]:
            episodes.append(Episode(
                int(e), int(self.number[e]), bool(info['success'][e]), float(self._reward[e]),
                int(self._decisions[e]), int(self._collisions[e])))

    def state_dict(self) -> dict:
        """Everything but the environment, as plain tensors."""
        return {
            'observation': {name: torch.from_numpy(np.array(rows))
                            for name, rows in self.observation.items()},
            'told': {key: torch.from_numpy(rows) for key, rows in self.told.items()},
            'starts': self.starts.clone(),
            'memory': [part.clone() for part in self.state],
            'totals': [torch.from_numpy(total.copy()) for total in self._totals()],
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken; the environment must stand there too."""
        self.observation = {name: rows.numpy() for name, rows in state['observation'].items()}
        self.told = {key: rows.numpy() for key, rows in state['told'].items()}
        self.starts = state['starts']
        self.state = RecurrentState(*state['memory'])
        for total, saved in zip(self._totals(), state['totals'], strict=True):
            total[:] = saved.numpy()

    def _totals(self) -> tuple[np.ndarray, ...]:
        return self.number, self._reward, self._decisions, self._collisions
