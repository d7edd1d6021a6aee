"""How robots stand about goals in the pairs of `view_pairs`: two mixtures, drawn by numbers.

A `placer` stands goals and robots up, by uniform numbers [K,3+5*TRIES].
"""

from __future__ import annotations

import math

import numba

from vn_sim_bridge.floor.floor_map import CELL

# How robots stand: share of the pairs, largest distance [m] and heading [rad] from the goal's.
NEARBY = (0.30, 4.0, math.radians(75))
CLOSE = (0.15, 1.0, math.radians(40))  # arrivals are among these
# With the goal ahead: pairs that overlap are seldom farther than a metre apart otherwise, and a
# robot that comes into a room sees its goal from afar. The heading is off that to the goal; the
# last angle is that of the robot's place off the line behind the goal. The rest stands anywhere.
BEHIND = (0.35, 6.0, math.radians(40), math.radians(60))
GOAL_CLEARANCE = 0.5  # m, free straight ahead of a goal: no picture of a wall alone
# The mixture `RECOGNITION` is for telling the goal from what is nearly it: about two fifths there
# or where the goal is likely seen, a fifth each nearly there (the hard ring) and across, the rest
# elsewhere. Shares
# (what is left of one stands anywhere in the place); distances [m] and headings off the goal's
# [rad], each drawn between two limits. Thirds taught to recognise near goals alone: of those
# beyond 3 m a quarter was called in view, at a heading no better than chance; a pair counts both
# ways round, and from afar the goal is in view one way only.
USUAL, RECOGNITION = 'usual', 'recognition'  # mixtures
THERE = (0.08, 0.0, 0.6, 0.0, math.radians(30))  # arrivals, but for walls in between,
SEEN, AFAR = 0.32, 0.75  # as `NEARBY` and `BEHIND`: share, and that of `BEHIND` in it
BESIDE = (0.10, 0.6, 1.5, 0.0, math.radians(45))  # the hard ring: beside it,
ASKEW = (0.08, 0.0, 0.6, math.radians(30), math.radians(60))  # or askew
TURNED = (0.10, 0.0, 4.0, math.radians(60), math.pi)  # look-alikes: the same room, another view
# What the goal looks at, from anywhere: a robot that searches sees it from any side, and without
# such pairs it often did not recognise the goal there.
# Share; limits of how far the place that both look at is from the goal, and from the robot [m];
# how far off the robot's heading is from it [rad].
ACROSS = (0.26, 0.7, 3.5, 0.7, 4.5, math.radians(30))
TRIES = 12  # draws of a goal or of a robot before the last one is taken as it is


@numba.njit(cache=True)
def _fits(x, y, place, rects, first_rect, free, origins, radius):
    """Whether a robot can stand, and get, there."""
    column = math.floor((x - origins[place, 0]) / CELL)
    row = math.floor((y - origins[place, 1]) / CELL)
    if not (0 <= row < free.shape[1] and 0 <= column < free.shape[2]
            and free[place, int(row), int(column)]):
        return False
    for m in range(first_rect[place], first_rect[place + 1]):
        dx = max(max(rects[m, 0] - x, x - rects[m, 2]), 0.0)
        dy = max(max(rects[m, 1] - y, y - rects[m, 3]), 0.0)
        if dx * dx + dy * dy < radius * radius:
            return False
    return True


@numba.njit(cache=True)
def _stand_goal(goal, rest, place, cells, low, count, rects, first_rect, free, origins):
    """A goal [4] on a random cell, free straight ahead, by uniform numbers [2*TRIES]."""
    for attempt in range(TRIES):
        cell = low + int(rest[2 * attempt] * count)
        goal[0], goal[1] = cells[cell, 0], cells[cell, 1]
        goal[2] = (2 * rest[2 * attempt + 1] - 1) * math.pi
        c, s = math.cos(goal[2]), math.sin(goal[2])
        clear = True
        for step in range(1, 6):
            reach = GOAL_CLEARANCE * step / 5
            if not _fits(goal[0] + c * reach, goal[1] + s * reach, place, rects, first_rect,
                         free, origins, 0.0):
                clear = False
                break
        if clear:
            break


@numba.njit(cache=True)
def _stand_anywhere(pose, rest, place, cells, low, count, rects, first_rect, free, origins,
                    radius):
    """A robot [4], but for its heading, anywhere in its place, by uniform numbers [3*TRIES]."""
    # Off the centre of its cell: robots stop anywhere.
    for attempt in range(TRIES):
        cell = low + int(rest[3 * attempt] * count)
        pose[0] = cells[cell, 0] + (rest[3 * attempt + 1] - 0.5) * CELL
        pose[1] = cells[cell, 1] + (rest[3 * attempt + 2] - 0.5) * CELL
        if _fits(pose[0], pose[1], place, rects, first_rect, free, origins, radius):
            break


