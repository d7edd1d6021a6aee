"""What `vn_nav train` takes from the command line: a preset, and changes to it."""

from __future__ import annotations

import argparse
import ast
import dataclasses
from collections.abc import Collection
from pathlib import Path

from vn_nav.errors import UserError
from vn_nav.learning.learner import PRIVILEGED
from vn_nav.learning.presets import ENVIRONMENT, PRESETS, TrainConfig, preset
from vn_nav.robot import DRIVE_ACTIONS

# Options that are numbers of `TrainConfig`, with their words.
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
    'frozen_weights': (str, "of icra2017: file with ResNet-50's weights (torchvision's names)"),
    'scenes': (int, 'of icra2017: houses with layers of their own'),
    'pair_minutes': (float, 'pre-train the encoder on picture pairs for so long first'),
    'pair_houses': (int, 'draw pairs from the first so many training houses'),
    'bag_share': (float, 'with --bags: steps of drives for each step of a rollout'),
    'threads': (int, 'of torch and of the renderer'),
    'device': (str, 'where network and simulator run: cpu, or a GPU such as cuda:0'),
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


def add_train_options(parser: argparse.ArgumentParser) -> None:
    """Everything but where to train."""
    parser.add_argument('--preset', choices=tuple(PRESETS), default='fast',
                        help='where every number comes from that is not given')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--init', type=Path, metavar='CHECKPOINT',
                        help='begin with the weights of a checkpoint')
    parser.add_argument('--env', choices=('house', 'ros'), default='house',
                        help='where: embedded houses, or robots behind ROS topics')
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
    parser.add_argument('--goals-per-room', type=int, default=1)
    parser.add_argument('--goal-variants', type=int,
                        help="differently lit pictures of each goal; default: the randomisation's")
    parser.add_argument('--task', default='image', help='image, object, room or collect')
    parser.add_argument('--objects', type=int, default=1, help='in the house at a time')
    parser.add_argument('--actions', default=','.join(DRIVE_ACTIONS),
                        help="names from the robot's table, with commas between")
    parser.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    for name, (kind, words) in (NUMBERS | WORLD).items():
        parser.add_argument('--' + name.replace('_', '-'), type=kind, help=words)
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


def check_train_options(args: argparse.Namespace) -> None:
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


def config_over_ros(config: TrainConfig, world: dict, offers: Collection[str], lock_step: bool
                    ) -> tuple[TrainConfig, list[str]]:
    """What of a training can be learned where only topics say what happens.

    Heads whose task is left out stay, so that the checkpoint of a simulator fits and bags can go
    on teaching them.

    Args:
        config: as it would be in a simulator.
        world: options of the environment, of `WORLD`.
        offers: keys of `info` that the topics can give.
        lock_step: the robot is simulated and waits.

    Returns:
        The configuration, and what is left out and why, in words.

    Raises:
        UserError: a device or architecture for which goals must be known before they are seen;
            or motion while the learner is busy.
    """
    rules = (
        (config.device == 'cpu', 'goals that come one by one are kept on the CPU',
         f'--device {config.device}', 'leave --device out'),
        (config.architecture != 'icra2017', 'goals that come one by one are encoded anew',
         'the architecture icra2017, which does so once', 'choose another --preset'),
        (lock_step or not config.overlap, 'a robot stands still while the learner is busy',
         '--overlap', 'leave it out, or train in --lock-step'),
    )
    for kept, rule, received, remedy in rules:
        if not kept:
            raise UserError(rule, received, remedy)
    lost = [name for name in config.tasks if not set(PRIVILEGED.get(name, ())) <= set(offers)
            or name == 'imitation']
    words = [f'{name} is left out: no topic says {" or ".join(PRIVILEGED.get(name, ("it",)))}'
             for name in lost]
    words += [f'{name} is left out: no topic says it'
              for name in ('progress_reward', 'exploration_reward') if world.get(name)]
    if config.start_difficulty < 1:
        words.append('there is no curriculum: robots start where they are')
    if config.pair_minutes:
        words.append("there are no picture pairs: they are the simulator's")
    return dataclasses.replace(
        config, **dict.fromkeys(lost, 0.0), teacher_share=0.0, pair_minutes=0.0,
        start_difficulty=1.0, extra_heads=(*config.extra_heads, *(
            name for name in lost if name != 'imitation'))), words


def train_config(args: argparse.Namespace) -> TrainConfig:
    """The preset with the changes of the command line.

    Raises:
        UserError: an unknown name or a value outside its range.
    """
    changes = {name: getattr(args, name) for name in CHANGES if getattr(args, name) is not None}
    known = {field.name: field.default for field in dataclasses.fields(TrainConfig)}
    for text in args.set:
        name, equals, value = text.partition('=')
        if not equals or name not in known:
            raise UserError('--set takes NAME=VALUE with a number of TrainConfig', text,
                            f'the names are {", ".join(sorted(known))}')
        try:
            changes[name] = ast.literal_eval({'true': 'True', 'false': 'False'}.get(value, value))
        except (ValueError, SyntaxError):
            changes[name] = value
        if isinstance(known[name], str):
            changes[name] = value  # a word, whatever it looks like
    return preset(args.preset, **changes, seed=args.seed, tensorboard=not args.no_tensorboard)


def world_options(args: argparse.Namespace) -> dict:
    """The environment's options: the preset's with the changes of the command line."""
    given = {name: getattr(args, name) for name in WORLD if getattr(args, name) is not None}
    return {'exploration_reward': 0.0, **ENVIRONMENT[args.preset], **given}
