"""`vn_nav simulators dump`: a place as a grid scene, in a file."""

from __future__ import annotations

import argparse
from pathlib import Path

from vn_nav.cli.options import check_folders
from vn_nav.errors import UserError


def add_action(actions) -> None:
    """The action `dump` among those of `vn_nav simulators`."""
    action = actions.add_parser('dump', help='write a place as a grid scene (HDF5)')
    action.add_argument('scene', help='of a simulator that puts robots anywhere, such as '
                        'house:7')
    action.add_argument('--out', type=Path, required=True, metavar='FILE.h5')
    action.add_argument('--robot', type=Path, metavar='YAML', help='its camera and footprint; '
                        'default: the standard robot')
    action.add_argument('--step', type=float, default=0.5, metavar='M', help='side of a cell [m]')
    action.add_argument('--size', type=int, default=174, help='side of the pictures [pixels]')
    action.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """`vn_nav simulators dump SCENE --out FILE.h5`."""
    from vn_nav.robot import RobotSpec, load_robot
    from vn_nav.scenes import scene_name
    check_folders(args.out)
    try:
        from vn_sim_bridge.grid.dump import dump
    except ModuleNotFoundError as error:
        raise UserError('a grid scene is written with h5py', str(error),
                        "pip install 'vn_nav[grid]'") from error
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    print(dump(scene_name(args.scene), args.out, robot, step=args.step, size=args.size))
    return 0
