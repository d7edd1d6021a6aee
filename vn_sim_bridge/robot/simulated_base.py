"""The base under a simulated robot: how the wheels follow a commanded velocity."""

from __future__ import annotations

import numpy as np

from vn_nav.robot import AXES, RobotSpec

ROUNDING = 1e-6  # share of a limit by which a profile that keeps it may seem to exceed it


class SimulatedBase:
    """Keeps the speed and acceleration limits of a robot, as the controller of a real base does.

    Every axis is limited on its own. A command within the limits is followed exactly, so a
    controller that ramps by itself is not disturbed. Braking is limited too, whoever asks for it:
    zero velocity, a time-out and a stop all take `max speed / acceleration` at most.

    Args:
        robot: limits.
        period: time between two commands [s].

    Attributes:
        velocity: [4] of the wheels: vx, vy [m/s], wz, tilt rate [rad/s].
    """

    def __init__(self, robot: RobotSpec, period: float):
        self._fastest = np.array([robot.max_velocity(axis) for axis in AXES])
        self._step = np.array([robot.acceleration(axis) for axis in AXES]) * period
        self.velocity = np.zeros(4)

    def stop(self) -> None:
        """At rest at once: only for a robot that is put somewhere else."""
        self.velocity = np.zeros(4)

    def follow(self, command: np.ndarray, driven: np.ndarray) -> np.ndarray:
        """The velocity [4] of the next period.

        Args:
            command: [4] finite, of any size.
            driven: [4] what the body really did in the last period. At an obstacle the wheels
                slip: they keep their speed, and the body, which stands, needs no braking.
        """
        wanted = np.clip(command, -self._fastest, self._fastest)
        allowed = self._step * (1 + ROUNDING)
        reached = (np.abs(wanted - self.velocity) <= allowed) | (
            np.abs(wanted - driven) <= allowed)
        self.velocity = np.where(reached, wanted, self.velocity + np.clip(
            wanted - self.velocity, -self._step, self._step))
        return self.velocity.copy()
