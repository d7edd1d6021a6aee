"""What `vn_nav train` takes from the command line: a preset, and changes to it."""

from __future__ import annotations

import argparse
import ast
import dataclasses
from pathlib import Path

from vn_nav.errors import UserError
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
    'threads': (int, 'of torch and of the renderer'),
    'device': (str, 'where network and simulator run: cpu, or a GPU such as cuda:0'),
}
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


def train_config(args: argparse.Namespace) -> TrainConfig:
    """The preset with the changes of the command line.

    Raises:
        UserError: an unknown name or a value outside its range.
    """
    changes = {name: getattr(args, name) for name in (*NUMBERS, 'channels', 'curriculum', 'bf16', 'overlap')
               if getattr(args, name) is not None}
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
        if isinstance(known[name], bool) and not isinstance(changes[name], bool):
            raise UserError(f'{name} is true or false', value, 'write one of the two')
    if 'frames' in changes:
        changes['frames'] = int(changes['frames'])
    if 'channels' in changes:
        changes['channels'] = tuple(changes['channels'])
    return preset(args.preset, **changes, seed=args.seed, tensorboard=not args.no_tensorboard)


def world_options(args: argparse.Namespace) -> dict:
    """The environment's options: the preset's with the changes of the command line."""
    given = {name: getattr(args, name) for name in WORLD if getattr(args, name) is not None}
    return {'exploration_reward': 0.0, **ENVIRONMENT[args.preset], **given}
