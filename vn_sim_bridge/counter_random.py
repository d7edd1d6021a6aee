"""Random numbers from a counter: a pure function of (seed, stream, environment, episode, step).

Results therefore do not depend on the number of environments, their order or threads. The mixing
function is the finaliser of SplitMix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number
generators", OOPSLA 2014), chained over the keys.
"""

from __future__ import annotations

import enum

import numpy as np


class Stream(enum.IntEnum):
    """What a number is drawn for; two streams never share numbers."""

    GOAL = 1
    START_CELL = 2
    START_YAW = 3
    MOTION_NOISE = 4
    WRONG_GOAL = 5
    APPEARANCE = 6  # light and camera of an episode
    GOAL_APPEARANCE = 7  # of a goal picture
    GOAL_VARIANT = 8
    SENSOR = 9
    BASE = 10  # motion scale of an episode
    SLIP = 11
    LATE_PICTURE = 12
    OBJECT_PLACE = 13
    OBJECT_KIND = 14
    HOUSE = 15  # of an episode
    PAIR = 16  # poses of two views
    PAIR_APPEARANCE = 17
    PAIR_SENSOR = 18
    ODOMETRY = 19  # errors of odometry
    VIEW = 20  # of a recorded place
    VIEW_APPEARANCE = 21
    EPISODE_ODOMETRY = 22  # errors of odometry, of a decision; ODOMETRY: of a tick
    PAIR_LENS = 23
    RANGES = 24  # noise of measured ranges


_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


def _hash(*keys) -> np.ndarray:
    state = np.zeros((), np.uint64)
    with np.errstate(over='ignore'):
        for key in keys:
            state = (state ^ np.asarray(key).astype(np.int64).view(np.uint64)) + _GAMMA
            state = (state ^ (state >> np.uint64(30))) * _MIX_1
            state = (state ^ (state >> np.uint64(27))) * _MIX_2
            state = state ^ (state >> np.uint64(31))
    return state


def key(seed: int | np.ndarray, stream: Stream, env, episode, step=0) -> np.ndarray:
    """64 random bits, uint64; integer arguments broadcast."""
    return _hash(seed, stream, env, episode, step)


def uniform(seed: int | np.ndarray, stream: Stream, env, episode, step=0) -> np.ndarray:
    """Uniform in [0, 1), float64; integer arguments broadcast."""
    return (_hash(seed, stream, env, episode, step) >> np.uint64(11)) * 2.0**-53


def normal(seed: int | np.ndarray, stream: Stream, env, episode, step=0) -> np.ndarray:
    """Standard normal, float64, by Box and Muller's transform; integer arguments broadcast."""
    first = _hash(seed, stream, env, episode, step, 0)
    second = _hash(seed, stream, env, episode, step, 1)
    radius = np.sqrt(-2.0 * np.log(((first >> np.uint64(11)) + np.uint64(1)) * 2.0**-53))
    return radius * np.cos((second >> np.uint64(11)) * (2.0**-52 * np.pi))
