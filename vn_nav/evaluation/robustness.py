"""How a policy bears what it was not trained with: one factor at a time, the same episodes each.

A `Level` is what differs from the usual, which is the training. The usual is measured once and
stands in the curve of every factor. Who makes the environments (`vn_nav robustness`) turns a level
into one; what every simulator can bear is done here: pictures that come late (`LateEnv`).
"""

from __future__ import annotations

import dataclasses
import datetime
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import ARRIVAL, DECLARED
from vn_nav.evaluation.kept import conditions_of, finished, keep
from vn_nav.evaluation.measurement import EvaluateConfig, measure_checkpoint
from vn_nav.evaluation.metrics import Episode, bootstrap_interval, summarise
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.robot import RobotSpec

USUAL = 'usual'  # name of the level that differs in nothing
HELD = 0.1  # of the usual success may be lost where a level counts as held
HEIGHTS_M, FOVS_DEG = (0.4, 0.7, 1.0, 1.4), (60.0, 70.0, 90.0, 110.0)
SAME = 0.01  # share by which two cameras may differ and be one
# What is as old as the picture; the last action is what the policy itself did last.
SENSED = ('image', 'odometry', 'scan', 'features')


@dataclasses.dataclass(frozen=True)
class Level:
    """What differs from the usual; the defaults differ in nothing."""

    motion_noise: float | None = None  # times the standard deviations of a good base
    light: float = 1.0  # times its spread, in the robot's pictures and in the goals'
    exposure: float = 0.0  # stops added to the robot's pictures alone
    camera_height: float | None = None  # m; the goal pictures are of the same camera
    camera_fov_deg: float | None = None  # the same
    blur: float | None = None  # motion blur of the robot's pictures alone, a share of their width
    latency: int = 0  # decisions that pictures and odometry are old
    odometry: str | None = None  # true, drift, commanded or none
    drift: float = 1.0  # of odometry that drifts, times that of a good indoor base


@dataclasses.dataclass(frozen=True)
class Step:
    """A level of a factor: in names of files, and for people."""

    name: str
    label: str
    level: Level

    @property
    def usual(self) -> bool:
        """Whether it is what the policy was trained with."""
        return self.level == Level()


@dataclasses.dataclass(frozen=True)
class Factor:
    """What is changed alone."""

    title: str
    unit: str  # of the labels, below the chart
    about: str  # how it is changed; sentences
    steps: tuple[Step, ...]
    apart: int = 0  # so many last steps are of another kind, and no further along the scale


def _scale(values: Sequence[float], field: str, usual: float, form: str = '{:g}'
           ) -> tuple[Step, ...]:
    """Steps of a number; `usual` is the one that differs in nothing."""
    def level(value: float) -> Level:
        change: dict[str, Any] = {} if value == usual else {field: value}
        return Level(**change)
    return tuple(Step(f'{value:g}', form.format(value), level(value)) for value in values)


def _camera(values: Sequence[float], field: str, usual: float) -> tuple[Step, ...]:
    others = [value for value in values if abs(value - usual) > SAME * usual]
    return _scale(sorted([*others, usual]), field, usual, '{:.3g}')


def factors(camera_height: float, camera_fov_deg: float, *, odometry: bool,
            motion_noise: bool = True) -> dict[str, Factor]:
    """All factors by name.

    Args:
        camera_height, camera_fov_deg: of the usual camera [m, deg].
        odometry: the policy uses some.
        motion_noise: it was trained with some.
    """
    own = 'Goal pictures are taken with the same camera.'
    found = {
        'motion_noise': Factor(
            'Motion noise', 'times the standard deviations',
            'Those of every move (0.02 m) and turn (2 deg).',
            _scale((0, 1, 2, 4), 'motion_noise', 1 if motion_noise else 0, '{:g} x')),
        'light': Factor(
            'Light', 'times the usual spread',
            'Ranges of daylight, sun, lamps, colours, exposure and white balance about their '
            'middles. Goal pictures and the robot draw their light independently.',
            _scale((0, 1, 2, 3), 'light', 1, '{:g} x')),
        'exposure': Factor(
            'Exposure', 'stops added',
            "Of the robot's pictures alone: goal pictures are exposed as usual.",
            _scale((-2, -1, 0, 1, 2), 'exposure', 0)),
        'camera_height': Factor(
            'Camera height', 'm above the floor', own,
            _camera(HEIGHTS_M, 'camera_height', camera_height)),
        'field_of_view': Factor(
            'Field of view', 'deg', own,
            _camera(FOVS_DEG, 'camera_fov_deg', camera_fov_deg)),
        'blur': Factor(
            'Motion blur', 'of the width of the picture',
            "A horizontal box filter, before the sensor's noise, in the robot's pictures alone: "
            'goal pictures are as usual.',
            (Step(USUAL, USUAL, Level()),
             *_scale((0.05, 0.1, 0.2), 'blur', -1, '{:.0%}'))),
        'latency': Factor(
            'Latency', 'decisions',
            'Pictures and odometry are so old; the last action is not. At the start of an episode '
            'its first picture stands for older ones.',
            _scale((0, 1, 2, 3), 'latency', 0)),
    }
    if odometry:
        found['odometry'] = Factor(
            'Odometry', 'times the usual drift, or of another kind',
            'True is what really happened, drift 1 that of a good indoor base with a gyro; '
            'commanded adds up the moves that were asked for, as far as nothing stood in the way.',
            (Step('true', 'true', Level(odometry='true')),
             *_scale((1, 2, 4), 'drift', 1, '{:g} x'),
             Step('commanded', 'commanded', Level(odometry='commanded')),
             Step('none', 'none', Level(odometry='none'))), apart=2)
    return found


