"""Supervised pre-training on recorded drives: image heads, goal poses, and the actions driven.

The thesis pre-trains the heads for depth and segmentations on a set of observations (sections 4.4
and 5.3: Adam, 30 epochs). Here every drive also gives picture pairs with the goal's pose, and the
actions to imitate towards pictures taken later on (`vn_nav.learning.hindsight`).
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.learning.hindsight import Drives, Split, draw_windows, partners, rows_of
from vn_nav.learning.log import METRICS
from vn_nav.learning.pretrain_config import PretrainConfig
from vn_nav.learning.state_file import own_folder, read_state, remove_partial, write_state, written
from vn_nav.learning.supervised import FIGURES, PARTS, Batch, Objective, Tally
from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.network import Policy

STATE, CHECKPOINT = 'pretrain_state', 'checkpoint'
# frames, minutes, tau and success are what `vn_nav compare` asks for; no episode is driven here.
COLUMNS = ('frames', 'minutes', 'tau', 'success', 'epoch',
           *(f'{where}{name}' for where in ('', 'validation_')
             for name in ('loss', *(f'{part}_loss' for part in PARTS), *FIGURES)),
           *(f'baseline_{name}' for name in FIGURES))
MAX_VALIDATION_STEPS = 1024  # pairs, and steps of windows, of a validation
VALIDATION_BATCH = 64  # pairs
BASELINE_STREAM = 1_000_003  # of the random numbers that draw pairs for the baseline


def pretrain_network(network: Policy, drives: Drives, parts: Sequence[str], split: Split,
                     folder: Path, config: PretrainConfig, *, info: dict, resume: bool = False,
                     on_epoch: Callable[[dict], None] | None = None) -> Path:
    """Train a network on drives, and keep the weights of the epoch that does best on the others.

    Repeats itself bit for bit when it was interrupted and resumed (one thread).

    Args:
        network: with a head for each of the parts; changed in place.
        drives: the bags.
        parts: some of `PARTS`, see `choose_parts`.
        split: which episodes are for what.
        folder: gets `checkpoint/`, `pretrain_state` (at least every `save_seconds`) and
            `metrics.csv`.
        config: numbers.
        info: what the checkpoint shall say, see `vn_nav.policy.checkpoint.INFO`.
        resume: go on from the folder's last save.
        on_epoch: called with each row of the metrics; the first one is of the untrained network.

    Returns:
        The folder of the checkpoint.

    Raises:
        UserError: a folder or resumption that does not fit, a loss that is not finite, or a full
            disk.
    """
    with own_folder(Path(folder)):
        return _Pretraining(network, drives, parts, split, folder, config, info).run(
            resume, on_epoch)


class _Pretraining:
    """Everything that changes, and its save file."""

    def __init__(self, network, drives, parts, split, folder, config, info):
        self.network, self.drives, self.config, self.info = network, drives, config, info
        self.split, self.folder = split, Path(folder)
        self.objective = Objective(network, drives, parts, config.window)
        self.parameters = [part for part in network.parameters() if part.requires_grad]
        self.optimiser = torch.optim.Adam(self.parameters, config.learning_rate)
        self.rows = rows_of(split.train)
        self.steps = -(-len(self.rows) // config.batch)  # of an epoch
        self.epoch = self.step = 0
        self.seconds = 0.0
        self.metrics: list[dict] = []  # a row an epoch, before the first one too
        self.best: dict = {'loss': math.inf, 'epoch': 0, 'weights': None}
        self.tally = Tally()  # of the present epoch
        rng = np.random.default_rng((config.seed, BASELINE_STREAM))
        some = np.sort(rng.permutation(len(self.rows))[:MAX_VALIDATION_STEPS])
        self.guess = self.objective.guess(self.rows[some], partners(split.train, rng)[some],
                                          drives.action[self.rows])

    def run(self, resume: bool, on_epoch) -> Path:
        self._begin(resume)
        clock = saved = time.monotonic()

        def lap() -> None:
            nonlocal clock
            now = time.monotonic()
            self.seconds, clock = self.seconds + now - clock, now

        if not self.metrics:
            self._report(on_epoch)
        while self.epoch < self.config.epochs:
            for batch in list(self._epoch())[self.step:]:
                self._learn(batch)
                self.step += 1
                if time.monotonic() - saved >= self.config.save_seconds:
                    lap()
                    self._save()
                    saved = time.monotonic()
            self.epoch, self.step = self.epoch + 1, 0
            lap()
            self._report(on_epoch)
        self._save()
        self._write_best()
        return self.folder / CHECKPOINT

    def _epoch(self) -> Iterator[Batch]:
        """The batches of the present epoch, a function of the seed and its number."""
        config, train = self.config, self.split.train
        rng = np.random.default_rng((config.seed, self.epoch))
        order = rng.permutation(len(self.rows))
        goals = partners(train, rng)
        windows = np.zeros((0, 3), np.int64)
        if self.objective.windowed:
            windows = rng.permutation(
                draw_windows(self.drives, train, config.window, config.farthest, rng))
        for chosen, some in zip(np.array_split(order, self.steps),
                                np.array_split(windows, self.steps), strict=True):
            paired = self.objective.paired
            yield Batch(self.rows[chosen] if paired else None, goals[chosen] if paired else None,
                        some if len(some) else None)

    def _learn(self, batch: Batch) -> None:
        if batch.rows is None and batch.windows is None:
            return
        config = self.config
        done = (self.epoch * self.steps + self.step) / (config.epochs * self.steps)
        for group in self.optimiser.param_groups:
            group['lr'] = config.learning_rate * (1 - 0.95 * done)
        losses = self.objective.losses(batch, self.tally)
        loss = sum(config.weight(name) * value for name, value in losses.items())
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, config.max_gradient_norm)
        if not torch.isfinite(loss + norm):
            raise UserError('losses and gradients stay finite', ', '.join(
                f'{name} {value.item():g}' for name, value in losses.items()),
                'lower --learning-rate and resume')
        self.optimiser.step()

    @torch.no_grad()
    def _judge(self) -> tuple[dict[str, float], dict[str, float]]:
        """Figures on the validation's episodes: the same pairs and windows every time.

        And those of the best guess on the same ones.
        """
        config, spans = self.config, self.split.validation
        rng = np.random.default_rng(config.seed)
        rows, goals = rows_of(spans), partners(spans, rng)
        some = np.sort(rng.permutation(len(rows))[:MAX_VALIDATION_STEPS])
        tally = Tally()
        if self.objective.paired:
            for part in np.array_split(some, -(-len(some) // VALIDATION_BATCH)):
                self.objective.losses(Batch(rows[part], goals[part], None), tally)
        if self.objective.windowed:
            windows = rng.permutation(
                draw_windows(self.drives, spans, config.window, config.farthest, rng))
            windows = windows[:max(MAX_VALIDATION_STEPS // config.window, 1)]
            for first in range(0, len(windows), max(VALIDATION_BATCH // config.window, 1)):
                part = windows[first:first + max(VALIDATION_BATCH // config.window, 1)]
                self.objective.losses(Batch(None, None, part), tally)
        return tally.figures(config.weight), tally.baseline(self.guess)

    def _report(self, on_epoch) -> None:
        """End an epoch: judge, write the curves, keep the best weights."""
        judged, guessed = self._judge()
        row = dict.fromkeys(COLUMNS, math.nan) | {
            'frames': self.epoch * len(self.rows), 'minutes': self.seconds / 60, 'tau': 1.0,
            'epoch': self.epoch, **self.tally.figures(self.config.weight),
            **{f'validation_{name}': value for name, value in judged.items()},
            **{f'baseline_{name}': value for name, value in guessed.items()}}
        self.metrics.append(row)
        self.tally = Tally()
        if self.epoch and judged['loss'] < self.best['loss']:
            self.best = {'loss': judged['loss'], 'epoch': self.epoch, 'weights': {
                name: tensor.detach().cpu().clone()
                for name, tensor in self.network.state_dict().items()}}
            self._write_best()
        if on_epoch is not None:
            on_epoch(row)
        text = io.StringIO(newline='')
        writer = csv.DictWriter(text, COLUMNS)
        writer.writeheader()
        writer.writerows({name: f'{value:.6g}' if isinstance(value, float) else value
                          for name, value in row.items()} for row in self.metrics)
        with written(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_file(self.folder / METRICS, text.getvalue().encode())

    def _write_best(self) -> None:
        """The checkpoint of the best epoch so far."""
        if self.best['weights'] is None:
            raise UserError('a validation loss is finite', 'none of '
                            f'{self.config.epochs} epochs has one', 'look at the bags with '
                            '`vn_nav bag doctor`')
        network = Policy(self.network.config)
        network.load_state_dict(self.best['weights'])
        row = self.metrics[self.best['epoch']]
        judged, guessed = ({name.removeprefix(kind): value for name, value in row.items()
                            if name.startswith(kind) and math.isfinite(value)}
                           for kind in ('validation_', 'baseline_'))
        save_checkpoint(self.folder / CHECKPOINT, network, {
            **self.info, 'minutes': round(self.seconds / 60, 2), 'seed': self.config.seed,
            'losses': list(self.objective.parts),
            'results': {'pre-training, validation steps': judged,
                        'the same steps, a guess without pictures': guessed},
            'notes': f'Weights of epoch {self.best["epoch"]} of {self.config.epochs}, the best on '
                     f'the validation. {self.info.get("notes", "")}'.strip()})

    def _begin(self, resume: bool) -> None:
        path = self.folder / STATE
        if path.is_file() and not resume:
            raise UserError('a new pre-training has a folder of its own', str(self.folder),
                            'go on there with --resume, or choose another folder')
        if not path.is_file():
            if resume:
                raise UserError('a pre-training is resumed from its folder', str(path),
                                'start it without --resume, or name the folder of one')
            with written(self.folder):
                self.folder.mkdir(parents=True, exist_ok=True)
            self._save()  # from here on there is something to resume
            return
        remove_partial(self.folder)
        state = read_state(path)
        for name, value in self._identity().items():
            if state['identity'].get(name) != value:
                raise UserError(f'a pre-training is resumed with its own {name}: '
                                f'{state["identity"].get(name)}', value,
                                'use the same options and bags, or another folder')
        self.network.load_state_dict(state['network'])
        self.optimiser.load_state_dict(state['optimiser'])
        for name in ('epoch', 'step', 'seconds', 'metrics', 'best'):
            setattr(self, name, state[name])
        self.tally.load_state_dict(state['tally'])

    def _save(self) -> None:
        write_state(self.folder / STATE, {
            'identity': self._identity(), 'network': self.network.state_dict(),
            'optimiser': self.optimiser.state_dict(), 'tally': self.tally.state_dict(),
            **{name: getattr(self, name)
               for name in ('epoch', 'step', 'seconds', 'metrics', 'best')}})

    def _identity(self) -> dict:
        """What must not change between save and resumption."""
        network, numbers = (
            {name: repr(value) for name, value in dataclasses.asdict(part).items()}
            for part in (self.network.config, self.config))
        del numbers['save_seconds']
        digest = hashlib.sha256(self.drives.pose.tobytes() + self.drives.action.tobytes())
        return {'network': network, 'numbers': numbers, 'parts': list(self.objective.parts),
                'bags': digest.hexdigest()[:16]}
