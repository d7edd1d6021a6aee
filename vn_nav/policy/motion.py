"""From a discrete action to velocities: the only place where an action becomes a Twist.

The profile is a trapezoid under the robot's limits. It is closed on odometry where there is any,
else timed. The last velocity is chosen so that it lands on the target within one period.
"""

from __future__ import annotations

import math

import numpy as np

from vn_nav.robot import AXES, RobotSpec

BLOCKED_FACTOR = 1.5  # an action without progress ends after this multiple of its duration
LONGEST_FACTOR = 3.0  # and any action after this one


class ActionExecutor:
    """Drives one action at a time.

    Args:
        robot: action table and limits.
        tolerance: distance [m] (and, times 2, angle [rad]) at which an action is done.
        creep: least speed [m/s, rad/s] before the tolerance is reached; a real base does not turn
            its wheels for less.
    """

    def __init__(self, robot: RobotSpec, *, tolerance: float, creep: float):
        self.robot, self.tolerance, self.creep = robot, tolerance, creep
        self.action: int | None = None

    def begin(self, action: int, odometry: np.ndarray | None) -> None:
        """Start an action from rest.

        Args:
            action: index into the robot's table.
            odometry: [3] x, y [m], yaw [rad] at its start; None: timed.
        """
        self.action = action
        entry = self.robot.actions[action]
        self._axis, self._sign = entry.axis, math.copysign(1.0, entry.size)
        self._size = abs(entry.size)
        # Odometry knows nothing of the camera's tilt.
        self._start = None if odometry is None or entry.axis == 'dpitch' else odometry.copy()
        self._covered = self._before = 0.0
        self._turned, self._last_yaw = 0.0, None if odometry is None else odometry[2]
        self._speed = self._elapsed = 0.0
        self._nominal = self.robot.nominal_duration(action)

    def velocity(self, dt: float, odometry: np.ndarray | None) -> tuple[np.ndarray, bool]:
        """The velocity for the next period.

        Args:
            dt: its length [s].
            odometry: [3] x, y, yaw now; ignored by a timed action.

        Returns:
            [4] vx, vy [m/s], wz, tilt rate [rad/s]; and whether the action is over (then zero).
        """
        if self._start is not None and odometry is not None:
            self._measure(self._start, odometry)
        remaining = self._size - self._covered
        tolerance = self.tolerance * (1.0 if self._axis in ('dx', 'dy') else 2.0)
        stuck = (self._elapsed >= BLOCKED_FACTOR * self._nominal
                 and self._covered - self._before < 0.1 * self._speed * dt)
        if remaining <= tolerance or stuck or self._elapsed >= LONGEST_FACTOR * self._nominal:
            self.action = None
            return np.zeros(4), True
        acceleration = self.robot.acceleration(self._axis)
        # The fastest speed from which n periods of full braking end exactly at the target:
        # v dt + (v - a dt) dt + ... + (v - (n - 1) a dt) dt = remaining.
        step = acceleration * dt
        periods = max(1, math.ceil((math.sqrt(1 + 8 * remaining / (step * dt)) - 1) / 2 - 1e-9))
        braking = remaining / (periods * dt) + step * (periods - 1) / 2
        speed = min(self.robot.max_velocity(self._axis), self._speed + step,
                    max(braking, self.creep))
        self._speed, self._elapsed, self._before = speed, self._elapsed + dt, self._covered
        if self._start is None:
            self._covered += speed * dt
        velocity = np.zeros(4)
        velocity[AXES.index(self._axis)] = self._sign * speed
        return velocity, False

    def _measure(self, start: np.ndarray, odometry: np.ndarray) -> None:
        """Displacement along the action's axis since odometry said `start`."""
        if self._axis == 'dyaw':
            change = odometry[2] - self._last_yaw
            self._turned += (change + math.pi) % (2 * math.pi) - math.pi
            self._last_yaw = odometry[2]
            self._covered = self._sign * self._turned
            return
        along = start[2] + (math.pi / 2 if self._axis == 'dy' else 0.0)
        dx, dy = odometry[0] - start[0], odometry[1] - start[1]
        self._covered = self._sign * (dx * math.cos(along) + dy * math.sin(along))


def ramp(velocity: np.ndarray, target: np.ndarray, robot: RobotSpec, dt: float) -> np.ndarray:
    """One period of acceleration from a velocity [4] towards a target [4]."""
    limits = np.array([robot.acceleration(axis) for axis in AXES]) * dt
    return velocity + np.clip(target - velocity, -limits, limits)


def cruise(robot: RobotSpec, action: int) -> np.ndarray:
    """The velocity [4] that an action holds in `continuous` mode."""
    entry = robot.actions[action]
    velocity = np.zeros(4)
    velocity[AXES.index(entry.axis)] = math.copysign(robot.max_velocity(entry.axis), entry.size)
    return velocity
