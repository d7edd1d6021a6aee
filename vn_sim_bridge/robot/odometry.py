"""What a robot's odometry says of its motion: dead reckoning, with the errors of a real one.

The errors are those of the odometry motion model (Thrun, Burgard & Fox, "Probabilistic Robotics",
2005, section 5.4): a motion is a rotation, a translation and a rotation, and each of them is
measured with a Gaussian error that grows with the rotation and with the translation. The model's
variances hold for a whole step of a filter; here they grow with the way, so that many short ticks
add up to what few long ones give.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_sim_bridge.floor.contacts import ROTATION_NOISE, TRANSLATION_NOISE

# The model's four alphas at drift 1, a good indoor robot with a gyro: variance of the heading
# [rad^2] and of the way [m^2], for each radian turned and each metre driven.
HEADING_BY_TURN, HEADING_BY_WAY = 1e-5, 5e-5
WAY_BY_WAY, WAY_BY_TURN = 4e-4, 2e-5

Numbers = TypeVar('Numbers', float, np.ndarray)


def drift_errors(motion: Sequence[float], drift: float, normals: Sequence[float] | np.ndarray
                 ) -> tuple[float, float, float]:
    """By how much a motion is measured wrongly.

    Args:
        motion: dx, dy [m], dyaw [rad] in the robot's frame.
        drift: scale of the standard deviations; 0: no errors.
        normals: three standard normal numbers.

    Returns:
        Of the rotation before the translation [rad], of the way [m], of the rotation after it
        [rad].
    """
    heading, along = _deviations(motion, drift)
    return heading * normals[0], along * normals[1], heading * normals[2]


def _deviations(motion: Sequence[float], drift: float) -> tuple[float, float]:
    """Standard deviations of either rotation [rad] and of the way [m]."""
    rotation, along = _variances(math.hypot(motion[0], motion[1]), abs(motion[2]))
    return drift * math.sqrt(rotation), drift * math.sqrt(along)


def _variances(way: Numbers, turn: Numbers) -> tuple[Numbers, Numbers]:
    """Of either rotation [rad^2] and of the way [m^2], at drift 1."""
    return ((HEADING_BY_TURN * turn + HEADING_BY_WAY * way) / 2,
            WAY_BY_WAY * way + WAY_BY_TURN * turn)


def advance(pose: np.ndarray, motion: Sequence[float],
            errors: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The pose [3] x, y [m], yaw [rad] of odometry after a motion and its errors.

    Args:
        pose: before it.
        motion, errors: as of `drift_errors`. The way follows the mean heading, as in `World`.
    """
    dx, dy, dyaw = motion
    before, along, after = errors
    way = math.hypot(dx, dy)
    # A turn on the spot shifts the robot forward or backward.
    dx, dy = (dx + along * dx / way, dy + along * dy / way) if way > 0 else (along, 0.0)
    heading = pose[2] + dyaw / 2 + before
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([pose[0] + cos * dx - sin * dy, pose[1] + sin * dx + cos * dy,
                     wrap_angle(pose[2] + dyaw + before + after)])


def drift_errors_of_all(motions: np.ndarray, drift: float, normals: np.ndarray) -> np.ndarray:
    """`drift_errors` of the motions [K,3] of K robots, by their normals [K,3]: [K,3]."""
    rotation, along = (drift * np.sqrt(variance) for variance in _variances(
        np.hypot(motions[:, 0], motions[:, 1]), np.abs(motions[:, 2])))
    return normals * np.stack([rotation, along, rotation], axis=1)


def advance_all(poses: np.ndarray, motions: np.ndarray, errors: np.ndarray | None = None
                ) -> np.ndarray:
    """`advance` of the poses [K,3] of K robots, by their motions and errors [K,3]: [K,3]."""
    errors = np.zeros_like(motions) if errors is None else errors
    way = np.hypot(motions[:, 0], motions[:, 1])
    on_the_spot = way == 0
    share = errors[:, 1] / np.where(on_the_spot, 1.0, way)
    dx = np.where(on_the_spot, errors[:, 1], motions[:, 0] * (1 + share))
    dy = np.where(on_the_spot, 0.0, motions[:, 1] * (1 + share))
    heading = poses[:, 2] + motions[:, 2] / 2 + errors[:, 0]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([poses[:, 0] + cos * dx - sin * dy, poses[:, 1] + sin * dx + cos * dy,
                     wrap_angle(poses[:, 2] + motions[:, 2] + errors[:, 0] + errors[:, 2])],
                    axis=1)


class Uncertainty:
    """How far odometry may be off, given what the robot has driven: the covariances it publishes.

    First-order propagation (Thrun et al., section 3.3) of the errors that the simulator makes: the
    drift of `drift_errors`, and the motion noise that odometry does not see. Contacts, slip and
    the scale of a randomised base are not in it: no real base knows of them.

    Args:
        drift: as of `drift_errors`.
        period: of a tick [s].
        exact_turns: the simulator's turns have no motion noise.

    Attributes:
        pose: [3,3] covariance of x, y [m], yaw [rad] in the odom frame, since the start.
        twist: [3,3] of vx, vy [m/s], wz [rad/s] in the robot's frame, over the last tick.
    """

    # The least variance: a tenth of a millimetre, 0.006 degrees. Filters invert these matrices.
    FLOOR = 1e-8

    def __init__(self, drift: float, period: float, *, exact_turns: bool = False):
        self._drift, self._period = drift, period
        self._turn_variance = 0.0 if exact_turns else ROTATION_NOISE**2
        self.pose = self.FLOOR * np.eye(3)
        self.rest()

    def rest(self) -> None:
        """Say that the robot stood in the last tick."""
        self.twist = self.FLOOR * np.eye(3) / self._period**2

    def add(self, yaw: float, motion: Sequence[float], noise: float = 0.0) -> None:
        """Add the motion of a tick.

        Args:
            yaw: of odometry at its start [rad].
            motion: dx, dy [m], dyaw [rad] in the robot's frame.
            noise: share of a whole action that it is (`world.motion_noise`); 0: no motion noise.
        """
        dx, dy, dyaw = motion
        way = math.hypot(dx, dy)
        rotation, along = (deviation**2 for deviation in _deviations(motion, self._drift))
        along += noise * TRANSLATION_NOISE**2 * (way > 0)
        turn = 2 * rotation + noise * self._turn_variance * (way == 0 and dyaw != 0)
        ux, uy = (dx / way, dy / way) if way > 0 else (1.0, 0.0)
        c, s = math.cos(yaw + dyaw / 2), math.sin(yaw + dyaw / 2)
        # Where the pose goes with the rotation before the way, and with the way itself.
        before = np.array([-s * dx - c * dy, c * dx - s * dy, 1.0])
        ahead = np.array([c * ux - s * uy, s * ux + c * uy, 0.0])
        step = np.eye(3)
        step[:2, 2] = before[:2]
        self.pose = step @ self.pose @ step.T + (
            rotation * np.outer(before, before) + along * np.outer(ahead, ahead))
        self.pose[2, 2] += turn - rotation
        self.rest()
        self.twist[:2, :2] += along * np.outer((ux, uy), (ux, uy)) / self._period**2
        self.twist[2, 2] += turn / self._period**2
