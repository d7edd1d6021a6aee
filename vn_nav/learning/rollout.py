"""The batch that learning consumes, and how it is collected from an environment.

Time under NEXT_STEP autoreset, for an episode that ends with the action of row t: row t+1 shows
its true last observation, whose value bootstraps a truncated episode; the environment ignores the
action of that row, so it is no frame (`valid` is False). Row t+2 begins the next episode
(`starts`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.action_filter import make_filter
from vn_nav.policy.goal_maps import GoalMaps
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.zhu import check_scenes
from vn_nav.policy.zhu_policy import ScenePolicy
from vn_nav.vector_env import NavigationVectorEnv, PlacedEnv


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
    state: RecurrentState | None  # before the first row; None: empty
    # [T+1,B,...] What a simulator knows and the network must not see: targets of losses.
    privileged: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    driven: Tensor | None = None  # [T,B] bool: a teacher chose the action, not the policy
    # When it was chosen and seen; None where nobody wrote it down (replay, bags).
    log_probability: Tensor | None = None  # [T,B] of the action
    value: Tensor | None = None  # [T+1,B]
    # [T,B,A] float32, what the action filter added to the logits; None: there was none.
    filter_offsets: Tensor | None = None

    @property
    def frames(self) -> int:
        """Agent decisions in this batch."""
        return int(self.valid.sum())

    def state_dict(self) -> dict:
        """Everything but the goal pictures, as plain tensors on the host."""
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        rows['observation'] = self.observation._replace(goals=None)._asdict()
        rows['state'] = None if self.state is None else list(self.state)
        return _on_host(rows)

    @staticmethod
    def from_state(state: dict, goals: Tensor) -> Rollout:
        """The rollout of a `state_dict`; `goals` [G,3,S,S] are its environment's."""
        memory = state['state']
        return Rollout(**{**state, 'observation': Observation(**state['observation'] | {
            'goals': goals}), 'state': None if memory is None else RecurrentState(*memory)})


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

    Everything lives on the network's device. Of an environment on that device (its `goals` are a
    tensor, as `WarpNavigationEnv`'s are) nothing passes through the host
    while it acts, and the host waits for the device once a rollout, to read the episodes.

    Args:
        env: its tensors may change in place with its next step.
        network: the policy; it acts in its `compute_dtype`.
        generator: source of the sampled actions, on the network's device.
        privileged: keys of the environment's `info` to keep with the observations.
    """

    def __init__(self, env: NavigationVectorEnv, network: Policy, generator: torch.Generator,
                 privileged: tuple[str, ...] = ()):
        self.env, self.network, self.generator = env, network, generator
        self.privileged = privileged
        self.device = network.device
        self.on_device = isinstance(env.goals, Tensor)
        self.targets: dict[str, Tensor] = {}  # privileged, of the present observation
        self.goals = self._tensor(env.goals)
        if isinstance(network, ScenePolicy):
            known = getattr(env, 'goal_features', None)
            self._takes_features = known is not None and network.takes_features(known.shape[-1])
            self.goals = (self._tensor(known) if self._takes_features
                          else network.look(self.goals))
        self._scenes = network.config.scenes
        n = env.num_envs
        self.observation: dict[str, Tensor] = {}
        self.starts = torch.ones(n, dtype=torch.bool, device=self.device)
        self.driven = torch.zeros_like(self.starts)  # by a teacher, in this episode
        self.state = network.initial_state(n)
        config = network.config
        self._filter = make_filter(config.filter_name, config.moves, n, self.device)
        # Of each environment's present episode: its number, return, decisions and collisions.
        self._totals = tuple(torch.zeros(n, dtype=dtype, device=self.device) for dtype in (
            torch.int64, torch.float64, torch.int64, torch.int64))

    @property
    def number(self) -> np.ndarray:
        """[N] number of each environment's present episode; this waits for the device."""
        return self._totals[0].cpu().numpy()

    def begin(self, seed: int) -> None:
        """Reset every environment."""
        self._see(*self.env.reset(seed=seed))
        self.starts = torch.ones_like(self.starts)
        number, *others = self._totals
        number += 1
        for total in others:
            total.zero_()

    @torch.no_grad()
    def collect(self, steps: int, teacher: str | None = None, share: float = 0.0
                ) -> tuple[Rollout, list[Episode]]:
        """Act for a number of steps.

        Args:
            steps: of every environment.
            teacher: privileged key of the actions that drive a part of the episodes.
            share: of the episodes that begin now which it drives to their ends.

        Returns:
            What happened, and the policy's own episodes that ended, in the order of their ends.
        """
        n, size = self.env.num_envs, self.observation['image'].shape[-1]
        flag, real, whole = torch.bool, torch.float32, torch.int64

        def empty(length: int, dtype: torch.dtype, *shape: int) -> Tensor:
            return torch.empty(length, n, *shape, dtype=dtype, device=self.device)

        # Channels last, as the convolutions read them.
        image = empty(steps + 1, torch.uint8, size, size, 3).permute(0, 1, 4, 2, 3)
        seen = Observation(image, self.goals, empty(steps + 1, whole), empty(steps + 1, whole),
                           empty(steps + 1, real), self._empty_extras(steps + 1))
        targets = {key: empty(steps + 1, rows.dtype, *rows.shape[1:])
                   for key, rows in self.targets.items()}
        driven = None if teacher is None else empty(steps, flag)
        chosen, value = empty(steps, real), empty(steps + 1, real)
        offsets = None if self._filter is None else empty(
            steps, real, len(self.network.config.actions))
        rollout = Rollout(
            seen, empty(steps + 1, flag), empty(steps, whole), empty(steps, real),
            empty(steps, flag), empty(steps, flag), empty(steps, flag), self.state, targets,
            driven, chosen, value, offsets)
        facts = empty(steps, torch.float64, 1 + len(self._totals))
        goal_maps = self._goal_maps()
        for t in range(steps + 1):
            for name, rows in seen._asdict().items():
                if name not in ('goals', 'extras'):
                    rows[t] = self.observation[name]
            self._fill_extras(seen, t)
            for key, rows in targets.items():
                rows[t] = self.targets[key]
            rollout.starts[t] = self.starts
            if teacher is not None:
                drawn = torch.rand(n, device=self.device, generator=self.generator) < share
                self.driven = torch.where(self.starts, drawn, self.driven)
            now = slice(t, t + 1)
            extras = seen.extras and {key: rows[now] for key, rows in seen.extras.items()}
            row = Observation(image[now], None, None, seen.last_action[now],
                              seen.last_reward[now], extras)
            output, state = self.network(row, rollout.starts[now], self.state,
                                         goal_maps(seen.goal_index[t]))
            value[t] = output.value[0]
            if t == steps:
                break  # this observation only bootstraps; the next rollout begins with it
            self.state = state
            logits = output.logits[0]
            if self._filter is not None and offsets is not None:
                offsets[t] = self._filter.offsets(
                    image[t], seen.last_action[t], rollout.starts[t])
                logits = logits + offsets[t]
            log_probability = torch.log_softmax(logits, dim=-1)
            action = self._sample(log_probability)
            if teacher is not None and driven is not None:
                driven[t] = self.driven
                action = torch.where(self.driven[:, None], targets[teacher][t][:, None], action)
            rollout.action[t] = action[:, 0]
            chosen[t] = log_probability.gather(1, action)[:, 0]
            facts[t] = self._step(rollout, t)
        ended = rollout.terminated | rollout.truncated
        return rollout, _episodes(ended if driven is None else ended & ~driven, facts)

    def _tensor(self, rows) -> Tensor:
        """Rows of the environment, on the network's device; shared where they are there."""
        if not isinstance(rows, Tensor):
            rows = torch.from_numpy(np.ascontiguousarray(rows))
        return rows.to(self.device)

    def _goal_maps(self) -> Callable[[Tensor], Tensor]:
        """Goal maps by index: on a device all at once, for it cannot say which ones changed."""
        if not self.on_device:
            maps = GoalMaps(self.network)
            return lambda index: maps.of(self.goals, index)
        table = self.network.encode_goals(self.goals)
        return lambda index: table[index]

    def _sample(self, log_probability: Tensor) -> Tensor:
        """Actions [N,1]: what torch.multinomial draws, without its look at the probabilities."""
        weights = log_probability.exp()
        waiting = torch.empty_like(weights).exponential_(generator=self.generator)
        return (weights / waiting).argmax(dim=-1, keepdim=True)

    def _empty_extras(self, steps: int) -> dict[str, Tensor] | None:
        """Room for what only the architecture icra2017 looks at."""
        if not isinstance(self.network, ScenePolicy):
            return None
        encoder, n = self.network.encoder, self.env.num_envs
        extras = {'features': torch.empty(steps, n, encoder.frozen.features, device=self.device)}
        if self._scenes > 1:
            extras['scene'] = torch.empty(steps, n, dtype=torch.int64, device=self.device)
        return extras

    def _fill_extras(self, seen: Observation, t: int) -> None:
        if seen.extras is None:
            return
        assert isinstance(self.network, ScenePolicy)  # no other has room for them
        # Never encoded again: not by the learner either.
        # What a simulator's files hold is not computed at all.
        seen.extras['features'][t] = (self.observation['features'] if self._takes_features
                                      else self.network.look(seen.image[t]))
        if self._scenes > 1:
            if not isinstance(self.env, PlacedEnv):
                raise UserError('layers for several scenes need to know which scene a robot is in',
                                type(self.env).__name__, 'train with scenes=1')
            scene = self.env.place_index
            if self.on_device:
                scene = scene.cpu().numpy()  # a wait that only these networks pay for
            seen.extras['scene'][t] = self._tensor(check_scenes(scene, self._scenes))

    def _see(self, observation: dict, info: dict) -> None:
        """Keep the outputs of the environment until the next row."""
        missing = [key for key in self.privileged if key not in info]
        if missing:
            raise UserError('the environment gives everything that the auxiliary tasks need',
                            missing, 'list it among its privileged outputs, or set the weight of '
                            'those tasks to 0')
        self.observation = {name: self._tensor(rows) for name, rows in observation.items()}
        self.targets = {key: self._tensor(info[key]) for key in self.privileged}

    def _step(self, rollout: Rollout, t: int) -> Tensor:
        """Step the environment with row t's actions and write down what came of it.

        Returns:
            [N,5] float64, of each environment's episode: success and `_totals`.
        """
        action = rollout.action[t]
        observation, reward, terminated, truncated, info = self.env.step(
            action if self.on_device else action.cpu().numpy())
        self._see(observation, info)
        reward, reset = self._tensor(reward), self._tensor(info['reset'])
        rollout.reward[t] = reward
        rollout.terminated[t] = self._tensor(terminated)
        rollout.truncated[t] = self._tensor(truncated)
        self.starts = reset
        rollout.valid[t] = ~reset
        number, total, decisions, collisions = self._totals
        number += reset
        for part in (total, decisions, collisions):
            part.masked_fill_(reset, 0)
        total += torch.where(reset, 0.0, reward)
        decisions += ~reset
        collisions += self._tensor(info['collided']) & ~reset
        return torch.stack([self._tensor(info['success']), *self._totals], dim=1)

    def state_dict(self) -> dict:
        """Everything but the environment, as plain tensors."""
        def copy(rows: Tensor) -> Tensor:
            return rows.detach().clone().cpu()
        return {
            'observation': {name: copy(rows) for name, rows in self.observation.items()},
            # Under the name of earlier states: a training begun with those is resumed.
            'told': {key: copy(rows) for key, rows in self.targets.items()},
            'starts': copy(self.starts), 'driven': copy(self.driven),
            'memory': [copy(part) for part in self.state],
            'totals': [copy(total) for total in self._totals],
            'filter': None if self._filter is None else {
                name: copy(rows) for name, rows in self._filter.state_dict().items()},
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken; the environment must stand there too."""
        self.observation = {name: self._tensor(rows)
                            for name, rows in state['observation'].items()}
        self.targets = {key: self._tensor(rows) for key, rows in state['told'].items()}
        self.starts = self._tensor(state['starts'])
        self.driven = self._tensor(state['driven'])
        self.state = RecurrentState(*map(self._tensor, state['memory']))
        for total, saved in zip(self._totals, state['totals'], strict=True):
            total.copy_(saved)
        # A training of before there was a filter in it goes on with an empty one.
        if self._filter is not None and state.get('filter') is not None:
            self._filter.load_state_dict(state['filter'])


def _on_host(rows):
    if isinstance(rows, dict):
        return {key: _on_host(value) for key, value in rows.items()}
    if isinstance(rows, list):
        return [_on_host(value) for value in rows]
    return rows if rows is None else rows.cpu()


def _episodes(ended: Tensor, facts: Tensor) -> list[Episode]:
    """Episodes that ended in a rollout, [T,N] bool, from what `Collector._step` wrote down."""
    row, env = ended.nonzero(as_tuple=True)
    rows = torch.cat([env.unsqueeze(1), facts[row, env]], dim=1).tolist()
    return [Episode(int(env), int(number), bool(success), reward, int(decisions), int(collisions))
            for env, success, number, reward, decisions, collisions in rows]
