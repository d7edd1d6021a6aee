"""`vn_nav teach`: a policy for the place where a bag was driven, learned in the bag's pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from vn_nav.cli.options import add_place_options, command_line, parse_changes, place_options
from vn_nav.learning.presets import ENVIRONMENT
from vn_nav.learning.teach_job import PLACES, PRESET, TeachJob
from vn_nav.learning.teaching import teach
from vn_nav.robot import RobotSpec, load_robot


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav teach`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 folder or MCAP file')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--checkpoint', type=Path, metavar='DIR', help='begin with this policy, '
                        'its network, size and actions, for example models/anywhere; '
                        'default: from nothing')
    parser.add_argument('--minutes', type=float, default=10.0, help='time for all: '
                        'reading the bag, learning and evaluation (docs/bags.md)')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='the robot that drove, with its camera; default: the standard robot')
    add_place_options(parser)
    parser.add_argument('--places', type=int, default=PLACES, metavar='K', help='place cells '
                        'by which the policy recognises the place; 0: none')
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


def run(args: argparse.Namespace) -> int:
    """`vn_nav teach`.

    Raises:
        UserError: options, a bag or a checkpoint that do not fit.
        KeyboardInterrupt: after SIGINT or SIGTERM, with what was learned and measured until then.
    """
    from vn_sim_bridge import teach_place as place
    job = TeachJob(
        bag=args.bag, out=args.out, checkpoint=args.checkpoint, minutes=args.minutes,
        robot=load_robot(args.robot) if args.robot else RobotSpec(), options=place_options(args),
        places=args.places, episodes=args.episodes, size=args.size, envs=args.envs,
        changes=parse_changes(args.set), cache=args.cache, resume=args.resume, seed=args.seed,
        threads=args.threads, command=command_line())
    print(teach(job, place))
    return 0
