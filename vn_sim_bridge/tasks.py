"""Image-goal navigation as pure functions: starts, success, rewards."""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.counter_random import Stream, uniform
from vn_sim_bridge.houses.house import DistanceField, Goal, House

ARRIVAL_RADIUS = 0.6  # m, geodesic
ARRIVAL_HEADING = math.radians(30.0)  # rad


def wrap_angle(angle):
    """To [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def heading_error(yaw, goal_yaw):
    """Unsigned angle between two headings [rad]."""
    return np.abs(wrap_angle(yaw - goal_yaw))


def arrived(distance, error):
    """At the goal pose: within the arrival radius and heading."""
    return (distance <= ARRIVAL_RADIUS) & (error <= ARRIVAL_HEADING)


def sparse_reward(success):
    """The thesis's reward: 1 at the goal, else 0. The only one that the network may see."""
    return np.asarray(success, np.float32)


def shaping_reward(before, after, collided, *, progress: float, collision: float):
    """Optional terms beside the sparse reward; they never reach the network.

    Args:
        before, after: geodesic distance to the goal around the decision [m].
        collided: [N] bool.
        progress: reward per metre of progress; collision: reward of a contact (negative).
    """
    return (progress * (before - after) + collision * collided).astype(np.float32)


class GoalField:
    """One goal of one house: distances to it, and where episodes towards it may start."""

    def __init__(self, house: House, goal: Goal, min_distance: float):
        self.goal = goal
        self.field: DistanceField = house.geodesic(goal.pose[0], goal.pose[1])
        cells = house.floor.centres()
        distance = self.field.distance(cells)
        keep = np.isfinite(distance) & (distance >= min_distance)
        order = np.argsort(distance[keep], kind='stable')
        self.starts = cells[keep][order]  # [K,2], nearest first
        self.start_distances = distance[keep][order]

    def start(self, tau: float, seed: int, env, episode) -> np.ndarray:
        """A start pose for an episode: uniform over the cells within tau of the maximum distance.

        Args:
            tau: curriculum (thesis, section 4.5): share of the largest start distance, in (0, 1].
            seed, env, episode: counter of the random numbers.

        Returns:
            [4] x, y, yaw, pitch.
        """
        limit = tau * self.start_distances[-1]
        count = max(int(np.searchsorted(self.start_distances, limit, side='right')), 1)
        cell = int(uniform(seed, Stream.START_CELL, env, episode) * count)
        yaw = (uniform(seed, Stream.START_YAW, env, episode) * 2 - 1) * math.pi
        return np.array([*self.starts[cell], float(yaw), 0.0])


def draw_goal(count: int, seed: int, env, episode) -> int:
    """Index of an episode's goal among `count`."""
    return int(uniform(seed, Stream.GOAL, env, episode) * count)


def draw_wrong_goal(count: int, right: int, seed: int, env, episode) -> int:
    """Another goal of the same house, for the wrong-goal control."""
    shift = 1 + int(uniform(seed, Stream.WRONG_GOAL, env, episode) * (count - 1))
    return (right + shift) % count
