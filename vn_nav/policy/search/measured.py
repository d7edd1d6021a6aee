"""Measured ranges on an occupancy grid: the kernels of `OccupancyGrid.add_scan`.

A measured range is certain, where a picture's is a distribution: a ray clears the cells that it
passes and marks the one that it ends in.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.measured_ranges import Scan


@numba.njit(cache=True)
def enter_scan(log_odds, measured, origin, cell, at, bearings, ranges, nearest, clear_from, reach,
               free, hit, most):
    """Each cell counts once a scan: as an obstacle where a ray ends in it, else as free.

    Args:
        log_odds, measured, origin: of the grid; cell: m.
        at: [3] pose of the scanner on the map.
        bearings, ranges: [K], by REP 117.
        nearest, clear_from: as of `Scanner`; reach: m beyond which nothing is entered.
        free, hit: log-odds of a ray that passes, and of one that ends here; most: either way.
    """
    side = log_odds.shape[0]
    step = 0.5 * cell
    mark = np.zeros((side, side), np.int8)  # 1: passed in blind, 2: passed, 3: a ray ends here
    low_row, high_row, low_column, high_column = side, -1, side, -1
    for i in range(len(bearings)):
        found = ranges[i]
        if math.isnan(found):
            continue
        dx, dy = math.cos(at[2] + bearings[i]), math.sin(at[2] + bearings[i])
        far = max(found, nearest)  # minus infinity: something is nearer than that
        ends = far <= reach
        passes = 0.0 if found < nearest else min(far, reach)
        for k in range(int(passes / step) + 2):
            # The last one is where the ray ends, exactly.
            r = (k + 0.5) * step
            last = r >= passes
            if last:
                r = far
                if not ends:
                    break
            column = int(math.floor((at[0] + r * dx - origin[0]) / cell))
            row = int(math.floor((at[1] + r * dy - origin[1]) / cell))
            if row < 0 or row >= side or column < 0 or column >= side:
                break
            value = 3 if last else 2 if r >= clear_from else 1
            mark[row, column] = max(mark[row, column], value)
            low_row, high_row = min(low_row, row), max(high_row, row)
            low_column, high_column = min(low_column, column), max(high_column, column)
            if last:
                break
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            if mark[row, column] == 0:
                continue
            measured[row, column] = True
            change = hit if mark[row, column] == 3 else -free if mark[row, column] == 2 else 0.0
            log_odds[row, column] = min(max(log_odds[row, column] + change, -most), most)


def ends_of(scan: Scan, at: np.ndarray, reach: float) -> np.ndarray:
    """Where the rays of a scan end within a reach, on the map: [K,2] m.

    Args:
        at: [3] pose of the scanner on the map; reach: m.
    """
    ranges = np.maximum(scan.ranges, scan.scanner.nearest)  # minus infinity: nearer than that
    known = ranges <= reach
    angles = at[2] + scan.scanner.bearings[known]
    return at[:2] + ranges[known, None] * np.stack([np.cos(angles), np.sin(angles)], 1)


@numba.njit(cache=True)
def free_of_points(points, x, y, angle, length, radius):
    """How far [m] a disc gets on a straight line without a point in it, and the clearance [m].

    What it leaves behind does not count.

    Args:
        points: [K,2] m; x, y: m where it begins; angle: rad; length: m.
        radius: of the disc [m].
    """
    dx, dy = math.cos(angle), math.sin(angle)
    got = length
    for i in range(len(points)):
        px, py = points[i, 0] - x, points[i, 1] - y
        along, across = dx * px + dy * py, dx * py - dy * px
        if along > 0.0 and abs(across) < radius:
            got = min(got, max(along - math.sqrt(radius**2 - across**2), 0.0))
    clear = math.inf
    for i in range(len(points)):
        px, py = points[i, 0] - x, points[i, 1] - y
        along, across = dx * px + dy * py, dx * py - dy * px
        if along > 0.0:
            clear = min(clear, math.hypot(max(along - got, 0.0), across))
    return got, clear


@numba.njit(cache=True)
def look_over(seen, measured, obstacles, origin, cell, x, y, angles, reach, rays):
    """A camera looks at the measured floor along its columns, up to obstacles: seen once more.

    Args:
        seen, measured, obstacles, origin: of the grid; cell: m.
        x, y: m of the camera; angles: [C] rad of its columns on the map.
        reach: m that it sees; rays: for each column.
    """
    side = seen.shape[0]
    step = 0.5 * cell
    spread = abs(angles[-1] - angles[0]) / max(len(angles) - 1, 1)
    done = np.zeros((side, side), np.bool_)
    for angle in angles:
        for ray in range(rays):
            way = angle + spread * ((ray + 0.5) / rays - 0.5)
            dx, dy = math.cos(way), math.sin(way)
            for k in range(int(reach / step)):
                r = (k + 0.5) * step
                column = int(math.floor((x + r * dx - origin[0]) / cell))
                row = int(math.floor((y + r * dy - origin[1]) / cell))
                if row < 0 or column < 0 or row >= side or column >= side:
                    break
                if measured[row, column] and not done[row, column]:
                    done[row, column] = True
                    seen[row, column] += 1.0
                if obstacles[row, column]:
                    break
