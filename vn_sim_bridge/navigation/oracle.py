"""The shortest path as a teacher and a control: the next action, from a simulator's geometry."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError

TURN_COST = 0.05  # m, what the shortest-path action charges for one rotation
BLOCKED_COST = 1.0  # per metre that a contact cuts off a forward move


def turning_table(action_names: tuple[str, ...]) -> dict[str, int]:
    """Numbers of the actions by name, of a robot that can turn and drive forward."""
    table = {name: index for index, name in enumerate(action_names)}
    for name in ('forward', 'rotate_left', 'rotate_right'):
        if name not in table:
            raise UserError('path-following actions need forward and both rotations',
                            action_names, 'add them to the actions')
    return table


class FloorOracle:
    """The way over a floor on which a robot can turn anywhere.

    Far from the goal: the heading, among those that rotations reach, whose forward move comes
    closest to the goal, charging `TURN_COST` a rotation and `BLOCKED_COST` for contacts. At the
    goal: turn to its yaw.

    Args:
        action_names: of the robot.
        moves: [A,4] dx, dy [m], dyaw, dpitch [rad] of its actions.
    """

    def __init__(self, action_names: tuple[str, ...], moves: np.ndarray):
        self._table: Mapping[str, int] = turning_table(action_names)
        self._turn = moves[self._table['rotate_left'], 2]
        self._length = moves[self._table['forward'], 0]
        half = math.ceil(math.pi / self._turn)
        self._turns = np.arange(-half + 1, half + 1)

    def action(self, pose: np.ndarray, turn_to: float | None,
               reach: Callable[[np.ndarray, float], np.ndarray],
               distance: Callable[[np.ndarray], np.ndarray]) -> int:
        """What one robot should do.

        Args:
            pose: [4].
            turn_to: yaw of the goal [rad] for a robot that is near enough; None: it is not.
            reach: where forward moves [K] along headings end, [K,2] m.
            distance: geodesic, of positions [K,2] to the goal [m].
        """
        yaw = pose[2]
        if turn_to is not None:
            wanted = wrap_angle(turn_to - yaw)
        else:
            ends = reach(yaw + self._turns * self._turn, self._length)
            cut = self._length - np.hypot(*(ends - pose[:2]).T)
            cost = distance(ends) + TURN_COST * np.abs(self._turns) + BLOCKED_COST * cut
            wanted = self._turns[np.argmin(cost)] * self._turn
        if abs(wanted) < self._turn / 2:
            return self._table['forward']
        return self._table['rotate_left' if wanted > 0 else 'rotate_right']
