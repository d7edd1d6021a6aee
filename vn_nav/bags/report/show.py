"""`vn_nav bag show`: what a recorded drive holds, collected in two passes over the bag.

The first pass is the doctor's, over every message as it lies in the file; the second puts pictures
and poses together, as training does. With a policy there is a third, see `agreement`. What is
kept is bounded (`show_figures`), so a bag of hours takes no more memory than one of minutes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.doctor.figures import Diagnosis
from vn_nav.bags.drive import (
    Frame,
    Report,
    TimestampedMessage,
    find_topics,
    synchronise,
    timestamped_messages,
)
from vn_nav.bags.report.agreement import Agreement, judge
from vn_nav.bags.report.figures import Film, Goals, Odometer, Shot, Timeline, Ways
from vn_nav.bags.roles import Topics
from vn_nav.bags.segmenter import ActionSegmenter
from vn_nav.robot import RobotSpec

if TYPE_CHECKING:  # it takes torch along
    from vn_nav.policy.checkpoint import LoadedCheckpoint

MIN_RATE_INTERVAL_S, MIN_VELOCITY_INTERVAL_S = 0.5, 0.05  # s: the shortest interval of either
AXES = ('vx', 'vy', 'wz')


@dataclasses.dataclass
class Shown:
    """The content of the page. K points of a path, L stretches of time."""

    diagnosis: Diagnosis
    start: float  # s since 1970, of the first message
    topics: Topics  # as they are in the bag
    rates: Timeline  # by topic
    velocities: Timeline  # by 'commanded vx', 'measured wz' and so on, see `AXES`
    ways: dict[int, np.ndarray]  # [K,3] poses of each episode
    film: list[Shot]
    goals: Goals
    odometer: Odometer
    report: Report  # pictures, episodes, actions and what did not fit
    robot: RobotSpec  # whose actions they are
    agreement: Agreement | None = None


def show(bag: str | Path, *, topics: Topics, robot: RobotSpec,
         checkpoint: LoadedCheckpoint | None = None) -> Shown:
    """Look through a bag.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: names of camera, odometry and so on.
        robot: into whose actions the drive is cut; with a checkpoint they are the policy's.
        checkpoint: a policy to ask what it would have done.

    Raises:
        UserError: no readable bag, one without a camera or anything that shows motion, or (with
            a checkpoint) a camera that is too narrow or no usable picture.
    """
    # Depth and labels are not shown; without them no picture waits for any.
    names = find_topics(bag, dataclasses.replace(topics, depth='', labels=''))
    rates, velocities = Timeline(MIN_RATE_INTERVAL_S), Timeline(MIN_VELOCITY_INTERVAL_S)
    diagnosis = diagnose(bag, topics=topics, listen=lambda message: rates.add(
        message.connection.topic, message.log_time))
    velocities.origin = rates.origin  # one axis of time on the whole page
    film, goals, way, odometer, report = Film(), Goals(), Ways(), Odometer(), Report()

    def watched(frames: Iterable[Frame]) -> Iterator[Frame]:
        for frame in frames:
            odometer.go(frame)
            film.add(frame, odometer.progress)
            goals.add(frame)
            way.add(frame)
            yield frame

    frames = synchronise(_heard(bag, names, velocities), names, report)
    for _ in ActionSegmenter(robot, report).cut(watched(frames)):
        pass
    assert rates.origin is not None  # a camera was found: there are messages
    shown = Shown(diagnosis, rates.origin * 1e-9, names, rates, velocities, way.ways(),
                  film.shots(), goals, odometer, report, robot)
    if checkpoint is not None:
        shown.agreement = judge(bag, checkpoint, robot, topics)
    return shown


def _heard(bag: str | Path, names: Topics, velocities: Timeline) -> Iterator[TimestampedMessage]:
    """The messages of a drive; velocities are noted as they pass."""
    for m in timestamped_messages(bag, names):
        kind = {names.command: 'commanded', names.odometry: 'measured'}.get(m.topic)
        if kind is not None:
            try:
                velocity = (twist_to_array(m.message)[:3] if kind == 'commanded'
                            else odometry_to_array(m.message)[3:6])
            except MotionError:
                pass  # the doctor reports it
            else:
                for axis, value in zip(AXES, velocity, strict=True):
                    velocities.add(f'{kind} {axis}', round(m.time * 1e9), float(value))
        yield m
