"""What a search knows at a moment, to be looked at: map, hypotheses, what it is about."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.motion import quaternion_to_yaw
from vn_nav.bags.mapping.pose_graph import between
from vn_nav.policy.search.grid import CELL
from vn_nav.policy.search.searcher import Searcher

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # cells of a snapshot, as of nav_msgs/OccupancyGrid


class Guess(NamedTuple):
    """A pose that the goal may have."""

    pose: np.ndarray  # [3] x, y [m], yaw [rad]
    weight: float  # evidence, see `hypotheses.Hypothesis`; NaN: unknown


class Snapshot(NamedTuple):
    """A search at a moment, in the frame of its map."""

    cells: np.ndarray  # [R,C] int8, `FREE` to `OCCUPIED` in percent, or `UNKNOWN`; rows along y
    origin: np.ndarray  # [2] m, of the lower left corner of the first cell
    cell: float  # m
    pose: np.ndarray  # [3] x, y [m], yaw [rad] of the robot
    guesses: tuple[Guess, ...]  # the one with most evidence first
    aim: str  # in a word, see `Searcher.aim`; '': unknown
    arrival: float  # probability that the robot has arrived; NaN: unknown


def snapshot(searcher: Searcher) -> Snapshot:
    """What a searcher knows now; a copy, cut to the known part of its map."""
    grid = searcher.grid
    # What it keeps off, also where it has hardly looked.
    cells = np.where(grid.obstacles(), np.int8(OCCUPIED), grid.occupancy())
    cells, origin = cut_to_known(cells, grid.origin, CELL)
    guesses = sorted(searcher.hypotheses.all, key=lambda own: -own.weight)
    return Snapshot(
        cells, origin, CELL, searcher.pose.copy(),
        tuple(Guess(own.pose.copy(), own.weight) for own in guesses), searcher.aim,
        float(searcher.arrival))


def cut_to_known(cells: np.ndarray, origin: np.ndarray, cell: float
                 ) -> tuple[np.ndarray, np.ndarray]:
    """The part of a map that is known, a copy, and its origin [2] m.

    Args:
        cells: [R,C] as of `Snapshot`; origin: [2] m of theirs; cell: m.
    """
    rows, columns = (_range((cells != UNKNOWN).any(axis)) for axis in (1, 0))
    return cells[rows, columns].copy(), origin + cell * np.array([columns.start, rows.start])


def _range(known: np.ndarray) -> slice:
    """From the first to the last true value; empty where there is none."""
    found = np.flatnonzero(known)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)


def snapshot_of(message: Any, guesses: Any, robot: np.ndarray) -> tuple[Snapshot, np.ndarray]:
    """What a policy knew, out of its messages.

    Args:
        message: OccupancyGrid.
        guesses: PoseArray; None: there is none.
        robot: [3] x, y [m], yaw [rad] in the message's frame.

    Returns:
        A snapshot in a frame of its own, and where that lies in the message's, [3].
    """
    origin = _pose(message.info.origin)
    cells = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    cells, corner = cut_to_known(cells, np.zeros(2), message.info.resolution)
    poses = [] if guesses is None else [between(origin, _pose(pose)) for pose in guesses.poses]
    return Snapshot(cells, corner, message.info.resolution, between(origin, robot),
                    tuple(Guess(pose, math.nan) for pose in poses), '', math.nan), origin


def _pose(message: Any) -> np.ndarray:
    at, turn = message.position, message.orientation
    return np.array([at.x, at.y, quaternion_to_yaw(turn.x, turn.y, turn.z, turn.w)])
