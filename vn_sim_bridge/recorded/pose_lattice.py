"""Where a robot may be, and face, when only recorded pictures say so; ways among these poses.

A floor alone does not tell: a picture shows a place in one direction. The map has a layer of
`FloorMap` cells for every `HEADING` and knows which of these states are open, where each action
leads from there, which of them can all be reached from one another, and how many decisions it is
to a goal.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_sim_bridge.floor.floor_map import CELL, FloorMap, main_component

HEADINGS = 72  # layers
HEADING = 2 * math.pi / HEADINGS  # rad between two
# A picture stands for poses beside its own from where it is in sight, up to these,
FARTHEST, TURNED_MOST = 1.0, math.radians(30)  # m, rad
# and one is as near as another where both are as many of these away.
NEAR, TURNED = 0.25, math.radians(15)  # m, rad
GAP = 6  # layers between open ones that are open too: where a robot could not turn it is trapped
STEP, TURN_STEP = 0.02, math.radians(2)  # a move is checked at this spacing [m, rad]
# Where the floor ends a robot slides along its edge: off its course by the first of these angles
# that leads on. The edge is that of what was recorded, seldom a wall.
ASIDE = tuple(math.radians(angle) for angle in (0, 15, -15, 30, -30, 45, -45, 60, -60, 75, -75))
BORDER = 2  # cells around the floor
# What an action costs on a shortest way: that ends well within the open states, or at their edge,
# where the next one may be cut off, or in a contact.
CLEAN, EDGE, CUT = 2, 3, 6
COSTS_KEPT = 1024  # of goals; a third of a megabyte each in a flat
FAR = 2**16 - 1  # no way
MOST = 5.0  # decisions: a worse action is as bad
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
        room = margin + BORDER * CELL
        x, y = np.floor((low - room) / CELL) * CELL
        self.origin = (x, y)
        columns, rows = (np.ceil((high + room - self.origin) / CELL).astype(int)).tolist()
        beside = np.zeros((rows, columns), bool)
        # A picture without a way to it is a place of its own.
        points = np.repeat(poses[:, None, :2], 2, axis=1)
        _mark_ways(np.concatenate([ways.reshape(-1, 2, 2), points]), margin, *self.origin, beside)
        is_open = np.zeros((rows, columns, HEADINGS), bool)
        _mark_poses(np.ascontiguousarray(poses, float), beside, *self.origin, is_open)
        _fill_gaps(is_open)
        self.floor = FloorMap(self.origin, main_component(np.any(is_open, axis=2)))
        is_open &= self.floor.free[:, :, None]
        state = np.full(is_open.shape, -1, np.int32)
        state[is_open] = np.arange(np.count_nonzero(is_open))
        self.lattice = Lattice(*self.origin, state)
        self.cells = np.argwhere(is_open)  # [S,3] of the states
        self.costs = functools.lru_cache(COSTS_KEPT)(self._costs)

    def states(self, poses: np.ndarray) -> np.ndarray:
        """Numbers of the states that poses [N,>=3] are in; -1: closed."""
        return _states(np.ascontiguousarray(poses[:, :3], float), *self.lattice)

    def drive(self, poses: np.ndarray, deltas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move robots in their own frames, up to where the open poses end.

        Args:
            poses: [N,>=3]; deltas: [N,>=3] dx, dy [m], dyaw [rad]. A simultaneous turn bends the
                translation to the mean heading, as in `world.World.move`.

        Returns:
            [N,3] where they are then, and [N] the share of each move that was done.
        """
        return _drive(np.ascontiguousarray(poses[:, :3], float),
                      np.ascontiguousarray(deltas[:, :3], float), *self.lattice)

    @functools.cached_property
    def leads(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the actions lead, [S,A] int32 states, and [S,A] bool: a contact ends them."""
        return _leads(self.cells, self.moves, *self.lattice)

    @functools.cached_property
    def component(self) -> np.ndarray:
        """[S] bool: the largest set of states that can be reached from one another.

        Turns are never exact: without that, turns of 30 deg would leave headings in between apart.
        """
        own, beside = np.arange(len(self.cells), dtype=np.int32), []
        for step in (1, -1):
            row, column, layer = self.cells.T
            state = self.lattice.state[row, column, (layer + step) % HEADINGS]
            beside.append(np.where(state >= 0, state, own))
        number = _components(np.column_stack([self.leads[0], *beside]))
        return number == np.argmax(np.bincount(number))

    def _costs(self, x: float, y: float, yaw: float) -> np.ndarray:
        """[S] uint16 cost of the shortest way to a goal pose; `FAR`: there is none."""
        at = np.array(self.origin) + (self.cells[:, 1::-1] + 0.5) * CELL
        turn = np.abs((self.cells[:, 2] * HEADING - yaw + math.pi) % (2 * math.pi) - math.pi)
        there = (np.hypot(*(at - (x, y)).T) <= SURE_RADIUS) & (turn <= SURE_HEADING)
        own = self.states(np.array([[x, y, yaw]]))[0]
        if own >= 0:
            there[own] = True
        return _spread(np.flatnonzero(there), *self._backwards, len(self.cells))

    @functools.cached_property
    def _backwards(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By state: the first of its entries, [S+1]; from which state, and at what cost."""
        to, cut = self.leads
        order = np.argsort(to.ravel(), kind='stable')
        first = np.searchsorted(to.ravel()[order], np.arange(len(to) + 1))
        cost = np.where(cut, CUT, np.where(self.inner[to], CLEAN, EDGE)).astype(np.int32)
        return first, (order // to.shape[1]).astype(np.int32), cost.ravel()[order]

    @functools.cached_property
    def inner(self) -> np.ndarray:
        """[S] bool: states all of whose neighbours are open."""
        closed = np.pad(self.lattice.state < 0, ((1, 1), (1, 1), (0, 0)), constant_values=True)
        rows, columns = self.floor.free.shape
        beside = np.zeros_like(self.lattice.state, bool)
        for i in range(3):
            for j in range(3):
                part = closed[i:i + rows, j:j + columns]
                beside |= part | np.roll(part, 1, axis=2) | np.roll(part, -1, axis=2)
        return ~beside[tuple(self.cells.T)]

    def regrets_to(self, poses: np.ndarray, goal_pose: Sequence[float]) -> np.ndarray:
        """What each action costs more than the best one, [N,A] float32 in decisions.

        The rest of the way to a goal is the shortest; at most `MOST`, also of what leads nowhere.

        Args:
            poses: [N,>=3].
        """
        return _regrets(np.ascontiguousarray(poses[:, :3], float), self.moves,
                        self.costs(*map(float, goal_pose[:3])), self.inner, *self.lattice)

    def regrets(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """As `regrets_to`, of poses [N,4] each towards a goal of its own, [N,4]."""
        return np.concatenate([self.regrets_to(pose[None], goal)
                               for pose, goal in zip(poses, goal_poses, strict=True)])

    def actions(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """The first action [N] of the shortest way from poses [N,4] to goals [N,4]."""
        chosen = np.empty(len(poses), np.int64)
        for n, goal in enumerate(goal_poses):
            chosen[n] = _choose(poses[n, :3], self.moves, self.costs(*map(float, goal[:3])),
                                self.inner, *self.lattice)
        return chosen


@numba.njit(cache=True)
def _mark_ways(ways, margin, x, y, beside):
    """Cells whose centres lie within the margin of some straight pieces."""
    rows, columns = beside.shape
    for k in range(len(ways)):
        ax, ay, bx, by = ways[k, 0, 0], ways[k, 0, 1], ways[k, 1, 0], ways[k, 1, 1]
        length = (bx - ax) ** 2 + (by - ay) ** 2
        for i in range(max(int((min(ay, by) - margin - y) / CELL), 0),
                       min(int((max(ay, by) + margin - y) / CELL) + 1, rows)):
            for j in range(max(int((min(ax, bx) - margin - x) / CELL), 0),
                           min(int((max(ax, bx) + margin - x) / CELL) + 1, columns)):
                px, py = x + (j + 0.5) * CELL, y + (i + 0.5) * CELL
                share = 0.0
                if length > 0:
                    share = ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length
                    share = min(max(share, 0.0), 1.0)
                if math.hypot(px - ax - share * (bx - ax), py - ay - share * (by - ay)) <= margin:
                    beside[i, j] = True


@numba.njit(cache=True)
def in_sight(ax, ay, bx, by, x, y, free):
    """Whether the straight way between two points is all free; `free` [rows,columns] from x, y."""
    count = max(int(math.hypot(bx - ax, by - ay) / (0.5 * CELL)), 1)
    for k in range(count + 1):
        i = math.floor((ay + (by - ay) * k / count - y) / CELL)
        j = math.floor((ax + (bx - ax) * k / count - x) / CELL)
        if i < 0 or j < 0 or i >= free.shape[0] or j >= free.shape[1] or not free[i, j]:
            return False
    return True


@numba.njit(cache=True)
def _mark_poses(poses, beside, x, y, is_open):
    """States that a picture stands for."""
    rows, columns = beside.shape
    reach, around = int(FARTHEST / CELL) + 1, int(TURNED_MOST / HEADING) + 1
    for k in range(len(poses)):
        px, py = poses[k, 0], poses[k, 1]
        row, column = int((py - y) / CELL), int((px - x) / CELL)
        layer = int(round(poses[k, 2] / HEADING))
        for i in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for j in range(max(column - reach, 0), min(column + reach + 1, columns)):
                cx, cy = x + (j + 0.5) * CELL, y + (i + 0.5) * CELL
                if not beside[i, j] or math.hypot(cx - px, cy - py) > FARTHEST or (
                        is_open[i, j, layer % HEADINGS]
                        and is_open[i, j, (layer - around) % HEADINGS]
                        and is_open[i, j, (layer + around) % HEADINGS]):
                    continue  # nothing to do, or nothing new
                if not in_sight(cx, cy, px, py, x, y, beside):
                    continue
                for h in range(layer - around, layer + around + 1):
                    if abs(h * HEADING - poses[k, 2]) <= TURNED_MOST:
                        is_open[i, j, h % HEADINGS] = True


@numba.njit(cache=True)
def _fill_gaps(is_open):
    """Open up to `GAP` closed layers between two open ones."""
    for i in range(is_open.shape[0]):
        for j in range(is_open.shape[1]):
            layers = is_open[i, j]
            if not layers.any() or layers.all():
                continue
            begin = int(np.argmax(layers))
            last = begin
            for h in range(begin + 1, begin + HEADINGS + 1):
                if layers[h % HEADINGS]:
                    if h - last - 1 <= GAP:
                        for k in range(last + 1, h):
                            layers[k % HEADINGS] = True
                    last = h


@numba.njit(cache=True)
def _state(px, py, yaw, x, y, state):
    i, j = math.floor((py - y) / CELL), math.floor((px - x) / CELL)
    if i < 0 or j < 0 or i >= state.shape[0] or j >= state.shape[1]:
        return -1
    return state[i, j, int(round(yaw / HEADING)) % HEADINGS]


@numba.njit(cache=True)
def _states(poses, x, y, state):
    found = np.empty(len(poses), np.int64)
    for n in range(len(poses)):
        found[n] = _state(poses[n, 0], poses[n, 1], poses[n, 2], x, y, state)
    return found


@numba.njit(cache=True)
def _move(px, py, yaw, dx, dy, dyaw, x, y, state):
    """The pose where a move ends, and the share of it that is done until nothing is open."""
    heading = yaw + 0.5 * dyaw
    c, s = math.cos(heading), math.sin(heading)
    mx, my = c * dx - s * dy, s * dx + c * dy
    count = max(math.ceil(math.hypot(dx, dy) / STEP), math.ceil(abs(dyaw) / TURN_STEP), 1)
    mx, my, turn = mx / count, my / count, dyaw / count
    still = mx == 0.0 and my == 0.0
    for k in range(count):
        there = False
        for aside in ASIDE:
            c, s = math.cos(aside), math.sin(aside)
            nx, ny = px + c * (c * mx - s * my), py + c * (s * mx + c * my)
            if _state(nx, ny, _wrap(yaw + turn), x, y, state) >= 0:
                px, py, yaw, there = nx, ny, _wrap(yaw + turn), True
            if there or still:
                break
        if not there:
            return px, py, yaw, k / count
    return px, py, yaw, 1.0


@numba.njit(cache=True)
def _wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


@numba.njit(cache=True)
def _drive(poses, deltas, x, y, state):
    ends, share = np.empty((len(poses), 3)), np.empty(len(poses))
    for n in range(len(poses)):
        ends[n, 0], ends[n, 1], ends[n, 2], share[n] = _move(
            poses[n, 0], poses[n, 1], poses[n, 2], deltas[n, 0], deltas[n, 1], deltas[n, 2], x, y,
            state)
    return ends, share


@numba.njit(cache=True)
def _leads(cells, moves, x, y, state):
    to = np.empty((len(cells), len(moves)), np.int32)
    cut = np.empty((len(cells), len(moves)), np.bool_)
    for n in range(len(cells)):
        px, py = x + (cells[n, 1] + 0.5) * CELL, y + (cells[n, 0] + 0.5) * CELL
        for a in range(len(moves)):
            ex, ey, eyaw, share = _move(px, py, cells[n, 2] * HEADING, moves[a, 0], moves[a, 1],
                                        moves[a, 2], x, y, state)
            to[n, a] = _state(ex, ey, eyaw, x, y, state)
            cut[n, a] = share < 1.0
    return to, cut


@numba.njit(cache=True)
def _components(to):
    """[S] number of each state's strongly connected component (Tarjan 1972, without recursion)."""
    count, actions = to.shape
    number = np.full(count, -1, np.int32)
    index = np.full(count, -1, np.int32)
    low = np.zeros(count, np.int32)
    path = np.empty(count, np.int32)  # states whose component is not known yet
    calls = np.empty(count, np.int32)
    action = np.zeros(count, np.int32)  # that is looked at next
    on_path = np.zeros(count, np.bool_)
    seen, found, length = 0, 0, 0
    for root in range(count):
        if index[root] >= 0:
            continue
        depth = 0
        calls[0] = root
        while depth >= 0:
            v = calls[depth]
            if index[v] < 0:
                index[v] = low[v] = seen
                seen += 1
                path[length] = v
                length += 1
                on_path[v] = True
            deeper = False
            while action[v] < actions:
                w = to[v, action[v]]
                if index[w] < 0:
                    depth += 1
                    calls[depth] = w
                    deeper = True
                    break
                if on_path[w]:
                    low[v] = min(low[v], low[w])
                action[v] += 1
            if deeper:
                continue
            if low[v] == index[v]:
                while True:
                    length -= 1
                    w = path[length]
                    on_path[w] = False
                    number[w] = found
                    if w == v:
                        break
                found += 1
            depth -= 1
            if depth >= 0:
                parent = calls[depth]
                low[parent] = min(low[parent], low[v])
                action[parent] += 1
    return number


@numba.njit(cache=True)
def _spread(there, first, source, cost, count):
    """Costs of the ways to some states, by label correction over a queue."""
    costs = np.full(count, FAR, np.uint16)
    queue = np.empty(count + 1, np.int32)
    waiting = np.zeros(count, np.bool_)
    head, tail = 0, 0
    for state in there:
        costs[state] = 0
        queue[tail] = state
        waiting[state] = True
        tail += 1
    while head != tail:
        state = queue[head]
        head = (head + 1) % len(queue)
        waiting[state] = False
        for k in range(first[state], first[state + 1]):
            before, value = source[k], np.int64(costs[state]) + cost[k]
            if value < costs[before]:
                costs[before] = value
                if not waiting[before]:
                    waiting[before] = True
                    queue[tail] = before
                    tail = (tail + 1) % len(queue)
    return costs


@numba.njit(cache=True)
def _values(pose, moves, costs, inner, x, y, state, values):
    """What the way costs by each first action; none that a contact ends at once, if there is."""
    for a in range(len(moves)):
        ex, ey, eyaw, share = _move(pose[0], pose[1], pose[2], moves[a, 0], moves[a, 1],
                                    moves[a, 2], x, y, state)
        end = _state(ex, ey, eyaw, x, y, state)
        values[a] = 2.0 * FAR
        if end >= 0 and share > 0.0:
            values[a] = costs[end] + (CUT if share < 1.0 else CLEAN if inner[end] else EDGE)


@numba.njit(cache=True)
def _choose(pose, moves, costs, inner, x, y, state):
    values = np.empty(len(moves))
    _values(pose, moves, costs, inner, x, y, state, values)
    return np.argmin(values)


@numba.njit(cache=True)
def _regrets(poses, moves, costs, inner, x, y, state):
    found, values = np.empty((len(poses), len(moves)), np.float32), np.empty(len(moves))
    for n in range(len(poses)):
        _values(poses[n], moves, costs, inner, x, y, state, values)
        least = values.min()
        for a in range(len(moves)):
            found[n, a] = min((values[a] - least) / CLEAN, MOST)
    return found
