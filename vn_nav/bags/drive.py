"""Drives out of messages: every camera picture with what belongs to it, episode by episode.

Any bag will do: pictures raw or compressed, odometry or only the velocity that was commanded, at
any rate, driven by a policy or by hand. `synchronise` gives each picture its pose, depth and
labels by header stamps, as a stream. `vn_nav.bags.segmenter` then finds the robot's actions.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.motion import MotionError
from vn_nav.bags.poses import DeadReckoning, OdometryPoses
from vn_nav.bags.roles import Topics
from vn_nav.bags.stamped import EPISODE_GAP_S, PAIRING_TIMEOUT_S, Stamped, set_back
from vn_nav.bags.storage.stream import messages, summary

ODOMETRY_JUMP_M_PER_S = 5.0  # faster: the robot was carried, or its odometry was reset
ODOMETRY_JUMP_M = 0.3  # m that odometry may be corrected by between two pictures
RECORDED = 'recorded'  # world version of pictures from no simulator, or from several


def find_topics(bag: str | Path, wanted: Topics) -> Topics:
    """The topics of a bag by their roles, see `Topics.within`.

    Raises:
        UserError: no readable bag, or topics that it lacks or has with another type.
    """
    return wanted.within({name: topic.type for name, topic in summary(bag).items()})


def timestamped_messages(bag: str | Path, topics: Topics) -> Iterator[TimestampedMessage]:
    """The messages of a drive in the order of recording, one take after the other.

    No scans, and not the cameras of goals: `vn_nav.bags.goal_cameras` reads those.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: as `find_topics` returns them.

    Raises:
        BagError: damage, or a message that is not what its topic says.
    """
    names = tuple(filter(None, dataclasses.astuple(
        dataclasses.replace(topics, scan='', goal_camera_info=''))))
    for m in messages(bag, names, clocks=(topics.image, topics.odometry or topics.command)):
        yield TimestampedMessage(m.topic, m.message, m.time)


class TimestampedMessage(NamedTuple):
    """A message of a bag, in the order of recording."""

    topic: str
    message: Any
    time: float  # of recording [s]


@dataclasses.dataclass
class Frame:
    """A camera picture and what belongs to it; pictures are still messages."""

    image: Any
    stamp: float  # s, of its header; of recording where the header has none
    time: float  # s, of recording
    pose: np.ndarray  # [3] x, y [m], yaw [rad] in the frame of the odometry
    episode: int
    announced: int  # number of the episode by its announcements alone
    goal: Any = None
    depth: Any = None
    labels: Any = None


@dataclasses.dataclass
class Report:
    """What a bag held and what of it did not fit."""

    pictures: int = 0
    without_pose: int = 0  # no odometry within `STAMP_WINDOW_S`
    unordered: int = 0  # late and repeated stamps
    set_back: int = 0  # of the clock of the pictures: a new episode begins
    bad: int = 0  # velocities and poses that are none
    jumps: int = 0  # of the pose: a new episode begins
    episodes: int = 0
    actions: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    misfits: int = 0  # motions that fit no action

    @property
    def misfit_share(self) -> float:
        """Of all motions, those that fit no action."""
        return self.misfits / max(self.misfits + sum(self.actions.values()), 1)


def synchronise(messages: Iterable[TimestampedMessage], topics: Topics, report: Report
                ) -> Iterator[Frame]:
    """Camera pictures with their poses, in order, one episode after the other.

    Poses are interpolated between the odometry before and after a picture, if the nearer of the
    two lies within `STAMP_WINDOW_S`. Without odometry, commanded velocities are integrated. An
    episode ends with a message on `episode_end`, with a new goal, after `EPISODE_GAP_S` seconds
    without a picture, where the pose jumps, and where the clock of the pictures was set back (see
    `set_back`). What is held at a time is bounded by `PAIRING_TIMEOUT_S` seconds of recording.

    Args:
        messages: in the order of recording.
        topics: as `find_topics` returns them.
        report: is filled.
    """
    track = OdometryPoses() if topics.odometry else DeadReckoning()
    maps = {name: Stamped() for name in (topics.depth, topics.labels) if name}
    waiting: collections.deque[tuple[float, float, Any, int, Any]] = collections.deque()
    episode, goal, goal_stamp = 0, None, None
    newest = -math.inf  # s, of recording
    last: Frame | None = None
    for topic, message, time in messages:
        if topic in (topics.image, topics.odometry or topics.command):
            if set_back(time, newest):  # another take: nothing more comes of the one before
                while waiting:
                    last = yield from _settle(waiting.popleft(), track, maps, topics, last,
                                              report)
                newest = time
            newest = max(newest, time)
        if topic == topics.image:
            report.pictures += 1
            waiting.append((_stamp(message, time), time, message, episode, goal))
        elif topic in (topics.odometry, topics.command):
            if topic == (topics.odometry or topics.command):
                try:
                    track.add(message, time)
                except MotionError:
                    report.bad += 1
        elif topic in maps:
            maps[topic].add(_stamp(message, time), time, message)
        elif topic == topics.episode_end:
            episode += 1
        elif topic == topics.goal:
            stamp = _stamp(message, time)
            if goal_stamp not in (None, stamp):
                episode += 1
            goal, goal_stamp = message, stamp
        while waiting and (track.knows(waiting[0][0]) and all(
                rows.reaches(waiting[0][0]) for rows in maps.values())
                or waiting[0][1] < time - PAIRING_TIMEOUT_S):
            last = yield from _settle(waiting.popleft(), track, maps, topics, last, report)
    while waiting:
        last = yield from _settle(waiting.popleft(), track, maps, topics, last, report)


def _settle(picture, track, maps, topics: Topics, last: Frame | None, report: Report):
    """Yield a picture's frame, if it has one; the last frame that there was."""
    stamp, time, message, episode, goal = picture
    pose = track.pose(stamp, time)
    if pose is None:
        report.without_pose += 1
        return last
    back = last is not None and set_back(stamp, last.stamp)
    if last is not None and stamp <= last.stamp and not back and episode == last.announced:
        report.unordered += 1
        return last
    own = {role: maps[name].nearest(stamp, time) for role, name in (
        ('depth', topics.depth), ('labels', topics.labels)) if name}
    number = 0
    if last is not None:
        # Episodes are renumbered, because gaps and jumps begin episodes without a message.
        announced = episode != last.announced
        gap = stamp - last.stamp > EPISODE_GAP_S or time - last.time > EPISODE_GAP_S
        moved = math.hypot(*(pose[:2] - last.pose[:2]))
        jumped = moved > ODOMETRY_JUMP_M + ODOMETRY_JUMP_M_PER_S * max(stamp - last.stamp, 0.0)
        report.set_back += back
        report.jumps += jumped and not announced and not back
        number = last.episode + (announced or gap or jumped or back)
    report.episodes = number + 1
    frame = Frame(message, stamp, time, pose, number, episode, goal, **own)
    yield frame
    return frame


def _stamp(message: Any, time: float) -> float:
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec * 1e-9) or time
