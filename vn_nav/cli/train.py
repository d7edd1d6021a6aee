"""`vn_nav train`: a policy by reinforcement, in a simulator or behind ROS topics."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import math
from collections.abc import Sequence
from pathlib import Path

from vn_nav.cli.options import command_line, parse_changes
from vn_nav.cli.scenes import split_scenes, training_scenes
from vn_nav.cli.world import MOTION_NOISE, add_world, check_backend, machine, make_env
from vn_nav.errors import UserError
from vn_nav.learning.left_out import ALWAYS, config_without
from vn_nav.learning.over_ros import config_over_ros
from vn_nav.learning.presets import ENVIRONMENT, PRESETS, TrainConfig, preset
from vn_nav.learning.pretrain_job import load_bags, print_line
from vn_nav.learning.trainer import train
from vn_nav.policy.network_config import SEARCH
from vn_nav.robot import DRIVE_ACTIONS
from vn_nav.scenes import one_simulator

VALIDATION_SCENES = 16  # that picture pairs are judged by
# Options that are numbers of `TrainConfig`, with their help.
NUMBERS = {
    'frames': (float, 'agent decisions; schedules end here'),
    'minutes': (float, 'stop after this wall-clock time; schedules end then'),
    'learning_rate': (float, 'at the start'),
    'final_learning_rate': (float, 'at the end'),
    'entropy_coefficient': (float, 'at the start'),
    'final_entropy_coefficient': (float, 'at the end'),
    'rollout_length': (int, 'steps between updates'),
    'epochs': (int, 'passes over a rollout'),
    'minibatches': (int, 'steps of the optimiser a pass'),
    'features': (int, "of the encoder's last layer"),
    'hidden': (int, 'units of the LSTM'),
    'blocks': (int, 'residual blocks a stage'),
    'frozen_weights': (str, "of icra2017: file with ResNet-50's weights (torchvision's "
                       'names); scene: the features in the files of grid scenes'),
    'scenes': (int, 'of icra2017: scenes with layers of their own'),
    'pair_minutes': (float, 'pre-train the encoder on picture pairs for so long first'),
    'pair_houses': (int, 'draw pairs from the first so many scenes of the split train'),
    'bag_share': (float, 'with --bags: steps of drives for each step of a rollout'),
    'threads': (int, 'of torch and of the renderer'),
    'device': (str, 'where the network runs, and robots if they can: cpu, or a GPU (cuda:0)'),
}
CHANGES = (*NUMBERS, 'channels', 'curriculum', 'bf16', 'overlap')
# Options of the environment, whose defaults are the preset's.
WORLD = {
    'envs': (int, 'environments'),
    'max_decisions': (int, 'limit of an episode'),
    'progress_reward': (float, 'per metre of progress; the network never sees it'),
    'collision_reward': (float, 'per contact, negative'),
    'exploration_reward': (float, 'per square metre seen first'),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav train`."""
    add_world(parser)
    add_train_options(parser)


