"""`evaluate`: figures of a checkpoint in the environments of some splits."""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.checkpoint_info import DECODINGS
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import SEARCH
from vn_nav.policy.search.views import NONE, check_verify
from vn_nav.robot import RobotSpec


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """How a checkpoint is measured.

    Raises:
        UserError: values outside their range.
    """

    episodes: int = 100  # of a row at least; the same number in each scene
    seed: int = 10_000  # of environments and sampled actions
    decoding: str | None = None  # sample or greedy; None: as the checkpoint was measured
    controls: tuple[str, ...] = evaluator.CONTROLS  # on the same starts
    # Probability above which the arrival head declares a stop; None: the checkpoint's.
    stop_threshold: float | None = None
    robot: RobotSpec | None = None  # for durations; None: the scenes' own
    stops: tuple[str, ...] = evaluator.STOPS  # what ends the episodes
    policy: bool = True  # the policy itself drives to its goals; else the controls alone
    verify: str = NONE  # see `vn_nav.policy.search.verification`
    difficulty: float = 1.0  # tau of the starts; 1: anywhere

    def __post_init__(self):
        threshold = self.stop_threshold
        rules = (
            (self.episodes >= 1, 'there is at least one episode', self.episodes,
             'raise --episodes'),
            (0 < self.difficulty <= 1, 'difficulty lies in (0, 1]', self.difficulty,
             'choose a value in range'),
            (threshold is None or 0 <= threshold < 1, 'the stop threshold lies in [0, 1)',
             threshold, 'choose a value in range'),
            (self.decoding in (None, *DECODINGS), f'decoding is one of {", ".join(DECODINGS)}',
             self.decoding, 'choose one'),
            (set(self.controls) <= set(evaluator.CONTROLS),
             f'controls are some of {", ".join(evaluator.CONTROLS)}', self.controls,
             'choose some of them'),
            (0 < len(self.stops) and set(self.stops) <= set(evaluator.STOPS),
             f'stops are some of {", ".join(evaluator.STOPS)}', self.stops, 'choose some of them'),
        )
        for kept, rule, received, remedy in rules:
            if not kept:
                raise UserError(rule, received, remedy)


@dataclasses.dataclass
class Evaluation:
    """What was measured.

    Attributes:
        result: figures by split, kind of stop and row; JSON has what it holds.
        measured: the episodes, by split.
        plans: floor plans by split and scene; None: the scene has none.
    """

    result: dict
    measured: dict[str, evaluator.Rows]
    plans: dict[str, dict[str, Any]]


def new_result(info: Mapping, *, checkpoint: str, bag: str | None, max_decisions: int,
               decoding: str, seed: int, odometry: str, ranges: str = 'picture',
               camera: str | None = None, verify: str = NONE) -> dict:
    """A result without splits: what all of them have in common.

    Args:
        info: of the checkpoint, with the simulator and the world version that are measured in;
            its `sha256` is left out where the weights still change.
        checkpoint: its name.
        bag: name of the recorded drive; None: scenes of a simulator.
        max_decisions: of an episode.
        decoding: 'sample' or 'greedy'.
        seed: of the episodes.
        odometry: that the policy was given: true, drift, commanded, or none.
        ranges: that its map was given: picture, scan or depth.
        camera: of the robots, in words; None: the one that the policy was trained with.
        verify: see `vn_nav.policy.search.verification`; said only where something verifies.
    """
    return {'checkpoint': checkpoint,
            **({'sha256': info['sha256']} if 'sha256' in info else {}),
            'bag': bag, 'simulator': info['simulator'],
            'world_version': info['world_version'], 'task': info['task'],
            'decoding': decoding, 'max_decisions': max_decisions, 'seed': seed,
            'odometry': odometry, 'ranges': ranges,
            **({} if verify == NONE else {'verify': verify}), 'camera': camera or camera_name(
                info['camera_fov_deg'], info['camera_height']),
            'date': datetime.date.today().isoformat(), 'splits': {}}


def camera_name(fov_deg: float, height: float) -> str:
    """A camera in words: its field of view [deg] and height above the floor [m]."""
    return f'{fov_deg:.3g} deg, {height:.3g} m high'


def odometry_for(network: Policy, wanted: str | None = None) -> str:
    """The odometry that a policy is measured with: true, drift, commanded, or none.

    Args:
        network: the policy.
        wanted: by the user; None: drift where the policy uses odometry, else none.

    Raises:
        UserError: the policy uses none.
    """
    if wanted not in (None, 'none') and not network.uses_odometry:
        raise UserError('odometry is for policies that use it', f'{wanted}; this one uses none',
                        'leave it out (--odometry)')
    return wanted or ('drift' if network.uses_odometry else 'none')


