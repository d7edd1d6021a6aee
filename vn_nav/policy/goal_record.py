"""How a goal ends: arrived, given up and why, or taken back. No torch, no ROS."""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from vn_nav.robot import RobotSpec


class Status(enum.Enum):
    """Of the newest goal."""

    NONE = 'none'  # there has been no usable one
    WAITING = 'waiting'  # for ~/enable
    ACTIVE = 'active'
    SUCCEEDED = 'succeeded'  # the robot says that it has arrived
    FAILED = 'failed'
    CANCELLED = 'cancelled'  # by a person, or by another goal


ENDED = (Status.SUCCEEDED, Status.FAILED, Status.CANCELLED)


class Code(enum.IntEnum):
    """Why a goal failed; the numbers of `vn_interfaces/action/NavigateToImage`.

    Nav2 leaves the codes from 10000 on to servers of others; ours are 10600 to 10699.
    """

    NONE = 0
    BUDGET = 10601  # decisions or time are used up
    NO_PROGRESS = 10602  # it stays about one place
    BLOCKED = 10603  # its moves are cut off
    CAMERA_LOST = 10604
    ODOMETRY_LOST = 10605
    GOAL_REFUSED = 10606  # the picture is unusable
    STOPPED = 10607  # by the watchdog, another publisher of commands, a person, with the node
    NOT_READY = 10608  # an action goal: motion could not be enabled


@dataclasses.dataclass(frozen=True)
class GoalLimits:
    """When a goal is given up; 0: never for that reason."""

    max_decisions: int = 0
    time_allowance: float = 0.0  # s from `enable` on
    progress_decisions: int = 0  # in a row that end within `progress_radius` of the first
    progress_radius: float = 0.5  # m
    blocked_moves: int = 0  # in a row that go less than `BLOCKED_SHARE` of their way


BLOCKED_SHARE = 0.25


class GoalRecord:
    """The newest goal, from its acceptance to its end.

    Attributes:
        number: of goals accepted or refused so far.
        status, code, message: where it stands, and why it ended.
        begun: steady time from which on it has been under way [s]; NaN: never.
    """

    def __init__(self):
        self.number = 0
        self.status, self.code, self.message = Status.NONE, Code.NONE, ''
        self.begun = self._ended = math.nan

    def accept(self) -> None:
        """A goal is known, and nothing moves towards it yet."""
        self.number += 1
        self.status, self.code, self.message = Status.WAITING, Code.NONE, ''
        self.begun = self._ended = math.nan

    def refuse(self, why: str) -> None:
        """A goal picture is unusable."""
        self.accept()
        self.status, self.code, self.message = Status.FAILED, Code.GOAL_REFUSED, why

    def activate(self, now: float) -> None:
        """Motion is enabled; for a goal that has ended it begins again."""
        if self.status is not Status.ACTIVE and self.status is not Status.NONE:
            self.status, self.code, self.message = Status.ACTIVE, Code.NONE, ''
            self.begun, self._ended = now, math.nan

    def end(self, status: Status, now: float, code: Code = Code.NONE, message: str = '') -> None:
        """It is over; a goal that is not under way has no end."""
        if self.status is Status.ACTIVE:
            self.status, self.code, self.message, self._ended = status, code, message, now

    def cancel(self, now: float, message: str) -> None:
        """A person takes it back, also where it waits: nobody but a person sets it going."""
        if self.status is Status.WAITING:
            self.status, self.message = Status.CANCELLED, message
        self.end(Status.CANCELLED, now, message=message)

    def seconds(self, now: float) -> float:
        """How long it has been under way, or was [s]."""
        if math.isnan(self.begun):
            return 0.0
        return max((now if math.isnan(self._ended) else self._ended) - self.begun, 0.0)


class ProgressWatch:
    """Notices a robot that gets nowhere, by odometry at its decisions.

    Args:
        limits: of the goals.
        robot: what its actions do.
    """

    def __init__(self, limits: GoalLimits, robot: RobotSpec):
        self.limits = limits
        self._ways = [abs(action.size) if action.axis in ('dx', 'dy') else 0.0
                      for action in robot.actions]
        self.reset()

    def reset(self) -> None:
        """Another goal, or the same once more."""
        self._anchor: np.ndarray | None = None
        self._before: np.ndarray | None = None
        self._stays = self._cut_off = 0
        self._action: int | None = None

    def decided(self, action: int, pose: np.ndarray | None) -> tuple[Code, str] | None:
        """Whether to give up instead of doing this action.

        Args:
            action: that was decided.
            pose: [3] x, y [m], yaw [rad] of odometry where it was decided; None: unknown, then
                nothing is noticed.
        """
        if pose is None:
            self.reset()
            return None
        if self._before is not None and self._action is not None and self._ways[self._action]:
            moved = math.hypot(*(pose[:2] - self._before[:2]))
            short = moved < BLOCKED_SHARE * self._ways[self._action]
            self._cut_off = self._cut_off + 1 if short else 0
        self._before, self._action = np.array(pose, float), action
        if self._anchor is None or (
                math.hypot(*(pose[:2] - self._anchor[:2])) > self.limits.progress_radius):
            self._anchor, self._stays = self._before, 0
        else:
            self._stays += 1
        if 0 < self.limits.blocked_moves <= self._cut_off:
            return Code.BLOCKED, f'{self._cut_off} moves in a row were cut off'
        if 0 < self.limits.progress_decisions <= self._stays:
            return Code.NO_PROGRESS, (f'{self._stays} decisions within '
                                      f'{self.limits.progress_radius:g} m')
        return None
