"""A planar laser scanner, exact: rays against what a robot cannot drive through.

The same rectangles stop the robot, so that a map made from the scan, or a collision monitor that
reads it, agrees with what the robot bumps into (a table is its whole outline, not four legs).
"""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.floor.rays import ray_cast

RAYS = 360  # over the full turn
NEAREST, FARTHEST = 0.05, 12.0  # m, what the scanner measures


def scan_angles() -> np.ndarray:
    """Directions [RAYS] of the rays against the robot's heading [rad], from -pi to the left."""
    return -math.pi + 2 * math.pi / RAYS * np.arange(RAYS)


def scan(rects: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Distances [RAYS] float32 m to the first rectangle on each ray of `scan_angles`.

    Args:
        rects: [M,4] x0, y0, x1, y1 [m] of the obstacles.
        pose: [>=3] x, y [m], yaw [rad] of the scanner.

    Returns:
        Infinity where nothing is within `FARTHEST`, as REP 117 wants it; negative infinity for
        what is nearer than `NEAREST`.
    """
    return limited(ray_cast(pose[None], np.zeros(1, np.int64), scan_angles(),
                            np.asarray(rects, float), np.array([0, len(rects)]))[0])


def limited(ranges: np.ndarray) -> np.ndarray:
    """Ranges as the scanner gives them, see `scan`; the array is changed."""
    ranges[ranges > FARTHEST] = np.inf
    ranges[ranges < NEAREST] = -np.inf
    return ranges
