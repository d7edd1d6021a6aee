"""The base under a simulated robot: how the wheels follow a commanded velocity."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from vn_nav.robot import AXES, RobotSpec

ROUNDING = 1e-6  # share of a limit by which a profile that keeps it may seem to exceed it
STANDS = 0.02  # m/s or rad/s: slower, wheels that nobody drives stick


class SimulatedBase:
    """Keeps the speed and acceleration limits of a robot, as the controller of a real base does.

    Every axis is limited on its own. A command within the limits is followed exactly, so a
    controller that ramps by itself is not disturbed. Braking is limited too, whoever asks for it:
    zero velocity, a time-out and a stop all take `max speed / acceleration` at most.

    A cheap base (`respond`) hears a command late, and its motors follow the controller as a
    first-order lag.

    Args:
        robot: limits.
        period: time between two commands [s].
    """

    def __init__(self, robot: RobotSpec, period: float):
        self._fastest = np.array([robot.max_velocity(axis) for axis in AXES])
        self._fastest[AXES.index('dy')] *= not robot.differential
        self._step = np.array([robot.acceleration(axis) for axis in AXES]) * period
        self._period = period
        self._share = 1.0  # of a difference in speed that the motors make up in a period
        self._on_the_way: deque[np.ndarray] = deque()
        self._delay = 0
        self.velocity = np.zeros(4)

    @property
    def velocity(self) -> np.ndarray:
        """[4] of the wheels: vx, vy [m/s], wz, tilt rate [rad/s]."""
        return self._velocity

    @velocity.setter
    def velocity(self, value: np.ndarray) -> None:
        self._velocity, self._controlled = value, value.copy()

    @property
    def late(self) -> bool:
        """Something moves it yet: a command on its way, or motors that lag."""
        return (self._share < 1.0 and bool(self._velocity.any())) or any(
            command.any() for command in self._on_the_way)

    def respond(self, delay: float = 0.0, lag: float = 0.0) -> None:
        """How late it is from now on; what is on the way is lost.

        Args:
            delay: until a command reaches the controller [s]; rounded to periods.
            lag: time constant of the motors [s]; 0: they follow at once.
        """
        self._delay = round(delay / self._period)
        self._on_the_way.clear()
        self._share = 1.0 - math.exp(-self._period / lag) if lag > 0 else 1.0

    def stop(self) -> None:
        """At rest at once: only for a robot that is put somewhere else."""
        self.velocity = np.zeros(4)
        self._on_the_way.clear()

    def follow(self, command: np.ndarray, driven: np.ndarray) -> np.ndarray:
        """The velocity [4] of the next period.

        Args:
            command: [4] finite, of any size.
            driven: [4] what the body really did in the last period. At an obstacle the wheels
                slip: they keep their speed, and the body, which stands, needs no braking.
        """
        wanted = np.clip(self._heard(command), -self._fastest, self._fastest)
        allowed, before = self._step * (1 + ROUNDING), self._controlled
        reached = (np.abs(wanted - before) <= allowed) | (np.abs(wanted - driven) <= allowed)
        controlled = np.where(reached, wanted, before + np.clip(
            wanted - before, -self._step, self._step))
        if self._share == 1.0:
            self.velocity = controlled
            return controlled.copy()
        moved = self._velocity + self._share * (controlled - self._velocity)
        self._controlled = controlled
        self._velocity = np.where((controlled == 0) & (np.abs(moved) < STANDS), 0.0, moved)
        return self._velocity.copy()

    def _heard(self, command: np.ndarray) -> np.ndarray:
        """The command that reaches the controller when this one is sent."""
        if not self._delay:
            return command
        self._on_the_way.append(command.copy())
        late = len(self._on_the_way) > self._delay
        return self._on_the_way.popleft() if late else np.zeros(4)
