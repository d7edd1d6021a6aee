"""A bag's drive as a place of pictures, as `vn_nav teach` and `vn_nav evaluate --bag` read it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.bags.dataset import MAX_DEPTH, DriveSet, Wanted
from vn_nav.bags.drive import RECORDED
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.mapping.loop_closure import ROUND_FACTORS, optimise_odometry
from vn_nav.bags.mapping.one_place import Part, check_frame, check_place, choose, parse_pictures
from vn_nav.bags.roles import Topics
from vn_nav.bags.storage.stream import messages
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec

MAX_GOALS, MIN_GOALS = 1000, 4
PLACE_PICTURE_PX = 128  # pixels a side of the pictures that places are recognised by


@dataclasses.dataclass(frozen=True)
class PlaceOptions:
    """How the pictures of a drive become a place.

    Raises:
        UserError: values that no drive is a place with.
    """

    topics: Topics = Topics()  # names in the bag
    margin: float | None = None  # m around the driven path that counts as free; None: 0.3
    loop_closure: bool = True  # correct odometry by the places that the drive shows twice
    # Numbers of the pictures to learn from, 'A-B[,C-D]'; several ranges: the caller vouches for
    # their odometry being in one frame. Empty: all that are of one place.
    pictures: str = ''
    goals: int = MAX_GOALS  # pictures to drive to, at most

    def __post_init__(self):
        if self.goals < MIN_GOALS:
            raise UserError('there are at least four goals', self.goals, 'raise --goals')
        if self.pictures:
            parse_pictures(self.pictures)


def read_place(bag: Path, options: PlaceOptions, build_graph: Callable, robot: RobotSpec,
               size: int, cache: Path,
               show: Callable[[str, float], None] = lambda stage, share: None,
               until: float = math.inf) -> Any:
    """The place out of a bag; a summary of it goes to standard output.

    Args:
        bag: the drive.
        options: how it becomes a place.
        build_graph: of the simulator's half, `vn_sim_bridge.recorded.image_graph.build_graph`.
        robot: that drove, with the policy's actions.
        size: side of the pictures [pixels].
        cache: folder of decoded bags.
        show: receives the current step and its share done.
        until: see `loop_closure.optimise_odometry`.

    Raises:
        UserError: a bag without what is needed; a drive too short, of one spot, or of several
            places.
    """
    def load(side: int) -> DriveSet:
        return load_drives(bag, Wanted(robot, side, options.topics, every=True), cache,
                           lambda share: show(f'pictures of {side} pixels', share))
    drives = load(size)
    facts = drives.facts
    print(f'{bag}: {len(drives):,} pictures with poses in {facts["episodes"]:,} '
          f'stretch{"es" * (facts["episodes"] > 1)}; {facts["without_pose"]:,} without a pose, '
          f'{facts["jumps"]:,} jumps' + (f', {facts["set_back"]:,} times the clock of the '
                                         'pictures was set back' if facts['set_back'] else ''),
          flush=True)
    for note in facts['notes']:
        print(f'{bag}: {note}', flush=True)
    part = choose(bag, drives, options.pictures)
    if len(part.rows) < len(drives):
        print(f'{len(part.rows):,} of the {len(drives):,} pictures are used'
              + (f': {options.pictures}' if options.pictures else ''), flush=True)
    margin = {} if options.margin is None else {'margin': options.margin}
    stretch = part.stretch
    if options.loop_closure:
        # Larger pictures than the network's show more exactly where they were taken.
        large = load(PLACE_PICTURE_PX) if size < PLACE_PICTURE_PX else drives
        found = optimise_odometry(part.of(large), robot, stretch=stretch, until=until,
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
        farthest=MAX_DEPTH, goals=options.goals, goal_pictures=drives.goals, **margin,
        world_version=str(scene_of(bag).get('world_version', RECORDED)),
        name=f'bag:{bag}')


def _episodes(part: Part) -> np.ndarray:
    """[K] numbers of independent parts: episodes, and stretches of odometry."""
    anew = (np.diff(part.drives.episode) != 0) | (np.diff(part.stretch) != 0)
    return np.append(0, np.cumsum(anew))


def _say(facts: dict, stretches: int, vouched: bool) -> None:
    """How odometry was corrected."""
    if stretches > 1:
        print(f'{stretches} stretches that odometry does not connect: '
              + ('taken for one frame, as --pictures states' if vouched else
                 'pictures show that they are of one place'), flush=True)
    if facts['corrected']:
        print(f'odometry is corrected: {facts["closures"]:,} times the robot saw a place '
              f'again; poses moved by up to {facts["moved"]:.2f} m and '
              f'{math.degrees(facts["turned"]):.0f} deg', flush=True)
    else:
        print('odometry is not corrected: too few loop closures', flush=True)
    if facts['rounds'] < len(ROUND_FACTORS):
        print(f'the search for loop closures ended after round {facts["rounds"]} of '
              f'{len(ROUND_FACTORS)}: time limit', flush=True)


def scene_of(bag: Path) -> dict:
    """The message on `scene` in a bag; empty: there is none."""
    first = next(messages(bag, ('scene',)), None)
    try:
        said = json.loads(first.message.data) if first is not None else {}
    except (AttributeError, TypeError, ValueError):  # another kind of scene
        return {}
    return said if isinstance(said, dict) else {}