class LateEnv:
    """A vector environment whose robots sense late; everything else is the environment's.

    Args:
        env: a `MeasuredVectorEnv`.
        decisions: that `SENSED` is old, at least 1. An episode's first observation stands for
            those before it.
    """

    def __init__(self, env: Any, decisions: int):
        self.env = env
        self._decisions = decisions
        self._past: deque[dict] = deque(maxlen=decisions + 1)  # oldest first

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **options) -> tuple[dict, dict]:
        """See `NavigationVectorEnv`."""
        observation, info = self.env.reset(**options)
        return self._late(observation, info['reset']), info

    def step(self, actions: np.ndarray) -> tuple[dict, Any, Any, Any, dict]:
        """See `NavigationVectorEnv`."""
        observation, *outcome, info = self.env.step(actions)
        return (self._late(observation, info['reset']), *outcome, info)

    def _late(self, observation: dict, begins: np.ndarray) -> dict:
        now = {name: observation[name] for name in SENSED if name in observation}
        while len(self._past) < self._decisions:
            self._past.append({name: part.copy() for name, part in now.items()})
        self._past.append({name: part.copy() for name, part in now.items()})
        for past in self._past:
            for name, part in now.items():
                past[name][begins] = part[begins]
        return {**observation, **{name: part.copy() for name, part in self._past[0].items()}}


@dataclasses.dataclass(frozen=True)
class RobustnessConfig:
    """How every level is measured: the same episodes, from the same starts.

    Raises:
        UserError: values outside their range.
    """

    split: str = 'validation'
    houses: int = 20  # of the split
    episodes: int = 60  # of a level, at least; the same number in each house
    seed: int = 10_000  # of the episodes
    max_decisions: int = 300
    randomisation: str | None = None  # usual; None: that of the training
    stop_threshold: float | None = None  # None: the checkpoint's
    robot: RobotSpec | None = None  # the usual one; None: the scenes' own

    def __post_init__(self):
        rules = ((self.houses >= 1, 'a split has at least one scene', self.houses, '--houses'),
                 (self.max_decisions >= 1, 'an episode has at least one decision',
                  self.max_decisions, '--max-decisions'))
        for kept, rule, received, option in rules:
            if not kept:
                raise UserError(rule, received, f'raise {option}')
        self.evaluation(ARRIVAL)  # whose rules hold too

    def evaluation(self, stop: str) -> EvaluateConfig:
        """For `measure_checkpoint`: the policy alone, under one kind of stop."""
        return EvaluateConfig(episodes=self.episodes, seed=self.seed, controls=(), stops=(stop,),
                              stop_threshold=self.stop_threshold, robot=self.robot)


@dataclasses.dataclass(frozen=True)
class Measured:
    """What was found of a step; figures as of `summarise`."""

    step: Step
    figures: dict
    successes: tuple[bool, ...]  # episode by episode, in the order of the usual ones

    @classmethod
    def of(cls, step: Step, entry: dict) -> Measured:
        """Of what was kept."""
        return cls(step, entry['figures'], tuple(entry['successes']))


@dataclasses.dataclass
class Robustness:
    """Curves, as far as they are measured.

    Attributes:
        stop: what ended the episodes, 'declared' or 'arrival'.
        curves: by factor, in the order of its steps.
        refused: what cannot be measured, in words.
        usual: in none of `curves` where no factor is; None: not measured yet.
    """

    stop: str
    factors: dict[str, Factor]
    curves: dict[str, list[Measured]]
    refused: list[str]
    usual: Measured | None = None


