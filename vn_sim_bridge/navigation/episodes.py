"""How an episode is drawn: goal, start, light and base, for whoever runs one.

`NavigationEnv` and `SimulatedRobot` draw by these functions. `warp_env` has them as kernels; a
test holds its episodes to theirs. Everything is a function of the counter (seed, environment,
episode).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vn_sim_bridge.counter_random import Stream, key, uniform
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import Distance, Goal, Place, StraightDistance

MIN_START_DISTANCE = 1.0  # m that a start keeps from its goal, unless told otherwise


def draw_index(count: int, seed: int, stream: Stream, env, episode, step=0) -> int:
    """A whole number below `count`."""
    return int(uniform(seed, stream, env, episode, step) * count)


def draw_goal(count: int, seed: int, env, episode) -> int:
    """Index of an episode's goal among `count`."""
    return draw_index(count, seed, Stream.GOAL, env, episode)


def draw_wrong_goal(count: int, right: int, seed: int, env, episode) -> int:
    """Another goal of the same place, for the wrong-goal control."""
    return (right + 1 + draw_index(count - 1, seed, Stream.WRONG_GOAL, env, episode)) % count


def draw_absent_goal(ranges: Sequence[tuple[int, int]], place: int, seed: int, env, episode
                     ) -> int:
    """A view of another place, for a goal that is nowhere here.

    Args:
        ranges: first view and number of goals, by place; at least two places.
        place: where the robot is.
        seed, env, episode: counter of the random numbers.
    """
    others = [own for other, own in enumerate(ranges) if other != place and own[1]]
    first, count = others[draw_index(len(others), seed, Stream.WRONG_GOAL, env, episode, 1)]
    return first + draw_index(count, seed, Stream.WRONG_GOAL, env, episode, 2)


def draw_variant(count: int, seed: int, env, episode) -> int:
    """Which of a goal's differently lit pictures an episode shows."""
    return draw_index(count, seed, Stream.GOAL_VARIANT, env, episode)


def draw_motion_scale(randomisation: Randomisation, seed, env, episode) -> np.ndarray:
    """Metres that the bases of some episodes drive for each metre asked for."""
    low, high = randomisation.motion_scale
    return low + (high - low) * uniform(seed, Stream.BASE, env, episode)


def draw_delays(randomisation: Randomisation, seed: int, episode: int
                ) -> tuple[float, float, float]:
    """How late an episode's commands, motors and pictures are [s]."""
    limits = (randomisation.command_delay, randomisation.motor_lag, randomisation.camera_delay)
    command, motors, camera = (
        low + (high - low) * float(uniform(seed, Stream.BASE, 0, episode, 1 + k))
        for k, (low, high) in enumerate(limits))
    return command, motors, camera


def draw_grip(randomisation: Randomisation, seed, env, episode, step) -> np.ndarray:
    """The share of some decisions' motion that wheels on a smooth floor turn into driving."""
    counter = (seed, Stream.SLIP, env, episode, step)
    part = key(*counter) % np.uint64(1000) / 1000.0
    return np.where(uniform(*counter) < randomisation.slip, part, 1.0)


class Starts:
    """Where episodes towards a goal may start (in a house: the free cells), by distance.

    Args:
        place: a house, for instance.
        field: distances to the goal.
        min_distance: that a start keeps from the goal [m], as long as any cell does.
    """

    def __init__(self, place: Place, field: Distance, min_distance: float):
        cells, headings = place.starts()
        distance = field.at(cells if headings is None else np.column_stack([cells, headings]))
        keep = np.isfinite(distance) & (distance >= min_distance)
        if not keep.any():
            keep = np.isfinite(distance)
        order = np.argsort(distance[keep], kind='stable')
        self.cells = cells[keep][order]  # [K,2], nearest first
        self.distances = distance[keep][order]
        self.headings = None if headings is None else headings[keep][order]  # None: any

    def draw(self, tau: float, seed: int, env, episode) -> np.ndarray:
        """A start pose for an episode: uniform over the cells within tau of the maximum distance.

        Args:
            tau: curriculum (thesis, section 4.5): share of the largest start distance, in (0, 1].
            seed, env, episode: counter of the random numbers.

        Returns:
            [4] x, y, yaw, pitch.
        """
        limit = tau * self.distances[-1]
        count = max(int(np.searchsorted(self.distances, limit, side='right')), 1)
        cell = draw_index(count, seed, Stream.START_CELL, env, episode)
        yaw = ((uniform(seed, Stream.START_YAW, env, episode) * 2 - 1) * math.pi
               if self.headings is None else self.headings[cell])
        return np.array([*self.cells[cell], float(yaw), 0.0])


class GoalField:
    """One goal pose of one place: distances to it, and where episodes towards it may start.

    Where nobody knows the ways, `field` is the straight line: arrival is judged by it, and no
    figure that needs the shortest way is made of it (`NavigationEnv`).
    """

    def __init__(self, place: Place, goal: Goal, min_distance: float):
        self.goal = goal
        self.field: Distance = place.distance_to(goal) or StraightDistance(goal)
        self.starts = Starts(place, self.field, min_distance)

    def start(self, tau: float, seed: int, env, episode) -> np.ndarray:
        """A start pose, see `Starts.draw`."""
        return self.starts.draw(tau, seed, env, episode)
