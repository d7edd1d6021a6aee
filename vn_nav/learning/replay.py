"""The replay memory of A2CAT-VN: windows and reward frames out of the stored steps."""

from __future__ import annotations

import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.learning.replay_rings import ReplayRings
from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation


class Replay(ReplayRings):
    """The last `capacity` steps of every environment (thesis 4.3: replay of UNREAL).

    Everything drawn comes from stored steps with equal probability, with replacement; equal
    generators draw equal batches. Arguments and errors are those of `ReplayRings`.
    """

    @property
    def steps(self) -> int:
        """Stored steps of all environments that can be drawn."""
        return sum(len(part) for part in self._stored_steps(1)) if self.count else 0

    def windows(self, batch: int, length: int, generator: torch.Generator) -> Rollout:
        """Stretches of episodes, one a column.

        A stored step is drawn, and the window begins there; where its episode has fewer than
        `length` steps left, it begins earlier in the episode, as far as it is stored. Episodes
        shorter than the window are padded by their last observation, with `valid` False.

        Returns:
            [length+1,batch] observations. `starts` only where an episode really begins; `state`
            is None: the consumer begins with zeros. `privileged` pictures are as they are stored
            (depth: 255 is `max_depth`) and hold `goal_segmentation` where there is its table.

        Raises:
            UserError: nothing is stored yet.
        """
        steps = torch.cat(self._stored_steps(1))
        row, env = self._draw(steps, batch, generator)
        ahead = torch.arange(length + 1, device=self.device)[:, None]
        age = self._read('age', row + ahead, env)
        remaining = (age == age[0] + ahead).long().cumprod(0).sum(0) - 1
        back = torch.minimum(torch.minimum(length - remaining, age[0].long()), row)
        first, last = row - back, row + remaining
        rows = torch.minimum(first + ahead, last)
        real = first + ahead[:-1] < last
        past = rows[:-1]
        valid = real & self._read('valid', past, env)
        privileged = {name: self._read(name, rows, env) for name in self.privileged}
        observation = self._observations(rows, env)
        if self.goal_segmentation is not None:
            privileged['goal_segmentation'] = self.goal_segmentation[
                observation.goal_index.to(self.goal_segmentation.device)]
        return Rollout(
            observation=observation,
            starts=self._read('starts', rows, env),
            action=self._read('action', past, env).long(),
            reward=torch.where(valid, self._read('reward', past, env), 0.0),
            terminated=valid & self._read('terminated', past, env),
            truncated=valid & self._read('truncated', past, env),
            valid=valid, state=None, privileged=privileged)

    def reward_frames(self, batch: int, generator: torch.Generator, *, frames: int = 3,
                      unrewarded: float = 1 / 3) -> tuple[Observation, Tensor]:
        """Consecutive observations, and the sign of the reward that follows (thesis 4.3.1).

        The reward is the task's own, without shaping. Before an episode's start its first
        observation is repeated, so that a reward after one or two steps is predicted as well.

        Args:
            batch: samples; of them round(batch * unrewarded) without a reward, the others with
                one, or all of one kind while the other is not there.
            generator: source of the draws.
            frames: observations of a sample.
            unrewarded: share in [0, 1] of samples without a reward.

        Returns:
            Observations [frames,batch], and labels [batch] int64: 0 no reward, 1 positive,
            2 negative.

        Raises:
            UserError: nothing is stored yet.
        """
        zero, rewarded = self._stored_steps(frames)
        plain = round(batch * unrewarded)
        if not len(zero) or not len(rewarded):
            plain = batch if len(zero) else 0
        parts = [self._draw(kind, number, generator)
                 for kind, number in ((zero, plain), (rewarded, batch - plain)) if number]
        row, env = (torch.cat(part) for part in zip(*parts, strict=True))
        back = torch.arange(frames - 1, -1, -1, device=self.device)[:, None]
        rows = row - torch.minimum(back, self._read('age', row, env).long())
        sign = self._read('last_reward', row + 1, env).sign().long()
        return self._observations(rows, env), torch.where(sign < 0, 2, sign)

    def _stored_steps(self, frames: int) -> tuple[Tensor, Tensor]:
        """Steps whose next observation and `frames` observations up to theirs are stored.

        Those without and those with a task reward, each as row * N + environment, the rows
        counted from the oldest. Found once an `extend`.
        """
        if frames not in self._steps:
            order = self._position(torch.arange(self.count, device=self.device))
            age = self.rings['age'][order]
            row = torch.arange(len(age), device=self.device)[:, None]
            step = (age[1:] == age[:-1] + 1) & self.rings['valid'][order[:-1]]
            # Of an episode whose beginning was overwritten, the oldest rows lack predecessors.
            step &= (row >= age.clamp(max=frames - 1))[:-1]
            rewarded = self.rings['last_reward'][order[1:]] != 0
            self._steps[frames] = ((step & ~rewarded).flatten().nonzero()[:, 0],
                                   (step & rewarded).flatten().nonzero()[:, 0])
        return self._steps[frames]

    def _draw(self, steps: Tensor, number: int, generator: torch.Generator
              ) -> tuple[Tensor, Tensor]:
        """Rows (from the oldest) and environments, [number] each."""
        if not len(steps):
            raise UserError('a replay memory is drawn from once a step and what followed it '
                            'are stored', f'{self.count} rows', 'extend it first')
        chosen = steps[torch.randint(len(steps), (number,), generator=generator,
                                     device=self.device)]
        return chosen // self.num_envs, chosen % self.num_envs

    def _observations(self, rows: Tensor, env: Tensor) -> Observation:
        return Observation(
            self._read('image', rows, env).permute(0, 1, 4, 2, 3), self.goals,
            self._read('goal_index', rows, env).long(),
            self._read('last_action', rows, env).long(), self._read('last_reward', rows, env))
