"""Costmap of an occupancy grid: cost to go, frontiers (Yamauchi, 1997), free straight ways."""

from __future__ import annotations

import heapq
import math

import cv2
import numba
import numpy as np

from vn_nav.policy.search.grid import CELL, OccupancyGrid
from vn_nav.policy.search.measured import free_of_points

KEEP = 0.04  # m beyond the footprint that is passable: a cell's edge is half a cell off
SCAN_KEEP = 0.015  # m, the same of what a scan shows exactly
KEEP_OFF = 0.2  # m beyond the footprint within which a way costs more
CLOSE_COST = 2.0  # of it: this many metres more for a metre, at the footprint
UNKNOWN_COST = 2.0  # the same for floor that nobody has seen or measured
LANE_KEEP = 0.08  # m that what is seen may be nearer, where a robot has driven
ASIDE_COST = 0.5  # where a robot has driven: for a metre beside that
WALL_COST = 30.0  # for a wall that is known by hearsay
ROOM = 0.7  # m about a frontier cell in which the unknown floor counts
HEAD_START = 1.5  # m that all of it unknown is worth
LEAST_SHARE = 0.12  # of it that makes a frontier
OWN = 0.12  # m about the robot's centre in which it may be whatever the map says
STEP_COST = np.array([math.sqrt(2), 1.0, math.sqrt(2), 1.0, 1.0, math.sqrt(2), 1.0, math.sqrt(2)])


