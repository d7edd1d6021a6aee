"""Motion of round robots among rectangles: partial moves up to the collision, no sliding."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_nav.robot import MAX_TILT, RobotSpec
from vn_sim_bridge.floor.places import WalledPlace

TRANSLATION_NOISE = 0.02  # m per decision, standard deviation along the movement (thesis, 5.6)
ROTATION_NOISE = math.radians(2.0)  # rad per decision (thesis, 5.7)
STEP = 0.01  # m, the path is checked at this spacing
PRECISION = 1e-4  # m, to which a contact is located


class World:
    """Poses of N robots, each in one of several places with `obstacle_rects`.

    Args:
        places: houses, for instance.
        place_index: [N] the place of each robot.
        radius: footprint radius of the robots [m].
    """

    def __init__(self, places: Sequence[WalledPlace], place_index: np.ndarray, radius: float):
        self.place_index = np.array(place_index, np.int64)
        self.radius = radius
        self.poses = np.zeros((len(self.place_index), 4))  # x, y, yaw, pitch
        self._rects = np.concatenate([place.obstacle_rects for place in places])
        self._first = np.cumsum([0] + [len(place.obstacle_rects) for place in places])

    def move(self, delta: np.ndarray, env_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displace robots in their own frames; a translation ends where it would touch something.

        Args:
            delta: [K,4] dx (forward), dy (left) [m], dyaw (left), dpitch (down) [rad]. A
                simultaneous turn bends the translation to the mean heading.
            env_ids: [K] which robots.

        Returns:
            [K,4] what really happened, and [K] bool: something was touched.
        """
        done = np.empty((len(env_ids), 4))
        touched = np.zeros(len(env_ids), bool)
        _move(self.poses, np.asarray(env_ids, np.int64), np.ascontiguousarray(delta, float),
              self.place_index, self._first, self._rects, self.radius, done, touched)
        return done, touched

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        place = self.place_index[env_id]
        rects = self._rects[self._first[place]:self._first[place + 1]]
        return _reach(self.poses[env_id, 0], self.poses[env_id, 1], headings, length, rects,
                      self.radius)