def ranges_for(network: Policy, wanted: str | None = None) -> str:
    """The ranges that the map of a policy is measured with: picture, scan or depth.

    Args:
        network: the policy.
        wanted: by the user; None: picture, what the network sees itself.

    Raises:
        UserError: the policy has no map.
    """
    if wanted not in (None, 'picture') and network.config.architecture != SEARCH:
        raise UserError('measured ranges are for policies that search with a map',
                        f'{wanted}; this one has none', 'leave it out (--ranges)')
    return wanted or 'picture'


def measure_checkpoint(checkpoint: LoadedCheckpoint, scenes: Sequence[str], make_env: Callable,
                       config: EvaluateConfig, on_row: evaluator.OnRow | None = None
                       ) -> evaluator.Rows:
    """Episodes of a checkpoint in some scenes; see `evaluator.measure`."""
    info, controls = checkpoint.info, list(config.controls)
    if info['task'] == 'collect':  # no goal: none to show wrong, and no shortest path to it
        controls = [name for name in controls if name in (evaluator.OTHER, evaluator.RANDOM)]

    def make(names: Sequence[str], environments: int, stop: str):
        env = make_env(names, environments, stop)
        if config.difficulty < 1.0:
            env.set_difficulty(config.difficulty)
        can = env.simulator.capabilities
        if can.rewards:  # its task is its own: no goal to show another of, and no way to it
            controls[:] = [name for name in controls
                           if name in (evaluator.OTHER, evaluator.RANDOM)]
        if not (can.geodesic or env.simulator.planner) and evaluator.SHORTEST in controls:
            controls.remove(evaluator.SHORTEST)
        # One goal has no other to take for it; where there is none, none is shown.
        if min(count for _, count in env.task.ranges) < 2 and evaluator.WRONG in controls:
            controls.remove(evaluator.WRONG)
        if env.config.task != 'image' and evaluator.ABSENT in controls:
            controls.remove(evaluator.ABSENT)
        if can.own_actions and evaluator.BLANK in controls:
            controls.remove(evaluator.BLANK)
        return env

    return evaluator.measure(
        make, checkpoint.network, scenes, known=info['scenes'],
        decoding=config.decoding or info['decoding'], episodes=config.episodes,
        controls=controls, seed=config.seed, robot=config.robot, stops=config.stops,
        own=config.policy, verify=config.verify, on_row=on_row,
        camera_fov=math.radians(info['camera_fov_deg']),
        threshold=(info.get('stop_threshold') if config.stop_threshold is None
                   else config.stop_threshold))


def evaluate(checkpoint: LoadedCheckpoint, splits: Mapping[str, Sequence[str]],
             make_env: Callable, config: EvaluateConfig | None = None, *, name: str = '',
             bag: str | None = None,
             on_split: Callable[[str, dict], None] = lambda split, result: None,
             on_row: evaluator.OnRow | None = None) -> Evaluation:
    """Measure a checkpoint and its controls in every split.

    Args:
        checkpoint: the policy.
        splits: names of the scenes by the split's name.
        make_env: (split, scenes, environments, stop) -> vector environment in which environment
            i lives in scene i modulo their number; `stop` is 'arrival' or 'declared'.
        config: numbers; None: the defaults.
        name: of the checkpoint, for the result.
        bag: name of the recorded drive that the environments are made of; None: scenes.
        on_split: called with the name and the whole result after each split.
        on_row: see `evaluator.measure`.

    Raises:
        UserError: no split.
    """
    config = config or EvaluateConfig()
    check_verify(config.verify, checkpoint.config.architecture == SEARCH)
    if not splits:
        raise UserError('there is a split to measure in', dict(splits), 'name one')
    done = Evaluation({}, {}, {})
    for split, scenes in splits.items():
        plans = done.plans[split] = {}
        configs: list[Any] = []
        cameras: list[str] = []
        world: dict[str, str] = {}

        def make(names: Sequence[str], environments: int, stop: str, split: str = split,
                 plans: dict = plans, configs: list[Any] = configs, world: dict = world,
                 cameras: list[str] = cameras):
            env = make_env(split, names, environments, stop)
            world.update(simulator=env.simulator_name, world_version=env.world_version)
            plans.update({place.name: place.plan() for place in env.places})
            configs.append(env.config)
            cameras.append(camera_name(math.degrees(env.robot.camera_fov),
                                       env.robot.camera_height))
            return env

        measured = done.measured[split] = measure_checkpoint(checkpoint, scenes, make, config,
                                                             on_row)
        done.result = done.result or new_result(
            {**checkpoint.info, **world}, checkpoint=name, bag=bag,
            max_decisions=configs[0].max_decisions, odometry=configs[0].odometry,
            ranges=configs[0].ranges,
            camera=cameras[0], verify=config.verify,
            decoding=config.decoding or checkpoint.info['decoding'], seed=config.seed)
        done.result['splits'][split] = evaluator.split_figures(measured, scenes)
        on_split(split, done.result)
    return done
