"""Distances that a robot has to drive over a floor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_sim_bridge.floor.floor_map import CELL, FloorMap, Rect

FAR = 1e9  # cells: not reached
NEAR = 32  # see `interpolate`: close to furniture, and not behind a wall


class FloorDistance:
    """Shortest driving distances to one point of a floor, by the eikonal equation |grad T| = 1.

    Solved by fast sweeping (Zhao, "A fast sweeping method for eikonal equations", 2005), which,
    unlike Dijkstra on the grid, does not prefer eight directions.
    """

    def __init__(self, floor: FloorMap, x: float, y: float):
        self.floor = floor
        self.values = _around(floor.free, (x - floor.origin[0]) / CELL - 0.5,
                              (y - floor.origin[1]) / CELL - 0.5)  # [rows, columns] m, float32
        _fast_sweeping(floor.free, self.values)

    @classmethod
    def to_rectangles(cls, floor: FloorMap, rects: Sequence[Rect]) -> FloorDistance:
        """Distances to the nearest free cell within some rectangles."""
        self = cls.__new__(cls)
        self.floor = floor
        rows, columns = floor.free.shape
        y = floor.origin[1] + (np.arange(rows)[:, None] + 0.5) * CELL
        x = floor.origin[0] + (np.arange(columns)[None, :] + 0.5) * CELL
        inside = np.zeros(floor.free.shape, bool)
        for x0, y0, x1, y1 in rects:
            inside |= (x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1)
        self.values = np.where(inside & floor.free, 0.0, FAR).astype(np.float32)
        _fast_sweeping(floor.free, self.values)
        return self

    @property
    def maximum(self) -> float:
        """The largest distance on the floor [m]."""
        return float(self.values[np.isfinite(self.values)].max())

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Distance of positions [N,>=2] to the point [m]; inf where it cannot be reached."""
        return interpolate(self.values[None], np.zeros(len(xy), np.int64),
                           (xy[:, 0] - self.floor.origin[0]) / CELL - 0.5,
                           (xy[:, 1] - self.floor.origin[1]) / CELL - 0.5, NEAR)


@numba.njit(cache=True)
def _around(free, goal_column, goal_row):
    """Distances [cells] close to a point; FAR elsewhere."""
    rows, columns = free.shape
    t = np.full((rows, columns), np.float32(FAR))
    # Exact distances around the goal: the grid's first steps would be the least accurate.
    reach = 3
    i0, j0 = int(round(goal_row)), int(round(goal_column))
    for i in range(max(0, i0 - reach), min(rows, i0 + reach + 1)):
        for j in range(max(0, j0 - reach), min(columns, j0 + reach + 1)):
            distance = math.hypot(i - goal_row, j - goal_column)
            if free[i, j] and distance <= reach:
                clear = True
                for step in range(1, 10):
                    a = int(round(goal_row + (i - goal_row) * step / 10))
                    b = int(round(goal_column + (j - goal_column) * step / 10))
                    if not free[min(max(a, 0), rows - 1), min(max(b, 0), columns - 1)]:
                        clear = False
                if clear:
                    t[i, j] = distance
    return t


@numba.njit(cache=True)
def _fast_sweeping(free, t):
    """Fill in distances [cells] from where they are known, then turn them into metres."""
    rows, columns = free.shape
    far = FAR
    changed = True
    while changed:
        changed = False
        for sweep in range(4):
            for p in range(rows):
                i = p if sweep < 2 else rows - 1 - p
                for q in range(columns):
                    j = q if sweep % 2 == 0 else columns - 1 - q
                    if not free[i, j]:
                        continue
                    a = min(t[i - 1, j] if i > 0 else far, t[i + 1, j] if i + 1 < rows else far)
                    b = min(t[i, j - 1] if j > 0 else far, t[i, j + 1] if j + 1 < columns else far)
                    if a >= far and b >= far:
                        continue
                    if abs(a - b) >= 1.0:
                        value = min(a, b) + 1.0
                    else:
                        value = 0.5 * (a + b + math.sqrt(2.0 - (a - b) * (a - b)))
                    if value < t[i, j] - 1e-4:
                        t[i, j] = value
                        changed = True
    for i in range(rows):
        for j in range(columns):
            t[i, j] = t[i, j] * CELL if t[i, j] < far else np.inf


@numba.njit(cache=True)
def interpolate(stack, which, columns, rows, near):
    """Distances [K] at fractional cells, from maps `which` [K] of a stack [G,rows,columns].

    Bilinear where all four neighbours are reached, else straight to one that is and on from there;
    inf where none is within about half of `near` cells.
    """
    height, width = stack.shape[1:]
    out = np.empty(len(columns))
    for n in range(len(columns)):
        values = stack[which[n]]
        x, y = columns[n], rows[n]
        j, i = int(math.floor(x)), int(math.floor(y))
        if 0 <= i < height - 1 and 0 <= j < width - 1:
            a, b = values[i, j], values[i, j + 1]
            c, d = values[i + 1, j], values[i + 1, j + 1]
            if max(max(a, b), max(c, d)) < np.inf:
                u, v = x - j, y - i
                out[n] = (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v
                continue
        # Off those cells: over the nearest of them, searched outwards.
        best = np.inf
        ring = 2
        while best == np.inf and ring < near:
            for p in range(max(0, i - ring), min(height, i + ring + 2)):
                for q in range(max(0, j - ring), min(width, j + ring + 2)):
                    if values[p, q] < np.inf:
                        best = min(best, values[p, q] + CELL * math.hypot(p - y, q - x))
            ring *= 2
        out[n] = best
    return out
