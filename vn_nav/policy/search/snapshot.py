"""What a search knows at a moment, to be looked at: map, hypotheses, what it is about."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vn_nav.policy.search.grid import CELL, KNOWN
from vn_nav.policy.search.searcher import Searcher

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # cells of a snapshot, as of nav_msgs/OccupancyGrid


class Guess(NamedTuple):
    """A pose that the goal may have."""

    pose: np.ndarray  # [3] x, y [m], yaw [rad]
    weight: float  # evidence, see `hypotheses.Hypothesis`; NaN: unknown


class Snapshot(NamedTuple):
    """A search at a moment, in the frame of its map."""

    cells: np.ndarray  # [R,C] int8 of `UNKNOWN`, `FREE`, `OCCUPIED`, rows along y
    origin: np.ndarray  # [2] m, of the lower left corner of the first cell
    cell: float  # m
    pose: np.ndarray  # [3] x, y [m], yaw [rad] of the robot
    guesses: tuple[Guess, ...]  # the one with most evidence first
    aim: str  # in a word, see `Searcher.aim`; '': unknown
    arrival: float  # probability that the robot has arrived; NaN: unknown


def snapshot(searcher: Searcher) -> Snapshot:
    """What a searcher knows now; a copy, cut to the known part of its map."""
    grid = searcher.grid
    obstacles = grid.obstacles()
    known = (grid.seen >= KNOWN) | grid.stood | obstacles
    cells = np.where(obstacles, OCCUPIED, np.where(known, FREE, UNKNOWN)).astype(np.int8)
    rows, columns = (_range(known.any(axis)) for axis in (1, 0))
    guesses = sorted(searcher.hypotheses.all, key=lambda own: -own.weight)
    return Snapshot(
        cells[rows, columns].copy(), grid.origin + CELL * np.array([columns.start, rows.start]),
        CELL, searcher.pose.copy(), tuple(Guess(own.pose.copy(), own.weight) for own in guesses),
        searcher.aim, float(searcher.arrival))


def _range(known: np.ndarray) -> slice:
    """From the first to the last true value; empty where there is none."""
    found = np.flatnonzero(known)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)