class Costmap:
    """Where a robot can be on an occupancy grid as it is now, and what a metre costs there.

    Args:
        grid: the map.
        off: m by which obstacles are passed closer than the footprint, where all else failed.
        felt: what the robot has touched counts as well.

    Attributes:
        clearance: [SIDE,SIDE] m to the nearest obstacle.
        passable: [SIDE,SIDE] bool: the robot's centre may be here.
        unknown: [SIDE,SIDE] bool: nobody has looked there; uncharted: [SIDE,SIDE] bool: nor has
            anybody measured.
        cost: [SIDE,SIDE] float32 of a metre; 0 where it is not passable.
        metre: [SIDE,SIDE] float32, what a metre of a straight piece costs `lookahead`: in a taught
            place as `cost`, for the ways of the drive; else 1, which did better.
    """

    def __init__(self, grid: OccupancyGrid, off: float = 0.0, felt: bool = True):
        self.grid = grid
        obstacles = grid.obstacles()
        if not felt:
            obstacles &= ~grid.contacts
        self.clearance = CELL * cv2.distanceTransform(
            (~obstacles).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        limit = grid.footprint + (KEEP if off == 0 else -off)
        self.unknown, self.uncharted = grid.unknown(), grid.uncharted()
        self.passable = (self.clearance > limit) | grid.been
        close = np.clip((limit + KEEP_OFF - self.clearance) / KEEP_OFF, 0, 1)
        price = 1 + CLOSE_COST * close + UNKNOWN_COST * self.uncharted
        heard = grid.heard_of()
        if heard is not None:
            # Where a robot has driven is the surest way, surer than what this one sees. Where it
            # has only seen floor is none: there may be a wall that its eyes missed. Its walls lie
            # a little off, and would close doors: they cost, and block nothing.
            lane, wall, floor = heard
            # Obstacles as near to it as a robot can pass may be seen a little off.
            lane = lane & (self.clearance > grid.footprint - LANE_KEEP)
            self.passable |= lane
            price = np.where(lane, 1, price + ASIDE_COST + UNKNOWN_COST * floor + WALL_COST * wall)
        self.cost = np.where(self.passable, price, 0).astype(np.float32)
        self.metre = np.ones_like(self.cost) if heard is None else self.cost

    def frontiers(self) -> tuple[np.ndarray, np.ndarray]:
        """Cells [K,2] from which more floor shows, and their head start [K] in metres."""
        window = 2 * round(ROOM / CELL) + 1
        share = cv2.blur((self.unknown & (self.clearance > 0)).astype(np.float32),
                         (window, window))
        grown = cv2.dilate(self.unknown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        edge = grown & ~self.unknown & self.passable & (share > LEAST_SHARE)
        cells = np.argwhere(edge)
        return cells, HEAD_START * share[edge]

    def cost_to_go(self, cells: np.ndarray, costs: np.ndarray, here: tuple[int, int], *,
                   through_unknown: bool) -> np.ndarray:
        """Cost of the way to the best of some cells, from everywhere about the robot.

        Args:
            cells: [K,2]; costs: [K] m that each adds.
            here: the robot's cell.
            through_unknown: also over floor that nobody has seen or measured.

        Returns:
            [SIDE,SIDE] float32 m, inf where there is no way or nobody asked.
        """
        price = self.cost if through_unknown else np.where(self.uncharted, 0, self.cost)
        return _dijkstra(price, cells.astype(np.int64), costs.astype(np.float64), here[0], here[1])

    def free_length(self, pose: np.ndarray, angle: float, length: float) -> tuple[float, float]:
        """How far [m] the robot gets on a straight line of some length, and its clearance [m].

        Args:
            pose: [3] where it begins; angle: of the line on the map [rad]; length: m.
        """
        got, clear = free_length(self.passable, self.clearance, self.grid.origin, float(pose[0]),
                                 float(pose[1]), angle, length)
        exact, room = self.scanned_length(pose, angle, length)
        return min(got, exact), min(clear, room)

    def scanned_length(self, pose: np.ndarray, angle: float, length: float
                       ) -> tuple[float, float]:
        """As `free_length`, by the newest scan alone, which is finer than cells.

        Returns:
            The whole length and infinity where a picture came since.
        """
        if self.grid.points is None:
            return length, math.inf
        return free_of_points(self.grid.points, float(pose[0]), float(pose[1]), angle, length,
                              self.grid.footprint + SCAN_KEEP)


@numba.njit(cache=True)
def _dijkstra(price, cells, costs, row0, column0):
    side = price.shape[0]
    result = np.full((side, side), np.inf, np.float32)
    heap = [(0.0, 0, 0)]
    heap.clear()
    for k in range(len(cells)):
        row, column = cells[k, 0], cells[k, 1]
        if costs[k] < result[row, column]:
            result[row, column] = costs[k]
            heapq.heappush(heap, (costs[k], int(row), int(column)))
    limit = np.inf
    while heap:
        cost, row, column = heapq.heappop(heap)
        if cost > result[row, column] + 1e-4:
            continue
        if cost > limit:
            break
        if row == row0 and column == column0:
            limit = cost + 3.0  # about the robot, neighbours are known as well
        k = -1
        for i in range(-1, 2):
            for j in range(-1, 2):
                if i == 0 and j == 0:
                    continue
                k += 1
                r, c = row + i, column + j
                if r < 0 or c < 0 or r >= side or c >= side:
                    continue
                at = price[r, c]
                if at <= 0.0 and not (abs(r - row0) <= 3 and abs(c - column0) <= 3):
                    continue
                if at <= 0.0:
                    at = np.float32(6.0)  # out of where the map says that nobody can stand
                new = cost + CELL * STEP_COST[k] * at
                if new < result[r, c] - 1e-5:
                    result[r, c] = new
                    heapq.heappush(heap, (new, r, c))
    return result


@numba.njit(cache=True)
def free_length(passable, clearance, origin, x, y, angle, length):
    """`Costmap.free_length`, for other kernels."""
    side = passable.shape[0]
    dx, dy = math.cos(angle), math.sin(angle)
    count = max(int(math.ceil(length / (0.5 * CELL))), 1)
    least = np.inf
    for k in range(1, count + 1):
        r = length * k / count
        column = int(math.floor((x + r * dx - origin[0]) / CELL))
        row = int(math.floor((y + r * dy - origin[1]) / CELL))
        if row < 0 or column < 0 or row >= side or column >= side:
            return length * (k - 1) / count, 0.0
        # The robot's own surroundings may look blocked: it is there.
        if not passable[row, column] and r > OWN:
            return length * (k - 1) / count, 0.0
        if r > OWN:
            least = min(least, clearance[row, column])
    return length, least
