"""The one place where AI2-THOR's frame becomes ours: for its engine, its houses and its dumps.

Unity's frame is left-handed: x right, y up, z forward; `rotation` turns clockwise seen from above,
`horizon` looks down, both in degrees. Ours is right-handed: x forward, y left, z up, yaw turns
counter-clockwise, pitch looks down, in radians. So (x, y, z) = (Z, -X, Y), yaw = -rotation: a
change of hands, and nothing is mirrored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from vn_nav.arrival import wrap_angle

TO_MAP = np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]])  # Unity's axes to the map's
HORIZON = (-30.0, 60.0)  # degrees that the agent can look up and down to


def points_to_ours(points) -> np.ndarray:
    """Points [...,3] x, y, z [m] of Unity in the map frame."""
    return np.asarray(points, float) @ TO_MAP.T


def points_to_thor(points) -> np.ndarray:
    """Points [...,3] of the map frame as Unity has them."""
    return np.asarray(points, float) @ TO_MAP


def point_to_ours(position: Mapping[str, float]) -> tuple[float, float, float]:
    """x, y, z [m] of a position in Unity."""
    return position['z'], -position['x'], position['y']


def point_to_thor(x: float, y: float, z: float) -> dict[str, float]:
    """The position in Unity of x, y, z [m]."""
    return {'x': float(-y), 'y': float(z), 'z': float(x)}


def pose_to_ours(agent: Mapping, camera_pitch: float) -> np.ndarray:
    """[4] x, y [m], yaw, pitch [rad] of an agent's metadata.

    Args:
        agent: `position`, `rotation`, `cameraHorizon`.
        camera_pitch: at which the robot's camera is mounted [rad]; the pose's pitch is beyond it.
    """
    x, y, _ = point_to_ours(agent['position'])
    yaw = float(wrap_angle(-math.radians(agent['rotation']['y'])))
    return np.array([x, y, yaw, math.radians(agent['cameraHorizon']) - camera_pitch])


def pose_to_thor(pose: np.ndarray, height: float, camera_pitch: float) -> dict:
    """Arguments of `TeleportFull` for a pose [4] of an agent whose centre is at a height [m]."""
    horizon = math.degrees(pose[3] + camera_pitch)
    return {**point_to_thor(pose[0], pose[1], height),
            'rotation': {'x': 0.0, 'y': -math.degrees(pose[2]) % 360.0, 'z': 0.0},
            'horizon': min(max(horizon, HORIZON[0]), HORIZON[1])}
