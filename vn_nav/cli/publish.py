"""`vn_nav publish`: a run's checkpoint, measured and rounded, as one to ship."""

from __future__ import annotations

import argparse
import datetime
import re
from pathlib import Path

from vn_nav.cli.world import load_for_scenes, machine, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.measurement import EvaluateConfig, measure_checkpoint, odometry_for
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.report import tables
from vn_nav.robot import load_robot
from vn_nav.scenes import HOUSE, house_scene, parse_scene, rooms_of, scene_name

STOP_THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 0.95)  # that are tried


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav publish`."""
    parser.add_argument('source', type=Path, help='checkpoint of a training run')
    parser.add_argument('target', type=Path, help='for example models/house')
    parser.add_argument('--unseen', required=True, metavar='SCENE',
                        help='held out: the name of a scene, or the seed of a house')
    parser.add_argument('--episodes', type=int, default=100)
    parser.add_argument('--robot', type=Path, metavar='YAML', help='that it was trained for')


def run(args: argparse.Namespace) -> int:
    """`vn_nav publish`."""
    checkpoint, _ = load_for_scenes(args.source, args.robot)
    info = {key: value for key, value in checkpoint.info.items() if key != 'sha256'}
    scenes = info['scenes']
    if not scenes:
        raise UserError('a policy is published with figures of the scenes that it was trained in',
                        'a checkpoint that names none', 'train it in a simulator')
    unseen = held_out(args.unseen, info)
    kind = 'house' if info['simulator'] == HOUSE else 'scene'
    named = parse_scene(unseen).place if info['simulator'] == HOUSE else unseen
    save_checkpoint(args.target, checkpoint.network, info, half=True)
    shipped = load_checkpoint(args.target)  # measure what ships: the rounded weights
    if shipped.config.declares:
        info['stop_threshold'] = _stop_threshold(shipped, args)
        save_checkpoint(args.target, shipped.network, info, half=True)
        shipped = load_checkpoint(args.target)
    info['results'] = {}
    for place, names in ((f'trained {kind}', scenes),
                         (f'unseen {kind} {named}', [unseen])):
        rows = _measure(shipped, names, args)
        results = evaluator.figures(rows)
        tables.print_rows(results, place)
        for stop, row in results.items():
            kind = '' if stop == evaluator.ARRIVAL else 'declared stop, '
            info['results'] |= {f'{place}: {kind}{name}': figures
                                for name, figures in row.items()}
    odometry = odometry_for(shipped.network)
    named = '' if odometry == 'none' else f'odometry: {odometry}, '
    info['notes'] += (f' Measured with `vn_nav publish`, {args.episodes} episodes a row, 300 '
                      f'decisions at most, motion noise on, {named}on {machine()}, '
                      f'{datetime.date.today().isoformat()}. Figures are defined in '
                      'docs/architecture.md.')
    save_checkpoint(args.target, shipped.network, info, half=True)
    return 0


def held_out(text: str, info: dict) -> str:
    """The scene that is held out.

    Raises:
        UserError: no scene of the policy's simulator, or one that it was trained in.
    """
    if re.fullmatch(r'\d{1,18}', text) and info['simulator'] == HOUSE:
        return house_scene(int(text), rooms_of(info['scenes'][0]))
    unseen = scene_name(text)
    if parse_scene(unseen).simulator != info['simulator'] or unseen in info['scenes']:
        raise UserError(f'the scene held out is one of {info["simulator"]} that the policy was '
                        'not trained in', text, 'name another one with --unseen')
    return unseen


def _measure(checkpoint, scenes, args: argparse.Namespace, **changes) -> evaluator.Rows:
    """Episodes of a checkpoint in some scenes."""
    own = set(scenes) <= set(checkpoint.info['scenes'])

    def make(names, environments: int, stop: str):
        return make_env_for(checkpoint, names, environments, stop=stop, robot=args.robot, own=own)
    config = EvaluateConfig(episodes=args.episodes, **changes,
                            robot=load_robot(args.robot) if args.robot else None)
    return measure_checkpoint(checkpoint, scenes, make, config)


def _stop_threshold(checkpoint, args: argparse.Namespace) -> float:
    """The probability of arrival that is best declared at, on starts that no figure is from."""
    success = {}
    for threshold in STOP_THRESHOLDS:
        rows = _measure(checkpoint, checkpoint.info['scenes'][:16], args, seed=20_000,
                        controls=(), stop_threshold=threshold)
        (row,) = evaluator.figures(rows)[evaluator.DECLARED].values()
        success[threshold] = row['success']
        print(f'declaring above {threshold:.0%}: success {row["success"]:.2f}, false stops '
              f'{row["false_stops"]:.2f}', flush=True)
    return max(success, key=success.__getitem__)
