"""When a robot has arrived at the place of a goal picture: the rule of the image task.

A leaf, because the simulator judges by it and learning from bags labels by it.
"""

from __future__ import annotations

import math

import numpy as np

OBJECT_RADIUS = 1.0  # m, geodesic, of goals that are objects (thesis, 5.6)
ARRIVAL_RADIUS = 0.6  # m: geodesic where a floor map is known, straight where only odometry is
ARRIVAL_HEADING = math.radians(30.0)  # rad


def wrap_angle(angle):
    """To [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def heading_error(yaw, goal_yaw):
    """Unsigned angle between two headings [rad]."""
    return np.abs(wrap_angle(yaw - goal_yaw))


def arrived(distance, error):
    """At the goal pose: within the arrival radius and heading."""
    return (distance <= ARRIVAL_RADIUS) & (error <= ARRIVAL_HEADING)


def radius_of(task: str) -> float:
    """How near to its goal a task ends [m]; 0: at the goal itself, such as a room's edge."""
    return {'image': ARRIVAL_RADIUS, 'object': OBJECT_RADIUS}.get(task, 0.0)
