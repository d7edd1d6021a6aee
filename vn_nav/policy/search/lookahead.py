"""The first of some turns and straight drives that lead on best, by a cost to go.

The cost to go knows metres, not turns; a robot that turns in steps and drives in steps pays for
both. So two straight pieces are tried, each behind some turns, and what is left is the cost to go
and the turn towards it.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_nav.policy.search.costmap import free_length
from vn_nav.policy.search.grid import CELL

STEPS = 4  # of a straight piece, at most
SECOND = 3  # turns before the second piece, at most, either way
RING, DIRECTIONS = 0.4, 16  # m about the end of a piece: which way the cost falls
SETTLED = 0.4  # m to go: the heading does not matter any more
ENOUGH = 0.45  # share of a first step that is free, at least


@numba.njit(cache=True)
def best_turns(passable, clearance, metre, field, origin, pose, turn, length, most, open_turns,
               prices):
    """Turns, to the left where positive, before the best first step ahead, and its price [m].

    Args:
        passable, clearance, metre: [S,S] of a costmap, the last one what a metre costs.
        field: [S,S] m to go; origin: [2] m.
        pose: [3] x, y [m], yaw [rad].
        turn: rad of one turn; length: m of one step ahead.
        most: turns either way, at most.
        open_turns: [2*most+1] m more for each number of turns, from -most on; inf: not allowed.
        prices: [4] m for a turn, for each metre that an obstacle cuts off, for passing one at the
            footprint and 0 from so far on: (turn, contact, graze, graze from) and the footprint.

    Returns:
        Turns and price; a price of inf: nothing leads anywhere.
    """
    best, chosen = np.inf, 0
    for k in range(-most, most + 1):
        if not open_turns[k + most] < np.inf:
            continue
        yaw = pose[2] + k * turn
        start = open_turns[k + most] + prices[0] * abs(k)
        x, y, cost = pose[0], pose[1], start
        for step in range(STEPS):
            got, clear = free_length(passable, clearance, origin, x, y, yaw, length)
            if got < length and (step > 0 or got <= ENOUGH * length):
                break
            cost += (_price(metre, origin, x, y, yaw, got) + prices[1] * (length - got)
                     + _graze(clear, prices))
            x += got * math.cos(yaw)
            y += got * math.sin(yaw)
            total = cost + _left(field, origin, x, y, yaw, turn, prices[0])
            if total < best:
                best, chosen = total, k
            if got < length:
                break
            for second in range(-SECOND, SECOND + 1):
                if second == 0:
                    continue
                on = yaw + second * turn
                u, v, more = x, y, cost + prices[0] * abs(second)
                for _ in range(STEPS):
                    got, clear = free_length(passable, clearance, origin, u, v, on, length)
                    if got < length:
                        break
                    more += _price(metre, origin, u, v, on, got) + _graze(clear, prices)
                    u += got * math.cos(on)
                    v += got * math.sin(on)
                    total = more + _left(field, origin, u, v, on, turn, prices[0])
                    if total < best:
                        best, chosen = total, k
    return chosen, best


@numba.njit(cache=True)
def _price(metre, origin, x, y, angle, length):
    """Of a straight piece, by what a metre costs there; 1 where the map names no price."""
    total, side = 0.0, metre.shape[0]
    count = max(int(math.ceil(length / CELL)), 1)
    for k in range(count):
        r = length * (k + 0.5) / count
        column = int(math.floor((x + r * math.cos(angle) - origin[0]) / CELL))
        row = int(math.floor((y + r * math.sin(angle) - origin[1]) / CELL))
        known = 0 <= row < side and 0 <= column < side
        total += max(metre[row, column], 1.0) if known else 1.0
    return total * length / count


@numba.njit(cache=True)
def _graze(clear, prices):
    return prices[2] * max(1 - (clear - prices[4]) / prices[3], 0.0)


@numba.njit(cache=True)
def cost_at(field, origin, x, y):
    """A field's value at a place: of the best cell about it."""
    side = field.shape[0]
    column = int(math.floor((x - origin[0]) / CELL))
    row = int(math.floor((y - origin[1]) / CELL))
    if row < 0 or column < 0 or row >= side or column >= side:
        return np.inf
    if field[row, column] < np.inf:
        return float(field[row, column])
    least = np.inf
    for i in range(max(row - 1, 0), min(row + 2, side)):
        for j in range(max(column - 1, 0), min(column + 2, side)):
            least = min(least, field[i, j])
    return least + 0.15


@numba.njit(cache=True)
def _left(field, origin, x, y, yaw, turn, price):
    """Cost to go from a place, and of the turn towards where it falls fastest."""
    here = cost_at(field, origin, x, y)
    if here <= SETTLED or not here < np.inf:
        return here
    least, off = np.inf, 0.0
    for k in range(DIRECTIONS):
        angle = 2 * math.pi * k / DIRECTIONS
        there = cost_at(field, origin, x + RING * math.cos(angle), y + RING * math.sin(angle))
        if there < least:
            least = there
            off = abs((angle - yaw + math.pi) % (2 * math.pi) - math.pi)
    # Half a turn off a step would not turn.
    return here + price * max(off / turn - 0.5, 0.0)
