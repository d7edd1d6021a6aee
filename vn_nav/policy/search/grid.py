"""What a robot has seen of the floor: an occupancy map about its start, built look by look.

Cells of `CELL` metres hold log-odds of an obstacle and how often they were seen. The map lies in
the frame of the odometry that poses are given in; where the robot comes near its edge, it moves
along. Kernels run in NumPy's memory, compiled; torch is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from vn_nav.measured_ranges import Scan
from vn_nav.policy.search.measured import ends_of, enter_scan, look_over

CELL = 0.1  # m
SIDE = 320  # cells
MARGIN = 60  # cells from the edge at which the map is moved
REACH = 3.5  # m: ranges beyond tell nothing about cells
SCAN_REACH = 6.0  # m: the same for measured ranges
SUB_RAYS = 3  # a column of the picture
FREE_WEIGHT, HIT_WEIGHT = 0.9, 3.0  # log-odds of a ray that passes, and of one that ends here
MOST = 4.0  # log-odds either way
POINT = 0.75 * CELL  # m: a disc of this radius has a cell's centre in it wherever it lies
OCCUPIED = 0.5  # log-odds from which a cell is an obstacle
KNOWN = 0.6  # looks from which a cell is not unknown any more
MISSES = 3  # looks that should have shown a cell by the map, and did not: it is none to look for
VIEW = 2.5  # m to which a look is expected to show floor


class Prior(NamedTuple):
    """What somebody knows of the cells of a map, [SIDE,SIDE] float32 each."""

    log_odds: np.ndarray
    seen: np.ndarray
    lane: np.ndarray  # 1: a robot's centre was here


class OccupancyGrid:
    """The map of one robot.

    Args:
        footprint: radius of the robot [m].
        side: cells; middle: [2] m, of the map.

    Attributes:
        log_odds: [SIDE,SIDE] float32, rows along y.
        seen: [SIDE,SIDE] float32: looks that passed or ended here, in expectation.
        measured: [SIDE,SIDE] bool: a scan passed or ended here, whoever has looked.
        missed: [SIDE,SIDE] int16: looks that should have shown it, by the map, and did not.
        stood: [SIDE,SIDE] bool: the robot was on it; been: its centre was.
        contacts: [SIDE,SIDE] bool: it met something here.
        prior: of somebody who knows the place, for cells that the robot has not seen itself; None:
            nobody, or the map has moved.
        origin: [2] m, of the lower left corner.
        points: [K,2] m where the rays of the newest scan end; None: a picture came since.
    """

    def __init__(self, footprint: float, side: int = SIDE, middle: Sequence[float] = (0.0, 0.0)):
        self.footprint = footprint
        self.log_odds = np.zeros((side, side), np.float32)
        self.seen = np.zeros((side, side), np.float32)
        self.measured = np.zeros((side, side), bool)
        self.missed = np.zeros((side, side), np.int16)
        self.stood = np.zeros((side, side), bool)
        self.been = np.zeros((side, side), bool)
        self.contacts = np.zeros((side, side), bool)
        self.origin = np.asarray(middle, float) - CELL * side / 2
        self.points: np.ndarray | None = None
        self.prior: Prior | None = None
        self._prior_counts = True

    def add_ranges(self, pose: np.ndarray, bearings: np.ndarray, ranges: np.ndarray,
                   edges: np.ndarray) -> None:
        """Enter what a picture says.

        Args:
            pose: [3] x, y [m], yaw [rad] of the camera's robot.
            bearings: [C] rad of the columns, positive to the left.
            ranges: [C,B] probabilities of the first obstacle's range.
            edges: [B-1] m between the bins; the first bin is nearer than the first edge, the last
                one farther than the last.
        """
        self._follow(pose)
        self.points = None
        spread = np.abs(np.gradient(bearings)).mean()
        _integrate(self.log_odds, self.seen, self.origin, np.asarray(pose, float),
                   np.asarray(bearings, float), float(spread), np.asarray(ranges, float),
                   np.asarray(edges, float))
        _expect(self.unknown(), self.obstacles(), self.missed, self.origin, pose[0], pose[1],
                pose[2] + np.asarray(bearings, float), True)

    def add_scan(self, pose: np.ndarray, scan: Scan, bearings: np.ndarray) -> None:
        """Enter measured ranges, and that a camera looks at what is known by them.

        A scanner may see all around: where something stands. The goal is found where the camera
        looks, and so `seen` grows along its columns alone.

        Args:
            pose: [3] x, y [m], yaw [rad] of the robot.
            scan: from there.
            bearings: [C] rad of the picture's columns.
        """
        self._follow(pose)
        scanner = scan.scanner
        at = on_robot(pose, scanner.mount)
        enter_scan(self.log_odds, self.measured, self.origin, CELL, at, scanner.bearings,
                   scan.ranges.astype(float), scanner.nearest, scanner.clear_from,
                   min(scanner.farthest, SCAN_REACH), FREE_WEIGHT, HIT_WEIGHT, MOST)
        self.points = ends_of(scan, at, SCAN_REACH)
        angles = pose[2] + np.asarray(bearings, float)
        look_over(self.seen, self.measured, self.obstacles(), self.origin, CELL, pose[0], pose[1],
                  angles, REACH, SUB_RAYS)
        _expect(self.unknown(), self.obstacles(), self.missed, self.origin, pose[0], pose[1],
                angles, True)

    def look_gains(self, pose: np.ndarray, headings: np.ndarray, bearings: np.ndarray
                   ) -> np.ndarray:
        """Unknown floor [K] m^2 that looks from a place would show, by the map.

        Args:
            pose: [3] of the place; its own heading does not count.
            headings: [K] rad.
            bearings: [C] rad of the picture's columns.
        """
        unknown, obstacles = self.unknown(), self.obstacles()
        return np.array([_expect(unknown, obstacles, self.missed, self.origin, pose[0],
                                 pose[1], heading + bearings, False) for heading in headings])

    def forget_looks(self, prior: bool = False) -> None:
        """Let everything be looked at again; obstacles and free floor stay.

        Args:
            prior: whether what the prior has seen counts as seen.
        """
        self.seen *= 0.2
        self.missed[:] = 0
        self._prior_counts = prior

    def known_area(self) -> float:
        """Floor that was seen [m^2]."""
        return CELL**2 * float(np.count_nonzero(self.seen >= KNOWN))

    def give_up(self, cell: tuple[int, int], radius: float) -> None:
        """Let nothing within a radius [m] of a cell be looked for any more."""
        x, y = self.origin + CELL * (np.array(cell[::-1]) + 0.5)
        done = np.zeros(self.seen.shape, bool)
        _disc(done, self.origin, x, y, radius, True)
        self.missed[done] = MISSES

    def add_footprint(self, pose: np.ndarray) -> None:
        """Enter that the robot stands here: its footprint is free."""
        self._follow(pose)
        _disc(self.stood, self.origin, pose[0], pose[1], self.footprint, True)
        _disc(self.been, self.origin, pose[0], pose[1], POINT, True)
        _disc(self.contacts, self.origin, pose[0], pose[1], self.footprint - CELL, False)

    def add_contact(self, pose: np.ndarray, direction: float) -> None:
        """Enter a contact: something is at the rim of the robot in a direction [rad]."""
        reach = self.footprint + 0.5 * CELL
        _disc(self.contacts, self.origin, pose[0] + reach * math.cos(direction),
              pose[1] + reach * math.sin(direction), POINT, True)

    def obstacles(self) -> np.ndarray:
        """[SIDE,SIDE] bool."""
        return ((self.log_odds > OCCUPIED) & ~self.stood) | self.contacts

    def unknown(self) -> np.ndarray:
        """[SIDE,SIDE] bool: hardly seen."""
        seen = self.seen
        if self.prior is not None and self._prior_counts:
            seen = seen + self.prior.seen
        return (seen < KNOWN) & (self.missed < MISSES) & ~self.stood & ~self.contacts

    def heard_of(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """What the prior says, [SIDE,SIDE] bool: where a robot drove, walls, floor that was seen.

        The last two where this robot has seen nothing itself. None: there is no prior.
        """
        if self.prior is None or not self._prior_counts:
            return None
        lane = (self.prior.lane > 0.5) & (self.log_odds <= OCCUPIED) & ~self.contacts
        other = (self.seen < KNOWN) & ~self.stood & ~self.contacts & (self.log_odds <= OCCUPIED)
        wall = other & ~lane & (self.prior.log_odds > OCCUPIED)
        return lane, wall, other & ~lane & ~wall & (self.prior.seen >= KNOWN)

    def occupancy(self) -> np.ndarray:
        """[SIDE,SIDE] int8: percent of an obstacle, -1: nothing is known."""
        percent = np.round(100 / (1 + np.exp(-self.log_odds.astype(float)))).astype(np.int8)
        known = (self.seen >= KNOWN) | self.measured
        return np.where(self.contacts, 100, np.where(
            self.stood, 0, np.where(known, percent, -1))).astype(np.int8)

    def uncharted(self) -> np.ndarray:
        """[SIDE,SIDE] bool: nobody knows whether something stands there."""
        return self.unknown() & ~self.measured

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of a place; outside, of the nearest cell."""
        column, row = ((np.array([x, y]) - self.origin) / CELL).astype(int)
        side = len(self.seen)
        return int(np.clip(row, 0, side - 1)), int(np.clip(column, 0, side - 1))

    def _follow(self, pose: np.ndarray) -> None:
        """Move the map where the robot comes near its edge; what falls off is forgotten."""
        side = len(self.seen)
        column, row = np.floor((np.asarray(pose[:2]) - self.origin) / CELL).astype(int)
        if MARGIN <= row < side - MARGIN and MARGIN <= column < side - MARGIN:
            return
        shift = np.array([column, row]) - side // 2
        for name in ('log_odds', 'seen', 'measured', 'missed', 'stood', 'been', 'contacts'):
            old = getattr(self, name)
            new = np.zeros_like(old)
            rows, columns = (np.arange(side) + s for s in shift[::-1])
            inside = np.ix_((rows >= 0) & (rows < side), (columns >= 0) & (columns < side))
            new[inside] = old[np.ix_(rows[(rows >= 0) & (rows < side)],
                                     columns[(columns >= 0) & (columns < side)])]
            setattr(self, name, new)
        self.origin = self.origin + CELL * shift
        self.prior = None


