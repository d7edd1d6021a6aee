"""Squares of floor that robots have stood on in their episodes."""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.navigation.goal_distances import FloorDistances

SQUARE_SIDE = 1.0  # m, of the squares of floor that are counted


class Exploration:
    """Which squares N robots have visited.

    Attributes:
        visited: [N,rows,columns] bool.
    """

    def __init__(self, distances: FloorDistances, count: int):
        self._origins = distances.origins
        rows, columns = (math.ceil(side * CELL / SQUARE_SIDE)
                         for side in distances.maps.shape[1:])
        self.visited = np.zeros((count, rows, columns), bool)

    def begin(self, env_ids: np.ndarray) -> None:
        """Robots [K] have visited nothing."""
        self.visited[env_ids] = False

    def visit(self, env_ids: np.ndarray, place_index: np.ndarray, poses: np.ndarray
              ) -> np.ndarray:
        """Which of robots [K] stand on a square that is new to their episodes, [K] bool.

        Args:
            env_ids: [K].
            place_index: [K] their places.
            poses: [K,>=2] x, y [m].
        """
        at = (poses[:, :2] - self._origins[place_index]) / SQUARE_SIDE
        column, row = at.astype(np.int64).T
        new = ~self.visited[env_ids, row, column]
        self.visited[env_ids, row, column] = True
        return new
