"""A house: its scene, what stands in the way, and distances a robot has to drive."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numba
import numpy as np

from vn_sim_bridge.houses.layout import Rect
from vn_sim_bridge.render.scene import Scene

CELL = 0.1  # m, side of a cell of the floor map
FAR = 1e9  # cells: not reached
FREE_MARGIN = 0.02  # m beyond the footprint that a cell's centre keeps from obstacles


class Room(NamedTuple):
    """A room: its name ('kitchen', 'bedroom 2', ...), its type and its floor inside the walls."""

    name: str
    kind: str
    rect: Rect


class Obstacle(NamedTuple):
    """What a robot cannot drive through: a rectangle on the floor."""

    rect: Rect
    label: str


class Goal(NamedTuple):
    """A place where a goal picture is taken."""

    pose: tuple[float, float, float, float]  # x, y [m], yaw, pitch [rad] in the map frame
    room: str


@dataclasses.dataclass(frozen=True)
class House:
    """One house, the same for every run of the same generator version and seed."""

    name: str
    seed: int
    outline: Rect
    scene: Scene
    rooms: tuple[Room, ...]
    obstacles: tuple[Obstacle, ...]
    goals: tuple[Goal, ...]
    footprint_radius: float  # m, of the robot that the floor map is for

    @property
    def area(self) -> float:
        """Floor inside the walls [m^2]."""
        return sum(room.rect.area for room in self.rooms)

    @functools.cached_property
    def obstacle_rects(self) -> np.ndarray:
        """[M,4] float64: x0, y0, x1, y1 of every obstacle."""
        return np.array([obstacle.rect for obstacle in self.obstacles], float)

    @functools.cached_property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""
        return floor_map(self.outline, self.obstacle_rects, self.footprint_radius)

    def geodesic(self, x: float, y: float) -> DistanceField:
        """Shortest driving distance from anywhere to (x, y)."""
        return DistanceField(self.floor, x, y)

    def starts(self) -> tuple[np.ndarray, None]:
        """Where episodes may begin, see `simulator.Place`: anywhere, facing anywhere."""
        return self.floor.centres(), None

    def room_at(self, x: float, y: float) -> str:
        """Name of the room that holds a point; '' inside walls and doors."""
        for room in self.rooms:
            if room.rect.x0 <= x <= room.rect.x1 and room.rect.y0 <= y <= room.rect.y1:
                return room.name
        return ''

    def floor_plan(self) -> dict:
        """What a map needs of the house, ready for JSON; lengths in m, poses as in `Goal`."""
        return {
            'house': self.seed, 'bounds': list(self.outline), 'area': self.area,
            'rooms_list': [{'name': room.name, 'rect': list(room.rect)} for room in self.rooms],
            'walls': [list(o.rect) for o in self.obstacles if o.label == 'wall'],
            'obstacles': [[*o.rect, o.label] for o in self.obstacles
                          if o.label not in ('wall', 'outside')],
            'outside': [list(o.rect) for o in self.obstacles if o.label == 'outside'],
            'goals': [{'room': goal.room, 'pose': list(goal.pose)} for goal in self.goals],
        }

    def room_index(self, x: float, y: float) -> int:
        """Index of the room nearest to a point."""
        gaps = [math.hypot(max(r.x0 - x, 0, x - r.x1), max(r.y0 - y, 0, y - r.y1))
                for r in (room.rect for room in self.rooms)]
        return int(np.argmin(gaps))


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


class DistanceField:
    """Shortest driving distances to one point, by the eikonal equation |grad T| = 1.

    Solved by fast sweeping (Zhao, "A fast sweeping method for eikonal equations", 2005), which,
    unlike Dijkstra on the grid, does not prefer eight directions.
    """

    def __init__(self, floor: FloorMap, x: float, y: float):
        self.floor = floor
        self.values = _around(floor.free, (x - floor.origin[0]) / CELL - 0.5,
                              (y - floor.origin[1]) / CELL - 0.5)  # [rows, columns] m, float32
        _fast_sweeping(floor.free, self.values)

    @classmethod
    def to_rectangles(cls, floor: FloorMap, rects: Sequence[Rect]) -> DistanceField:
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
        """The largest distance in the house [m]."""
        return float(self.values[np.isfinite(self.values)].max())

    def distance(self, xy: np.ndarray) -> np.ndarray:
        """Distance of positions [N,2] to the field's point [m]; inf where it cannot be reached."""
        return interpolate(self.values[None], np.zeros(len(xy), np.int64),
                           (xy[:, 0] - self.floor.origin[0]) / CELL - 0.5,
                           (xy[:, 1] - self.floor.origin[1]) / CELL - 0.5)


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
def interpolate(stack, which, columns, rows):
    """Distances [K] at fractional cells, from maps `which` [K] of a stack [G,rows,columns].

    Bilinear where all four neighbours are free, else the best detour over a free neighbour.
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
        # Off the free cells (close to furniture): over the nearest of them, searched outwards.
        best = np.inf
        ring = 2
        while best == np.inf and ring < 32:
            for p in range(max(0, i - ring), min(height, i + ring + 2)):
                for q in range(max(0, j - ring), min(width, j + ring + 2)):
                    if values[p, q] < np.inf:
                        best = min(best, values[p, q] + CELL * math.hypot(p - y, q - x))
            ring *= 2
        out[n] = best
    return out
