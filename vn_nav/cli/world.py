"""What `vn_nav` commands share about the simulator: its options, environments, checkpoints."""

from __future__ import annotations

import argparse
import functools
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vn_nav.cli.scenes import add_scene_options
from vn_nav.errors import UserError
from vn_nav.scenes import BAG, ROOMS

if TYPE_CHECKING:
    from vn_nav.evaluation.evaluator import OnRow
    from vn_nav.robot import RobotSpec
    from vn_sim_bridge.render.randomisation import Randomisation

SAY = functools.partial(print, flush=True)
# Values of --motion-noise, as options of `EnvConfig`.
MOTION_NOISE: dict[str, dict[str, Any]] = {
    'all': {}, 'moves': {'turn_noise': False}, 'none': {'noise': 0.0}}
LONG_S = 30.0  # that a row of episodes takes, to be said
BACKENDS = ('house',)  # of --house and --houses; other scenes are named by --scene


def add_world(parser: argparse.ArgumentParser, defaults: bool = True) -> None:
    """Options of the simulated world."""
    parser.add_argument('--backend', default='house', help=f'one of: {", ".join(BACKENDS)}')
    parser.add_argument('--house', type=int, action='append', metavar='SEED',
                        help='seed of a house, short for --scene house:SEED; may be given several '
                        'times')
    parser.add_argument('--rooms', type=int, help=f'of the houses by seed (default {ROOMS})')
    add_scene_options(parser)
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='robot file (config/robots/); default: the standard robot')
    parser.add_argument('--randomisation', default='none' if defaults else None, metavar='NAME',
                        help='of light, camera and base: none, standard, rough, harsh or a YAML '
                        'file')
    parser.add_argument('--seed', type=int, default=0 if defaults else 10_000)


def check_backend(name: str) -> None:
    """Whether there is such a simulator."""
    if name not in BACKENDS:
        raise UserError(f'the backend is one of: {", ".join(BACKENDS)}', name, 'choose one')


def make_env(scenes, envs: int, *, robot: Path | RobotSpec | None = None, threads: int = 1,
             randomisation: str | Path | Randomisation = 'none', device: str = 'cpu',
             may_lack: Collection[str] | None = None,
             say: Callable[[str], None] = SAY, **options):
    """A `NavigationEnv` of some scenes; without a robot file with the scenes' own robot.

    On a device other than the CPU it is a `WarpNavigationEnv` if that can simulate what is asked
    for; else a line says why robots are simulated on the CPU, beside a network on the device.

    Args:
        may_lack: options of `env_config.OPTIONAL` that are left out, with a line, in a simulator
            that cannot do them; then `privileged` are wishes as well. None: all must be there.
        say: receives the lines.
    """
    from vn_sim_bridge.navigation.env import NavigationEnv
    from vn_sim_bridge.navigation.env_config import (
        EnvConfig,
        check_simulator,
        not_on_device,
        setup_for,
        with_own_actions,
        without_the_unknown,
    )
    from vn_sim_bridge.render.randomisation import Randomisation, load_randomisation
    from vn_sim_bridge.simulators import open_simulator, robot_for
    if not isinstance(randomisation, Randomisation):
        randomisation = load_randomisation(randomisation)
    config = EnvConfig(scenes=tuple(scenes), num_envs=envs, randomisation=randomisation,
                       **options)
    spec = robot_for(config.scenes, _loaded(robot))
    if device != 'cpu':
        refusal = not_on_device(config)
        _check_gpu(device, simulates=refusal is None)
        if refusal is None:
            from vn_sim_bridge.navigation.warp_env import WarpNavigationEnv
            return WarpNavigationEnv(config, spec, device=device)
        say(f'Robots are simulated on the CPU, and the network is on {device}: {refusal.rule} '
            f'(here: {refusal.received})')
    if may_lack is None:
        return NavigationEnv(config, spec, threads=threads)
    config = with_own_actions(config, spec)
    own = spec.with_actions(config.actions)
    simulator = open_simulator(config.scenes, setup_for(config, own, threads))
    try:
        config, words = without_the_unknown(config, simulator, may_lack)
        check_simulator(simulator, config, own)
        env = NavigationEnv(config, spec, simulator=simulator)
    except BaseException:
        simulator.close()
        raise
    for line in words:
        say(line)
    return env


