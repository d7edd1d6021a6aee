"""How far a place is free along bearings: labels of views, from walls or from depth pictures."""

from __future__ import annotations

import math

import numba
import numpy as np

# Heights of what a robot drives into, by a depth picture alone [m].
LOWEST, HIGHEST = 0.15, 1.2


@numba.njit(cache=True)
def ray_cast(poses, place, bearings, rects, first_rect):
    """Ranges from poses to the first obstacle, [V,C] float32 m; inf where there is none.

    Args:
        poses: [V,4] x, y [m], yaw [rad], and pitch.
        place: [V] whose obstacles.
        bearings: [V,C] rad off the heading, positive to the left.
        rects: [M,4] x0, y0, x1, y1 [m] of the obstacles of all places.
        first_rect: [P+1] where those of each place begin.
    """
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


def ranges_of_depth(depth: np.ndarray, cameras: np.ndarray, fov: np.ndarray, yaw: np.ndarray,
                    bearings: np.ndarray) -> np.ndarray:
    """Ranges to the nearest point at the height of a robot, [V,C] float32 m; NaN: nobody knows.

    A point belongs to the bearing whose tangent is nearest, within half a column.

    Args:
        depth: [V,S,S] float32 m along the optical axis, 0 where nothing is seen.
        cameras: [V,5] x, y, z [m], yaw (left), pitch (down) [rad]; fov: [V] rad, as of
            `vn_nav.co_visibility.lift`.
        yaw: [V] rad, nominal headings, which the bearings [V,C] are off, evenly in their tangents.
    """
    slopes = np.tan(np.asarray(bearings, float))
    return _ranges_of_depth(depth, np.ascontiguousarray(cameras), np.asarray(fov, float),
                            np.asarray(yaw, float), slopes)


@numba.njit(cache=True)
def _ranges_of_depth(depth, cameras, fov, yaw, slopes):
    count, size = depth.shape[0], depth.shape[1]
    columns = slopes.shape[1]
    found = np.full((count, columns), np.nan, np.float32)
    for n in range(count):
        focal = size / 2 / math.tan(fov[n] / 2)
        cp, sp = math.cos(cameras[n, 4]), math.sin(cameras[n, 4])
        step = slopes[n, 1] - slopes[n, 0] if columns > 1 else 0.1
        turn = cameras[n, 3] - yaw[n]
        ct, st = math.cos(turn), math.sin(turn)
        for row in range(size):
            down = (row + 0.5 - size / 2) / focal
            for column in range(size):
                z = depth[n, row, column]
                height = cameras[n, 2] - z * (sp + down * cp)
                if z <= 0.0 or not LOWEST <= height <= HIGHEST:
                    continue
                ahead, left = z * (cp - down * sp), -z * (column + 0.5 - size / 2) / focal
                ahead, left = ct * ahead - st * left, st * ahead + ct * left
                if ahead <= 0.0:
                    continue
                place = (left / ahead - slopes[n, 0]) / step
                index = int(math.floor(place + 0.5))
                if 0 <= index < columns:
                    away = math.hypot(ahead, left)
                    if not found[n, index] <= away:
                        found[n, index] = away
    return found
