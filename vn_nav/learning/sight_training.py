"""Supervised training of the networks of `search`, on picture pairs that somebody draws.

No environment is driven: a simulator, or a recorded place, says of every pair where the goal
stands, whether it is in view and reached, and of every view how far the place is free.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.learning.augmentation import augment
from vn_nav.learning.log import METRICS
from vn_nav.learning.sight_figures import FIGURES, Judged, figures, judge
from vn_nav.learning.sight_losses import WEIGHTS, losses
from vn_nav.learning.state_file import own_folder, read_state, remove_partial, write_state, written
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network_config import SEARCH
from vn_nav.policy.search.look import column_bearings
from vn_nav.policy.search.network import SearchPolicy

STATE, CHECKPOINT, PAGE = 'sight_state', 'checkpoint', 'sight.html'
# frames, minutes, tau and success are what `vn_nav compare` asks for; no episode is driven here.
COLUMNS = ('frames', 'minutes', 'tau', 'success', 'loss', *(f'{part}_loss' for part in WEIGHTS),
           *(f'validation_{name}' for name in FIGURES))
WARM_UP = 200  # steps in which the learning rate rises: weights that are good already stay so


class ViewSource(Protocol):
    """Draws pairs; `vn_sim_bridge.datasets.view_pairs.PairSampler` does."""

    count: int  # robots placed so far; may be set

    def draw_groups(self, count: int, robots: int, *, bearings: np.ndarray
                    ) -> dict[str, np.ndarray]:
        """Groups of views and their pairs, with `arrived` and `ranges`."""


@dataclasses.dataclass(frozen=True)
class SightConfig:
    """Numbers of the training. It ends with its pairs or its minutes, whichever come first."""

    pairs: int = 40_000_000
    minutes: float | None = None  # wall-clock, drawing included
    augment: bool = False  # pictures to learn from, see `vn_nav.learning.augmentation`
    groups: int = 64  # of a goal and a robot each, in a step: two pairs each
    learning_rate: float = 8e-4  # at the start
    final_learning_rate: float = 2e-5  # falls linearly to it
    max_gradient_norm: float = 2.0  # of each of the two networks
    report_every: int = 500  # steps
    validation_groups: int = 1024
    page_groups: int = 2560
    save_seconds: float = 30.0
    seed: int = 0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name not in ('seed', 'augment') and not (value is None or value > 0):
                raise UserError(f'{field.name} of a training of search is positive', value,
                                'correct it')


def train_sight(network: SearchPolicy, source: ViewSource, validation: ViewSource,
                folder: str | Path, config: SightConfig, *, info: dict, resume: bool = False,
                init: str | Path | None = None, say: Callable[[str], None] = print,
                on_step: Callable[[float], None] = lambda share: None,
                page: Callable[[list[dict], Judged], str] | None = None) -> Path:
    """Train the networks of `search`.

    Repeats itself bit for bit when it was interrupted and resumed (one thread, no wall-clock
    limit).

    Args:
        network: changed in place.
        source, validation: pairs to learn from, and others to judge by.
        folder: gets `checkpoint/` and `sight_state` (at least every `save_seconds`),
            `metrics.csv`, and at the end `sight.html`.
        config: numbers.
        info: what the checkpoint shall say, see `vn_nav.policy.checkpoint.INFO`.
        resume: go on from the folder's last save.
        init: a checkpoint to begin with, of search, or of matching with the head goal_pose.
        say: called with each line of progress.
        on_step: called between steps with the share that is done; a KeyboardInterrupt that it
            raises ends the training behind a save.
        page: makes the page at the end, of the rows of metrics and of pairs to judge by.

    Returns:
        The folder of the checkpoint.

    Raises:
        UserError: a folder, resumption or checkpoint that does not fit, a loss that is not finite,
            or a full disk; the last save stays as it is.
        KeyboardInterrupt: see on_step.
    """
    training = _Training(network, source, validation, Path(folder), config, info)
    with own_folder(training.folder):
        return training.run(resume, init, say, on_step, page)


class _Training:
    """Everything that changes, and its save file."""

    def __init__(self, network, source, validation, folder, config, info):
        self.network, self.source, self.validation = network, source, validation
        self.folder, self.config, self.info = folder, config, info
        self.bearings = column_bearings(network.config.view)
        self.parts = [[*network.encoder.parameters(), *network.recogniser.parameters()],
                      [*network.ranges.parameters()]]
        self.optimiser = torch.optim.Adam([p for part in self.parts for p in part],
                                          config.learning_rate)
        self.steps, self.seconds, self.begun_with = 0, 0.0, ''
        self.rows: list[dict[str, float]] = []
        self.sums = dict.fromkeys(WEIGHTS, 0.0)  # of the losses since the last report
        self.summed = 0
        self.clock = time.monotonic()

    @property
    def pairs(self) -> int:
        """Learned from so far; a group of two views is two pairs, one each way."""
        return self.steps * 2 * self.config.groups

    @property
    def share(self) -> float:
        """How much of the training is over."""
        config = self.config
        by_clock = self.seconds / 60 / config.minutes if config.minutes else 0.0
        return min(max(self.pairs / config.pairs, by_clock), 1.0)

    def run(self, resume: bool, init: str | Path | None, say, on_step, page) -> Path:
        self._begin(resume, init, say)
        self.validation.count = 0
        held_out = self._draw(self.validation, self.config.validation_groups)
        self.clock = saved = time.monotonic()
        if not self.rows:
            self._report(held_out, say)
            self._save()  # from here on there is something to resume
        while self.share < 1:
            batch = self._draw(self.source, self.config.groups)
            if self.config.augment:
                augment(batch['image'], np.random.default_rng((self.config.seed, self.steps)))
            self._learn(batch)
            self.steps += 1
            self._lap()
            if self.steps % self.config.report_every == 0:
                self._report(held_out, say)
            if time.monotonic() - saved >= self.config.save_seconds:
                self._save()
                saved = time.monotonic()
            try:
                on_step(self.share)
            except KeyboardInterrupt:
                self._save()
                raise
        if self.summed:
            self._report(held_out, say)
        self._save()
        if page is not None:
            others = self._draw(self.validation, self.config.page_groups)
            with written(self.folder):
                write_file(self.folder / PAGE,
                           page(self.rows, judge(self.network, others)).encode())
        return self.folder / CHECKPOINT

    def _draw(self, source: ViewSource, groups: int) -> dict[str, np.ndarray]:
        return source.draw_groups(groups, 1, bearings=self.bearings)

    def _learn(self, batch: dict[str, np.ndarray]) -> None:
        config = self.config
        rate = config.learning_rate + self.share * (
            config.final_learning_rate - config.learning_rate)
        for group in self.optimiser.param_groups:
            group['lr'] = rate * min((self.steps + 1) / WARM_UP, 1.0)
        found = losses(self.network, batch)
        loss = sum((WEIGHTS[name] * value for name, value in found.items()), torch.zeros(()))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norms = [torch.nn.utils.clip_grad_norm_(part, config.max_gradient_norm)
                 for part in self.parts]
        if not torch.isfinite(loss + sum(norms)):
            raise UserError('losses and gradients stay finite', ', '.join(
                f'{name} {value.item():g}' for name, value in found.items()),
                'lower --learning-rate and resume')
        self.optimiser.step()
        for name, value in found.items():
            self.sums[name] += value.item()
        self.summed += 1

    def _lap(self) -> None:
        now = time.monotonic()
        self.seconds, self.clock = self.seconds + now - self.clock, now

    def _report(self, held_out: dict[str, np.ndarray], say: Callable[[str], None]) -> None:
        """Judge, and write the curves."""
        judged = figures(judge(self.network, held_out))
        self._lap()
        means = {name: total / self.summed if self.summed else math.nan
                 for name, total in self.sums.items()}
        row = {'frames': self.pairs, 'minutes': self.seconds / 60, 'tau': 1.0,
               'success': math.nan, 'loss': sum(WEIGHTS[name] * mean
                                                for name, mean in means.items()),
               **{f'{name}_loss': mean for name, mean in means.items()},
               **{f'validation_{name}': value for name, value in judged.items()}}
        self.rows.append({name: row[name] for name in COLUMNS})
        self.sums, self.summed = dict.fromkeys(WEIGHTS, 0.0), 0
        say(_line(self.rows[-1], self.steps))
        text = io.StringIO(newline='')
        writer = csv.DictWriter(text, COLUMNS)
        writer.writeheader()
        writer.writerows({name: f'{value:.6g}' if isinstance(value, float) else value
                          for name, value in row.items()} for row in self.rows)
        with written(self.folder):
            write_file(self.folder / METRICS, text.getvalue().encode())

    def _begin(self, resume: bool, init: str | Path | None, say: Callable[[str], None]) -> None:
        path = self.folder / STATE
        if path.is_file() and not resume:
            raise UserError('a new training has a folder of its own', str(self.folder),
                            'go on there with --resume, or choose another folder')
        if not path.is_file():
            if resume:
                raise UserError('a training is resumed from its folder', str(path),
                                'start it without --resume, or name the folder of one')
            if init is not None:
                self.begun_with = str(init)
                for line in begin_with(self.network, init):
                    say(f'{init}: {line}')
            with written(self.folder):
                self.folder.mkdir(parents=True, exist_ok=True)
            return
        remove_partial(self.folder)
        state = read_state(path)
        for name, value in self._identity().items():
            if state['identity'].get(name) != value:
                raise UserError(f'a training is resumed with its own {name}: '
                                f'{state["identity"].get(name)}', value,
                                'use the same options, or another folder')
        self.network.load_state_dict(state['network'])
        self.optimiser.load_state_dict(state['optimiser'])
        self.source.count = state['count']
        for name in ('steps', 'seconds', 'begun_with', 'rows', 'sums', 'summed'):
            setattr(self, name, state[name])

    def _save(self) -> None:
        """The state to resume from, and the checkpoint of the present weights."""
        write_state(self.folder / STATE, {
            'identity': self._identity(), 'network': self.network.state_dict(),
            'optimiser': self.optimiser.state_dict(), 'count': self.source.count,
            **{name: getattr(self, name)
               for name in ('steps', 'seconds', 'begun_with', 'rows', 'sums', 'summed')}})
        measured = {name: {key.removeprefix('validation_'): value for key, value in row.items()
                           if key.startswith('validation_') and math.isfinite(value)}
                    for name, row in (('held-out pairs, before training', self.rows[0]),
                                      ('held-out pairs', self.rows[-1]))}
        begun = f'; begun with the weights of {self.begun_with}' if self.begun_with else ''
        save_checkpoint(self.folder / CHECKPOINT, self.network, {
            **self.info, 'minutes': round(self.seconds / 60, 2), 'seed': self.config.seed,
            'losses': list(WEIGHTS), 'results': measured,
            'data': f'{self.pairs:,} picture pairs{self.info.get("data", "")}{begun}'})

    def _identity(self) -> dict[str, Any]:
        """What must not change between save and resumption."""
        network, numbers = (
            {name: repr(value) for name, value in dataclasses.asdict(part).items()}
            for part in (self.network.config, self.config))
        for name in ('pairs', 'minutes', 'save_seconds', 'page_groups'):
            del numbers[name]
        return {'network': network, 'numbers': numbers,
                'scenes': list(self.info.get('scenes', ())),
                'randomisation': self.info.get('randomisation', '')}


@torch.no_grad()
def begin_with(network: SearchPolicy, source: str | Path) -> list[str]:
    """Give a network the weights of a checkpoint, and say what is new.

    Of search: all weights. Of matching with the head goal_pose: the encoder, and of the recogniser
    what says position, heading and co-visibility; residual blocks beyond those that it has begin
    as the identity.

    Raises:
        UserError: a checkpoint of another network.
    """
    given = load_checkpoint(source)
    own, config = network.config, given.config
    fits = (config.architecture == SEARCH
            or (config.architecture == 'matching' and 'goal_pose' in config.heads
                and config.blocks <= own.blocks and config.frames == 1))
    same = ('size', 'channels', 'features', 'pixel_mean', 'pixel_std')
    other = [name for name in same if getattr(own, name) != getattr(config, name)]
    if config.architecture == SEARCH and own.blocks != config.blocks:
        other.append('blocks')
    if not fits or other:
        raise UserError(
            'a training of search begins with a checkpoint of search, or of matching with the '
            'head goal_pose, of the same size, channels and features, and no more residual blocks',
            f'{source}: {config.architecture}, ' + ', '.join(
                f'{name} {getattr(config, name)}' for name in (*same[:3], 'blocks')),
            'choose another, or leave out --init')
    before = given.network.state_dict()
    if config.architecture == SEARCH:
        network.load_state_dict(before)
        return []
    network.encoder.load_state_dict({**network.encoder.state_dict(), **{
        name.removeprefix('encoder.'): tensor for name, tensor in before.items()
        if name.startswith('encoder.')}})
    recogniser = network.recogniser
    weight: Tensor = before['heads.goal_pose.hidden.weight']
    rows, said = weight.shape[0], before['heads.goal_pose.out.weight'].shape[0]
    recogniser.hidden.weight[:rows] = weight
    recogniser.hidden.bias[:rows] = before['heads.goal_pose.hidden.bias']
    recogniser.out.weight[:said] = 0
    recogniser.out.weight[:said, :rows] = before['heads.goal_pose.out.weight']
    recogniser.out.bias[:said] = before['heads.goal_pose.out.bias']
    return ['encoder, position, heading and co-visibility as in the checkpoint; deviations, '
            'arrival and ranges are new']


def _line(row: dict[str, float], steps: int) -> str:
    """A report in a line."""
    def said(name: str, form: str) -> str:
        return format(row[f'validation_{name}'], form)
    # Positions: far ones; a quarter to a half in view; more.
    return (f'{row["minutes"]:.1f} min · {steps:,} steps · loss {row["loss"]:.2f} '
            f'({said("loss", ".2f")}) · bearing {said("bearing_deg", ".1f")} (far '
            f'{said("far_bearing_deg", ".1f")}) deg · position {said("far_position_m", ".2f")} / '
            f'{said("position_m_quarter", ".2f")} / {said("position_m_half", ".2f")} m · heading '
            f'{said("heading_deg", ".1f")} deg · AUC in view {said("co_visible_auc", ".3f")}, '
            f'arrived {said("arrived_auc", ".3f")}, in the ring {said("arrived_ring_auc", ".3f")} '
            f'· ranges {said("range_error", ".1%")}, {said("range_within_fifth", ".0%")} within a '
            'fifth')