def _loaded(robot: Path | RobotSpec | None) -> RobotSpec | None:
    from vn_nav.robot import RobotSpec, load_robot
    return robot if robot is None or isinstance(robot, RobotSpec) else load_robot(robot)


def make_env_for(checkpoint, scenes, envs: int, *, stop: str, own: bool,
                 robot: Path | RobotSpec | None = None,
                 randomisation: str | Path | Randomisation | None = None,
                 max_decisions: int = 300, goal_seed: int = 0, odometry: str | None = None,
                 size: int | None = None, smallest: int = 0,
                 ranges: str | None = None, privileged: Collection[str] = (),
                 say: Callable[[str], None] = SAY, **options):
    """A `NavigationEnv` in which a checkpoint is measured, on its own task.

    Args:
        checkpoint: the policy.
        scenes, envs, robot: see `make_env`.
        stop: what ends an episode before its limit, 'arrival' or 'declared'.
        own: the scenes are those that it was trained in, with as many goals.
        randomisation: None: that of the training, as far as the simulator can vary its pictures.
        max_decisions: of an episode.
        goal_seed: 0 for the goals of the training.
        odometry: that the policy is given; None: see `measurement.odometry_for`.
        size: side of the pictures [pixels]; None: what the policy needs.
        smallest: side that they have at least, where more than the network looks at them.
        ranges: that its map is given; None: see `measurement.ranges_for`.
        privileged: what it tells beside the observations, to who measures.
        say: receives a line about what the simulator cannot vary.
        options: further fields of `EnvConfig`; motion noise is else that of the training.

    Raises:
        UserError: the checkpoint belongs to another version of the simulator; the policy uses no
            odometry.
    """
    from vn_nav.evaluation.measurement import odometry_for, ranges_for
    from vn_nav.observation import needed_side
    info = checkpoint.info
    robot = _loaded(robot)
    if size is None:
        size = checkpoint.config.size
        if robot is not None:  # which may have another camera: see `PolicyActor`
            size = needed_side(size, robot.camera_fov, math.radians(info['camera_fov_deg']))
    env = make_env(scenes, envs, robot=robot, size=max(size, smallest),
                   randomisation=randomisation or info['randomisation'], task=info['task'],
                   objects=info['objects'], actions=checkpoint.config.actions,
                   max_decisions=max_decisions, stop=stop, goal_seed=goal_seed,
                   goals_per_room=info['goals_per_room'] if own else 1,
                   odometry=odometry_for(checkpoint.network, odometry),
                   ranges=ranges_for(checkpoint.network, ranges), privileged=tuple(privileged),
                   may_lack=() if randomisation else ('randomisation',), say=say,
                   **(MOTION_NOISE[info['motion_noise']] | options))
    try:
        check_version(info, simulator=env.simulator_name, version=env.world_version)
    except UserError:
        env.close()
        raise
    return env


def _check_gpu(device: str, simulates: bool) -> None:
    """Whether a GPU such as cuda:0 is there for the network and, where it simulates, for Warp."""
    import torch
    known = torch.cuda.device_count()
    if simulates:
        try:
            import warp as wp
        except ImportError as error:
            raise UserError('the simulator runs on a GPU with the extra "gpu"', str(error),
                            "pip install 'vn_nav[gpu]', or use --device cpu") from error
        known = min(known, wp.get_cuda_device_count())
    if (torch.device(device).index or 0) >= known:
        who = 'torch and Warp find' if simulates else 'torch finds'
        raise UserError(f'the device is a GPU that {who}', f'{device}; found: {known or "none"}',
                        'look at nvidia-smi and at torch.version.cuda, or use --device cpu')


def machine(device: str = 'cpu') -> str:
    """The name of the processor, or of the GPU."""
    if device != 'cpu':
        import torch
        return torch.cuda.get_device_name(device)
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        model = next(line.split(':', 1)[1].strip() for line in lines if 'model name' in line)
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f'{model}, {os.cpu_count()} cores'


