"""The replay memory of A2CAT-VN: the last steps of every environment, in uint8.

A ring of rows, each with all environments side by side. A row holds one observation and what came
of the action there; the observation that follows is the next row. So a rollout's last observation
is not stored with it, but as the first row of the next rollout, and the newest row's action is
drawn only once that row is there. The rows are numbered since training began (their serial); row
s lies in the ring at s modulo the capacity.

`age` counts an observation's place in its episode. Two neighbouring rows belong to one episode
where it grows by one, which is all that drawing needs to know about episodes.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.learning.replay_files import RingFiles
from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation

# What may be kept beside the observation, [S,S]: depth as uint8, segmentation as its ids come.
PICTURES = ('depth', 'segmentation')
LAYOUT = 1  # of the files


def encode_depth(depth: Tensor, max_depth: float = 10.0) -> Tensor:
    """Metric depth [m] as uint8, 255 at `max_depth` and beyond; uint8 passes unchanged."""
    if depth.dtype == torch.uint8:
        return depth
    levels = (depth * (255.0 / max_depth)).nan_to_num_(255.0)
    return levels.clamp_(0.0, 255.0).round_().to(torch.uint8)


class Replay:
    """The last `capacity` steps of every environment (thesis 4.3: replay of UNREAL).

    Everything drawn comes from stored steps with equal probability, with replacement; equal
    generators draw equal batches.

    Args:
        capacity: rows kept, that is steps of each environment (2,000 in the thesis).
        num_envs: environments, N.
        size: side of the square pictures, S [pixels].
        goals: [G,3,S,S] uint8, the table that every rollout's `goal_index` points into; kept by
            reference, once. None: a task without goal pictures.
        privileged: which of `PICTURES` the rollouts bring and the memory keeps.
        goal_segmentation: [G,S,S] classes of the goal pictures, if an image head needs
            them: looked up like the goals, not kept for each step.
        max_depth: depth that is stored as 255 [m].
        label_type: of the class ids in segmentations, torch.uint8 or torch.uint16.
        directory: where the rings live as memory-mapped files, so that a resumed training finds
            them. They survive a killed process at any moment; for a power cut call `flush`
            before the checkpoint is written. None: in memory only.
        device: where the rings live and the draws are made; files need the CPU.

    Attributes:
        count: rows that can be read.
        resumed: 'mapped' or 'refilled' after `load_state_dict`: whether the stored steps were
            found again, or have to be collected anew. None before.

    Raises:
        UserError: sizes that make no memory, files of another memory, or a full disk.
    """

    def __init__(self, capacity: int, num_envs: int, size: int, goals: Tensor | None, *,
                 privileged: tuple[str, ...] = PICTURES, goal_segmentation: Tensor | None = None,
                 max_depth: float = 10.0, label_type: torch.dtype = torch.uint8,
                 directory: Path | None = None, device: torch.device | str = 'cpu'):
        if capacity < 2 or num_envs < 1:
            raise UserError('a replay memory keeps at least two steps of one environment',
                            (capacity, num_envs), 'make it larger')
        if directory is not None and torch.device(device).type != 'cpu':
            raise UserError('a memory-mapped replay lives on the CPU', str(device),
                            'leave out the directory or the device')
        self.capacity, self.num_envs, self.size = capacity, num_envs, size
        self.goals, self.goal_segmentation = goals, goal_segmentation
        self.privileged, self.max_depth = tuple(privileged), max_depth
        self.label_type = label_type
        self.device = torch.device(device)
        self.resumed: str | None = None
        self.total = self.count = 0  # rows ever appended; readable ones, the newest of them
        self._steps: dict[int, tuple[Tensor, Tensor]] = {}
        layout = self._layout(capacity, num_envs, size, self.privileged, label_type)
        self._files = (None if directory is None
                       else RingFiles(Path(directory), self._header()))
        if self._files is None:
            self.rings = {name: torch.zeros(shape, dtype=dtype, device=self.device)
                          for name, (dtype, shape) in layout.items()}
        else:
            self.rings = self._files.open(layout)

    @staticmethod
    def _layout(capacity: int, num_envs: int, size: int, privileged: tuple[str, ...],
                label_type: torch.dtype = torch.uint8
                ) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """Type and shape of every ring."""
        for name in privileged:
            if name not in PICTURES:
                raise UserError(f'the replay memory keeps {" and ".join(PICTURES)}', name,
                                'leave it out')
        picture, row = (size, size), (capacity, num_envs)
        return {
            'serial': (torch.int64, (capacity,)),
            'image': (torch.uint8, (*row, *picture, 3)),  # as the convolutions read them
            **{name: (label_type if name == 'segmentation' else torch.uint8, (*row, *picture))
               for name in privileged},
            'age': (torch.int32, row),
            'goal_index': (torch.int32, row),
            'last_action': (torch.int16, row),
            'last_reward': (torch.float32, row),
            'action': (torch.int16, row),
            'reward': (torch.float32, row),
            **{name: (torch.bool, row) for name in ('starts', 'terminated', 'truncated', 'valid')},
        }

    @classmethod
    def bytes_needed(cls, capacity: int, num_envs: int, size: int,
                     privileged: tuple[str, ...] = PICTURES,
                     label_type: torch.dtype = torch.uint8) -> int:
        """Bytes of such a memory's rings, without making it."""
        return sum(math.prod(shape) * dtype.itemsize for dtype, shape in
                   cls._layout(capacity, num_envs, size, privileged, label_type).values())

    @property
    def nbytes(self) -> int:
        """Bytes of the rings; the goal tables are their owner's."""
        return sum(ring.nbytes for ring in self.rings.values())

    @property
    def steps(self) -> int:
        """Stored steps of all environments that can be drawn."""
        return sum(len(part) for part in self._stored_steps(1)) if self.count else 0

    def extend(self, rollout: Rollout) -> None:
        """Append the T steps of a rollout; its last observation comes with the next rollout.

        Raises:
            UserError: another number of environments, another goal table, a missing privileged
                picture, or more steps than the memory keeps.
        """
        steps, envs = rollout.action.shape
        seen = rollout.observation
        if envs != self.num_envs or steps > self.capacity:
            raise UserError(f'a rollout has {self.num_envs} environments and at most '
                            f'{self.capacity} steps', (steps, envs), 'make the memory larger')
        self._check_goals(seen.goals)
        for name in self.privileged:
            if name not in rollout.privileged:
                raise UserError(f'rollouts bring {name}', sorted(rollout.privileged),
                                'let the environment give it, or do not keep it')
        rows = {
            'image': seen.image.permute(0, 1, 3, 4, 2),
            **{name: rollout.privileged[name] for name in self.privileged},
            'goal_index': seen.goal_index, 'last_action': seen.last_action,
            'last_reward': seen.last_reward, 'starts': rollout.starts,
            'action': rollout.action, 'reward': rollout.reward, 'valid': rollout.valid,
            'terminated': rollout.terminated, 'truncated': rollout.truncated,
            'age': self._ages(rollout.starts[:steps]),
        }
        if 'segmentation' in rows and rows['segmentation'].dtype != self.label_type:
            raise UserError(f'segmentations of this memory are {self.label_type}',
                            rows['segmentation'].dtype, 'make one for such labels (label_type)')
        if 'depth' in rows:
            rows['depth'] = encode_depth(rows['depth'][:steps], self.max_depth)
        if not self.total:
            self._take_over()
        serial = torch.arange(self.total, self.total + steps, device=self.device)
        # The serial last: a process killed in between leaves rows that nobody trusts.
        self._write('serial', torch.full_like(serial, -1))
        for name, part in rows.items():
            self._write(name, part[:steps])
        self._write('serial', serial)
        self.total += steps
        self.count = min(self.count + steps, self.capacity)
        self._steps.clear()

    def _check_goals(self, goals: Tensor | None) -> None:
        if goals is None and self.goals is None:
            return
        if goals is None or self.goals is None or goals.shape != self.goals.shape or not (
                goals.data_ptr() == self.goals.data_ptr()
                or torch.equal(goals, self.goals.to(goals.device))):
            raise UserError("rollouts point into the memory's own table of goals",
                            None if goals is None else tuple(goals.shape),
                            'make a memory for each table')

    def _ages(self, starts: Tensor) -> Tensor:
        """Place in the episode [T,N] of rows that follow the newest one."""
        starts = starts.to(self.device)
        t = torch.arange(len(starts), device=self.device)[:, None]
        began = torch.where(starts, t, -1).cummax(0).values
        before = (self.rings['age'][(self.total - 1) % self.capacity].long() if self.count
                  else torch.full_like(t[0], -1))
        return torch.where(began >= 0, t - began, before + 1 + t)

    def _write(self, name: str, rows: Tensor) -> None:
        ring, at = self.rings[name], self.total % self.capacity
        head = min(len(rows), self.capacity - at)
        ring[at:at + head].copy_(rows[:head])
        ring[:len(rows) - head].copy_(rows[head:])

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

    def _position(self, row: Tensor) -> Tensor:
        """Where rows counted from the oldest lie in the rings."""
        return (self.total - self.count + row) % self.capacity

    def _read(self, name: str, row: Tensor, env: Tensor) -> Tensor:
        """Values at rows counted from the oldest; the newest row stands for those after it."""
        place = self._position(row.clamp(max=self.count - 1)) * self.num_envs + env
        ring = self.rings[name].flatten(0, 1)
        return ring.index_select(0, place.flatten()).view(*place.shape, *ring.shape[1:])

    def _observations(self, rows: Tensor, env: Tensor) -> Observation:
        return Observation(
            self._read('image', rows, env).permute(0, 1, 4, 2, 3), self.goals,
            self._read('goal_index', rows, env).long(),
            self._read('last_action', rows, env).long(), self._read('last_reward', rows, env))

    # Files, and resuming from them.

    def state_dict(self) -> dict:
        """Where the memory stands; the steps themselves stay in the files."""
        return {'total': self.total, 'count': self.count, 'identity': self.identity}

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken, from the files, or empty where there are none.

        Rows written after that moment, and all before such a row, are not trusted: the present
        training writes other ones.

        Raises:
            UserError: the files belong to another training.
        """
        self._steps.clear()
        self.total = self.count = 0
        self.resumed = 'refilled'
        if not self.identity or not state['total']:
            return
        if self._files is not None and state['identity'] != self.identity:
            raise UserError('a training goes on with its own replay files',
                            f'files of {self.identity} in {self._files.directory}',
                            'remove that folder: the memory is then filled anew')
        newest_first = torch.arange(state['total'] - 1, state['total'] - 1 - state['count'], -1)
        kept = self.rings['serial'][newest_first % self.capacity] == newest_first
        count = int(kept.long().cumprod(0).sum())
        if count:
            self.total, self.count, self.resumed = state['total'], count, 'mapped'

    @property
    def identity(self) -> str:
        """Of the training that the rings belong to; empty: they are in no files."""
        return '' if self._files is None else self._files.identity

    def flush(self) -> None:
        """Write the mapped files to the disk."""
        if self._files is not None:
            self._files.flush()

    def _header(self) -> dict:
        digest = hashlib.sha256()
        for table in (self.goals, self.goal_segmentation):
            if table is not None:
                digest.update(table.cpu().numpy().tobytes())
        return {'layout': LAYOUT, 'capacity': self.capacity, 'num_envs': self.num_envs,
                'size': self.size, 'privileged': list(self.privileged),
                'max_depth': self.max_depth, 'goals': digest.hexdigest(),
                # Files of before there was a choice know no such key.
                **({} if self.label_type == torch.uint8 else {'labels': str(self.label_type)})}

    def _take_over(self) -> None:
        self.rings['serial'].fill_(-1)
        if self._files is not None:
            self._files.take_over()
