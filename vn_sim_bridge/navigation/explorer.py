"""A teacher that knows no more than a robot could: it explores until it has seen the goal.

The shortest path to a goal that was never seen is nothing that a policy could learn from
pictures. This teacher drives to the nearest part of the place that the robot has not looked at
yet, and to the goal once the camera has shown what the goal picture shows
(`co_visibility.co_visible`): what it does can be inferred from what the robot has seen (frontier
exploration: Yamauchi 1997).
Targets of a loss only; no network is shown its state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.floor.places import WalledPlace
from vn_sim_bridge.navigation.oracle import BLOCKED_COST, TURN_COST

COARSE = 2  # cells of the floor map a side of one of the explorer's
SIDE = COARSE * CELL  # m
SIGHT = 4.0  # m: what lies farther was not really looked at
RAYS = 41  # across the camera's field of view
NEAR = 1.0  # m: around itself a robot need not look
ENOUGH = 0.25  # overlap with the goal picture from which the goal counts as seen
TURN_BACK_COST = 0.6  # m, charged for rotating against the rotation before
FAR = np.float32(1e9)


class Explorer:
    """What N robots have looked at in their episodes, and where each should go next.

    Args:
        places: the places.
        num_envs: robots.
        fov: of the camera [rad]; turn, length: of one rotation [rad] and one forward move [m].
        radius: distance [m] from which on a robot only turns to the goal's heading.
    """

    def __init__(self, places: Sequence[WalledPlace], num_envs: int, *, fov: float, turn: float,
                 length: float, radius: float):
        rows = max(place.floor.free.shape[0] for place in places)
        columns = max(place.floor.free.shape[1] for place in places)
        self._free = np.zeros((len(places), rows, columns), bool)
        shape = -(-rows // COARSE), -(-columns // COARSE)
        self._open = np.zeros((len(places), *shape), bool)  # a robot can stand somewhere in it
        self._wall = np.ones((len(places), *shape), bool)  # hides what is behind
        for k, place in enumerate(places):
            free = place.floor.free
            self._free[k, :free.shape[0], :free.shape[1]] = free
            padded = np.zeros((shape[0] * COARSE, shape[1] * COARSE), bool)
            padded[:free.shape[0], :free.shape[1]] = free
            self._open[k] = padded.reshape(shape[0], COARSE, shape[1], COARSE).any(axis=(1, 3))
            self._wall[k] = _walls(place, shape) & ~self._open[k]
        self._origins = np.array([place.floor.origin for place in places], float)
        self._rays = np.linspace(-fov / 2, fov / 2, RAYS)
        self._turn, self._length, self._radius = turn, length, radius
        half = math.ceil(math.pi / turn)
        self._turns = np.arange(-half + 1, half + 1)
        self.seen = np.zeros((num_envs, *shape), bool)
        self.found = np.zeros(num_envs, bool)  # the goal has been seen

    def begin(self, env_ids: np.ndarray) -> None:
        """Forget everything: new episodes."""
        self.seen[env_ids] = False
        self.found[env_ids] = False

    def turns(self, poses: np.ndarray, place_index: np.ndarray, overlap: np.ndarray,
              distance: np.ndarray, goal_yaw: np.ndarray, goal_maps: np.ndarray,
              turned: np.ndarray) -> np.ndarray:
        """Look from here, then say by how much each robot should turn; 0: drive forward.

        Args:
            poses: [N,4] x, y [m], yaw, pitch [rad]; place_index: [N].
            overlap: [N] share of the goal picture in view.
            distance: [N] geodesic, to the goal [m]; goal_yaw: [N] rad.
            goal_maps: [N,rows,columns] geodesic distances to the goal [m].
            turned: [N] sign of the rotation that was the last action; 0: it was none.

        Returns:
            [N] rad, left.
        """
        self.found |= overlap >= ENOUGH
        wanted = np.empty(len(poses))
        _advise(poses, place_index, distance, goal_yaw, self.found, self.seen, self._open,
                self._wall, self._free, self._origins, goal_maps, turned, self._rays, self._turns,
                self._turn, self._length, self._radius, wanted)
        return wanted


def _walls(place: WalledPlace, shape: tuple[int, int]) -> np.ndarray:
    """[rows,columns] of the explorer's cells that a wall touches, or that lie outside."""
    wall = np.zeros(shape, bool)
    x0, y0 = place.floor.origin
    for rect, label in place.obstacles:
        if label in ('wall', 'outside'):
            low = int(max((rect.y0 - y0) / SIDE, 0)), int(max((rect.x0 - x0) / SIDE, 0))
            high = math.ceil((rect.y1 - y0) / SIDE), math.ceil((rect.x1 - x0) / SIDE)
            wall[low[0]:max(high[0], 0), low[1]:max(high[1], 0)] = True
    return wall


