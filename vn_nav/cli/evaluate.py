"""`vn_nav evaluate`: a checkpoint in the scenes of a simulator, or in a recorded drive."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

from vn_nav.cli.options import (
    add_place_options,
    check_folders,
    given_place_options,
    place_options,
)
from vn_nav.cli.scenes import SPLIT_SCENES, UNSEEN_GOALS, checkpoint_scenes, scenes_from
from vn_nav.cli.world import (
    add_world,
    check_backend,
    check_version,
    load_for,
    long_rows,
    make_env_for,
)
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.measurement import EvaluateConfig, evaluate, odometry_for, ranges_for
from vn_nav.files import write_file
from vn_nav.learning.teach_evaluation import DRIVE_SPLITS
from vn_nav.policy.network_config import SEARCH
from vn_nav.policy.search.local_features import SIDE
from vn_nav.policy.search.views import NONE, VERIFY, check_verify
from vn_nav.report import tables
from vn_nav.report.evaluation_page import evaluation_page
from vn_nav.robot import load_robot
from vn_nav.scenes import BAG, HOUSE, one_simulator, rooms_of

# Options without meaning in a bag.
OF_SCENES = ('scene', 'house', 'houses', 'rooms', 'randomisation')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav evaluate`."""
    parser.add_argument('checkpoint', type=Path)
    add_world(parser, defaults=False)
    parser.add_argument('--split', action='append', metavar='NAME',
                        help='train, validation, test, unseen_look (other scenes), seen_goals or '
                        "unseen_goals (in the checkpoint's own scenes; the first of the two is "
                        'the default); may be given several times. In a bag: seen_goals, '
                        'unseen_goals, as `vn_nav teach` divides them; default: all')
    parser.add_argument('--bag', type=Path, metavar='BAG', help='measure in the pictures of this '
                        'recorded drive, as `vn_nav teach` makes a place of it, not in scenes')
    add_place_options(parser)
    parser.add_argument('--houses', type=int, metavar='N', help='the first N scenes of each split '
                        f'(default: all of its own, {SPLIT_SCENES} others)')
    parser.add_argument('--episodes', type=int, default=100,
                        help='of a row at least; the same number in each scene')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--decoding', choices=('sample', 'greedy'))
    parser.add_argument('--stop-threshold', type=float, metavar='P', help='probability above '
                        "which the arrival head declares a stop (default: the checkpoint's)")
    parser.add_argument('--odometry', choices=('true', 'drift', 'commanded', 'none'),
                        help='that a policy which uses odometry is given: what really happened, '
                        'that with the errors of a good base, or the moves as commanded (default: '
                        'drift; none for other policies)')
    parser.add_argument('--ranges', choices=('picture', 'scan', 'depth'),
                        help='that the map of a policy which searches is given: what its network '
                        'sees in the picture, a laser scan all around, or a depth picture '
                        '(default: picture)')
    parser.add_argument('--verify', choices=VERIFY, default=NONE, help='by what the sight of a '
                        'policy which searches is verified: local features of pictures of '
                        f'{SIDE} pixels, which its network is shown shrunk (default: none)')
    parser.add_argument('--stop', choices=evaluator.STOPS, help='what ends the episodes: '
                        'arriving, or that the policy says so (default: both, apart)')
    parser.add_argument('--difficulty', type=float, default=1.0, metavar='TAU', help='of the '
                        'starts, as in a curriculum: share of the largest distance from which '
                        'they are drawn (default 1: anywhere)')
    parser.add_argument('--no-controls', action='store_true')
    parser.add_argument('--per-scene', action='store_true', help='print each scene as well')
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write the figures here')
    parser.add_argument('--html', type=Path, metavar='FILE', help='also write a page with maps')
    parser.add_argument('--maps', type=int, default=6, help='of episodes of each split')


def run(args: argparse.Namespace) -> int:
    """`vn_nav evaluate`."""
    check_backend(args.backend)
    _check(args)
    config = EvaluateConfig(
        episodes=args.episodes, seed=args.seed, decoding=args.decoding,
        controls=() if args.no_controls else evaluator.CONTROLS,
        stop_threshold=args.stop_threshold, robot=load_robot(args.robot) if args.robot else None,
        stops=(args.stop,) if args.stop else evaluator.STOPS, verify=args.verify,
        difficulty=args.difficulty)
    # Pictures of a drive were taken with its own camera.
    checkpoint, robot = load_for(args.checkpoint, args.robot, any_camera=args.bag is None)
    odometry = odometry_for(checkpoint.network, args.odometry)
    ranges = ranges_for(checkpoint.network, args.ranges)
    check_verify(args.verify, checkpoint.config.architecture == SEARCH)
    measured_by = '' if ranges == 'picture' else f', ranges: {ranges}'
    measured_by += '' if args.verify == NONE else f', verify: {args.verify}'
    bag = args.bag.name if args.bag else None

    def show(name: str, result: dict) -> None:
        split = result['splits'][name]
        camera = f', camera {result["camera"]}' if args.robot else ''
        title = (f'{args.checkpoint}, {tables.place(name, list(split["scenes"]), bag)}, '
                 f'{args.max_decisions} decisions at most{camera}{measured_by}')
        tables.print_rows(split['rows'], title)
        if args.per_scene and not args.bag:
            tables.print_scenes(split['scenes'], title)

    with tempfile.TemporaryDirectory() as decoded:  # the pictures of a drive are mapped from there
        splits, make_env = (
            _drive(args, checkpoint, robot, args.cache or Path(decoded), odometry) if args.bag else
            _scenes(args, checkpoint, odometry))
        done = evaluate(checkpoint, splits, make_env, config, name=str(args.checkpoint), bag=bag,
                        on_split=show, on_row=long_rows())
    if args.json:
        write_file(args.json, json.dumps(done.result, indent=2).encode())
    if args.html:
        page = evaluation_page(done.result, done.measured, done.plans, maps=args.maps)
        write_file(args.html, page.encode())
    return 0


