"""Poses of a robot along a drive: out of odometry, or integrated from commanded velocities."""

from __future__ import annotations

import collections
import math
from typing import Any

import numpy as np

from vn_msgs_py.motion import odometry_to_array, twist_to_array
from vn_nav.arrival import wrap_angle
from vn_nav.bags.stamped import Stamped, set_back

COMMAND_TIMEOUT_S = 0.5  # a velocity is valid for this long without a new one, as in bases


class OdometryPoses:
    """Poses by header stamps."""

    def __init__(self):
        self._received = Stamped()

    def add(self, message: Any, time: float) -> None:
        values = odometry_to_array(message)
        self._received.add(values[6] or time, time, values[:3])

    def knows(self, stamp: float) -> bool:
        return self._received.reaches(stamp)

    def pose(self, stamp: float, time: float) -> np.ndarray | None:
        found = self._received.around(stamp, time)
        if found is None:
            return None
        before, after = found
        one, other = before.value, after.value
        span = after.stamp - before.stamp
        share = np.clip((stamp - before.stamp) / span, 0, 1) if span > 0 else 0.0
        return interpolate(one, other, share)


class DeadReckoning:
    """Poses from commanded velocities, which carry no stamp of their own: by recording time."""

    def __init__(self):
        self._pose = np.zeros(3)
        self._velocity = np.zeros(3)
        self._from = -math.inf  # when the velocity was received
        self._at: float | None = None  # time of the pose
        self._past: collections.deque[tuple[float, np.ndarray]] = collections.deque()

    def add(self, message: Any, time: float) -> None:
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


def interpolate(one: np.ndarray, other: np.ndarray, share: float) -> np.ndarray:
    """The pose [3] a share of the way from one to another, turning the shorter way round."""
    pose = one + share * (other - one)
    pose[2] = one[2] + share * wrap_angle(other[2] - one[2])
    return pose


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