def own_stop(checkpoint: LoadedCheckpoint) -> str:
    """What ends the episodes: the policy's own declaration, where it can declare; else arrival."""
    can = checkpoint.network.config.declares and checkpoint.info['task'] == 'image'
    return DECLARED if can else ARRIVAL


def measure_level(checkpoint: LoadedCheckpoint, level: Level, scenes: Sequence[str],
                  make_env: Callable, config: RobustnessConfig) -> list[Episode]:
    """Episodes at one level.

    Args:
        checkpoint: the policy.
        level: what differs.
        scenes: names.
        make_env: (level, scenes, environments, stop) -> vector environment, whose latency is not
            its matter.
        config: numbers.

    Raises:
        UserError: policy or simulator cannot be measured so.
    """
    stop = own_stop(checkpoint)

    def make(names: Sequence[str], environments: int, stop: str):
        env = make_env(level, names, environments, stop)
        return LateEnv(env, level.latency) if level.latency else env
    rows = measure_checkpoint(checkpoint, scenes, make, config.evaluation(stop))
    (episodes,) = rows[stop].values()
    return episodes


def measure_robustness(checkpoint: LoadedCheckpoint, chosen: dict[str, Factor],
                       scenes: Sequence[str], make_env: Callable, config: RobustnessConfig,
                       folder: Path, *, name: str = '', machine: str = '',
                       on_level: Callable[[str, dict, Robustness], None] = lambda *_: None,
                       say: Callable[[str], None] = print) -> Robustness:
    """The curves of some factors; levels that `folder` has are not measured again.

    Args:
        checkpoint, scenes, make_env, config: see `measure_level`.
        chosen: of `factors`.
        folder: for a JSON file a level; exists.
        name: of the checkpoint, machine: kept with the figures.
        on_level: called with a level's name, its figures and all that there is, as soon as it is
            measured.
        say: is told what cannot be measured.
    """
    stop = own_stop(checkpoint)
    common = conditions_of(
        checkpoint, split=config.split, houses=config.houses, episodes=config.episodes,
        seed=config.seed, max_decisions=config.max_decisions, stops=(stop,),
        stop_threshold=config.stop_threshold)
    common |= {'randomisation': config.randomisation or checkpoint.info['randomisation'],
               'motion_noise': checkpoint.info['motion_noise'], 'scenes': list(scenes),
               'robot': None if config.robot is None else repr(config.robot)}
    found = Robustness(stop, chosen, {factor: [] for factor in chosen}, [])
    steps: list[tuple[str | None, Step]] = [(None, Step(USUAL, USUAL, Level()))]
    steps += [(factor, step) for factor, own in chosen.items() for step in own.steps]
    for factor, step in steps:
        key = USUAL if factor is None else f'{factor}_{step.name}'
        if step.usual and factor is not None:
            if found.usual is not None:
                found.curves[factor].append(dataclasses.replace(found.usual, step=step))
            continue
        path = folder / f'{key}.json'
        wanted = common | {'level': dataclasses.asdict(step.level)}
        entry, new = finished(path, wanted), False
        if entry is None:
            begun = time.monotonic()
            try:
                episodes = measure_level(checkpoint, step.level, scenes, make_env, config)
            except UserError as error:
                if factor is None:  # nothing could be compared with the usual
                    raise
                found.refused.append(f'{factor}, {step.label}: {error.rule}; {error.received}')
                say(f'{key}: {error}')
                continue
            entry, new = {
                'checkpoint': name, 'factor': factor, 'label': step.label, 'conditions': wanted,
                'figures': summarise(episodes), 'successes': [e.success for e in episodes],
                'minutes': round((time.monotonic() - begun) / 60, 1), 'machine': machine,
                'date': datetime.date.today().isoformat()}, True
            keep(path, entry)
        measured = Measured.of(step, entry)
        if factor is None:
            found.usual = measured
        else:
            found.curves[factor].append(measured)
        if new:
            on_level(key, measured.figures, found)
    return found


def change(measured: Measured, usual: Measured) -> tuple[float, float, float]:
    """By how much success differs from the usual, and the paired 95 % interval of that."""
    differences = (np.array(measured.successes, float) - np.array(usual.successes, float))
    return (float(differences.mean()), *bootstrap_interval(differences))


def held(measured: Measured, usual: Measured) -> bool:
    """Whether success is no more than `HELD` below the usual."""
    return change(measured, usual)[0] >= -HELD - 1e-9
