"""From a discrete action to velocities: the only place where an action becomes a Twist.

The profile is a trapezoid under the robot's limits. It is closed on odometry where there is any,
else timed. The last velocity is chosen so that it lands on the target within one period. A real
base hears commands late and rolls on: how far is learned from where its actions come to rest, and
each action ends so much earlier (iterative learning control: Arimoto et al., 1984).
"""

from __future__ import annotations

import math

import numpy as np

from vn_nav.robot import AXES, RobotSpec

BLOCKED_FACTOR = 1.5  # an action without progress ends after this multiple of its duration
LONGEST_FACTOR = 3.0  # and any action after this one
LEARNING = 0.5  # share of an overshoot by which the next action of its axis ends earlier
MOST_ROLL = 0.7  # of an action may be left to rolling on


class ActionExecutor:
    """Drives one action at a time.

    Args:
        robot: action table and limits.
        tolerance: distance [m] (and, times 2, angle [rad]) at which an action is done.
        creep: least speed [m/s, rad/s] before the tolerance is reached; a real base does not turn
            its wheels for less.
        learns: whether it learns how far the base rolls on; needs odometry.

    Attributes:
        roll: by axis, how far the base moves after an action's end [m or rad].
    """

    def __init__(self, robot: RobotSpec, *, tolerance: float, creep: float, learns: bool = False):
        self.robot, self.tolerance, self.creep, self.learns = robot, tolerance, creep, learns
        self.action: int | None = None
        self.roll = dict.fromkeys(AXES, 0.0)
        self._completed = False  # the last action came to its end

    def begin(self, action: int, odometry: np.ndarray | None) -> None:
        """Start an action from rest.

        Args:
            action: index into the robot's table.
            odometry: [3] x, y [m], yaw [rad] at its start; None: timed.
        """
        if self.learns and self._completed and odometry is not None:
            self._learn(odometry)
        self._completed = False
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

    def abandon(self) -> None:
        """Forget the action: where the robot is next says nothing of it."""
        self.action, self._completed = None, False

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
        remaining = self._size - self._covered - (
            0.0 if self._start is None else min(self.roll[self._axis], MOST_ROLL * self._size))
        tolerance = self._tolerance()
        stuck = (self._elapsed >= BLOCKED_FACTOR * self._nominal
                 and self._covered - self._before < 0.1 * self._speed * dt)
        if remaining <= tolerance or stuck or self._elapsed >= LONGEST_FACTOR * self._nominal:
            self.action = None
            self._completed = remaining <= tolerance
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

    def _tolerance(self) -> float:
        return self.tolerance * (1.0 if self._axis in ('dx', 'dy') else 2.0)

    def _learn(self, odometry: np.ndarray) -> None:
        """From where the last action's end has left the robot, which is at rest now."""
        if self._start is None:
            return
        self._measure(self._start, odometry)
        over = self._covered - self._size
        # Less is noise; more is no rolling: the pose was set, or somebody else drove.
        if self._tolerance() < abs(over) < self._size:
            self.roll[self._axis] = max(0.0, self.roll[self._axis] + LEARNING * over)

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
