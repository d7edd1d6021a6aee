"""A grid of states: where each one is, what the graph says, and how many steps apart they are.

A state is a cell and one of four headings. A scene's file says for each state which one every
action leads to. Poses here are ours: x, y [m], yaw (left), pitch [rad].
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.thor.frame import points_to_ours

# Columns of a graph in this package, by what they do; -1 stands for a collision.
FORWARD, BACKWARD, LEFT, RIGHT = range(4)
# Names of these columns in files; the first of each is that of Zhu et al., whose order is COLUMNS.
NAMES = {
    'MoveForward': FORWARD, 'MoveBackward': BACKWARD, 'RotateLeft': LEFT, 'RotateRight': RIGHT,
    'MoveAhead': FORWARD, 'MoveBack': BACKWARD,
}
COLUMNS = ('MoveForward', 'RotateRight', 'RotateLeft', 'MoveBackward')
EXACT = 1e-6  # m or rad: a robot that is no farther from a state is in it
NEARLY = 0.02, math.radians(2)  # m, rad: from where another kind of move may begin


def place_states(location: np.ndarray, graph: np.ndarray, rotation: np.ndarray | None,
                 where: str) -> tuple[np.ndarray, float]:
    """Poses of states [N,4], and the length of a step [m].

    The graph says which way a state faces: forward leads there. So a file without `rotation`
    tells its headings too, and one with mirrored axes is read as what it is.

    Args:
        location: [N,2] m, `x` and `z` of AI2-THOR's frame (left-handed: z forward, x right).
        graph: [N,4] int64 by the columns of this module.
        rotation: [N] deg, clockwise from z; None: the file has none.
        where: the file, for messages.

    Raises:
        UserError: location, graph and rotation contradict each other, or do not say enough.
    """
    def refuse(name: str, rule: str, received: object) -> UserError:
        return UserError(f'{rule} (data set {name})', f'{received} in {where}',
                         'name the columns of its graph as they are (?actions=...), or write the '
                         'file again')

    angle, step = _facing(location, graph, refuse)
    if _mirrored(angle, graph, refuse):
        location, angle = location * [1.0, -1.0], -angle % 360
    _follow_turns(angle, graph)
    known = ~np.isnan(angle)
    if rotation is not None:
        offset = (angle + rotation) % 360
        first = offset[known][0] if known.any() else 90.0
        if (offset[known] != first).any():
            raise refuse('rotation', 'rotation says which way forward leads, in degrees clockwise',
                         f'state {np.nonzero(known)[0][np.argmax(offset[known] != first)]}')
        angle[~known] = (first - rotation[~known]) % 360
    elif not known.all():
        raise refuse('rotation', 'the graph says which way every state faces where there is no '
                     'rotation', f'state {np.argmin(known)} cannot move')
    yaw = (np.round(angle / 90).astype(np.int64) - 1) % 4 * (math.pi / 2)
    poses = np.zeros((len(location), 4))
    poses[:, :2] = points_to_ours(np.insert(location, 1, 0.0, axis=1))[:, :2]
    poses[:, 2] = np.where(yaw > math.pi - EXACT, yaw - 2 * math.pi, yaw)
    _check_moves(poses, graph, refuse)
    return poses, step


def _facing(location, graph, refuse) -> tuple[np.ndarray, float]:
    """Degrees from the first axis of `location` [N], nan: unknown; and the length of a step."""
    angle, lengths = np.full(len(location), np.nan), []
    for column, sign in ((BACKWARD, -1.0), (FORWARD, 1.0)):
        moved = np.nonzero(graph[:, column] >= 0)[0]
        gap = sign * (location[graph[moved, column]] - location[moved])
        found = np.degrees(np.arctan2(gap[:, 1], gap[:, 0])) % 360
        square = np.round(found / 90) * 90
        length = np.hypot(*gap.T)
        if (bad := (np.abs(found - square) > 1) | (length < 1e-3)).any():
            raise refuse('graph', 'a move leads along an axis to another cell',
                         f'that of state {moved[np.argmax(bad)]}')
        known = ~np.isnan(angle[moved])
        if (bad := angle[moved][known] != square[known] % 360).any():
            raise refuse('graph', 'forward and backward are opposite',
                         f'state {moved[known][np.argmax(bad)]}')
        angle[moved] = square % 360
        lengths.append(length)
    every = np.concatenate(lengths)
    if not len(every):
        raise refuse('graph', 'some move leads somewhere', 'collisions alone')
    if np.ptp(every) > 0.01:
        raise refuse('location', 'all moves are equally long', f'{every.min():g} to '
                     f'{every.max():g} m')
    return angle, float(np.median(every))


def _mirrored(angle, graph, refuse) -> bool:
    """Whether the axes of the locations make right turns look like left ones."""
    turns = []
    for column, sign in ((LEFT, 1), (RIGHT, -1)):
        rows = np.nonzero(graph[:, column] >= 0)[0]
        turns.append(sign * (angle[graph[rows, column]] - angle[rows]) % 360)
    turned = np.concatenate(turns)
    turned = turned[~np.isnan(turned)]
    if len(turned) and not ((turned == 90).all() or (turned == 270).all()):
        raise refuse('graph', 'rotations turn by 90 degrees, right the other way than left',
                     f'{np.mean(turned == 90):.0%} to the left')
    return bool(len(turned)) and bool((turned == 270).all())


def _follow_turns(angle, graph) -> None:
    """Fill in which way states face from which others turn into."""
    for _ in range(4):
        for column, turn in ((LEFT, 90), (RIGHT, -90)):
            rows = np.nonzero((graph[:, column] >= 0) & ~np.isnan(angle))[0]
            ends = graph[rows, column]
            new = np.isnan(angle[ends])
            angle[ends[new]] = (angle[rows[new]] + turn) % 360
            back = np.nonzero((graph[:, column] >= 0) & np.isnan(angle))[0]
            angle[back] = (angle[graph[back, column]] - turn) % 360


def _check_moves(poses, graph, refuse) -> None:
    """Whether every edge is the move that its column says."""
    for column in range(4):
        rows = np.nonzero(graph[:, column] >= 0)[0]
        gap = poses[graph[rows, column]] - poses[rows]
        turn = {LEFT: math.pi / 2, RIGHT: -math.pi / 2}.get(column, 0.0)
        bad = np.abs(np.sin((gap[:, 2] - turn) / 2)) > 1e-3
        if column in (LEFT, RIGHT):
            bad |= np.hypot(gap[:, 0], gap[:, 1]) > 1e-3
        if bad.any():
            raise refuse('graph', 'moves keep the heading, and rotations the cell',
                         f'state {rows[np.argmax(bad)]}')
    keys = np.round(poses[:, :3] * [1e3, 1e3, 2 / math.pi]).astype(np.int64)
    keys[:, 2] %= 4
    _, first, count = np.unique(keys, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        raise refuse('location', 'each cell and heading is one state',
                     f'state {first[np.argmax(count > 1)]} is there twice')


@numba.njit(cache=True)
def count_steps(graph):
    """Steps [N,N] int32 from each state (row) to each other one; -1: there is no way.

    Args:
        graph: [N,A] int64, -1: no move.
    """
    count, actions = graph.shape
    into = np.zeros(count + 1, np.int64)
    for state in range(count):
        for action in range(actions):
            if graph[state, action] >= 0:
                into[graph[state, action] + 1] += 1
    for state in range(count):
        into[state + 1] += into[state]
    before = np.empty(into[count], np.int64)
    free = into.copy()
    for state in range(count):
        for action in range(actions):
            if graph[state, action] >= 0:
                before[free[graph[state, action]]] = state
                free[graph[state, action]] += 1
    steps = np.full((count, count), -1, np.int32)
    queue = np.empty(count, np.int64)
    for goal in range(count):
        queue[0], end = goal, 1
        steps[goal, goal] = 0
        k = 0
        while k < end:
            for i in range(into[queue[k]], into[queue[k] + 1]):
                if steps[before[i], goal] < 0:
                    steps[before[i], goal] = steps[queue[k], goal] + 1
                    queue[end] = before[i]
                    end += 1
            k += 1
    return steps


@numba.njit(cache=True)
def walk(states, along, turned, delta, graph, step):
    """Move robots that may be on their way from one state to the next; in place.

    Args:
        states: [K] int64, the last state of each.
        along, turned: [K] how far it has gone forward [m], or turned left [rad], since.
        delta: [K,4], see `Simulator.move`: along one axis.
        graph: [M,4] int64 of all states.
        step: [K] length of a step [m].

    Returns:
        [K] bool: something was in the way, a wall or a grid that knows no such move.
    """
    hit = np.zeros(len(states), np.bool_)
    for k in range(len(states)):
        dx, dy, dyaw, dpitch = delta[k]
        moves, turns = abs(dx) > 0, abs(dyaw) > 0
        if not (moves or turns or dy != 0 or dpitch != 0):
            continue
        if (moves and turns) or dy != 0 or dpitch != 0:
            hit[k] = True
        elif moves:
            if abs(turned[k]) > NEARLY[1]:
                hit[k] = True
                continue
            states[k], along[k], hit[k] = _advance(states[k], along[k] + dx, step[k], graph,
                                                   FORWARD, BACKWARD)
        else:
            if abs(along[k]) > NEARLY[0]:
                hit[k] = True
                continue
            states[k], turned[k], hit[k] = _advance(states[k], turned[k] + dyaw, math.pi / 2,
                                                    graph, LEFT, RIGHT)
            along[k] = 0.0
        if moves:
            turned[k] = 0.0
    return hit


@numba.njit(cache=True)
def _advance(state, way, length, graph, ahead, back):
    while abs(way) > EXACT:
        following = graph[state, ahead if way > 0 else back]
        if following < 0:
            return state, 0.0, True
        if abs(way) < length - EXACT:
            return state, way, False
        state = following
        way -= length if way > 0 else -length
    return state, 0.0, False
