"""`vn_nav robustness`: what a checkpoint bears: noise, light, cameras, blur, latency, drift."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vn_nav.cli.options import check_folders
from vn_nav.errors import UserError

if TYPE_CHECKING:
    from vn_nav.robot import RobotSpec

PAGE = 'page.html'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav robustness`."""
    from vn_nav.evaluation.robustness import RobustnessConfig, factors
    usual, names = RobustnessConfig(), ', '.join(factors(1.0, 90.0, odometry=True))
    parser.add_argument('checkpoint', type=Path)
    parser.add_argument('--out', type=Path, required=True, metavar='FOLDER', help=f'for {PAGE} '
                        'and a JSON file of each level: a second run goes on where the first '
                        'ended')
    parser.add_argument('--factors', nargs='+', metavar='NAME', help=f'some of {names}')
    parser.add_argument('--split', default=usual.split, metavar='NAME',
                        help=f'of scenes (default {usual.split})')
    parser.add_argument('--houses', type=int, default=usual.houses, metavar='N',
                        help=f'the first N scenes of the split (default {usual.houses})')
    parser.add_argument('--episodes', type=int, default=usual.episodes,
                        help='of a level at least; the same number in each scene, from the same '
                        f'starts at every level (default {usual.episodes})')
    parser.add_argument('--max-decisions', type=int, default=usual.max_decisions)
    parser.add_argument('--seed', type=int, default=usual.seed)
    parser.add_argument('--stop-threshold', type=float, metavar='P',
                        help="of the declared stop (default: the checkpoint's)")
    parser.add_argument('--randomisation', metavar='NAME', help='usual light, camera and base '
                        '(default: that of the training)')
    parser.add_argument('--robot', type=Path, metavar='YAML', help='the usual robot '
                        '(default: that of the training)')
    parser.add_argument('--png', type=Path, metavar='FILE', help='also write all charts here')


def run(args: argparse.Namespace) -> int:
    """`vn_nav robustness`."""
    from vn_nav.cli.scenes import split_scenes
    from vn_nav.cli.world import check_version, load_for, machine
    from vn_nav.evaluation.robustness import (
        Robustness,
        RobustnessConfig,
        factors,
        measure_robustness,
    )
    from vn_nav.files import write_file
    from vn_nav.report import robustness_page, tables
    from vn_nav.robot import load_robot
    from vn_nav.scenes import rooms_of
    config = RobustnessConfig(
        split=args.split, houses=args.houses, episodes=args.episodes, seed=args.seed,
        max_decisions=args.max_decisions, randomisation=args.randomisation,
        stop_threshold=args.stop_threshold, robot=load_robot(args.robot) if args.robot else None)
    if args.png is not None and args.png.suffix != '.png':
        raise UserError('the picture of the charts is a PNG: its name ends in .png',
                        str(args.png), 'correct --png')
    check_folders(args.out, args.png)
    checkpoint, robot = load_for(args.checkpoint, args.robot, any_camera=True)
    info = checkpoint.info
    known = factors(robot.camera_height, math.degrees(robot.camera_fov),
                    odometry=checkpoint.network.uses_odometry,
                    motion_noise=info['motion_noise'] != 'none')
    if unknown := [name for name in args.factors or () if name not in known]:
        raise UserError(f'the factors of this policy are {", ".join(known)}', unknown[0],
                        'choose some of them (--factors)')
    chosen = {name: own for name, own in known.items()
              if args.factors is None or name in args.factors}
    check_version(info, simulator=info['simulator'])
    scenes = split_scenes(info['simulator'], args.split, args.houses,
                          rooms_of(info['scenes'][0]) if info['scenes'] else None)
    place = f'{tables.place(args.split, scenes)}, {args.max_decisions} decisions at most'
    try:
        args.out.mkdir(exist_ok=True)
    except FileExistsError as error:
        raise UserError('results go into a folder', str(args.out), 'correct --out') from error

    def write(found: Robustness) -> None:
        page = robustness_page.robustness_page(found, name=str(args.checkpoint), place=place)
        write_file(args.out / PAGE, page.encode())

    def show(key: str, figures: dict, found: Robustness) -> None:
        print(tables.row_line(key, figures, found.stop), flush=True)
        write(found)

    found = measure_robustness(
        checkpoint, chosen, scenes, env_maker(
            checkpoint, robot, own=config.robot, randomisation=args.randomisation,
            max_decisions=args.max_decisions),
        config, args.out, name=str(args.checkpoint), machine=machine(), on_level=show,
        say=lambda line: print(line, file=sys.stderr, flush=True))
    write(found)
    if args.png is not None:
        write_file(args.png, robustness_page.robustness_png(found))
    print(robustness_page.markdown(found))
    print(args.out / PAGE)
    return 1 if found.refused else 0


def env_maker(checkpoint, robot: RobotSpec, *, own: RobotSpec | None = None,
              randomisation: str | None = None, max_decisions: int = 300) -> Callable:
    """What makes the environments of a level, for `measure_robustness`.

    Args:
        checkpoint: the policy.
        robot: the usual one.
        own: the same, where it is not the scenes' own.
        randomisation: usual; None: that of the training.
        max_decisions: of an episode.
    """
    from vn_nav.cli.world import check_camera, make_env_for
    from vn_nav.evaluation.robustness import Level
    from vn_sim_bridge.render.randomisation import Randomisation, load_randomisation
    usual = load_randomisation(randomisation or checkpoint.info['randomisation'])

    def make(level: Level, names, environments: int, stop: str):
        changes: dict[str, Any] = {field: value for field, value in (
            ('camera_height', level.camera_height),
            ('camera_fov', None if level.camera_fov_deg is None
             else math.radians(level.camera_fov_deg))) if value is not None}
        changed = own
        if changes:
            changed = dataclasses.replace(robot, **changes)
            check_camera(checkpoint, changed.camera_fov)
        noise: dict[str, Any] = (
            {} if level.motion_noise is None else {'noise': level.motion_noise})
        varied: str | Randomisation | None = randomisation
        of_goals = None
        if level.light != 1.0:
            varied = usual.with_light(level.light)
        elif level.exposure or level.blur is not None:
            varied, of_goals = usual.with_camera(level.exposure, level.blur), usual
        return make_env_for(
            checkpoint, names, environments, stop=stop, own=False, robot=changed,
            randomisation=varied, goal_randomisation=of_goals, max_decisions=max_decisions,
            odometry=level.odometry, drift=level.drift, **noise)
    return make
