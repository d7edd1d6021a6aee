"""Which poses are open: those that a recorded picture stands for, near_path the driven path."""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_sim_bridge.floor.floor_map import CELL

HEADINGS = 72  # layers
HEADING = 2 * math.pi / HEADINGS  # rad between two
# A picture stands for the poses around its own from where its position is in sight, up to these.
FARTHEST, TURNED_MOST = 1.0, math.radians(30)  # m, rad
GAP = 6  # layers between open ones that are open too: where a robot could not turn it is trapped


@numba.njit(cache=True)
def mark_ways(ways, margin, x, y, near_path):
    """Cells whose centres lie within the margin of some straight pieces."""
    rows, columns = near_path.shape
    for k in range(len(ways)):
        ax, ay, bx, by = ways[k, 0, 0], ways[k, 0, 1], ways[k, 1, 0], ways[k, 1, 1]
        length = (bx - ax) ** 2 + (by - ay) ** 2
        for i in range(max(int((min(ay, by) - margin - y) / CELL), 0),
                       min(int((max(ay, by) + margin - y) / CELL) + 1, rows)):
            for j in range(max(int((min(ax, bx) - margin - x) / CELL), 0),
                           min(int((max(ax, bx) + margin - x) / CELL) + 1, columns)):
                px, py = x + (j + 0.5) * CELL, y + (i + 0.5) * CELL
                share = 0.0
                if length > 0:
                    share = ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length
                    share = min(max(share, 0.0), 1.0)
                if math.hypot(px - ax - share * (bx - ax), py - ay - share * (by - ay)) <= margin:
                    near_path[i, j] = True


@numba.njit(cache=True)
def in_sight(ax, ay, bx, by, x, y, free):
    """Whether the straight way between two points is all free; `free` [rows,columns] from x, y."""
    count = max(int(math.hypot(bx - ax, by - ay) / (0.5 * CELL)), 1)
    for k in range(count + 1):
        i = math.floor((ay + (by - ay) * k / count - y) / CELL)
        j = math.floor((ax + (bx - ax) * k / count - x) / CELL)
        if i < 0 or j < 0 or i >= free.shape[0] or j >= free.shape[1] or not free[i, j]:
            return False
    return True


@numba.njit(cache=True)
def mark_poses(poses, near_path, x, y, is_open):
    """States that a picture stands for."""
    rows, columns = near_path.shape
    reach, around = int(FARTHEST / CELL) + 1, int(TURNED_MOST / HEADING) + 1
    for k in range(len(poses)):
        px, py = poses[k, 0], poses[k, 1]
        row, column = int((py - y) / CELL), int((px - x) / CELL)
        layer = int(round(poses[k, 2] / HEADING))
        for i in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for j in range(max(column - reach, 0), min(column + reach + 1, columns)):
                cx, cy = x + (j + 0.5) * CELL, y + (i + 0.5) * CELL
                if not near_path[i, j] or math.hypot(cx - px, cy - py) > FARTHEST or (
                        is_open[i, j, layer % HEADINGS]
                        and is_open[i, j, (layer - around) % HEADINGS]
                        and is_open[i, j, (layer + around) % HEADINGS]):
                    continue  # nothing to do, or nothing new
                if not in_sight(cx, cy, px, py, x, y, near_path):
                    continue
                for h in range(layer - around, layer + around + 1):
                    if abs(h * HEADING - poses[k, 2]) <= TURNED_MOST:
                        is_open[i, j, h % HEADINGS] = True


@numba.njit(cache=True)
def fill_gaps(is_open):
    """Open up to `GAP` closed layers between two open ones."""
    for i in range(is_open.shape[0]):
        for j in range(is_open.shape[1]):
            layers = is_open[i, j]
            if not layers.any() or layers.all():
                continue
            begin = int(np.argmax(layers))
            last = begin
            for h in range(begin + 1, begin + HEADINGS + 1):
                if layers[h % HEADINGS]:
                    if h - last - 1 <= GAP:
                        for k in range(last + 1, h):
                            layers[k % HEADINGS] = True
                    last = h
