"""Depth pictures as ranges along bearings, compiled by Numba."""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.measured_ranges import HIGHEST, LOWEST


@numba.njit(cache=True)
def least_ranges(depth, focal_x, focal_y, centre_x, centre_y, camera_height, pitch, turn, slopes):
    """Ranges to the nearest point at the height of a robot, [C] float32; NaN: nobody knows.

    A point belongs to the bearing whose tangent is nearest, within half a column.

    Args:
        depth: [H,W] float32 m along the optical axis, 0 or NaN where nothing is seen.
        focal_x, focal_y, centre_x, centre_y: see `DepthCamera`.
        camera_height: above the floor; pitch: down; turn: of the camera against the bearings.
        slopes: [C] tangents of the bearings, evenly spaced.
    """
    columns = len(slopes)
    found = np.full(columns, np.nan, np.float32)
    cp, sp = math.cos(pitch), math.sin(pitch)
    ct, st = math.cos(turn), math.sin(turn)
    step = slopes[1] - slopes[0] if columns > 1 else 0.1
    for row in range(depth.shape[0]):
        down = (row + 0.5 - centre_y) / focal_y
        for column in range(depth.shape[1]):
            z = depth[row, column]
            height = camera_height - z * (sp + down * cp)
            if z <= 0.0 or not LOWEST <= height <= HIGHEST:
                continue
            ahead, left = z * (cp - down * sp), -z * (column + 0.5 - centre_x) / focal_x
            ahead, left = ct * ahead - st * left, st * ahead + ct * left
            if ahead <= 0.0:
                continue
            index = int(math.floor((left / ahead - slopes[0]) / step + 0.5))
            if 0 <= index < columns:
                away = math.hypot(ahead, left)
                if not found[index] <= away:
                    found[index] = away
    return found
