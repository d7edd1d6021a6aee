"""`vn_nav pretrain`: a policy pre-trained on recorded bags."""

from __future__ import annotations

import argparse
from pathlib import Path

from vn_nav.bags.roles import Topics, load_topics
from vn_nav.cli.options import command_line, parse_changes
from vn_nav.learning.presets import PRESETS
from vn_nav.learning.pretrain_config import PretrainConfig
from vn_nav.learning.pretrain_job import PretrainJob, pretrain
from vn_nav.learning.supervised import PARTS
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav pretrain`."""
    numbers = PretrainConfig()
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG',
                        help='rosbag2 folders or MCAP files')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--init', type=Path, metavar='CHECKPOINT',
                        help='begin with the weights of this checkpoint, its network, size and '
                        'actions')
    parser.add_argument('--preset', choices=tuple(PRESETS),
                        help='its network is trained; default: that of --init, or fast')
    parser.add_argument('--size', type=int, help='side of the pictures [pixels]; default 84')
    parser.add_argument('--actions', help="names from the robot's table, with commas between; "
                        f'default {",".join(DRIVE_ACTIONS)}')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='any other number of vn_nav.learning.presets.TrainConfig that makes '
                        'the network, such as hidden=128: give the same to vn_nav train')
    parser.add_argument('--epochs', type=int, default=numbers.epochs, help='passes over the bags')
    parser.add_argument('--batch', type=int, default=numbers.batch, help='pictures in a step')
    parser.add_argument('--learning-rate', type=float, default=numbers.learning_rate,
                        help='of Adam at the start; it falls to a twentieth')
    parser.add_argument('--heads', default='auto', metavar='NAMES', help='heads to train: auto '
                        '(those that the bags have data for, and others of the preset), none, or '
                        f'some of {", ".join(name for name in PARTS if name != "cloning")}')
    parser.add_argument('--cloning', action=argparse.BooleanOptionalAction,
                        help='imitate the recorded actions, with pictures taken later as goals; '
                        'default: if the bags have actions')
    parser.add_argument('--topics', type=Path, metavar='YAML', help='names of the topics')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='the robot that drove; default: the standard robot')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help='folder of decoded bags; default: OUT/decoded')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=1, help='of torch')
    parser.add_argument('--device', default='cpu', help='cpu, or a GPU such as cuda:0')


def run(args: argparse.Namespace) -> int:
    """`vn_nav pretrain`.

    Raises:
        UserError: options, bags or a checkpoint that do not fit.
    """
    numbers = PretrainConfig(epochs=args.epochs, batch=args.batch, seed=args.seed,
                             learning_rate=args.learning_rate)
    print(pretrain(PretrainJob(
        bags=args.bags, out=args.out, init=args.init, preset=args.preset,
        changes=parse_changes(args.set), size=args.size,
        actions=tuple(args.actions.split(',')) if args.actions else None,
        heads=None if args.heads == 'auto' else tuple(
            name for name in args.heads.split(',') if name != 'none'),
        cloning=args.cloning, robot=load_robot(args.robot) if args.robot else RobotSpec(),
        topics=load_topics(args.topics) if args.topics else Topics(), cache=args.cache,
        threads=args.threads, device=args.device, resume=args.resume, numbers=numbers,
        command=command_line())))
    return 0
