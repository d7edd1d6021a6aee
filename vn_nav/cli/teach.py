"""`vn_nav teach`: a policy for the place where a bag was driven, learned in the bag's pictures.

The simulator's half, which makes a place out of pictures with poses, comes from the caller
(`vn_sim_bridge.teach_place_place`).
"""

from __future__ import annotations

import argparse
import functools
import math
from pathlib import Path

from vn_nav.bags.mapping.recorded_place import add_place_options, check_place_options, read_place
from vn_nav.cli.teaching import PRESET, SEARCHED, Place, Teaching
from vn_nav.cli.train import CHANGES, train_config
from vn_nav.errors import UserError
from vn_nav.learning.presets import ENVIRONMENT, TrainConfig
from vn_nav.learning.stages import Stages
from vn_nav.learning.trainer import STATE
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint import LoadedCheckpoint, load_checkpoint
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot

# The place is one to know by heart: there the shortest path is something to imitate.
TEACHER = {'imitation': 1.0, 'imitation_until': 1.0, 'teacher': 'routes', 'teacher_share': 0.5,
           'teacher_until': 0.6, 'start_difficulty': 1.0}
# Without a checkpoint much is learned from each rollout.
FROM_NOTHING = {'epochs': 4, 'minibatches': 8, 'learning_rate': 1e-3}
PAIR_SHARE = 0.1  # of learning from nothing, for picture pairs
PLACES = 64  # spots that the policy tells apart


def add_teach_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav teach`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 folder or MCAP file')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--checkpoint', type=Path, metavar='DIR', help='begin with this policy, '
                        'for example models/anywhere: network, size and actions are its own; '
                        'default: from nothing')
    parser.add_argument('--minutes', type=float, default=10.0, help='that all of it takes: '
                        'reading the bag, learning and evaluation (docs/bags.md)')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='that drove, with its camera; default: the standard robot')
    add_place_options(parser)
    parser.add_argument('--places', type=int, default=PLACES, metavar='K', help='spots of the '
                        'place that the policy knows by heart; 0: none')
    parser.add_argument('--episodes', type=int, default=50, help='of each row of the '
                        'evaluation, at most')
    parser.add_argument('--size', type=int, help='without a checkpoint: side of the pictures '
                        '[pixels]; default 84')
    parser.add_argument('--envs', type=int, default=ENVIRONMENT[PRESET]['envs'],
                        help='robots that learn at a time')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='any number of vn_nav.learning.presets.TrainConfig')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=1, help='of torch')


def teach(args: argparse.Namespace, place: Place) -> int:
    """`vn_nav teach`.

    Returns:
        0; 130 after SIGINT or SIGTERM, with what was learned and measured until then.

    Raises:
        UserError: options, a bag or a checkpoint that do not fit; a drive too short, of one
            spot, or of several places.
    """
    _check(args)
    check_place_options(args)
    given = load_checkpoint(args.checkpoint) if args.checkpoint else None
    _config(args, given, args.minutes, args.minutes)  # refuse before hours what would fail then
    robot = _robot(args, given)
    with Stages(args.minutes) as stages:
        run = None
        try:
            size = given.config.size if given else args.size or 84
            graph = read_place(args, place.build_graph, robot, size,
                               args.cache or args.out / 'decoded', stages, stages.at(SEARCHED))
            run = Teaching(args, place, graph, given, robot, stages,
                           functools.partial(_config, args, given))
            run.learn()
            run.evaluate()
        except KeyboardInterrupt:
            stages.pause()
            print(f'interrupted after {stages.seconds / 60:.1f} min; '
                  + ('nothing is learned yet' if run is None else run.keep()), flush=True)
            return 130
    print(run.folder)
    return 0


def _check(args: argparse.Namespace) -> None:
    rules = (
        (args.minutes > 0, 'there is some time to learn', args.minutes, 'raise --minutes'),
        (args.episodes >= 1, 'there is at least one episode', args.episodes, 'raise --episodes'),
        (args.places == 0 or 2 <= args.places <= 1024, 'there are 2 to 1024 spots, or none',
         args.places, 'correct --places'),
        (args.envs >= 1, 'there is at least one robot', args.envs, 'raise --envs'),
        (args.size is None or args.checkpoint is None, 'the size is that of the checkpoint',
         args.size, 'leave out --size'),
        (args.resume or not (args.out / STATE).is_file(), 'a new run has a folder of its own',
         str(args.out), 'go on there with --resume, or choose another folder'),
    )
    for kept, rule, received, remedy in rules:
        if not kept:
            raise UserError(rule, received, remedy)


def _config(args: argparse.Namespace, given: LoadedCheckpoint | None, minutes: float,
            learned: float) -> TrainConfig:
    """The preset's numbers, for the network of a checkpoint if there is one.

    Args:
        minutes: of reinforcement, picture pairs included; learned: of all that is learning.
    """
    minutes = max(minutes, 1e-3)
    own = {'frames': 10**9, 'minutes': minutes, 'places': args.places, **TEACHER}
    if given is None:
        own |= FROM_NOTHING | {'pair_minutes': min(PAIR_SHARE * max(learned, 0.0) + 1e-4,
                                                   minutes / 3)}
    else:
        network = given.config
        if network.architecture == 'icra2017':
            raise UserError('an encoder that learns is taught', f'{args.checkpoint}, whose '
                            'encoder is frozen', 'choose another --checkpoint')
        own |= {'pair_minutes': 0.0, 'stacked_frames': network.frames,
                'track_goal': bool(network.moves),
                'action_filter': network.filter_name != NONE or not network.moves,
                **{name: getattr(network, name) for name in (
                    'architecture', 'channels', 'blocks', 'features', 'hidden', 'deconvolutions',
                    'pose_to_memory', 'pixel_mean', 'pixel_std')}}
    words = [f'{name}={value}' for name, value in own.items()]
    return train_config(argparse.Namespace(**dict.fromkeys(CHANGES) | {
        'preset': PRESET, 'set': [*words, *args.set], 'seed': args.seed, 'no_tensorboard': True,
        'threads': args.threads}))


def _robot(args: argparse.Namespace, given: LoadedCheckpoint | None) -> RobotSpec:
    """The robot with the actions of the policy."""
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    if given is None:
        return robot.with_actions(DRIVE_ACTIONS)
    before = given.info['camera_fov_deg'], given.info['camera_height']
    now = math.degrees(robot.camera_fov), robot.camera_height
    if any(abs(a - b) > 0.01 * b for a, b in zip(now, before, strict=True)):
        print(f'the camera is another one ({now[0]:.0f} deg, {now[1]:g} m high) than the policy '
              f'has learned with ({before[0]:.0f} deg, {before[1]:g} m): it gets used to it',
              flush=True)
    return robot.with_actions(given.config.actions, given.config.moves)
