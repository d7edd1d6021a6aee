"""Where a round robot can stand: a grid of cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

CELL = 0.1  # m, side of a cell of the floor map
FREE_MARGIN = 0.02  # m beyond the footprint that a cell's centre keeps from obstacles


class Rect(NamedTuple):
    """An axis-aligned rectangle [m]."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def area(self) -> float:
        """In square metres."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


class Room(NamedTuple):
    """A room: its name ('kitchen', 'bedroom 2', ...), its type and its floor inside the walls."""

    name: str
    kind: str
    rect: Rect


class FloorMap(NamedTuple):
    """A grid of cells; cell [i, j] has its centre at origin + ((j + 0.5), (i + 0.5)) * CELL."""

    origin: tuple[float, float]
    free: np.ndarray  # [rows, columns] bool: the robot can stand here, and get here

    def centres(self) -> np.ndarray:
        """[K,2] positions of the free cells [m], in row order."""
        rows, columns = np.nonzero(self.free)
        return np.stack([self.origin[0] + (columns + 0.5) * CELL,
                         self.origin[1] + (rows + 0.5) * CELL], axis=1)


def clearance(origin: tuple[float, float], shape: tuple[int, int],
              rects: np.ndarray) -> np.ndarray:
    """Distance from every cell's centre to the nearest rectangle [m], [rows, columns]."""
    y = origin[1] + (np.arange(shape[0]) + 0.5)[:, None] * CELL
    x = origin[0] + (np.arange(shape[1]) + 0.5)[None, :] * CELL
    nearest = np.full(shape, np.inf)
    for x0, y0, x1, y1 in rects:
        dx = np.maximum(np.maximum(x0 - x, x - x1), 0.0)
        dy = np.maximum(np.maximum(y0 - y, y - y1), 0.0)
        nearest = np.minimum(nearest, np.hypot(dx, dy))
    return nearest


def grid_of(outline: Rect) -> tuple[tuple[float, float], tuple[int, int]]:
    """Origin and shape of the floor map of an outline."""
    shape = (math.ceil((outline.y1 - outline.y0) / CELL),
             math.ceil((outline.x1 - outline.x0) / CELL))
    return (outline.x0, outline.y0), shape


def main_component(free: np.ndarray) -> np.ndarray:
    """The largest connected part of a free map: pockets that cannot be left are not free."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8),
                                                              connectivity=4)
    if count <= 1:
        return np.zeros_like(free)
    return parts == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))


def floor_map(outline: Rect, rects: np.ndarray, radius: float) -> FloorMap:
    """Where a round robot can stand among obstacles."""
    origin, shape = grid_of(outline)
    free = clearance(origin, shape, rects) > radius + FREE_MARGIN
    return FloorMap(origin, main_component(free))
