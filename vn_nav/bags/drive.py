"""Drives out of messages: frames with their poses, and where the robot's actions begin and end.

Any bag will do: pictures raw or compressed, odometry or only the velocity that was commanded, at
any rate, driven by a policy or by hand. Two stages, both streaming:

`synchronise` gives every camera picture the pose, depth and labels that belong to it, by header
stamps, and separates episodes. `ActionSegmenter` finds, along the poses, the pictures between
which the robot did just one of its discrete actions; what fits no action is kept, and counted.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav.arrival import wrap_angle
from vn_nav.bags.roles import Topics
from vn_nav.bags.stamped import EPISODE_GAP_S, PAIRING_TIMEOUT_S, Stamped, set_back
from vn_nav.bags.storage.stream import messages, summary
from vn_nav.robot import RobotSpec

COMMAND_TIMEOUT_S = 0.5  # a velocity is valid for this long without a new one, as in bases
ODOMETRY_JUMP_M_PER_S = 5.0  # faster: the robot was carried, or its odometry was reset
ODOMETRY_JUMP_M = 0.3  # m that odometry may be corrected by between two pictures
NO_ACTION = -1  # in place of an action
MAX_OFF_AXIS_SHARE = 0.5  # share of an action that a motion may have along another axis
ACTION_LENGTH_TOLERANCE = 0.35  # share of an action that may be missing or too much at its end
RECORDED = 'recorded'  # world version of pictures from no simulator, or from several


def find_topics(bag: str | Path, wanted: Topics) -> Topics:
    """The topics of a bag by their roles, see `Topics.within`.

    Raises:
        UserError: no readable bag, or topics that it lacks or has with another type.
    """
    return wanted.within({name: topic.type for name, topic in summary(bag).items()})


def hear(bag: str | Path, topics: Topics) -> Iterator[TimestampedMessage]:
    """The messages of a drive in the order of recording, one take after the other.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: as `find_topics` returns them.

    Raises:
        BagError: damage, or a message that is not what its topic says.
    """
    names = tuple(filter(None, dataclasses.astuple(topics)))
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
    two lies within `STAMP_WINDOW_S`; without odometry, commanded velocities are integrated. An
    episode
    ends with a message on `episode_end`, with a new goal, with `EPISODE_GAP_S` seconds without a
    picture,
    where the pose jumps and where the clock of the pictures was set back, see `set_back`. What is
    held at a time is bounded by `PAIRING_TIMEOUT_S` seconds of recording.

    Args:
        messages: in the order of recording.
        topics: as `find_topics` returns them.
        report: is filled.
    """
    track = _Odometry() if topics.odometry else _DeadReckoning()
    beside = {name: Stamped() for name in (topics.depth, topics.labels) if name}
    waiting: collections.deque[tuple[float, float, Any, int, Any]] = collections.deque()
    episode, goal, goal_stamp = 0, None, None
    newest = -math.inf  # s, of recording
    last: Frame | None = None
    for topic, message, time in messages:
        if topic in (topics.image, topics.odometry or topics.command):
            if set_back(time, newest):  # another take: nothing more comes of the one before
                while waiting:
                    last = yield from _settle(waiting.popleft(), track, beside, topics, last,
                                              report)
                newest = time
            newest = max(newest, time)
        if topic == topics.image:
            report.pictures += 1
            waiting.append((_stamp(message, time), time, message, episode, goal))
        elif topic in (topics.odometry, topics.command):
            if topic == (topics.odometry or topics.command):
                try:
                    track.hear(message, time)
                except MotionError:
                    report.bad += 1
        elif topic in beside:
            beside[topic].hear(_stamp(message, time), time, message)
        elif topic == topics.episode_end:
            episode += 1
        elif topic == topics.goal:
            stamp = _stamp(message, time)
            if goal_stamp not in (None, stamp):
                episode += 1
            goal, goal_stamp = message, stamp
        while waiting and (track.knows(waiting[0][0]) and all(
                rows.reaches(waiting[0][0]) for rows in beside.values())
                or waiting[0][1] < time - PAIRING_TIMEOUT_S):
            last = yield from _settle(waiting.popleft(), track, beside, topics, last, report)
    while waiting:
        last = yield from _settle(waiting.popleft(), track, beside, topics, last, report)


