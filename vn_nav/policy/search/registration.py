"""Where on the map a goal picture fits: the ranges seen in it, matched to what the robot has seen.

A goal picture shows how far the place was free where it was taken. About a pose that recognition
says, those poses are likelier from which the map shows the same ranges (correlative scan matching,
Olson 2009, with distributions in place of a scan). Floor that nobody has seen says nothing.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.policy.search.grid import CELL, OccupancyGrid
from vn_nav.policy.search.look import BINS, RANGE_EDGES

STEPS = 60  # of `CELL` along a ray
REACH, SHIFTS = 0.9, 4  # m either way that a pose is moved, in so many steps
TURN, TURNS = math.radians(16), 2  # rad either way, in so many steps
EVERY = 2  # columns of the picture: neighbouring rays say the same
SHARE = 1.0  # of a ray's log-likelihood that counts, for the same reason
OUTLIERS = 0.03  # share of rays that say nothing
TURN_SIGMA = math.radians(10)  # of a heading that recognition says
LEAST, MOST = 0.3, 1.2  # m: deviation of its position
SURE = 0.97  # probability of an obstacle in a cell, at most; of none, alike
SEEN = 0.3  # looks from which a cell is not unknown any more
LOGIT = 2.0  # of a cell, for a log-odds of the map


class Registration:
    """Fits one goal picture to maps.

    Args:
        bearings: [C] rad of the picture's columns, positive to the left.
        ranges: [C,B] probabilities of the first obstacle's range, see `look.RANGE_EDGES`.
    """

    def __init__(self, bearings: np.ndarray, ranges: np.ndarray):
        bearings, ranges = (np.asarray(part, float)[::EVERY] for part in (bearings, ranges))
        self._bearings = bearings
        edges = np.asarray(RANGE_EDGES, float)
        self._usual = _by_step(np.full((1, BINS), 1 / BINS), edges)[0]
        self._gain = _by_step(ranges, edges) / self._usual

    def fit(self, grid: OccupancyGrid, pose: np.ndarray, precision: float) -> np.ndarray:
        """The mean pose [3] of the goal, by what recognition and the map say together.

        Args:
            grid: the map.
            pose: [3] x, y [m], yaw [rad] that recognition says; precision: of its place [1/m^2].
        """
        sigma = min(max(1 / math.sqrt(precision), LEAST), MOST)
        found = _mean_pose(grid.log_odds, grid.seen, grid.measured, grid.contacts, grid.stood,
                           grid.origin, np.asarray(pose, float), sigma, self._bearings,
                           self._gain, self._usual)
        found[2] = wrap_angle(float(found[2]))
        return found


@numba.njit(cache=True)
def _by_step(ranges, edges):
    """Probability [C,STEPS+1] that the first obstacle lies in each step of a ray, or beyond."""
    found = np.empty((len(ranges), STEPS + 1))
    for c in range(len(ranges)):
        before = 0.0
        for k in range(STEPS):
            r, total, low = (k + 1) * CELL, 0.0, 0.0
            for b in range(len(edges)):
                if r < edges[b]:
                    total += ranges[c, b] * (r - low) / (edges[b] - low)
                    break
                total += ranges[c, b]
                low = edges[b]
            found[c, k] = total - before
            before = total
        found[c, STEPS] = max(1 - before, 1e-6)
    return found


@numba.njit(cache=True)
def _hits(log_odds, seen, measured, contacts, stood, low_row, low_column, rows, columns):
    """Probability [rows,columns] float32 of an obstacle in cells; -1: nobody has seen them."""
    side = log_odds.shape[0]
    found = np.full((rows, columns), np.float32(-1))
    for i in range(rows):
        row = low_row + i
        if row < 0 or row >= side:
            continue
        for j in range(columns):
            column = low_column + j
            if column < 0 or column >= side:
                continue
            if contacts[row, column]:
                found[i, j] = SURE
            elif stood[row, column]:
                found[i, j] = 1 - SURE
            elif seen[row, column] > SEEN or measured[row, column]:
                p = 1 / (1 + math.exp(-LOGIT * log_odds[row, column]))
                found[i, j] = min(max(p, 1 - SURE), SURE)
    return found


@numba.njit(cache=True)
def _mean_pose(log_odds, seen, measured, contacts, stood, origin, pose, sigma, bearings, gain,
               usual):
    reach = int(math.ceil((REACH + STEPS * CELL) / CELL)) + 1
    low_row = int(math.floor((pose[1] - origin[1]) / CELL)) - reach
    low_column = int(math.floor((pose[0] - origin[0]) / CELL)) - reach
    count = 2 * reach + 1
    hits = _hits(log_odds, seen, measured, contacts, stood, low_row, low_column, count, count)
    left, bottom = origin[0] + CELL * low_column, origin[1] + CELL * low_row
    # How likely the first obstacle is in a step where nobody has seen: as usual.
    hazard = np.empty(STEPS)
    beyond = 1.0
    for k in range(STEPS):
        hazard[k] = usual[k] / beyond
        beyond -= usual[k]
    side, turns = 2 * SHIFTS + 1, 2 * TURNS + 1
    worth = np.empty((turns, side, side))
    best = -np.inf
    for t in range(turns):
        off = TURN * (t - TURNS) / TURNS
        for i in range(side):
            for j in range(side):
                u, v = REACH * (i - SHIFTS) / SHIFTS, REACH * (j - SHIFTS) / SHIFTS
                total = (-math.hypot(u, v) * math.sqrt(3.0) / sigma
                         - 0.5 * (off / TURN_SIGMA) ** 2)
                for c in range(len(bearings)):
                    angle = pose[2] + off + bearings[c]
                    dx, dy = math.cos(angle), math.sin(angle)
                    free, likely = 1.0, 0.0
                    x, y = pose[0] + u - left, pose[1] + v - bottom
                    for k in range(STEPS):
                        r = (k + 0.5) * CELL
                        p = hits[int((y + r * dy) / CELL), int((x + r * dx) / CELL)]
                        if p < 0:
                            p = hazard[k]
                        likely += free * p * gain[c, k]
                        free *= 1 - p
                        if free < 0.01:
                            break
                    likely += free * gain[c, STEPS]
                    total += SHARE * math.log(OUTLIERS + (1 - OUTLIERS) * likely)
                worth[t, i, j] = total
                best = max(best, total)
    whole, x, y, yaw = 0.0, 0.0, 0.0, 0.0
    for t in range(turns):
        for i in range(side):
            for j in range(side):
                own = math.exp(worth[t, i, j] - best)
                whole += own
                x += own * (i - SHIFTS)
                y += own * (j - SHIFTS)
                yaw += own * (t - TURNS)
    return np.array([pose[0] + REACH / SHIFTS * x / whole, pose[1] + REACH / SHIFTS * y / whole,
                     pose[2] + TURN / TURNS * yaw / whole])
