"""Ways on a map: where they lead, and how many decisions a robot takes along them."""

from __future__ import annotations

import math

import numpy as np

from vn_nav.arrival import wrap_angle


def way_down(field: np.ndarray, here: tuple[int, int]) -> np.ndarray:
    """Cells [K,2] from here, downhill on a cost to go [SIDE,SIDE]; the first is here."""
    row, column = here
    way = [here]
    for _ in range(field.size):
        low, left = max(row - 1, 0), max(column - 1, 0)
        part = field[low:row + 2, left:column + 2]
        i, j = np.unravel_index(int(np.argmin(part)), part.shape)
        if (low + i, left + j) == (row, column):
            break
        row, column = int(low + i), int(left + j)
        way.append((row, column))
    return np.array(way)


def decisions_along(way: np.ndarray, yaw: float, heading: float, step: float, turn: float
                    ) -> float:
    """Moves and turns that a robot takes along a way.

    Args:
        way: [K,2] x, y [m] of its points.
        yaw: of the robot at its beginning [rad]; heading: that it shall have at the end.
        step: m of a move; turn: rad of a turn.
    """
    lengths = np.hypot(*np.diff(way, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    # Corners as a robot takes them that goes straight for a step: cells would zigzag.
    count = math.ceil(along[-1] / step - 1e-6)
    stops = np.linspace(0.0, along[-1], count + 1)
    dx, dy = (np.diff(np.interp(stops, along, axis)) for axis in way.T)
    headings = [yaw, *np.arctan2(dy, dx), heading]
    turned = sum(abs(wrap_angle(float(b - a)))
                 for a, b in zip(headings, headings[1:], strict=False))
    return count + turned / turn
