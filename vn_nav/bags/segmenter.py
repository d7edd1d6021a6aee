"""Where the robot's discrete actions begin and end along the poses of a drive.

`ActionSegmenter` finds the pictures between which the robot did just one of its discrete actions.
What fits no action is kept, and counted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import Frame, Report
from vn_nav.robot import RobotSpec

NO_ACTION = -1  # in place of an action
MAX_OFF_AXIS_SHARE = 0.5  # share of an action that a motion may have along another axis
ACTION_LENGTH_TOLERANCE = 0.35  # share of an action that may be missing or too much at its end


class Step(NamedTuple):
    """A frame at which an action begins, and the action; an episode's last frame has none."""

    frame: Frame
    action: int  # index; `NO_ACTION`: what followed was none of the robot's actions
    last: bool  # of its episode: no action follows


class ActionSegmenter:
    """Cuts frames into the actions of a robot.

    From a frame on, the robot moves along the axes of its actions. A later frame may end an action
    if the motion until there is that action to `ACTION_LENGTH_TOLERANCE`, and less than
    `MAX_OFF_AXIS_SHARE` of one along every other axis. Of those frames the best fit ends it, which
    shows when the robot has moved on from there. A drive by hand is cut where its curves allow.

    Args:
        robot: its actions; those that tilt the camera are no part of a drive.
        report: is filled.
    """

    # Shares of an action.
    MOVED_ON_MISFIT = 0.2  # by which the fit is worse than it was, once the robot has moved on
    MAX_MOTION_SHARE = 1.25  # along any axis: beyond it nothing will fit any more
    SAME_PLACE_SHARE = 0.01  # frames nearer than that to the one before show the same place

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
            step = np.abs(_relative(before.pose, frame.pose))
            if (step > self.SAME_PLACE_SHARE * self._unit).any():
                self._since.append(frame)
            # What it does now is measured by the nearest action, whether it fits or not.
            if self._cost(moved).min() > self._best[0] + self.MOVED_ON_MISFIT:
                yield from self._finish()
        elif (np.abs(moved) > self.MAX_MOTION_SHARE * self._unit).any():
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