def load_for(path: Path, robot: Path | None = None, *, any_camera: bool = False):
    """A checkpoint, and the robot with its actions.

    Args:
        path: of the checkpoint.
        robot: file of the robot; None: the one that it was trained for.
        any_camera: a robot file may have another camera than the policy was trained with, as far
            as the policy can be shown its pictures.

    Raises:
        UserError: the robot has other actions or another camera.
    """
    from vn_nav.policy.checkpoint import load_checkpoint
    checkpoint = load_checkpoint(path)
    spec = _loaded(robot) or _trained_robot(checkpoint.info)
    # Or says which action is unknown, or too long.
    spec = spec.with_actions(checkpoint.config.actions, checkpoint.config.moves)
    trained = checkpoint.info['camera_fov_deg'], checkpoint.info['camera_height']
    present = math.degrees(spec.camera_fov), spec.camera_height
    if any_camera and robot:
        check_camera(checkpoint, spec.camera_fov)
    elif any(
            abs(a - b) > 0.01 * b for a, b in zip(present, trained, strict=True)):
        raise UserError('the robot has the camera that the policy was trained with: '
                        f'{trained[0]:g} deg, {trained[1]:g} m high',
                        f'{present[0]:g} deg, {present[1]:g} m (robot {spec.name})',
                        'give its file with --robot, or train a policy for this robot')
    return checkpoint, spec


def check_camera(checkpoint, fov: float) -> None:
    """Whether a policy can be shown the pictures of a camera with a field of view [rad].

    Raises:
        UserError: it sees too little or, for a policy that searches, too much.
    """
    from vn_nav.observation import check_lens, crop_fraction
    from vn_nav.policy.network_config import SEARCH
    if checkpoint.config.architecture == SEARCH:
        check_lens(fov)
    else:
        crop_fraction(fov, math.radians(checkpoint.info['camera_fov_deg']))


def _trained_robot(info: dict):
    """The robot of a policy that no file names: that of its scenes, or the standard one."""
    from vn_nav.robot import RobotSpec
    from vn_sim_bridge.simulators import robot_for
    return robot_for(info['scenes']) if info['scenes'] else RobotSpec()


def long_rows() -> OnRow:
    """What says on stderr, while hours of episodes are driven, which rows are done."""
    from vn_nav.report.tables import TITLES
    begun = before = time.monotonic()

    def say(stop: str, name: str, count: int) -> None:
        nonlocal before
        now = time.monotonic()
        if now - before > LONG_S:
            print(f'{TITLES[stop]}, {name}: {count} episodes, {(now - begun) / 60:.0f} min',
                  file=sys.stderr, flush=True)
        before = now
    return say


def load_for_scenes(path: Path, robot: Path | None = None):
    """As `load_for`, of a policy whose simulator has the version that it was trained in."""
    checkpoint, spec = load_for(path, robot)
    check_version(checkpoint.info, simulator=checkpoint.info['simulator'])
    return checkpoint, spec


def check_version(info: dict, *, simulator: str, version: str | None = None) -> None:
    """Whether figures of a checkpoint mean something in a simulator.

    A version belongs to a simulator: between two simulators none is compared. Pictures of a real
    robot, and those of several simulators, are of no version: such a policy may be tried
    anywhere, and any policy in such pictures.

    Args:
        info: of the checkpoint.
        simulator: where it is to drive.
        version: of it; None: the present one.

    Raises:
        UserError: pixels, places or motion of its simulator have changed since.
    """
    from vn_nav.bags.drive import RECORDED
    from vn_sim_bridge.simulators import simulator_class
    if version is None:
        version = simulator_class(simulator).version
    trained = info['world_version']
    # A drive's version is that of the simulator that drew its pictures.
    same = simulator == info['simulator'] or BAG in (simulator, info['simulator'])
    if same and RECORDED not in (trained, version) and trained != version:
        raise UserError(f'the checkpoint belongs to world version {version!r}', trained,
                        'train it again (vn_nav train), or use the version of vn_nav that it '
                        'came with')