def move_among(rects: np.ndarray, radius: float, poses: np.ndarray, delta: np.ndarray,
               env_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displace robots that are all in one place, as `World.move` does.

    Args:
        rects: [M,4] x0, y0, x1, y1 [m] of its obstacles.
        radius: footprint radius [m].
        poses: [N,4], changed in place.
        delta: [K,4] displacements; env_ids: [K] whose.
    """
    done, touched = np.empty((len(env_ids), 4)), np.zeros(len(env_ids), bool)
    _move(poses, np.asarray(env_ids, np.int64), np.ascontiguousarray(delta, float),
          np.zeros(len(poses), np.int64), np.array([0, len(rects)]), rects, radius, done, touched)
    return done, touched


def reach_among(rects: np.ndarray, radius: float, x: float, y: float, headings: np.ndarray,
                length: float) -> np.ndarray:
    """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
    return _reach(x, y, headings, length, rects, radius)


def motion_noise(delta: np.ndarray, nominal: np.ndarray, normals: np.ndarray, *,
                 exact_turns: bool = False) -> np.ndarray:
    """Displacements with Gaussian noise along the movement; none on tilt.

    The variance grows with the share of the nominal action that is covered, so that many short
    ticks add up to the variance of one whole action.

    Args:
        delta: [K,4] intended displacement; nominal: [K] size of the whole action [m or rad].
        normals: [K] standard normal numbers.
        exact_turns: none on rotations either (`Simulator.exact_turns`).
    """
    noisy = delta.copy()
    share = np.sqrt(np.abs(delta[:, :3]).max(axis=1) / nominal)
    distance = np.hypot(delta[:, 0], delta[:, 1])
    moving = distance > 0
    scale = 1 + TRANSLATION_NOISE * share * normals / np.where(moving, distance, 1.0)
    noisy[moving, :2] *= scale[moving, None]
    if not exact_turns:
        turning = (delta[:, 2] != 0) & ~moving
        noisy[turning, 2] += (ROTATION_NOISE * share * normals)[turning]
    return noisy


def nominal_sizes(robot: RobotSpec) -> dict[str, float]:
    """Size of the action that a Twist along an axis and direction belongs to: '+dx', '-dx', ..."""
    sizes: dict[str, float] = {}
    for action in robot.actions:
        sizes.setdefault(('+' if action.size > 0 else '-') + action.axis, abs(action.size))
    return sizes


@numba.njit(cache=True)
def _collides(x, y, rects, radius):
    for m in range(rects.shape[0]):
        dx = max(max(rects[m, 0] - x, x - rects[m, 2]), 0.0)
        dy = max(max(rects[m, 1] - y, y - rects[m, 3]), 0.0)
        if dx * dx + dy * dy < radius * radius:
            return True
    return False


@numba.njit(cache=True)
def _nearby(x, y, reach, rects):
    """The rectangles that something within `reach` of a point can touch, in their order."""
    count = 0
    kept = np.empty(rects.shape[0], np.int64)
    for m in range(rects.shape[0]):
        if (rects[m, 0] - x < reach and x - rects[m, 2] < reach
                and rects[m, 1] - y < reach and y - rects[m, 3] < reach):
            kept[count] = m
            count += 1
    return rects[kept[:count]]


@numba.njit(cache=True)
def _travel(x, y, ux, uy, length, rects, radius):
    """Distance that can be driven along the unit vector (ux, uy), up to `length`."""
    free = 0.0
    while free < length:
        next_stop = min(free + STEP, length)
        if _collides(x + ux * next_stop, y + uy * next_stop, rects, radius):
            low, high = free, next_stop
            while high - low > PRECISION:
                middle = 0.5 * (low + high)
                if _collides(x + ux * middle, y + uy * middle, rects, radius):
                    high = middle
                else:
                    low = middle
            return low
        free = next_stop
    return length


@numba.njit(cache=True)
def _move(poses, env_ids, delta, place_index, first, rects, radius, done, touched):
    for k in range(len(env_ids)):
        n = env_ids[k]
        place = place_index[n]
        own = rects[first[place]:first[place + 1]]
        x, y, yaw, pitch = poses[n]
        dx, dy, dyaw = delta[k, 0], delta[k, 1], delta[k, 2]
        length = math.sqrt(dx * dx + dy * dy)
        travelled = 0.0
        if length > 0.0:
            heading = yaw + 0.5 * dyaw
            c, s = math.cos(heading), math.sin(heading)
            ux, uy = (c * dx - s * dy) / length, (s * dx + c * dy) / length
            near = _nearby(x, y, length + radius + STEP, own)
            travelled = _travel(x, y, ux, uy, length, near, radius)
            touched[k] = travelled < length
            x += ux * travelled
            y += uy * travelled
            done[k, 0] = dx * travelled / length
            done[k, 1] = dy * travelled / length
        else:
            done[k, 0] = 0.0
            done[k, 1] = 0.0
        tilted = min(max(pitch + delta[k, 3], -MAX_TILT), MAX_TILT)
        done[k, 2] = dyaw
        done[k, 3] = tilted - pitch
        yaw = (yaw + dyaw + math.pi) % (2 * math.pi) - math.pi
        poses[n, 0], poses[n, 1], poses[n, 2], poses[n, 3] = x, y, yaw, tilted


@numba.njit(cache=True)
def _reach(x, y, headings, length, rects, radius):
    out = np.empty((len(headings), 2))
    rects = _nearby(x, y, length + radius + STEP, rects)
    for k in range(len(headings)):
        ux, uy = math.cos(headings[k]), math.sin(headings[k])
        travelled = _travel(x, y, ux, uy, length, rects, radius)
        out[k, 0] = x + ux * travelled
        out[k, 1] = y + uy * travelled
    return out
