"""Text maps of our levels for DeepMind Lab, and the places that they are.

A row of a map is a line, north first: `*` is wall, anything else is floor. The same text is what
the engine builds its level of, so walls stand where our floor map has them.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import FloorMap, Rect, floor_map
from vn_sim_bridge.simulator import Goal

UNITS = 50.0  # of the engine, a metre: its player then looks from 1 m above the floor
FACE = 1.0  # units that the engine's walls stand out from their cells
VIEW = 3.0  # m that a goal's camera sees ahead, where there is as much
ARENA = """\
*******
*P    *
*     *
*  *  *
*     *
*     *
*******
"""
HOUSE = """\
***********
*AAA*BBBBB*
*AAA*BBBBB*
*PAAABBBBB*
*AAA*BBBBB*
**A***BB***
*CCC*DDDDD*
*CCC*DDDDD*
*CCCCDDDDD*
***********
"""


class Level(NamedTuple):
    """A level of ours."""

    rows: tuple[str, ...]
    cell: float  # units, side of a cell
    goals: int

    @property
    def map(self) -> str:
        """What the engine takes: walls, floor, and a spot to begin at."""
        return '\n'.join(''.join(c if c in '*P' else ' ' for c in row) for row in self.rows) + '\n'

    @property
    def looks(self) -> str:
        """Which cells look alike: a letter each."""
        return '\n'.join(''.join(' ' if c in '* ' else 'A' if c == 'P' else c for c in row)
                         for row in self.rows) + '\n'


def arena() -> Level:
    """An open square with one pillar; where fruit lies, episodes draw."""
    quarters = 'AB', 'CD'
    rows = [row if '*' * len(row) == row else ''.join(
        c if c in '*P' else quarters[i > 3][j > 3] for j, c in enumerate(row))
        for i, row in enumerate(ARENA.splitlines())]
    return Level(tuple(rows), 100.0, 4)


def house() -> Level:
    """Four rooms with doors, each with walls and floor of its own."""
    return Level(tuple(HOUSE.splitlines()), 64.0, 8)


def maze(seed: int, size: int) -> Level:
    """A maze of `size` x `size` cells, an odd number, by depth-first search; with a few loops."""
    rng = np.random.default_rng([seed, size])
    grid = np.full((size, size), '*')
    grid[1, 1] = ' '
    stack = [(1, 1)]
    while stack:
        i, j = stack[-1]
        ways = [(i + di, j + dj) for di, dj in ((0, 2), (2, 0), (0, -2), (-2, 0))
                if 0 < i + di < size and 0 < j + dj < size and grid[i + di, j + dj] == '*']
        if not ways:
            stack.pop()
            continue
        a, b = ways[rng.integers(len(ways))]
        grid[(i + a) // 2, (j + b) // 2] = grid[a, b] = ' '
        stack.append((a, b))
    for _ in range(size // 3):  # walls between two free cells
        i, j = rng.integers(1, size - 1, 2)
        if (i + j) % 2 and grid[i, j] == '*':
            grid[i, j] = ' '
    for i, j in zip(*np.nonzero(grid == ' '), strict=True):
        grid[i, j] = 'ABCDEFGHI'[int(3 * i // size) * 3 + int(3 * j // size)]
    grid[1, 1] = 'P'
    return Level(tuple(''.join(row) for row in grid), 100.0, 6)


class TextPlace:
    """A level of ours, as a place with walls, floor and distances.

    Args:
        name: of the scene; level: its map; radius: of the robot [m].
    """

    def __init__(self, name: str, level: Level, radius: float):
        self.name, self.level, self.radius = name, level, radius
        self.side = level.cell / UNITS
        rows, columns = len(level.rows), len(level.rows[0])
        self.outline = Rect(0.0, 0.0, columns * self.side, rows * self.side)

    def middle(self, i: int, j: int) -> tuple[float, float]:
        """Of the cell in row i (from the north) and column j [m]."""
        return (j + 0.5) * self.side, (len(self.level.rows) - i - 0.5) * self.side

    @functools.cached_property
    def obstacles(self) -> tuple[tuple[Rect, str], ...]:
        """Walls: a rectangle for cells side by side."""
        found, face = [], FACE / UNITS
        for i, row in enumerate(self.level.rows):
            low, j = (len(self.level.rows) - i - 1) * self.side, 0
            while j < len(row):
                end = j
                while end < len(row) and row[end] == '*':
                    end += 1
                if end > j:
                    found.append((Rect(j * self.side - face, low - face, end * self.side + face,
                                       low + self.side + face), 'wall'))
                j = max(end, j + 1)
        return tuple(found)

    @functools.cached_property
    def obstacle_rects(self) -> np.ndarray:
        """[M,4] float64: x0, y0, x1, y1 [m] of every wall."""
        return np.array([rect for rect, _ in self.obstacles], float)

    @functools.cached_property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""
        return floor_map(self.outline, self.obstacle_rects, self.radius)

    @functools.cached_property
    def goals(self) -> tuple[Goal, ...]:
        """Cells far from each other; each looks to where there is most to see."""
        cells = [(i, j) for i, row in enumerate(self.level.rows) for j, c in enumerate(row)
                 if c != '*']
        at = np.array([self.middle(*cell) for cell in cells])
        chosen, gap = [len(at) - 1], np.hypot(*(at - at[-1]).T)
        while len(chosen) < min(self.level.goals, len(at)):
            chosen.append(int(gap.argmax()))
            gap = np.minimum(gap, np.hypot(*(at - at[chosen[-1]]).T))
        found: list[Goal] = []
        for k in chosen:
            i, j = cells[k]
            free = [self._free(i, j, di, dj) for di, dj in ((0, 1), (-1, 0), (0, -1), (1, 0))]
            quarter = int(np.argmin([abs(way - VIEW) for way in free]))
            x, y = at[k].tolist()
            found.append(Goal((x, y, wrapped(quarter * math.pi / 2), 0.0),
                              f'{self.level.rows[i][j]}{len(found) + 1}'))
        return tuple(found)

    def _free(self, i: int, j: int, di: int, dj: int) -> float:
        steps = 0
        while self.level.rows[i + di][j + dj] != '*':
            i, j, steps = i + di, j + dj, steps + 1
        return steps * self.side

    def starts(self) -> tuple[np.ndarray, None]:
        """Where episodes may begin, see `Place`: anywhere, facing anywhere."""
        return self.floor.centres(), None

    def distance_to(self, goal: Goal) -> FloorDistance:
        """Shortest driving distance from anywhere to a goal."""
        return FloorDistance(self.floor, *goal.pose[:2])

    def plan(self) -> dict:
        """What a map needs, see `House.plan`."""
        return {
            'scene': self.name, 'bounds': list(self.outline),
            'area': self.side ** 2 * sum(c != '*' for row in self.level.rows for c in row),
            'rooms_list': [], 'walls': [list(rect) for rect, _ in self.obstacles],
            'obstacles': [], 'outside': [],
            'goals': [{'room': goal.room, 'pose': list(goal.pose)} for goal in self.goals],
        }


class LevelPlace:
    """A level of the engine's or of the user's: where it lets its player begin is all we know.

    Args:
        name: of the scene; spawns: [K,3] x, y [m], yaw [rad].
    """

    def __init__(self, name: str, spawns: np.ndarray):
        self.name, self.spawns = name, spawns
        self.goals = tuple(Goal((x, y, yaw, 0.0), f'start {k + 1}')
                           for k, (x, y, yaw) in enumerate(spawns.tolist()))

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Where episodes may begin, see `Place`."""
        return self.spawns[:, :2].copy(), self.spawns[:, 2].copy()

    def distance_to(self, goal: Goal) -> None:
        """Nobody knows the ways."""

    def plan(self) -> None:
        """There is no map."""


def wrapped(angle):
    """An angle between -pi and pi [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
