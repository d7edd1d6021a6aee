"""What `vn_nav evaluate` and `vn_nav compare` do apart from the simulator: options and output."""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Callable
from pathlib import Path

from vn_nav.bags.recorded_place import (
    add_place_options,
    check_place_options,
    given_place_options,
)
from vn_nav.errors import UserError

# Options without meaning in a bag.
OF_SCENES = ('scene', 'house', 'houses', 'rooms', 'randomisation')
DRIVE_SPLITS = ('seen_goals', 'unseen_goals')  # as `vn_nav teach` learns goals, and holds them out
SPLIT_SCENES = 20  # of a split that the checkpoint does not know, unless told otherwise


def add_evaluate_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav evaluate`, beside those of the world."""
    parser.add_argument('--split', action='append', metavar='NAME',
                        help='train, validation, test, unseen_look (other houses), seen_goals or '
                        "unseen_goals (in the checkpoint's own houses; the first of the two is "
                        'the default); may be given several times. In a bag: seen_goals, '
                        'unseen_goals, as `vn_nav teach` divides them; default: all')
    parser.add_argument('--bag', type=Path, metavar='BAG', help='measure in the pictures of this '
                        'recorded drive, as `vn_nav teach` makes a place of it, not in houses')
    add_place_options(parser)
    parser.add_argument('--houses', type=int, metavar='N', help='the first N houses of each split '
                        f'(default: all of its own, {SPLIT_SCENES} others)')
    parser.add_argument('--episodes', type=int, default=100,
                        help='of a row at least; the same number in each house')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--decoding', choices=('sample', 'greedy'))
    parser.add_argument('--stop-threshold', type=float, metavar='P', help='probability above '
                        "which the arrival head declares a stop (default: the checkpoint's)")
    parser.add_argument('--no-controls', action='store_true')
    parser.add_argument('--per-scene', action='store_true', help='print each scene as well')
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write the figures here')
    parser.add_argument('--html', type=Path, metavar='FILE', help='also write a page with maps')
    parser.add_argument('--maps', type=int, default=6, help='of episodes of each split')


def add_compare_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav compare`."""
    parser.add_argument('runs', nargs='+', type=Path, metavar='RUN', help='folder with '
                        'metrics.csv; NAME-seed1, NAME-seed2, ... are seeds of one curve')
    parser.add_argument('--out', type=Path, default=Path('compare.html'),
                        help='page (.html) or picture (.svg, .png)')
    parser.add_argument('--metric', default='success', help='a column of metrics.csv')
    parser.add_argument('--labels', nargs='+', metavar='LABEL', help='a name for each run; equal '
                        'names are seeds of one curve')
    parser.add_argument('--band', choices=('range', 'std'), default='range', help='over seeds: '
                        'from the smallest to the largest, or one standard deviation each way')
    parser.add_argument('--log', action='store_true', help='logarithmic frames and minutes')
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write the table here')


def check_evaluate_options(args) -> None:
    """Refuse before hours of work what would fail after them.

    Raises:
        UserError: which option, and why.
    """
    rules = (
        (args.episodes >= 1, 'there is at least one episode', args.episodes, 'raise --episodes'),
        (args.houses is None or args.houses >= 1, 'a split has at least one house', args.houses,
         'raise --houses'),
        (not ((args.house or args.scene) and (args.split or args.houses)),
         'scenes are given by name or by split',
         '--scene or --house together with --split or --houses', 'leave one of them out'),
        (args.stop_threshold is None or 0 <= args.stop_threshold < 1,
         'the stop threshold lies in [0, 1)', args.stop_threshold, 'choose a value in range'),
        (args.maps >= 0, 'the number of maps is not negative', args.maps, 'raise --maps'),
    )
    for kept, rule, received, remedy in rules:
        if not kept:
            raise UserError(rule, received, remedy)
    if args.bag is not None:
        _check_drive(args)
    elif given := given_place_options(args):
        raise UserError('pictures with poses are made a place in a recorded drive',
                        f'{", ".join(given)} without --bag', 'give --bag')
    _check_folders(args.json, args.html)


def _check_drive(args) -> None:
    """Whether the options are for a recorded drive."""
    check_place_options(args)
    for name in OF_SCENES:
        if getattr(args, name) is not None:
            raise UserError('a recorded drive has pictures and a size of its own',
                            f'--{name} together with --bag', 'leave one of them out')
    for name in args.split or ():
        if name not in DRIVE_SPLITS:
            raise UserError(f'goals of a drive are divided into {" and ".join(DRIVE_SPLITS)}',
                            name, 'choose one of them, or leave out --split')


def _check_folders(*files: Path | None) -> None:
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise UserError('a file is written into a folder that exists', str(file),
                            'make the folder, or choose another place')


def evaluate(args, info: dict, splits: dict[str, list[str]], measure: Callable) -> None:
    """Measure every split, print its tables, write JSON and page.

    Args:
        args: of the command line.
        info: of the checkpoint.
        splits: names of the scenes by the split's name.
        measure: (split, scenes) -> episodes as of `evaluator.measure`, floor plans by scene.
    """
    from vn_nav.evaluation import evaluator, tables
    from vn_nav.evaluation.evaluation_page import evaluation_page
    from vn_nav.files import write_file
    result = {
        'checkpoint': str(args.checkpoint), 'sha256': info['sha256'],
        'bag': args.bag.name if args.bag else None,
        'simulator': info['simulator'], 'world_version': info['world_version'],
        'task': info['task'],
        'decoding': args.decoding or info['decoding'], 'max_decisions': args.max_decisions,
        'seed': args.seed, 'date': datetime.date.today().isoformat(), 'splits': {}}
    measured, plans = {}, {}
    for name, scenes in splits.items():
        measured[name], plans[name] = measure(name, scenes)
        split = evaluator.split_figures(measured[name], scenes)
        result['splits'][name] = split
        title = (f'{args.checkpoint}, {tables.place(name, scenes, result["bag"])}, '
                 f'{args.max_decisions} decisions at most')
        tables.print_rows(split['rows'], title)
        if args.per_scene and not args.bag:
            tables.print_scenes(split['scenes'], title)
    if args.json:
        write_file(args.json, json.dumps(result, indent=2).encode())
    if args.html:
        write_file(args.html, evaluation_page(result, measured, plans, maps=args.maps).encode())


def run_compare(args) -> int:
    """`vn_nav compare`."""
    from vn_nav.evaluation.compare import compare
    _check_folders(args.out, args.json)
    compare(args.runs, args.out, metric=args.metric, labels=args.labels, band=args.band,
            log=args.log, json_file=args.json)
    return 0