def _settle(picture, track, beside, topics: Topics, last: Frame | None, report: Report):
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
    own = {role: beside[name].nearest(stamp, time) for role, name in (
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


class _Odometry:
    """Poses by header stamps."""

    def __init__(self):
        self._heard = Stamped()

    def hear(self, message: Any, time: float) -> None:
        values = odometry_to_array(message)
        self._heard.hear(values[6] or time, time, values[:3])

    def knows(self, stamp: float) -> bool:
        return self._heard.reaches(stamp)

    def pose(self, stamp: float, time: float) -> np.ndarray | None:
        found = self._heard.around(stamp, time)
        if found is None:
            return None
        before, after = found
        one, other = before.value, after.value
        span = after.stamp - before.stamp
        share = np.clip((stamp - before.stamp) / span, 0, 1) if span > 0 else 0.0
        pose = one + share * (other - one)
        pose[2] = one[2] + share * wrap_angle(other[2] - one[2])
        return pose


class _DeadReckoning:
    """Poses from commanded velocities, which carry no stamp of their own: by recording time."""

    def __init__(self):
        self._pose = np.zeros(3)
        self._velocity = np.zeros(3)
        self._from = -math.inf  # when the velocity was received
        self._at: float | None = None  # time of the pose
        self._past: collections.deque[tuple[float, np.ndarray]] = collections.deque()

    def hear(self, message: Any, time: float) -> None:
        velocity = twist_to_array(message)[:3]
        self._advance(time)
        self._velocity, self._from = velocity, time

    def knows(self, stamp: float) -> bool:
        return True  # messages come in the order of recording

    def pose(self, stamp: float, time: float) -> np.ndarray:
        self._advance(time)
        return self._pose.copy()

    def _advance(self, time: float) -> None:
        if self._at is not None and set_back(time, self._at):  # another take
            self._velocity, self._from, self._at = np.zeros(3), -math.inf, time
        if self._at is not None and time > self._at:
            lasts = min(time, self._from + COMMAND_TIMEOUT_S) - self._at
            if lasts > 0:
                self._pose = integrate(self._pose, self._velocity, lasts)
        self._at = time if self._at is None else max(self._at, time)


def integrate(pose: np.ndarray, velocity: np.ndarray, seconds: float) -> np.ndarray:
    """A pose [3] after moving with a constant body velocity [3] vx, vy [m/s], wz [rad/s]."""
    x, y, yaw = pose
    vx, vy, wz = velocity
    turn = wz * seconds
    # Along an arc; sin(t) / t and (1 - cos t) / t by series where t vanishes.
    s, c = ((math.sin(turn) / turn, (1 - math.cos(turn)) / turn) if abs(turn) > 1e-6
            else (1.0, turn / 2))
    ahead, left = (s * vx - c * vy) * seconds, (c * vx + s * vy) * seconds
    return np.array([x + math.cos(yaw) * ahead - math.sin(yaw) * left,
                     y + math.sin(yaw) * ahead + math.cos(yaw) * left, yaw + turn])


def _stamp(message: Any, time: float) -> float:
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec * 1e-9) or time


class Step(NamedTuple):
    """A frame at which an action begins, and the action; an episode's last frame has none."""

    frame: Frame
    action: int  # index; `NO_ACTION`: what followed was none of the robot's actions
    last: bool  # of its episode: no action follows


class ActionSegmenter:
    """Cuts frames into the actions of a robot.

    From a frame on, the robot moves along the axes of its actions. A later frame ends an action
    if the motion until there is that action to `ACTION_LENGTH_TOLERANCE`, and less than
    `MAX_OFF_AXIS_SHARE` of one along every
    other axis; of those that do, the one where it fits best, which shows when the robot has moved
    on from there. A drive by hand is cut where its curves allow.

    Args:
        robot: its actions; those that tilt the camera are no part of a drive.
        report: is filled.
    """

    MOVED_ON = 0.2  # of an action: the fit is so much worse than it was
    TOO_FAR = 1.25  # of an action, along any axis: nothing will fit any more
    STILL = 0.01  # of an action: frames nearer than that to the one before show the same place

    def __init__(self, robot: RobotSpec, report: Report):
        self._moves = np.array(robot.moves)
        self._driving = np.abs(self._moves).sum(1) > 0
        # The largest action of each axis is the unit of off-axis motion.
        length = np.abs(self._moves[:, :2]).max() or 0.5
        turn = np.abs(self._moves[:, 2]).max() or math.radians(30)
        self._unit = np.array([length, length, turn])
        self._report = report
        self._begin: Frame | None = None
        self._last: Frame | None = None
        self._best: tuple[float, int, Frame] | None = None  # misfit, action, where it ends
        self._since: list[Frame] = []  # frames after the best end, one a place

    def cut(self, frames: Iterable[Frame]) -> Iterator[Step]:
        """The steps of some frames; every frame that no step begins at is left out."""
        for frame in frames:
            if self._begin is not None and frame.episode != self._begin.episode:
                yield from self._end()
            if self._begin is None:
                self._begin = self._last = frame
                continue
            yield from self._go_on(frame)
            self._last = frame
        yield from self._end()

    def _go_on(self, frame: Frame) -> Iterator[Step]:
        assert self._begin is not None  # `cut` began with a frame
        moved = _relative(self._begin.pose, frame.pose)
        action, misfit = self._fit(moved)
        if misfit < (math.inf if self._best is None else self._best[0]):
            self._best = misfit, action, frame
            self._since.clear()
        elif self._best is not None:
            before = (self._since or [self._best[2]])[-1]
            if (np.abs(_relative(before.pose, frame.pose)) > self.STILL * self._unit).any():
                self._since.append(frame)
            # What it does now is measured by the nearest action, whether it fits or not.
            if self._cost(moved).min() > self._best[0] + self.MOVED_ON:
                yield from self._finish()
        elif (np.abs(moved) > self.TOO_FAR * self._unit).any():
            yield self._step(NO_ACTION, frame)

    def _finish(self) -> Iterator[Step]:
        """End the action where it fitted best, and go on from there."""
        assert self._best is not None  # else there is no end
        _, action, end = self._best
        rest, self._since, self._best = self._since, [], None
        yield self._step(action, end)
        for frame in rest:
            yield from self._go_on(frame)

    def _step(self, action: int, end: Frame) -> Step:
        assert self._begin is not None  # an action ends that began there
        step = Step(self._begin, action, False)
        if action == NO_ACTION:
            self._report.misfits += 1
        else:
            self._report.actions[action] += 1
        self._begin = end
        return step

    def _end(self) -> Iterator[Step]:
        while self._best is not None:
            yield from self._finish()
        if self._begin is not None and self._last is not None:
            # What is left over is a motion of its own, unless it is next to none.
            moved = np.abs(_relative(self._begin.pose, self._last.pose)) / self._unit
            if moved.max() >= MAX_OFF_AXIS_SHARE:
                yield self._step(NO_ACTION, self._last)
            yield Step(self._begin, NO_ACTION, True)
        self._begin = self._last = None

    def _fit(self, moved: np.ndarray) -> tuple[int, float]:
        """The action that a motion [3] is, and by how much it is not; infinity: it is none."""
        share, off_axis = self._shares(moved), self._off_axis(moved)
        fits = (np.abs(share - 1) <= ACTION_LENGTH_TOLERANCE) & (off_axis < MAX_OFF_AXIS_SHARE)
        cost = np.where(fits, self._cost(moved), np.inf)
        action = int(np.argmin(cost))
        return action, float(cost[action])

    def _cost(self, moved: np.ndarray) -> np.ndarray:
        cost = np.abs(self._shares(moved) - 1) + 0.5 * self._off_axis(moved)
        return np.where(self._driving, cost, np.inf)

    def _shares(self, moved: np.ndarray) -> np.ndarray:
        """How much of each action a motion [3] is, [A]."""
        along = (self._moves * moved).sum(1)
        return along / np.maximum((self._moves**2).sum(1), 1e-12)

    def _off_axis(self, moved: np.ndarray) -> np.ndarray:
        """The largest share of an action that a motion does along other axes than each's, [A]."""
        return np.where(self._moves == 0, np.abs(moved) / self._unit, 0.0).max(axis=1)


def _relative(origin: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A pose [3] in the frame of another: forward, left [m], turned left [rad]."""
    c, s = math.cos(origin[2]), math.sin(origin[2])
    x, y = pose[:2] - origin[:2]
    return np.array([c * x + s * y, c * y - s * x, wrap_angle(pose[2] - origin[2])])
