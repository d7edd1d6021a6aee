"""Where a robot may be, and face, when only recorded pictures say so; ways among these poses.

A floor alone does not tell: a picture shows a place in one direction. The map has a layer of
`FloorMap` cells for every `HEADING` and knows which of these states are open (`open_poses`), where
each action leads from there (`lattice_motion`), which of them can all be reached from one another,
and how many decisions it is to a goal (`lattice_graph`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_sim_bridge.floor.floor_map import CELL, FloorMap, main_component
from vn_sim_bridge.recorded.lattice_graph import components, costs_to
from vn_sim_bridge.recorded.lattice_motion import (
    CONTACT_COST,
    EDGE_COST,
    INNER_COST,
    choose,
    drive,
    leads_of,
    regrets_of,
    states_of,
)
from vn_sim_bridge.recorded.open_poses import (
    HEADING,
    HEADINGS,
    fill_gaps,
    mark_poses,
    mark_ways,
)

# Of two pictures one is as near as the other where both are as many of these away.
NEAR, TURNED = 0.25, math.radians(15)  # m, rad
BORDER_CELLS = 2  # around the floor
GOALS_KEPT = 1024  # whose costs are kept; a third of a megabyte each in a flat
# Within these of the goal's pose a robot has surely arrived, wherever in its cell it is.
SURE_RADIUS = ARRIVAL_RADIUS - 2 * CELL
SURE_HEADING = ARRIVAL_HEADING - 2 * HEADING


class Lattice(NamedTuple):
    """States as compiled code takes them."""

    x: float  # m, of the corner of cell [0, 0]
    y: float
    state: np.ndarray  # [rows,columns,HEADINGS] int32: number of an open state; -1: closed


class PoseMap:
    """The open poses about some pictures.

    Args:
        poses: [K,3] x, y [m], yaw [rad] of the pictures.
        ways: [W,2,2] m, straight pieces of the driven path.
        margin: m that a robot may be beside the driven path.
        moves: [A,3] dx, dy [m], dyaw [rad] of the robot's actions.
    """

    def __init__(self, poses: np.ndarray, ways: np.ndarray, margin: float, moves: np.ndarray):
        self.moves = np.ascontiguousarray(moves, float)
        low = np.minimum(poses[:, :2].min(0), ways.reshape(-1, 2).min(0, initial=np.inf))
        high = np.maximum(poses[:, :2].max(0), ways.reshape(-1, 2).max(0, initial=-np.inf))
        room = margin + BORDER_CELLS * CELL
        x, y = np.floor((low - room) / CELL) * CELL
        self.origin = (x, y)
        columns, rows = (np.ceil((high + room - self.origin) / CELL).astype(int)).tolist()
        near_path = np.zeros((rows, columns), bool)
        # A picture without a way to it is a place of its own.
        points = np.repeat(poses[:, None, :2], 2, axis=1)
        mark_ways(np.concatenate([ways.reshape(-1, 2, 2), points]), margin, *self.origin,
                  near_path)
        is_open = np.zeros((rows, columns, HEADINGS), bool)
        mark_poses(np.ascontiguousarray(poses, float), near_path, *self.origin, is_open)
        fill_gaps(is_open)
        self.floor = FloorMap(self.origin, main_component(np.any(is_open, axis=2)))
        is_open &= self.floor.free[:, :, None]
        state = np.full(is_open.shape, -1, np.int32)
        state[is_open] = np.arange(np.count_nonzero(is_open))
        self.lattice = Lattice(*self.origin, state)
        self.cells = np.argwhere(is_open)  # [S,3] of the states
        self.costs = functools.lru_cache(GOALS_KEPT)(self._costs)

    def states(self, poses: np.ndarray) -> np.ndarray:
        """Numbers of the states that poses [N,>=3] are in; -1: closed."""
        return states_of(np.ascontiguousarray(poses[:, :3], float), *self.lattice)

    def drive(self, poses: np.ndarray, deltas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move robots in their own frames, up to where the open poses end.

        Args:
            poses: [N,>=3]; deltas: [N,>=3] dx, dy [m], dyaw [rad]. A simultaneous turn bends the
                translation to the mean heading, as in `floor.contacts`.

        Returns:
            [N,3] where they are then, and [N] the share of each move that was done.
        """
        return drive(np.ascontiguousarray(poses[:, :3], float),
                     np.ascontiguousarray(deltas[:, :3], float), *self.lattice)

    @functools.cached_property
    def leads(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the actions lead, [S,A] int32 states, and [S,A] bool: a contact ends them."""
        return leads_of(self.cells, self.moves, *self.lattice)

    @functools.cached_property
    def component(self) -> np.ndarray:
        """[S] bool: the largest set of states that can be reached from one another.

        Turns are never exact: without that, turns of 30 deg would leave headings in between apart.
        """
        own, turned = np.arange(len(self.cells), dtype=np.int32), []
        for step in (1, -1):
            row, column, layer = self.cells.T
            state = self.lattice.state[row, column, (layer + step) % HEADINGS]
            turned.append(np.where(state >= 0, state, own))
        number = components(np.column_stack([self.leads[0], *turned]))
        return number == np.argmax(np.bincount(number))

    def _costs(self, x: float, y: float, yaw: float) -> np.ndarray:
        """[S] uint16 cost of the shortest way to a goal pose; `NO_WAY`: there is none."""
        at = np.array(self.origin) + (self.cells[:, 1::-1] + 0.5) * CELL
        turn = np.abs((self.cells[:, 2] * HEADING - yaw + math.pi) % (2 * math.pi) - math.pi)
        there = (np.hypot(*(at - (x, y)).T) <= SURE_RADIUS) & (turn <= SURE_HEADING)
        own = self.states(np.array([[x, y, yaw]]))[0]
        if own >= 0:
            there[own] = True
        return costs_to(np.flatnonzero(there), *self._backwards, len(self.cells))

    @functools.cached_property
    def _backwards(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By state: the first of its entries, [S+1]; from which state, and at what cost."""
        to, cut = self.leads
        order = np.argsort(to.ravel(), kind='stable')
        first = np.searchsorted(to.ravel()[order], np.arange(len(to) + 1))
        cost = np.where(cut, CONTACT_COST, np.where(self.inner[to], INNER_COST, EDGE_COST))
        return (first, (order // to.shape[1]).astype(np.int32),
                cost.astype(np.int32).ravel()[order])

    @functools.cached_property
    def inner(self) -> np.ndarray:
        """[S] bool: states all of whose neighbours are open."""
        closed = np.pad(self.lattice.state < 0, ((1, 1), (1, 1), (0, 0)), constant_values=True)
        rows, columns = self.floor.free.shape
        touches_closed = np.zeros_like(self.lattice.state, bool)
        for i in range(3):
            for j in range(3):
                part = closed[i:i + rows, j:j + columns]
                touches_closed |= part | np.roll(part, 1, axis=2) | np.roll(part, -1, axis=2)
        return ~touches_closed[tuple(self.cells.T)]

    def regrets_to(self, poses: np.ndarray, goal_pose: Sequence[float]) -> np.ndarray:
        """What each action costs more than the best one, [N,A] float32 in decisions.

        The rest of the way to a goal is the shortest; at most `MOST_REGRET`, also of what leads
        nowhere.

        Args:
            poses: [N,>=3].
        """
        return regrets_of(np.ascontiguousarray(poses[:, :3], float), self.moves,
                          self.costs(*map(float, goal_pose[:3])), self.inner, *self.lattice)

    def regrets(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """As `regrets_to`, of poses [N,4] each towards a goal of its own, [N,4]."""
        return np.concatenate([self.regrets_to(pose[None], goal)
                               for pose, goal in zip(poses, goal_poses, strict=True)])

    def actions(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """The first action [N] of the shortest way from poses [N,4] to goals [N,4]."""
        chosen = np.empty(len(poses), np.int64)
        for n, goal in enumerate(goal_poses):
            chosen[n] = choose(poses[n, :3], self.moves, self.costs(*map(float, goal[:3])),
                               self.inner, *self.lattice)
        return chosen