def on_robot(pose: np.ndarray, mount: tuple[float, float, float]) -> np.ndarray:
    """Pose [3] on the map of what sits on a robot at a pose [3]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y, yaw = mount
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + yaw])


@numba.njit(cache=True)
def _integrate(log_odds, seen, origin, pose, bearings, spread, ranges, edges):
    """Each cell gets the mean of the rays that pass it: a look counts once, near or far."""
    side = log_odds.shape[0]
    step = 0.5 * CELL
    count = int(REACH / step)
    first = np.zeros((side, side), np.float32)
    passed = np.zeros((side, side), np.float32)
    times = np.zeros((side, side), np.int32)
    bins = ranges.shape[1]
    low_row, high_row, low_column, high_column = side, -1, side, -1
    for c in range(len(bearings)):
        # Probability that the way is free up to each edge, and beyond.
        beyond = np.empty(bins)  # at the bin's far edge
        left = 1.0
        for b in range(bins):
            left -= ranges[c, b]
            beyond[b] = max(left, 0.0)
        for sub in range(SUB_RAYS):
            angle = pose[2] + bearings[c] + spread * ((sub + 0.5) / SUB_RAYS - 0.5)
            dx, dy = math.cos(angle), math.sin(angle)
            for k in range(count):
                r = (k + 0.5) * step
                here = _free_up_to(r - 0.5 * step, beyond, edges)
                after = _free_up_to(r + 0.5 * step, beyond, edges)
                if here < 0.02:
                    break
                column = int(math.floor((pose[0] + r * dx - origin[0]) / CELL))
                row = int(math.floor((pose[1] + r * dy - origin[1]) / CELL))
                if row < 0 or row >= side or column < 0 or column >= side:
                    break
                # A hit's thickness is a cell: two steps of the ray.
                first[row, column] += HIT_WEIGHT * 2 * (here - after) - FREE_WEIGHT * after
                passed[row, column] += here
                times[row, column] += 1
                low_row, high_row = min(low_row, row), max(high_row, row)
                low_column, high_column = min(low_column, column), max(high_column, column)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            n = times[row, column]
            if n:
                value = log_odds[row, column] + first[row, column] / n
                log_odds[row, column] = min(max(value, -MOST), MOST)
                seen[row, column] += passed[row, column] / n


@numba.njit(cache=True)
def _free_up_to(r, beyond, edges):
    """Probability that the first obstacle is farther than r, linear within a bin."""
    if r <= 0.0:
        return 1.0
    near, before = 0.0, 1.0
    for b in range(len(edges)):
        if r <= edges[b]:
            return before + (beyond[b] - before) * (r - near) / (edges[b] - near)
        near, before = edges[b], beyond[b]
    return before


@numba.njit(cache=True)
def _disc(layer, origin, x, y, radius, value):
    """Set the cells whose centres lie within a radius."""
    side = layer.shape[0]
    reach = int(math.ceil(radius / CELL))
    column, row = int(math.floor((x - origin[0]) / CELL)), int(math.floor((y - origin[1]) / CELL))
    for i in range(max(row - reach, 0), min(row + reach + 1, side)):
        for j in range(max(column - reach, 0), min(column + reach + 1, side)):
            dx, dy = origin[0] + (j + 0.5) * CELL - x, origin[1] + (i + 0.5) * CELL - y
            if dx * dx + dy * dy <= radius * radius:
                layer[i, j] = value


@numba.njit(cache=True)
def _expect(unknown, obstacles, missed, origin, x, y, angles, count):
    """Area of unknown cells [m^2] in view by the map; with `count` each is missed once more."""
    side = unknown.shape[0]
    spread = abs(angles[-1] - angles[0]) / max(len(angles) - 1, 1)
    done = np.zeros((side, side), np.bool_)
    area = 0.0
    for angle in angles:
        dx, dy = math.cos(angle), math.sin(angle)
        for k in range(3, int(VIEW / CELL)):
            r = (k + 0.5) * CELL
            column = int(math.floor((x + r * dx - origin[0]) / CELL))
            row = int(math.floor((y + r * dy - origin[1]) / CELL))
            if (row < 0 or column < 0 or row >= side or column >= side
                    or obstacles[row, column]):
                break
            if unknown[row, column]:
                area += r * spread * CELL
                if count and not done[row, column]:
                    done[row, column] = True
                    missed[row, column] += 1
    return area
