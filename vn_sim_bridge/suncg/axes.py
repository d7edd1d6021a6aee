"""SUNCG's axes (y up) and the map frame's (z up): both are right-handed, in metres.

This is the only place that turns one into the other. House3D's yaw is measured from x towards z;
ours from x towards y, which is SUNCG's -z.
"""

from __future__ import annotations

import math

import numpy as np


def to_map(points: np.ndarray) -> np.ndarray:
    """Points [...,3] of a SUNCG file in the map frame."""
    points = np.asarray(points, float)
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def to_suncg(points: np.ndarray) -> np.ndarray:
    """Points [...,3] of the map frame as SUNCG's files have them."""
    points = np.asarray(points, float)
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def box_to_map(low, high) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corner [3] of a SUNCG box in the map frame."""
    corners = to_map(np.array([low, high], float))
    return corners.min(axis=0), corners.max(axis=0)


def yaw_to_map(degrees):
    """Our yaw [rad] of House3D's [deg]."""
    return -np.radians(degrees)


def yaw_to_suncg(yaw):
    """House3D's yaw [deg], -180 to 180, of ours [rad]."""
    return (-np.asarray(yaw) * (180 / math.pi) + 180) % 360 - 180
