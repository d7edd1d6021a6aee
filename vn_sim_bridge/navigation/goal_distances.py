"""How far N robots are from the goals of their episodes, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.floor.distance import FloorDistance, interpolate
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.floor.places import FloorPlace
from vn_sim_bridge.simulator import Distance


class FloorDistances:
    """Over floors: all maps in one array, one look-up for all robots.

    Args:
        places: of the robots; num_envs: robots, N.
    """

    def __init__(self, places: Sequence[FloorPlace], num_envs: int):
        shapes = [place.floor.free.shape for place in places]
        rows, columns = (max(shape[axis] for shape in shapes) for axis in (0, 1))
        self.maps = np.full((num_envs, rows, columns), np.inf, np.float32)
        self.origins = np.array([place.floor.origin for place in places])

    def set(self, env: int, distance: Distance | None) -> None:
        """A new goal of one robot; None: it has none.

        Raises:
            UserError: the distance is none over a floor.
        """
        self.maps[env] = np.inf
        if distance is not None:
            values = over_floor(distance).values
            rows, columns = values.shape
            self.maps[env, :rows, :columns] = values

    def at(self, env_ids: np.ndarray, places: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Of robots [K] in places [K] at poses [K,>=2] to their goals, [K] m.

        Cells miss a gap that is hardly wider than a robot. It may have got through one, so it can
        get back: the way to the nearest cell that is reached is taken to be straight, however far.
        """
        cells = (poses[:, :2] - self.origins[places]) / CELL - 0.5
        return interpolate(self.maps, np.asarray(env_ids), cells[:, 0], cells[:, 1],
                           2 * sum(self.maps.shape[1:]))


class SeparateDistances:
    """Of any kind, one by one."""

    def __init__(self, num_envs: int):
        self._own: list[Distance | None] = [None] * num_envs

    def set(self, env: int, distance: Distance | None) -> None:
        """A new goal of one robot; None: it has none."""
        self._own[env] = distance

    def at(self, env_ids: np.ndarray, places: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Of robots [K] at poses [K,>=2] to their goals, [K] m."""
        return np.array([np.inf if self._own[n] is None else self._own[n].at(pose[None])[0]
                         for n, pose in zip(env_ids, poses, strict=True)])


def over_floor(distance: Distance) -> FloorDistance:
    """The distance, of which the map is asked.

    Raises:
        UserError: it has none.
    """
    if not isinstance(distance, FloorDistance):
        raise UserError('the distances of a place with a floor map are over that floor '
                        '(FloorDistance)', type(distance).__name__,
                        'give such ones from `distance_to`, or no `floor`')
    return distance
