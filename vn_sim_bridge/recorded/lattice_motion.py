"""Motion within the open poses of a `pose_lattice.PoseMap`, and what each first action costs."""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.recorded.lattice_graph import NO_WAY
from vn_sim_bridge.recorded.open_poses import HEADING, HEADINGS

STEP, TURN_STEP = 0.02, math.radians(2)  # a move is checked at this spacing [m, rad]
# Where the floor ends a robot slides along its edge: off its course by the first of these angles
# that leads on. The edge is that of what was recorded, seldom a wall.
SLIDE_ANGLES = tuple(math.radians(angle) for angle in (
    0, 15, -15, 30, -30, 45, -45, 60, -60, 75, -75))
# What an action costs on a shortest way, in halves of a decision: one that ends well within the
# open states, or at their edge, where the next one may be cut off, or in a contact.
INNER_COST, EDGE_COST, CONTACT_COST = 2, 3, 6
MOST_REGRET = 5.0  # decisions: a worse action is as bad


@numba.njit(cache=True)
def state_of(px, py, yaw, x, y, state):
    """Number of the state that a pose is in; -1: closed."""
    i, j = math.floor((py - y) / CELL), math.floor((px - x) / CELL)
    if i < 0 or j < 0 or i >= state.shape[0] or j >= state.shape[1]:
        return -1
    return state[i, j, int(round(yaw / HEADING)) % HEADINGS]


@numba.njit(cache=True)
def states_of(poses, x, y, state):
    """As `PoseMap.states`."""
    found = np.empty(len(poses), np.int64)
    for n in range(len(poses)):
        found[n] = state_of(poses[n, 0], poses[n, 1], poses[n, 2], x, y, state)
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
        for slide in SLIDE_ANGLES:
            c, s = math.cos(slide), math.sin(slide)
            nx, ny = px + c * (c * mx - s * my), py + c * (s * mx + c * my)
            if state_of(nx, ny, _wrap(yaw + turn), x, y, state) >= 0:
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
def drive(poses, deltas, x, y, state):
    """As `PoseMap.drive`."""
    ends, share = np.empty((len(poses), 3)), np.empty(len(poses))
    for n in range(len(poses)):
        ends[n, 0], ends[n, 1], ends[n, 2], share[n] = _move(
            poses[n, 0], poses[n, 1], poses[n, 2], deltas[n, 0], deltas[n, 1], deltas[n, 2], x, y,
            state)
    return ends, share


@numba.njit(cache=True)
def leads_of(cells, moves, x, y, state):
    """As `PoseMap.leads`."""
    to = np.empty((len(cells), len(moves)), np.int32)
    cut = np.empty((len(cells), len(moves)), np.bool_)
    for n in range(len(cells)):
        px, py = x + (cells[n, 1] + 0.5) * CELL, y + (cells[n, 0] + 0.5) * CELL
        for a in range(len(moves)):
            ex, ey, eyaw, share = _move(px, py, cells[n, 2] * HEADING, moves[a, 0], moves[a, 1],
                                        moves[a, 2], x, y, state)
            to[n, a] = state_of(ex, ey, eyaw, x, y, state)
            cut[n, a] = share < 1.0
    return to, cut


@numba.njit(cache=True)
def _values(pose, moves, costs, inner, x, y, state, values):
    """What the way costs by each first action; none that a contact ends at once, if there is."""
    for a in range(len(moves)):
        ex, ey, eyaw, share = _move(pose[0], pose[1], pose[2], moves[a, 0], moves[a, 1],
                                    moves[a, 2], x, y, state)
        end = state_of(ex, ey, eyaw, x, y, state)
        values[a] = 2.0 * NO_WAY
        if end >= 0 and share > 0.0:
            step = CONTACT_COST if share < 1.0 else INNER_COST if inner[end] else EDGE_COST
            values[a] = costs[end] + step


@numba.njit(cache=True)
def choose(pose, moves, costs, inner, x, y, state):
    """The first action of the shortest way from a pose [3]."""
    values = np.empty(len(moves))
    _values(pose, moves, costs, inner, x, y, state, values)
    return np.argmin(values)


@numba.njit(cache=True)
def regrets_of(poses, moves, costs, inner, x, y, state):
    """As `PoseMap.regrets_to`."""
    found, values = np.empty((len(poses), len(moves)), np.float32), np.empty(len(moves))
    for n in range(len(poses)):
        _values(poses[n], moves, costs, inner, x, y, state, values)
        least = values.min()
        for a in range(len(moves)):
            found[n, a] = min((values[a] - least) / INNER_COST, MOST_REGRET)
    return found
