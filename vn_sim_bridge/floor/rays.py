"""Rays against the obstacles of places: rectangles, the same that stop a robot."""

from __future__ import annotations

import math

import numba
import numpy as np


def ray_cast(poses: np.ndarray, place: np.ndarray, bearings: np.ndarray, rects: np.ndarray,
             first_rect: np.ndarray) -> np.ndarray:
    """Ranges from poses to the first obstacle, [V,C] float32 m; inf where there is none.

    Args:
        poses: [V,>=3] x, y [m], yaw [rad].
        place: [V] whose obstacles.
        bearings: [V,C] or [C] rad off the heading, positive to the left.
        rects: [M,4] x0, y0, x1, y1 [m] of the obstacles of all places.
        first_rect: [P+1] where those of each place begin.
    """
    bearings = np.broadcast_to(np.asarray(bearings, float),
                               (len(poses), np.shape(bearings)[-1]))
    return _ray_cast(poses, place, bearings, rects, first_rect)


@numba.njit(cache=True)
def _ray_cast(poses, place, bearings, rects, first_rect):
    found = np.empty(bearings.shape, np.float32)
    for n in range(len(poses)):
        x, y = poses[n, 0], poses[n, 1]
        begin, end = first_rect[place[n]], first_rect[place[n] + 1]
        for c in range(bearings.shape[1]):
            angle = poses[n, 2] + bearings[n, c]
            dx, dy = math.cos(angle), math.sin(angle)
            # A ray along an axis meets no edge across it: as good as infinitely far.
            along = 1 / dx if abs(dx) > 1e-12 else math.copysign(1e12, dx)
            across = 1 / dy if abs(dy) > 1e-12 else math.copysign(1e12, dy)
            nearest = math.inf
            for m in range(begin, end):
                a, b = (rects[m, 0] - x) * along, (rects[m, 2] - x) * along
                enter, leave = min(a, b), max(a, b)
                if leave < 0.0 or enter >= nearest:
                    continue
                a, b = (rects[m, 1] - y) * across, (rects[m, 3] - y) * across
                enter, leave = max(enter, min(a, b), 0.0), min(leave, max(a, b))
                if enter <= leave and enter < nearest:
                    nearest = enter
            found[n, c] = nearest
    return found