def _check(args: argparse.Namespace) -> None:
    """Refuse before hours of work what would fail after them.

    Raises:
        UserError: which option, and why.
    """
    rules = (
        (args.houses is None or args.houses >= 1, 'a split has at least one scene', args.houses,
         'raise --houses'),
        (not ((args.house or args.scene) and (args.split or args.houses)),
         'scenes are given by name or by split',
         '--scene or --house together with --split or --houses', 'leave one of them out'),
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
    check_folders(args.json, args.html)


def _check_drive(args: argparse.Namespace) -> None:
    """Whether the options are for a recorded drive."""
    for name in OF_SCENES:
        if getattr(args, name) is not None:
            raise UserError('a recorded drive has pictures and a size of its own',
                            f'--{name} together with --bag', 'leave one of them out')
    if args.ranges not in (None, 'picture'):
        raise UserError('nobody measures ranges in the pictures of a recorded drive',
                        f'--ranges {args.ranges} together with --bag', 'leave one of them out')
    if args.verify != NONE:
        raise UserError("local features are of full pictures; of a recorded drive the policy's "
                        'own are kept', f'--verify {args.verify} together with --bag',
                        'leave one of them out')
    for name in args.split or ():
        if name not in DRIVE_SPLITS:
            raise UserError(f'goals of a drive are divided into {" and ".join(DRIVE_SPLITS)}',
                            name, 'choose one of them, or leave out --split')


def _splits(args: argparse.Namespace, info: dict) -> dict[str, list[str]]:
    """The scenes of each split that is asked for."""
    houses = info['simulator'] == HOUSE
    if args.rooms and not (houses or args.house):
        raise UserError('rooms are a number of houses', f'--rooms {args.rooms} with a policy of '
                        f'{info["simulator"]}', 'leave it out')
    if args.house or args.scene:
        return {'scenes': scenes_from(args, args.rooms or (_rooms(info) if houses else None))}
    return {name: checkpoint_scenes(info, name, args.houses, args.rooms)
            for name in args.split or ['seen_goals']}


def _rooms(info: dict) -> int | None:
    """Rooms of the houses that a checkpoint knows."""
    return rooms_of(info['scenes'][0]) if info['scenes'] else None


def _scenes(args: argparse.Namespace, checkpoint, odometry: str) -> tuple[dict, Callable]:
    """The scenes of each split, and what makes environments of them."""
    splits = _splits(args, checkpoint.info)
    for scenes in splits.values():
        check_version(checkpoint.info, simulator=one_simulator(scenes)[0])

    said: set[str] = set()

    def say(line: str) -> None:  # once, however many environments there are
        if line not in said:
            said.add(line)
            print(line, flush=True)

    def make(split: str, names, environments: int, stop: str):
        return make_env_for(
            checkpoint, names, environments, stop=stop, robot=args.robot,
            own=set(splits[split]) <= set(checkpoint.info['scenes']),
            randomisation=args.randomisation, max_decisions=args.max_decisions,
            goal_seed=UNSEEN_GOALS if split == 'unseen_goals' else 0, odometry=odometry,
            ranges=args.ranges, smallest=0 if args.verify == NONE else SIDE, say=say)
    return splits, make


def _drive(args: argparse.Namespace, checkpoint, robot, cache: Path, odometry: str
           ) -> tuple[dict, Callable]:
    """The goals of each split in a recorded drive, and what makes environments there."""
    from vn_nav.bags.mapping.recorded_place import read_place
    from vn_sim_bridge import teach_place as place
    graph = read_place(args.bag, place_options(args), place.build_graph, robot,
                       checkpoint.config.size, cache)
    check_version(checkpoint.info, simulator=BAG, version=graph.world_version)
    graphs = {'all_goals': graph}
    if args.split:
        own, others = place.held_out(graph)
        if others is None:
            raise UserError('there are enough goals to hold some out',
                            f'{len(graph.goals)} goals', 'leave out --split')
        divided = dict(zip(DRIVE_SPLITS, (own, others), strict=True))
        graphs = {name: divided[name] for name in args.split}

    def make(split: str, _, environments: int, stop: str):
        return place.make_env(graphs[split], robot, environments, stop=stop, light=True,
                              task=checkpoint.info['task'], max_decisions=args.max_decisions,
                              odometry=odometry)
    return {name: [graph.name] for name in graphs}, make