def add_train_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav train`, without those of the world."""
    parser.add_argument('--preset', choices=tuple(PRESETS), default='fast',
                        help='where every number comes from that is not given')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--init', type=Path, metavar='CHECKPOINT',
                        help='begin with the weights of a checkpoint')
    parser.add_argument('--env', choices=('sim', 'house', 'ros'), default='sim',
                        help='where: in a simulator (house is an old word for it), or robots '
                        'behind ROS topics')
    parser.add_argument('--lock-step', action='store_true',
                        help='with --env ros: the robot is sim_bridge_node with time:=lock_step')
    parser.add_argument('--namespaces', nargs='+', metavar='NAME',
                        help='with --env ros: of the topics of several robots')
    parser.add_argument('--record', type=Path, metavar='BAG',
                        help='with --env ros: write what is seen into a new bag')
    parser.add_argument('--bags', type=Path, nargs='+', metavar='BAG',
                        help='learn from recorded drives as well, in every step')
    parser.add_argument('--topics', type=Path, metavar='YAML',
                        help='with --bags: names of the topics in them')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help='with --bags: of decoded bags; default: OUT/decoded')
    parser.add_argument('--houses', type=int, metavar='N', help='the first N training houses')
    parser.add_argument('--cameras', choices=('own', 'many'), default='own',
                        help="of the preset search: the robot's own camera, or other lenses, "
                        'formats, heights and pitches too, and changed pictures')
    parser.add_argument('--goals-per-room', type=int, default=1)
    parser.add_argument('--goal-variants', type=int,
                        help="differently lit pictures of each goal; default: the randomisation's")
    parser.add_argument('--task', default='image', help='image, object, room or collect')
    parser.add_argument('--objects', type=int, default=1, help='in the place at a time')
    parser.add_argument('--actions', default=','.join(DRIVE_ACTIONS),
                        help="names from the robot's table, with commas between")
    parser.add_argument('--motion-noise', choices=tuple(MOTION_NOISE), default='all',
                        help='of moves and turns, of moves alone (thesis, 5.6), or none')
    parser.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    for name, (kind, about) in (NUMBERS | WORLD).items():
        parser.add_argument('--' + name.replace('_', '-'), type=kind, help=about)
    parser.add_argument('--channels', type=int, nargs=3, help='of the fused convolutions')
    parser.add_argument('--curriculum', choices=('success', 'frames'),
                        help='what raises the difficulty')
    parser.add_argument('--bf16', action=argparse.BooleanOptionalAction,
                        help='compute in bfloat16, or in float32')
    parser.add_argument('--overlap', action=argparse.BooleanOptionalAction,
                        help='collect while learning, on a second core')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='any other number of vn_nav.learning.presets.TrainConfig')
    parser.add_argument('--no-tensorboard', action='store_true')
    parser.add_argument('--ros-args', nargs=argparse.REMAINDER, metavar='ARGUMENTS',
                        help='with --env ros, last of all: remappings and parameters, such as '
                        '-r image_raw:=/camera/image_raw -p patience:=600.0')


def _check(args: argparse.Namespace) -> None:
    """Refuse options that have no meaning together.

    Raises:
        UserError: naming them.
    """
    def refuse(names: tuple[str, ...], rule: str, remedy: str) -> None:
        given = [f'--{name.replace("_", "-")}' for name in names
                 if getattr(args, name) not in (None, False)]
        if given:
            raise UserError(rule, ' '.join(given), remedy)
    if args.env == 'ros':
        refuse(('scene', 'house', 'houses', 'envs', 'pair_minutes', 'goal_variants'),
               'where robots drive is not for their trainer to choose',
               'leave these out with --env ros')
    else:
        refuse(('lock_step', 'namespaces', 'record', 'ros_args'),
               'these are for robots behind topics', 'add --env ros')
    if not args.bags:
        refuse(('bag_share', 'topics', 'cache'), 'these are for learning from bags',
               'add --bags BAG')


def train_config(args: argparse.Namespace) -> TrainConfig:
    """The preset with the changes of the command line.

    Raises:
        UserError: an unknown name or a value outside its range.
    """
    changes = {name: getattr(args, name) for name in CHANGES if getattr(args, name) is not None}
    return preset(args.preset, **{'seed': args.seed, 'tensorboard': not args.no_tensorboard,
                                  **changes, **parse_changes(args.set)})


def world_options(args: argparse.Namespace) -> dict:
    """The environment's options: the preset's with the changes of the command line."""
    given = {name: getattr(args, name) for name in WORLD if getattr(args, name) is not None}
    return {'exploration_reward': 0.0, **ENVIRONMENT[args.preset], **given}


def run(args: argparse.Namespace) -> int:
    """`vn_nav train`."""
    check_backend(args.backend)
    config = train_config(args)
    if config.architecture == SEARCH:
        from vn_nav.cli import sight
        return sight.run(args, config)
    if args.cameras != 'own':
        raise UserError('other cameras are drawn for picture pairs of the preset search',
                        f'--cameras {args.cameras} with the preset {args.preset}',
                        'leave it out, or use --preset search')
    _check(args)
    if args.env == 'ros':
        return _over_ros(args)
    from vn_sim_bridge.navigation.env_config import PRIVILEGED
    scenes = training_scenes(args)
    world = world_options(args)
    # The preset's wishes, where nobody else has any.
    optional = [name for name in ('progress_reward', 'exploration_reward')
                if getattr(args, name) is None]
    env = make_env(scenes, world.pop('envs'), robot=args.robot, threads=config.threads,
                   randomisation=args.randomisation, size=args.size, seed=args.seed,
                   device=config.device, may_lack=optional,
                   actions=tuple(args.actions.split(',')), task=args.task,
                   objects=args.objects, goals_per_room=args.goals_per_room,
                   goal_variants=args.goal_variants, **MOTION_NOISE[args.motion_noise],
                   privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world)
    config, words = config_without(config, env.config.privileged, env.simulator_name,
                                   always=ALWAYS if _has_goals(env) else ())
    for line in words:
        print(line, flush=True)
    bags = _bag_mix(args, config, env.robot)
    info = _info(args, config, env, bags) | {
        'simulator': env.simulator_name, 'scenes': scenes, 'randomisation': args.randomisation,
        'goals_per_room': args.goals_per_room, 'goal_variants': args.goal_variants,
        'task': args.task, 'objects': args.objects, 'motion_noise': args.motion_noise}
    pairs = None
    if config.pair_minutes and not args.init:
        pairs = _pair_sources(args, config, scenes)
    with contextlib.closing(env):
        print(train(env, config, args.out, info=info, resume=args.resume, init=args.init,
                    pairs=pairs, bags=bags))
    return 0


def _has_goals(env) -> bool:
    """Whether arriving somewhere is what an environment is about, as in houses on any device."""
    simulator = getattr(env, 'simulator', None)  # `WarpNavigationEnv` is all of one
    return simulator is None or bool(env.distance_unit and not simulator.capabilities.rewards)


def _info(args: argparse.Namespace, config, env, bags) -> dict:
    """What every checkpoint of a training says."""
    taught = '' if bags is None else (
        f', and {len(bags.drives):,} steps of {len(args.bags)} bag{"s" * (len(args.bags) > 1)}')
    return {
        'preset': args.preset,
        'command': command_line(),
        'camera_fov_deg': math.degrees(env.robot.camera_fov),
        'camera_height': env.robot.camera_height,
        'notes': f'Trained on {machine(config.device)}, {config.threads} thread(s), '
                 f'{datetime.date.today().isoformat()}{taught}.',
        'world_version': env.world_version,
    }


def _bag_mix(args: argparse.Namespace, config, robot):
    """The bags that a training learns from as well; None: there are none."""
    if not args.bags:
        return None
    from vn_nav.bags.roles import Topics, load_topics
    from vn_nav.learning.bag_mix import BagMix
    drives, _ = load_bags(args.bags, robot, args.size,
                          load_topics(args.topics) if args.topics else Topics(),
                          args.cache or args.out / 'decoded', print_line)
    bags = BagMix(drives, config)
    parts = ', '.join(bags.parts).replace('_', ' ')
    for line in (*bags.notes, f'bags teach {parts}'):
        print(line, flush=True)
    return bags


def _over_ros(args: argparse.Namespace) -> int:
    """`vn_nav train --env ros`."""
    import torch

    from vn_nav.robot import RobotSpec, load_robot
    try:
        from vn_nav.nodes.ros_env import RosEnv
    except ImportError as error:
        raise UserError('training over ROS needs rclpy and the common messages', str(error),
                        "source ROS 2, or pip install 'vn_nav[ros]'") from error
    if torch.distributed.is_torchelastic_launched():
        raise UserError('one process trains over ROS', 'torchrun',
                        'name several robots with --namespaces instead')
    config, world = train_config(args), world_options(args)
    robot = (load_robot(args.robot) if args.robot else RobotSpec()).with_actions(
        args.actions.split(','))
    bags = _bag_mix(args, config, robot)  # no robot waits for the decoding
    with RosEnv(robot, args.size,
                namespaces=args.namespaces or ('',), lock_step=args.lock_step,
                max_decisions=world['max_decisions'], collision_reward=world['collision_reward'],
                record=args.record, ros_arguments=args.ros_args or ()) as env:
        config, notes = config_over_ros(config, world, env.offers, args.lock_step)
        for line in notes:
            print(line, flush=True)
        env.listen(config.privileged)
        info = _info(args, config, env, bags) | {
            'simulator': env.simulator_name, 'scenes': env.scene_names}

        def say(row: dict) -> None:
            print(f'{row["frames"]:,} frames: {env.steps / env.seconds:.2f} steps/s over ROS, '
                  f'{row["fps"]:.2f} with learning', flush=True)
        print(train(env, config, args.out, info=info, resume=args.resume, init=args.init,
                    bags=bags, on_update=say))
    return 0


def _pair_sources(args: argparse.Namespace, config, scenes: Sequence[str]):
    """Makes the pairs that a training begins with, and those to judge by.

    Of the splits train and validation where the simulator has them, else of the training's scenes.
    """
    def make():
        from vn_nav.robot import load_robot
        from vn_sim_bridge.datasets.view_pairs import PairSampler
        from vn_sim_bridge.render.randomisation import load_randomisation
        from vn_sim_bridge.simulators import simulator_class
        simulator, _ = one_simulator(scenes)
        own = others = scenes
        if {'train', 'validation'} <= set(simulator_class(simulator).splits):
            own, others = (split_scenes(simulator, split, count, args.rooms) for split, count in (
                ('train', config.pair_houses), ('validation', VALIDATION_SCENES)))
        else:
            print(f'picture pairs are of the training scenes: {simulator} has no splits train and '
                  'validation', flush=True)
        options = {'size': args.size, 'threads': config.threads,
                   'robot': load_robot(args.robot) if args.robot else None,
                   'randomisation': load_randomisation(args.randomisation)}
        return (PairSampler(own, seed=args.seed, **options),
                PairSampler(others, seed=args.seed + 1, **options))
    return make
