"""Runs an experiment: files, trainings with several seeds, measurements; keeps what stays.

`OUT/NAME-SIZE/` gets the runs and `RESULTS/NAME-SIZE/` what stays of them: a folder for each run
with its thinned curve and its measurement, the chart, the table and the page. A run whose
measurement is among the results is not repeated, on any machine; one that was interrupted goes on.
A try with fewer frames has folders of its own, `NAME-SIZE-FRAMES`.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import json
import os
import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from vn_nav.errors import UserError
from vn_nav.experiments import jobs
from vn_nav.experiments.experiment import Experiment, arguments, filled, slug
from vn_nav.files import write_file
from vn_nav.report.curves import thin
from vn_nav.resources import share_file

EVALUATION = 'evaluation.json'
OPTIONS = 'options.json'  # in a run's folder: what it was begun with
SCENES = '{scenes}'  # in a command of `prepare`: --scene of all of them


@dataclasses.dataclass(frozen=True)
class Reproduction:
    """How an experiment is run.

    Attributes:
        experiment, size: which, and 'quick' or 'full'.
        out: folder of the runs.
        results: folder of what stays.
        seeds: of every arm.
        arms: that are run; empty: all.
        scenes: instead of the experiment's own, such as a user's copies of the original ones.
        frames: of a run instead of the size's, to try it.
        device: of the trainings, see `vn_nav train --device`.
        machine: what the measurements say they were made on.
    """

    experiment: Experiment
    size: str
    out: Path
    results: Path
    seeds: Sequence[int] = (0, 1, 2)
    arms: Sequence[str] = ()
    scenes: Sequence[str] = ()
    frames: int | None = None
    device: str = 'cpu'
    machine: str = ''

    def __post_init__(self):
        known = self.experiment.arms
        for arm in self.arms:
            if arm not in known:
                raise UserError(f'the arms of {self.experiment.name} are {", ".join(known)}', arm,
                                'choose among them')
        if len(set(self.seeds)) < len(self.seeds) or not self.seeds:
            raise UserError('there is at least one seed, each once', list(self.seeds),
                            'correct --seeds')

    @property
    def folder(self) -> str:
        """Of this experiment in `out` and `results`."""
        tried = '' if self.frames is None else f'-{self.frames}'
        return f'{self.experiment.name}-{self.size}{tried}'

    @property
    def kept(self) -> Path:
        """Folder of what stays."""
        return self.results / self.folder

    def options(self, arm: str) -> dict[str, object]:
        """Of `vn_nav train` for an arm, as JSON has them, with names in place of folders."""
        options = self.experiment.options(arm, self.size)
        if self.scenes:
            options['scene'] = list(self.scenes)
        if self.frames:
            options['frames'] = self.frames
        return json.loads(json.dumps(options))

    def _check(self, arm: str, options: object, folder: Path) -> None:
        """Whether what is there was run with the options of now.

        Args:
            options: it was run with; None: it does not say so.

        Raises:
            UserError: it was not.
        """
        wanted = self.options(arm)
        if options == wanted:
            return
        if not isinstance(options, dict):
            raise UserError('a run says what options it had', str(folder),
                            'remove it, or choose another folder')
        others = [f'{key}: {options.get(key)}, now {wanted.get(key)}'
                  for key in {**options, **wanted} if options.get(key) != wanted.get(key)]
        raise UserError('runs of an experiment have the same options',
                        f'{folder}: {"; ".join(others)}', 'remove it, or choose another folder')

    def _difficulty(self, arm: str) -> float:
        """Tau at the end of the trainings of an arm, from which it is measured."""
        from vn_nav.learning.presets import TrainConfig
        sets = self.options(arm).get('set', {})
        assert isinstance(sets, dict)
        begin, end = (float(sets.get(f'curriculum_{name}', 0.0)) for name in ('begin', 'end'))
        if begin < 1.0 or end <= begin:
            return 1.0
        return float(sets.get('start_difficulty', TrainConfig.start_difficulty))

    def run_name(self, arm: str, seed: int) -> str:
        """Of a run's folder."""
        return f'{slug(arm)}-seed{seed}'

    def run(self, cores: Sequence[int], say: Callable[[str], None]) -> None:
        """Do what is left to do.

        Raises:
            UserError: a command failed.
        """
        runs = [(arm, seed) for seed in self.seeds for arm in self.arms or self.experiment.arms]
        left = []
        for arm, seed in runs:
            kept = self.kept / self.run_name(arm, seed) / EVALUATION
            if kept.exists():
                self._check(arm, json.loads(kept.read_text()).get('options'), kept.parent)
            else:
                left.append((arm, seed))
        if not left:
            return
        self._prepare(cores, say)
        jobs.run([self._job(arm, seed) for arm, seed in left], cores, say)

    @functools.cached_property
    def values(self) -> dict[str, object]:
        """What stands for `{name}` in the experiment's texts."""
        size = {key: value for key, value in self.experiment.sizes[self.size].items()
                if not isinstance(value, (dict, list))}
        return {'files': (self.out / self.folder / 'files').resolve(),
                'share': share_file('config').parent, **size}

    def _scenes(self) -> list[str]:
        """The scenes as options."""
        own = {**self.experiment.train, **self.experiment.sizes[self.size]}
        return arguments({'scene': list(self.scenes) or own['scene']}, self.values)

    def _prepare(self, cores: Sequence[int], say: Callable[[str], None]) -> None:
        """Make the files that are not there, one after the other."""
        (self.out / self.folder / 'files').mkdir(parents=True, exist_ok=True)
        log = self.out / self.folder / 'prepare.log'
        for step in self.experiment.prepare:
            if step.size not in (None, self.size):
                continue
            target = Path(filled(step.makes, self.values))
            done = target.with_name(target.name + '.done')  # by which command
            command = [word for part in step.command.split()
                       for word in (self._scenes() if part == SCENES
                                    else [filled(part, self.values)])]
            text = shlex.join(command) + '\n'
            if done.exists() and done.read_text() == text:
                continue
            done.unlink(missing_ok=True)
            if target.is_dir():  # half of it, or by another command
                shutil.rmtree(target)
            jobs.run([jobs.Job(f'{self.folder}: {target.name}', [command], log,
                               functools.partial(done.write_text, text))], cores[:1], say)

    def train_command(self, arm: str, seed: int, resume: bool = False) -> list[str]:
        """`vn_nav train` of one run, from its beginning or with the run that is there."""
        options = self.options(arm)
        if self.device != 'cpu':
            options['device'] = self.device
        if resume:
            options.pop('init', None)  # it has its own weights
        folder = self.out / self.folder / self.run_name(arm, seed)
        return ['train', *arguments(options, self.values), '--threads', '1', '--seed', str(seed),
                '--no-tensorboard', '--out', str(folder), *(['--resume'] if resume else [])]

    def evaluate_command(self, arm: str, seed: int) -> list[str]:
        """`vn_nav evaluate` of one run; the controls are measured with the first of each arm."""
        folder = self.out / self.folder / self.run_name(arm, seed)
        options = {key: value for key, value in self.experiment.options(arm, self.size).items()
                   if key in ('robot', 'max_decisions')} | dict(self.experiment.evaluate)
        if (difficulty := self._difficulty(arm)) < 1.0:
            options['difficulty'] = difficulty
        controls = [] if seed == self.seeds[0] else ['--no-controls']
        return ['evaluate', str(folder / 'checkpoint'), '--stop', 'arrival',
                *arguments(options, self.values), *controls, '--json', str(folder / EVALUATION)]

    def _job(self, arm: str, seed: int) -> jobs.Job:
        """Training and measurement of one run."""
        from vn_nav.learning.training import STATE
        name = self.run_name(arm, seed)
        folder = self.out / self.folder / name
        if (folder / OPTIONS).exists():
            self._check(arm, json.loads((folder / OPTIONS).read_text()), folder)

        def begin() -> None:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / OPTIONS, (json.dumps(self.options(arm), indent=1) + '\n').encode())

        def keep() -> None:
            thin(folder, self.kept / name)
            found = json.loads((folder / EVALUATION).read_text())
            found |= {'arm': arm, 'seed': seed, 'evaluation_seed': found['seed'],
                      'machine': self.machine,
                      'options': self.options(arm), 'difficulty': self._difficulty(arm),
                      'date': datetime.date.today().isoformat(),
                      'command': ['vn_nav', *self.train_command(arm, seed)],
                      'evaluate_command': ['vn_nav', *self.evaluate_command(arm, seed)]}
            text = json.dumps(found, indent=1).replace(f'{Path.cwd()}{os.sep}', '')
            write_file(self.kept / name / EVALUATION, (text + '\n').encode())
        return jobs.Job(f'{self.folder}: {name}',
                        [self.train_command(arm, seed, resume=(folder / STATE).exists()),
                         self.evaluate_command(arm, seed)],
                        folder.with_suffix('.log'), keep, begin)
