"""Recorded drives beside rollouts: what every step of the optimiser learns from bags as well."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.learning.hindsight import Drives, draw_windows, partners, rows_of
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.pretraining import PretrainConfig, choose_parts
from vn_nav.learning.rollout import Rollout
from vn_nav.learning.supervised import NEEDS, Batch, Objective, Tally
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import IMAGE_HEADS

WINDOW, FARTHEST = PretrainConfig().window, PretrainConfig().farthest  # steps, as there
PAIRS, WINDOWS = 0, 1  # streams of random numbers


class BagMix:
    """Draws batches from drives and computes their losses, weighted by `TrainConfig.bag_...`.

    All episodes are learned from, each step once an epoch as a pair and once in a window, in an
    order that is a function of seed and epoch: where it stands is all there is to save.

    Args:
        drives: the bags.
        config: its fields `bag_...`, `imitation_until` and `seed` count.

    Attributes:
        parts: of `supervised.PARTS` that are learned.
        words: what is not, and why.

    Raises:
        UserError: a frozen encoder, or nothing to learn.
    """

    def __init__(self, drives: Drives, config: TrainConfig):
        if config.architecture == 'icra2017':
            raise UserError('an encoder that learns is taught by bags',
                            'the architecture icra2017, whose encoder is frozen',
                            'choose another --preset, or leave out --bags')
        self.drives, self.config = drives, config
        self._imitation = config.bag_imitation  # its weight at present
        asked = [name for name in (*NEEDS, 'goal_pose', 'arrival', 'distance')
                 if self._weight(name) > 0]
        # Arrival and distance are learned along the actions, whether or not these are imitated.
        parts, self.words = choose_parts(drives, asked, (), None)
        self.parts = tuple(part for part in parts if self._weight(part) > 0)
        if not self.parts:
            raise UserError('bags beside rollouts teach something', 'weights of 0',
                            'give one of the numbers bag_... a weight, or leave out --bags')
        self._tally = Tally()

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads that the network needs."""
        return tuple(part for part in self.parts if part != 'cloning')

    @property
    def label_names(self) -> tuple[str, ...]:
        """Behind the classes of labels that are learned; empty: there are none, or unknown."""
        return self.drives.label_names if self._segments else ()

    @property
    def classes(self) -> int:
        """Of the labels that are learned; 0: there are none."""
        return self.drives.classes if self._segments else 0

    @property
    def _segments(self) -> bool:
        return any(NEEDS.get(part) == 'labels' for part in self.parts)

    def leave_out(self, names: Sequence[str]) -> list[str]:
        """Teach no more than the other parts; those of the names that would have been taught.

        Raises:
            UserError: nothing is left.
        """
        gone = [part for part in self.parts if part in names]
        self.parts = tuple(part for part in self.parts if part not in names)
        if not self.parts:
            raise UserError('bags beside rollouts teach something', f'only {", ".join(gone)}, '
                            'whose classes of labels are others here', 'leave out --bags')
        return gone

    @property
    def columns(self) -> tuple[str, ...]:
        """The keys of `figures`."""
        return ('bag_loss', *(f'bag_{part}_loss' for part in self.parts),
                *(('bag_action_accuracy',) if 'cloning' in self.parts else ()))

    @property
    def identity(self) -> str:
        """Of bags, parts and share: what must not change between save and resumption."""
        digest = hashlib.sha256(repr((self.parts, self.config.bag_share)).encode())
        digest.update(self.drives.pose.tobytes() + self.drives.action.tobytes())
        return digest.hexdigest()[:16]

    def attach(self, network: Policy, rank: int = 0) -> None:
        """Learn with this network; processes of other ranks draw other batches."""
        self._objective = Objective(network, self.drives, self.parts, WINDOW)
        seed = (self.config.seed, rank)
        self._pairs = _Endless(self._epoch_of_pairs, (*seed, PAIRS))
        self._windows = _Endless(self._epoch_of_windows, (*seed, WINDOWS))

    def begin_update(self, progress: float) -> None:
        """Forget the figures of the update before; `progress`: share of the training, for weights.

        As a teacher's actions do, those of the bags count less and less: reinforcement has the
        last word.
        """
        self._imitation = self.config.bag_imitation * max(
            1 - progress / self.config.imitation_until, 0.0)
        self._tally = Tally()

    def loss(self, batch: Rollout) -> Tensor:
        """Weighted losses of the next batch, as large as the share of this one says."""
        count = max(round(self.config.bag_share * batch.action.numel()), 1)
        rows = goals = windows = None
        if self._objective.paired:
            rows, goals = self._pairs.take(count).T
        if self._objective.windowed:
            windows = self._windows.take(max(count // WINDOW, 1))
        losses = self._objective.losses(Batch(rows, goals, windows), self._tally)
        return sum((self._weight(part) * value for part, value in losses.items()),
                   torch.zeros((), device=batch.action.device))

    def figures(self) -> dict[str, float]:
        """Mean losses since `begin_update`; see `columns`."""
        said = self._tally.figures(self._weight)
        return {name: said.get(name.removeprefix('bag_'), float('nan')) for name in self.columns}

    def state_dict(self) -> dict:
        """Plain values."""
        return {'pairs': self._pairs.state, 'windows': self._windows.state}

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken."""
        self._pairs.state, self._windows.state = state['pairs'], state['windows']

    def _weight(self, part: str) -> float:
        if part == 'cloning':
            return self._imitation
        if part in IMAGE_HEADS:
            return self.config.bag_image
        return getattr(self.config, f'bag_{part}')

    def _epoch_of_pairs(self, rng: np.random.Generator) -> np.ndarray:
        spans = self.drives.episodes
        return rng.permutation(np.stack([rows_of(spans), partners(spans, rng)], axis=1))

    def _epoch_of_windows(self, rng: np.random.Generator) -> np.ndarray:
        return rng.permutation(
            draw_windows(self.drives, self.drives.episodes, WINDOW, FARTHEST, rng))


class _Endless:
    """Rows of one epoch after the other.

    Args:
        epoch: makes the rows of an epoch [K,...], K at least 1, with a generator of its own.
        seed: of the generators, beside the number of the epoch.
    """

    def __init__(self, epoch: Callable[[np.random.Generator], np.ndarray], seed: tuple[int, ...]):
        self._make, self._seed = epoch, seed
        self.state = [0, 0]

    @property
    def state(self) -> list[int]:
        """Epoch, and rows that were taken of it."""
        return [self._epoch, self._taken]

    @state.setter
    def state(self, state: list[int]) -> None:
        self._epoch, self._taken = state
        self._rows: np.ndarray | None = None  # drawn when they are needed

    def take(self, count: int) -> np.ndarray:
        """The next rows."""
        found = []
        while count:
            if self._rows is None:
                self._rows = self._make(np.random.default_rng((*self._seed, self._epoch)))
            part = self._rows[self._taken:self._taken + count]
            found.append(part)
            count -= len(part)
            self._taken += len(part)
            if self._taken == len(self._rows):
                self.state = [self._epoch + 1, 0]
        return np.concatenate(found)
