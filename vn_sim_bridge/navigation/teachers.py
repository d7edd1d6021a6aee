"""Teachers of `NavigationEnv`: one explores as a robot can, one takes the shortest path."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.explorer import Explorer
from vn_sim_bridge.navigation.oracle import FloorOracle, turning_table


class ExplorerTeacher:
    """Actions of an `Explorer`, which knows only what the robots have seen.

    Args:
        places: places with walls.
        count: robots.
        fov: of their cameras [rad].
        action_names, deltas: the actions and their displacements [A,4].
    """

    def __init__(self, places: Sequence, count: int, *, fov: float,
                 action_names: tuple[str, ...], deltas: np.ndarray):
        self._table, self._deltas = turning_table(action_names), deltas
        self.explorer = Explorer(
            places, count, fov=fov, turn=deltas[self._table['rotate_left'], 2],
            length=deltas[self._table['forward'], 0], radius=tasks.ARRIVAL_RADIUS)

    def actions(self, reset: np.ndarray, poses: np.ndarray, place_index: np.ndarray,
                co_visibility: np.ndarray, distance: np.ndarray, goal_yaw: np.ndarray,
                maps: np.ndarray, last_action: np.ndarray) -> np.ndarray:
        """What it would do next, [N] int64; it looks from the poses [N,4].

        Args:
            reset: [N] whose episode begins; the other arguments as in `Explorer.turns`.
            last_action: [N] -1: none in this episode.
        """
        self.explorer.begin(np.nonzero(reset)[0])
        turned = np.where(last_action < 0, 0, np.sign(self._deltas[last_action, 2]))
        turns = self.explorer.turns(poses, place_index, co_visibility, distance, goal_yaw, maps,
                                    turned)
        return np.where(turns == 0, self._table['forward'], np.where(
            turns > 0, self._table['rotate_left'], self._table['rotate_right']))


class FloorTeacher:
    """Actions of a `FloorOracle`, which knows the distances over the floor."""

    def __init__(self, action_names: tuple[str, ...], deltas: np.ndarray):
        self._oracle = FloorOracle(action_names, deltas)

    def actions(self, poses: np.ndarray, goal_yaw: np.ndarray, near: np.ndarray,
                reach: Callable, distance_from: Callable) -> np.ndarray:
        """The next action [N] on a shortest path.

        Args:
            poses: [N,4].
            goal_yaw: [N] rad; robots that are `near` [N] turn to it.
            reach, distance_from: as `FloorOracle.action` takes them, after the robot's number.
        """
        return np.array([self._oracle.action(
            poses[n], goal_yaw[n] if near[n] else None, functools.partial(reach, n),
            functools.partial(distance_from, n)) for n in range(len(poses))], np.int64)
