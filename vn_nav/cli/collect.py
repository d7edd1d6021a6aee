"""`vn_nav collect`: pictures from random poses as a bag, for pre-training."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from vn_nav.cli.scenes import training_scenes
from vn_nav.cli.world import add_world, check_backend


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav collect`."""
    add_world(parser)
    parser.add_argument('--houses', type=int, metavar='N', help='the first N training houses')
    parser.add_argument('--pictures', type=int, default=20_000,
                        help='in all (thesis, 5.7: 20,000)')
    parser.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    parser.add_argument('--threads', type=int, default=1, help='that draw')
    parser.add_argument('--out', type=Path, required=True, help='folder of the bag')


def run(args: argparse.Namespace) -> int:
    """`vn_nav collect`."""
    check_backend(args.backend)
    from vn_nav.bags.storage.writer import BagWriter
    from vn_nav.robot import load_robot
    from vn_sim_bridge.datasets.collect import collect, random_views
    from vn_sim_bridge.render.randomisation import load_randomisation
    from vn_sim_bridge.simulators import robot_for
    names = training_scenes(args)
    robot = robot_for(names, load_robot(args.robot) if args.robot else None)
    scenes = random_views(names, args.size, robot, load_randomisation(args.randomisation),
                          args.seed, args.threads)
    begun = time.monotonic()
    done = collect(scenes, len(names), args.pictures, robot,
                   lambda topics: BagWriter(args.out, topics))
    seconds = time.monotonic() - begun
    print(f'{args.out}: {done.pictures:,} pictures in {done.episodes:,} episodes of {done.scenes} '
          f'scene{"s" * (done.scenes > 1)}, {done.pictures / seconds:,.0f} pictures/s')
    return 0
