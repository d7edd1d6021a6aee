"""A bag's drive as a place of pictures, as `vn_nav teach` and `vn_nav evaluate --bag` read it."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.bags.dataset import MAX_DEPTH, DriveSet, Wanted, load_drives
from vn_nav.bags.drive import RECORDED
from vn_nav.bags.loops import ROUNDS, straighten
from vn_nav.bags.one_place import Part, check_frame, check_place, choose, parse_pictures
from vn_nav.bags.roles import Topics, load_topics
from vn_nav.bags.stream import messages
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec

GOALS, LEAST_GOALS = 1000, 4
LOOKED_AT = 128  # pixels a side of the pictures that places are recognised by


def add_place_options(parser: argparse.ArgumentParser) -> None:
    """How pictures become a place."""
    parser.add_argument('--topics', type=Path, metavar='YAML', help='names of the topics')
    parser.add_argument('--margin', type=float, metavar='M',
                        help='beside the driven path that counts as free [m]; default 0.3')
    parser.add_argument('--straighten', action=argparse.BooleanOptionalAction, default=True,
                        help='correct odometry by the places that the drive shows twice '
                        '(docs/bags.md)')
    parser.add_argument('--pictures', metavar='A-B[,C-D]', help='numbers of those to learn from; '
                        'several ranges: you vouch for their odometry being in one frame')
    parser.add_argument('--goals', type=int, default=GOALS, help='pictures to drive to, at most')
    parser.add_argument('--cache', type=Path, metavar='DIR', help='that keeps decoded bags; '
                        'default: `decoded` in the folder of a run, or none')


def given_place_options(args: argparse.Namespace) -> list[str]:
    """Names of those that differ from their default."""
    given = {'--topics': args.topics, '--margin': args.margin, '--cache': args.cache,
             '--pictures': args.pictures,
             '--no-straighten': None if args.straighten else True,
             '--goals': None if args.goals == GOALS else args.goals}
    return [name for name, value in given.items() if value is not None]


def check_place_options(args: argparse.Namespace) -> None:
    """Refuse what no drive is a place with."""
    if args.goals < LEAST_GOALS:
        raise UserError('there are at least four goals', args.goals, 'raise --goals')
    if args.pictures:
        parse_pictures(args.pictures)


def read_place(args: argparse.Namespace, build_graph: Callable, robot: RobotSpec, size: int,
               cache: Path, show: Callable[[str, float], None] = lambda stage, share: None,
               until: float = math.inf) -> Any:
    """The place out of a bag, and words about it on standard output.

    Args:
        args: `bag` and the options of `add_place_options`.
        build_graph: of the simulator's half, `vn_sim_bridge.recorded.image_graph.build_graph`.
        robot: that drove, with the policy's actions.
        size: side of the pictures [pixels].
        cache: folder of decoded bags.
        show: is told what is done, and the share of it that is.
        until: see `loops.straighten`.

    Raises:
        UserError: a bag without what is needed; a drive too short, of one spot, or of several
            places.
    """
    topics = load_topics(args.topics) if args.topics else Topics()

    def load(side: int) -> DriveSet:
        return load_drives(args.bag, Wanted(robot, side, topics, every=True), cache,
                           lambda share: show(f'pictures of {side} pixels', share))
    drives = load(size)
    facts = drives.facts
    print(f'{args.bag}: {len(drives):,} pictures with poses in {facts["episodes"]:,} '
          f'stretch{"es" * (facts["episodes"] > 1)}; {facts["without_pose"]:,} without a pose, '
          f'{facts["jumps"]:,} jumps' + (f', {facts["set_back"]:,} times the clock of the '
                                         'pictures was set back' if facts['set_back'] else ''),
          flush=True)
    for note in facts['notes']:
        print(f'{args.bag}: {note}', flush=True)
    part = choose(args.bag, drives, args.pictures)
    if len(part.rows) < len(drives):
        print(f'{len(part.rows):,} of the {len(drives):,} pictures are used'
              + (f': {args.pictures}' if args.pictures else ''), flush=True)
    margin = {} if args.margin is None else {'margin': args.margin}
    stretch = part.stretch
    if args.straighten:
        # Larger pictures than the network's tell more exactly where they were taken.
        large = load(LOOKED_AT) if size < LOOKED_AT else drives
        found = straighten(part.of(large), robot, stretch=stretch, until=until,
                           show=lambda share: show('places seen again', share))
        check_place(part, found)
        _say(found.facts, len(part.reasons), part.vouched)
        poses = found.poses
    else:
        check_frame(part)
        poses = part.drives.pose
    show('the place', 0.0)
    return build_graph(
        part.drives.image, poses, _episodes(part), robot, depth=part.drives.depth,
        farthest=MAX_DEPTH, goals=args.goals, goal_pictures=drives.goals, **margin,
        world_version=str(scene_of(args.bag).get('world_version', RECORDED)),
        name=f'bag:{args.bag}')


def _episodes(part: Part) -> np.ndarray:
    """[K] numbers of what nobody drove in between: episodes, and stretches of odometry."""
    anew = (np.diff(part.drives.episode) != 0) | (np.diff(part.stretch) != 0)
    return np.append(0, np.cumsum(anew))


def _say(facts: dict, stretches: int, vouched: bool) -> None:
    """How odometry was corrected."""
    if stretches > 1:
        print(f'{stretches} stretches that odometry does not connect: '
              + ('taken for one frame, as --pictures says' if vouched else
                 'pictures show that they are of one place'), flush=True)
    if facts['corrected']:
        print(f'odometry is straightened: {facts["closures"]:,} times the robot saw a place '
              f'again; poses moved by up to {facts["moved"]:.2f} m and '
              f'{math.degrees(facts["turned"]):.0f} deg', flush=True)
    else:
        print('odometry stays as it is: too few places are recognised when seen again', flush=True)
    if facts['rounds'] < len(ROUNDS):
        print(f'the search for them ended after round {facts["rounds"]} of {len(ROUNDS)}, for '
              'lack of time', flush=True)


def scene_of(bag: Path) -> dict:
    """What a simulator said of the scene of a bag; empty: nobody did."""
    first = next(messages(bag, ('scene',)), None)
    try:
        said = json.loads(first.message.data) if first is not None else {}
    except (AttributeError, TypeError, ValueError):  # another kind of scene
        return {}
    return said if isinstance(said, dict) else {}
