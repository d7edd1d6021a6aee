"""Goals out of a recorded drive: pictures along it, and where they were taken."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import Report, find_topics, synchronise, timestamped_messages
from vn_nav.bags.roles import Topics
from vn_nav.dashboard.pictures import jpeg
from vn_nav.errors import UserError

APART_M, APART_RAD = 0.5, math.radians(40)  # between two goals, one of both at least
MOST = 200
KEPT_SIDE_PX = 1000  # as of `goal_picture`
THUMBNAIL_PX = 160


class RecordedGoal(NamedTuple):
    """A picture of the drive."""

    pose: np.ndarray  # [3] x, y [m], yaw [rad], in the bag's odometry
    picture: np.ndarray  # [H,W,3] uint8 RGB
    thumbnail: bytes  # JPEG


class RecordedGoals(NamedTuple):
    """What a bag has to choose from."""

    name: str
    path: np.ndarray  # [K,2] m: the whole drive
    goals: list[RecordedGoal]


def read_goals(bag: Path, most: int = MOST) -> RecordedGoals:
    """Pictures of a bag that are `APART_M` or `APART_RAD` apart, with their poses.

    Args:
        bag: folder or file.
        most: goals.

    Raises:
        UserError: no bag, or one without camera and odometry.
    """
    topics = find_topics(bag, Topics())
    goals: list[RecordedGoal] = []
    apart = 1.0
    path: list[np.ndarray] = []
    for frame in synchronise(timestamped_messages(bag, topics), topics, Report()):
        if not path or not np.array_equal(frame.pose[:2], path[-1]):
            path.append(frame.pose[:2])
        if any(_near(frame.pose, goal.pose, apart) for goal in goals):
            continue
        try:
            picture = decode_rgb(frame.image, KEPT_SIDE_PX)
        except ImageError:
            continue
        goals.append(RecordedGoal(frame.pose.copy(), picture, jpeg(picture, THUMBNAIL_PX)))
        while len(goals) > most:  # a long drive: fewer, further apart
            apart *= 2.0
            kept: list[RecordedGoal] = []
            for goal in goals:
                if not any(_near(goal.pose, other.pose, apart) for other in kept):
                    kept.append(goal)
            goals = kept
    if not goals:
        raise UserError('a bag to choose goals from holds camera pictures and odometry', str(bag),
                        'see `vn_nav bag doctor`')
    return RecordedGoals(bag.name, np.array(path), goals)


def _near(one: np.ndarray, other: np.ndarray, apart: float) -> bool:
    """Whether two poses [3] are no two goals; `apart`: times the usual spacing."""
    return math.dist(one[:2], other[:2]) < apart * APART_M and (
        abs(wrap_angle(one[2] - other[2])) < apart * APART_RAD)
