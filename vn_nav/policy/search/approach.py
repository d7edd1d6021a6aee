"""The last metre: the moves that bring a robot best onto a pose, place and heading together.

A cost to go knows no heading: a robot that stands half a metre beside its goal, turned as the goal
is, would be led there by a turn, a step and a turn back, when a step backward does as well. Near a
hypothesis all sequences of moves are searched, in decisions.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.policy.search.costmap import free_length

REACH = 1.6  # m about the goal's pose that is searched
SIDE = 0.1  # m of a state's cell
HEADINGS = 24  # of a state
SPREAD, TURN_SPREAD = 0.2, math.radians(9)  # of a near hypothesis, deviations
PRICE = 0.03  # probability that a decision is worth
LONGEST = 14  # decisions


@numba.njit(cache=True)
def arrives(away, turn):
    """Probability that a robot so far off a hypothesis [m], [rad] has arrived at the goal."""
    near = 0.5 * math.erfc((away - ARRIVAL_RADIUS) / SPREAD / math.sqrt(2))
    turned = 0.5 * math.erfc((abs(turn) - ARRIVAL_HEADING) / TURN_SPREAD / math.sqrt(2))
    return near * turned


@numba.njit(cache=True)
def best_move(passable, clearance, origin, pose, goal, moves, price, open_moves):
    """The first of the moves that end where the robot most likely has arrived.

    Args:
        passable, clearance: [S,S] of a costmap; origin: [2] m.
        pose, goal: [3] x, y [m], yaw [rad].
        moves: [A,3] dx, dy [m], dyaw [rad].
        price: what a decision costs, as a probability.
        open_moves: [A] bool, whether each may be the first.

    Returns:
        Its index; -1: no move is worth its price, -2: the goal is out of reach. And what it is
        worth: the probability at the end, less the price of the way.
    """
    count = 2 * int(REACH / SIDE) + 1
    done = np.zeros((count, count, HEADINGS), np.bool_)
    most = count * count * HEADINGS
    state = np.empty((most, 3))
    first = np.empty(most, np.int64)
    depth = np.empty(most, np.int64)
    state[0] = pose
    first[0], depth[0] = -1, 0
    head, tail = 0, 1
    best, chosen, found = -1.0, -2, False
    while head < tail:
        x, y, yaw = state[head, 0], state[head, 1], state[head, 2]
        away = math.hypot(x - goal[0], y - goal[1])
        turn = (yaw - goal[2] + math.pi) % (2 * math.pi) - math.pi
        worth = arrives(away, turn) - price * depth[head]
        if worth > best + 1e-9:
            best, chosen, found = worth, first[head], True
        if depth[head] < LONGEST and 1 - price * (depth[head] + 1) > best:
            for a in range(len(moves)):
                if depth[head] == 0 and not open_moves[a]:
                    continue
                length = math.hypot(moves[a, 0], moves[a, 1])
                u, v, on = x, y, yaw + moves[a, 2]
                if length > 0:
                    angle = yaw + math.atan2(moves[a, 1], moves[a, 0])
                    got, _ = free_length(passable, clearance, origin, x, y, angle, length)
                    if got < length:
                        continue
                    u, v = x + length * math.cos(angle), y + length * math.sin(angle)
                column = int(math.floor((u - goal[0] + REACH) / SIDE))
                row = int(math.floor((v - goal[1] + REACH) / SIDE))
                if row < 0 or column < 0 or row >= count or column >= count:
                    continue
                sector = int(math.floor(on / (2 * math.pi) * HEADINGS + 0.5)) % HEADINGS
                if done[row, column, sector]:
                    continue
                done[row, column, sector] = True
                state[tail, 0], state[tail, 1], state[tail, 2] = u, v, on
                first[tail] = a if depth[head] == 0 else first[head]
                depth[tail] = depth[head] + 1
                tail += 1
        head += 1
    if not found:
        chosen = -2
    return chosen, best