@numba.njit(cache=True)
def place_usually(draws, places, cells, first_cell, rects, first_rect, free, origins, radius,
                  poses, goal_poses):
    """Stand goals and robots up, by uniform numbers [K,3+5*TRIES]."""
    for k in range(len(places)):
        place = places[k]
        low, count = first_cell[place], first_cell[place + 1] - first_cell[place]
        rest = draws[k, 3:]
        goal = goal_poses[k]
        _stand_goal(goal, rest, place, cells, low, count, rects, first_rect, free, origins)
        rest = rest[2 * TRIES:]
        pose = poses[k]
        kind = draws[k, 1]
        behind = NEARBY[0] + CLOSE[0] <= kind < NEARBY[0] + CLOSE[0] + BEHIND[0]
        if kind >= NEARBY[0] + CLOSE[0] + BEHIND[0]:
            _stand_anywhere(pose, rest, place, cells, low, count, rects, first_rect, free, origins,
                            radius)
            pose[2] = (2 * draws[k, 2] - 1) * math.pi
            continue
        farthest, turn = BEHIND[1], BEHIND[2]
        if not behind:
            farthest, turn = (NEARBY[1], NEARBY[2]) if kind < NEARBY[0] else (CLOSE[1], CLOSE[2])
        pose[0], pose[1] = goal[0], goal[1]
        for attempt in range(TRIES):
            distance = farthest * rest[3 * attempt]
            angle = 2 * math.pi * rest[3 * attempt + 1]
            if behind:
                distance = farthest * math.sqrt(rest[3 * attempt])  # more of the far ones
                angle = goal[2] + math.pi + BEHIND[3] * (angle / math.pi - 1)
            x, y = goal[0] + distance * math.cos(angle), goal[1] + distance * math.sin(angle)
            if _fits(x, y, place, rects, first_rect, free, origins, radius):
                pose[0], pose[1] = x, y
                break
        yaw = goal[2]
        if behind and (pose[0] != goal[0] or pose[1] != goal[1]):
            yaw = math.atan2(goal[1] - pose[1], goal[0] - pose[0])
        yaw += (2 * draws[k, 2] - 1) * turn
        pose[2] = (yaw + math.pi) % (2 * math.pi) - math.pi


@numba.njit(cache=True)
def place_to_recognise(draws, places, cells, first_cell, rects, first_rect, free, origins, radius,
                       poses, goal_poses):
    """As `place_usually`, in the mixture `RECOGNITION`."""
    kinds = (THERE, BESIDE, ASKEW, TURNED)
    usual = draws.copy()
    for k in range(len(places)):
        kind = draws[k, 1]
        if kind < SEEN:  # `NEARBY` and `BEHIND` by the usual rules
            within = kind / SEEN
            usual[k, 1] = (within / (1 - AFAR) * NEARBY[0] if within < 1 - AFAR else
                           NEARBY[0] + CLOSE[0] + (within - 1 + AFAR) / AFAR * BEHIND[0])
        else:
            usual[k, 1] = 1.0  # anywhere, unless one of the kinds below
    place_usually(usual, places, cells, first_cell, rects, first_rect, free, origins, radius,
                  poses, goal_poses)
    for k in range(len(places)):
        begin = SEEN
        for share, nearest, farthest, least, most in kinds:
            if begin <= draws[k, 1] < begin + share:
                _stand_about(poses[k], goal_poses[k], draws[k, 2], draws[k, 3 + 2 * TRIES:],
                             nearest, farthest, least, most, places[k], rects, first_rect, free,
                             origins, radius)
            begin += share
        if begin <= draws[k, 1] < begin + ACROSS[0]:
            _stand_across(poses[k], goal_poses[k], draws[k, 2], draws[k, 3 + 2 * TRIES:],
                          places[k], rects, first_rect, free, origins, radius)


@numba.njit(cache=True)
def _stand_about(pose, goal, turn, rest, nearest, farthest, least, most, place, rects, first_rect,
                 free, origins, radius):
    """A robot [4] between two distances from a goal [4], its heading off by two limits.

    Where it fits nowhere it stays where it is.
    """
    for attempt in range(TRIES):
        # As dense over the ring's area everywhere.
        distance = math.sqrt(nearest**2 + (farthest**2 - nearest**2) * rest[3 * attempt])
        angle = 2 * math.pi * rest[3 * attempt + 1]
        x, y = goal[0] + distance * math.cos(angle), goal[1] + distance * math.sin(angle)
        if _fits(x, y, place, rects, first_rect, free, origins, radius):
            pose[0], pose[1] = x, y
            off = (2 * turn - 1) * (most - least)
            yaw = goal[2] + off + (least if off >= 0 else -least)
            pose[2] = (yaw + math.pi) % (2 * math.pi) - math.pi
            break


@numba.njit(cache=True)
def _stand_across(pose, goal, turn, rest, place, rects, first_rect, free, origins, radius):
    """A robot [4] that faces a place ahead of a goal [4] as the goal does, from any side.

    Where it fits nowhere it stays where it is.
    """
    _, goal_near, goal_far, near, far, off = ACROSS
    for attempt in range(TRIES):
        ahead = goal_near + (goal_far - goal_near) * rest[3 * attempt + 2]
        u, v = goal[0] + ahead * math.cos(goal[2]), goal[1] + ahead * math.sin(goal[2])
        distance = math.sqrt(near**2 + (far**2 - near**2) * rest[3 * attempt])
        angle = 2 * math.pi * rest[3 * attempt + 1]
        x, y = u + distance * math.cos(angle), v + distance * math.sin(angle)
        if _fits(u, v, place, rects, first_rect, free, origins, 0.0) and _fits(
                x, y, place, rects, first_rect, free, origins, radius):
            pose[0], pose[1] = x, y
            yaw = angle + math.pi + (2 * turn - 1) * off
            pose[2] = (yaw + math.pi) % (2 * math.pi) - math.pi
            break


PLACERS = {USUAL: place_usually, RECOGNITION: place_to_recognise}  # by mixture
