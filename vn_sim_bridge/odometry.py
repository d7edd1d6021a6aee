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

import numpy as np

from vn_nav.arrival import wrap_angle

# The model's four alphas at drift 1, a good indoor robot with a gyro: variance of the heading
# [rad^2] and of the way [m^2], for each radian turned and each metre driven.
HEADING_BY_TURN, HEADING_BY_WAY = 1e-5, 5e-5
WAY_BY_WAY, WAY_BY_TURN = 4e-4, 2e-5


def drift_errors(motion: Sequence[float], drift: float, normals: Sequence[float]
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
    way, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
    heading = drift * math.sqrt((HEADING_BY_TURN * turn + HEADING_BY_WAY * way) / 2)
    along = drift * math.sqrt(WAY_BY_WAY * way + WAY_BY_TURN * turn)
    return heading * normals[0], along * normals[1], heading * normals[2]


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