@numba.njit(cache=True)
def _look(x, y, yaw, rays, wall, seen):
    """Mark the cells along the rays as seen, up to the first wall, which is seen too."""
    rows, columns = wall.shape
    around = int(NEAR / SIDE)
    for a in range(-around, around + 1):
        for b in range(-around, around + 1):
            i, j = int(y / SIDE) + a, int(x / SIDE) + b
            if a * a + b * b <= around * around and 0 <= i < rows and 0 <= j < columns:
                seen[i, j] = True
    for ray in rays:
        c, s = math.cos(yaw + ray), math.sin(yaw + ray)
        reach = 0.0
        while reach <= SIGHT:
            i, j = int((y + s * reach) / SIDE), int((x + c * reach) / SIDE)
            if i < 0 or j < 0 or i >= rows or j >= columns:
                break
            seen[i, j] = True
            if wall[i, j]:
                break
            reach += 0.5 * SIDE


@numba.njit(cache=True)
def _unseen_field(x, y, seen, free, field, queue):
    """Distances [m] to the nearest cell that shows something new; whether there is one.

    Sources are unseen cells, and seen ones beside something unseen; the way leads through seen
    cells. Label-correcting over a queue, and not much farther than the robot's own cell.
    """
    rows, columns = free.shape
    field[:] = FAR
    size = len(queue)
    head, tail, waiting = 0, 0, 0
    for i in range(1, rows - 1):
        for j in range(1, columns - 1):
            if not free[i, j]:
                continue
            # A crack between furniture and wall is not worth a journey: two sides must be new.
            new = 0 if seen[i, j] else 2
            new += (not seen[i - 1, j]) + (not seen[i + 1, j])
            new += (not seen[i, j - 1]) + (not seen[i, j + 1])
            if new >= 2:
                field[i, j] = 0.0
                queue[tail] = i * columns + j
                tail += 1
                waiting += 1
    if waiting == 0:
        return False
    row, column = int(y / SIDE), int(x / SIDE)
    row, column = min(max(row, 1), rows - 2), min(max(column, 1), columns - 2)
    while waiting > 0:
        cell = queue[head]
        head = (head + 1) % size
        waiting -= 1
        i, j = cell // columns, cell % columns
        value = field[i, j]
        if value > field[row, column] + 1.0:
            continue
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if (di == 0 and dj == 0) or a < 0 or b < 0 or a >= rows or b >= columns:
                    continue
                if not free[a, b] or (di != 0 and dj != 0
                                      and not (free[a, j] and free[i, b])):
                    continue
                step = SIDE * (1.41421 if di != 0 and dj != 0 else 1.0)
                if value + step < field[a, b] - 1e-4 and waiting < size:
                    field[a, b] = value + step
                    queue[tail % size] = a * columns + b
                    tail = (tail + 1) % size
                    waiting += 1
    return field[row, column] < FAR or _around(x, y, field, SIDE) < FAR


@numba.njit(cache=True)
def _around(x, y, field, side):
    """Distance over the nearest cells of a field."""
    rows, columns = field.shape
    i, j = int(y / side), int(x / side)
    best = FAR
    for a in range(max(i - 1, 0), min(i + 2, rows)):
        for b in range(max(j - 1, 0), min(j + 2, columns)):
            if field[a, b] < FAR:
                gap = math.hypot((a + 0.5) * side - y, (b + 0.5) * side - x)
                best = min(best, field[a, b] + gap)
    return best


@numba.njit(cache=True)
def _advise(poses, place_index, distance, goal_yaw, found, seen, open_cells, walls, free_cells,
            origins, goal_maps, turned, rays, turns, turn, length, radius, wanted):
    rows, columns = open_cells.shape[1:]
    field = np.empty((rows, columns), np.float32)
    queue = np.empty(8 * rows * columns, np.int64)
    for n in range(len(poses)):
        place = place_index[n]
        x, y = poses[n, 0] - origins[place, 0], poses[n, 1] - origins[place, 1]
        yaw = poses[n, 2]
        _look(x, y, yaw, rays, walls[place], seen[n])
        exploring = not found[n] and _unseen_field(x, y, seen[n], open_cells[place], field, queue)
        if not exploring and distance[n] <= radius:
            wanted[n] = (goal_yaw[n] - yaw + math.pi) % (2 * math.pi) - math.pi
            if abs(wanted[n]) < 0.5 * turn:
                wanted[n] = 0.0
            continue
        free = free_cells[place]
        best, choice = math.inf, 0
        for k in turns:
            c, s = math.cos(yaw + k * turn), math.sin(yaw + k * turn)
            reach = 0.0
            while reach < length:
                step = min(reach + CELL, length)
                i, j = int((y + s * step) / CELL), int((x + c * step) / CELL)
                if not (0 <= i < free.shape[0] and 0 <= j < free.shape[1] and free[i, j]):
                    break
                reach = step
            ex, ey = x + c * reach, y + s * reach
            there = (_around(ex, ey, field, SIDE) if exploring
                     else _around(ex, ey, goal_maps[n], CELL))
            cost = there + TURN_COST * abs(k) + BLOCKED_COST * (length - reach)
            if k * turned[n] < 0:
                cost += TURN_BACK_COST  # what it does next can be told from what it did
            if cost < best:
                best, choice = cost, k
        wanted[n] = choice * turn
