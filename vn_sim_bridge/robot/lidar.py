"""A planar laser scanner, exact: rays against what a robot cannot drive through.

The same rectangles stop the robot, so that a map made from the scan, or a collision monitor that
reads it, agrees with what the robot bumps into (a table is its whole outline, not four legs).
"""

from __future__ import annotations

import math

import numpy as np

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
    angles = pose[2] + scan_angles()
    with np.errstate(divide='ignore'):  # a ray along an axis never reaches the other one's sides
        inverse = 1.0 / np.stack([np.cos(angles), np.sin(angles)])
    # A ray is inside a rectangle where it is between both pairs of sides (the slab method).
    enter, leave = np.full((RAYS, len(rects)), -np.inf), np.full((RAYS, len(rects)), np.inf)
    for axis in (0, 1):
        with np.errstate(invalid='ignore'):
            low = (rects[:, axis] - pose[axis]) * inverse[axis][:, None]
            high = (rects[:, axis + 2] - pose[axis]) * inverse[axis][:, None]
        enter = np.fmax(enter, np.fmin(low, high))
        leave = np.fmin(leave, np.fmax(low, high))
    hit = (leave >= enter) & (leave >= 0)
    ranges = np.where(hit, np.maximum(enter, 0.0), np.inf).min(axis=1, initial=np.inf)
    ranges[ranges > FARTHEST] = np.inf
    ranges[ranges < NEAREST] = -np.inf
    return ranges.astype(np.float32)
