"""What the odometry of robots says of their episodes: `EnvConfig.odometry`."""

from __future__ import annotations

import numpy as np

from vn_sim_bridge.counter_random import Stream, normal
from vn_sim_bridge.navigation.base_motion import Counters
from vn_sim_bridge.robot.odometry import advance_all, drift_errors_of_all

_AXES = [0, 0, 1]  # dx and dy are measured by the way, dyaw by the turn


class EpisodeOdometry:
    """Poses by dead reckoning, in frames that begin at (0, 0, 0) with every episode.

    `true` adds up what really happened: motion noise, slip, worn wheels and contacts included.
    `drift` adds up the same, measured with the errors of `odometry.drift_errors`; they are
    functions of seed, environment, episode and step. `commanded` adds up the nominal moves,
    as far as nothing stood in the way: noise, slip and worn wheels are not seen. That is what the
    sim bridge (`SimulatedRobot`) publishes with its default `odometry_drift` of 0, which counts
    wheel turns in the same way tick by tick. With an `odometry_drift` the bridge adds the errors
    to that count, and so misses the motion noise too: it errs more than `drift` does, whose base
    measures its real motion.

    Args:
        kind: 'true', 'drift' or 'commanded'.
        num_envs: robots N.
        drift: as of `odometry.drift_errors`; 1: a good indoor base with a gyro.

    Attributes:
        poses: [N,3] float64 x, y [m], yaw [rad].
    """

    def __init__(self, kind: str, num_envs: int, drift: float = 1.0):
        self._kind, self._drift = kind, drift
        self.poses = np.zeros((num_envs, 3))

    def begin(self, env_ids: np.ndarray) -> None:
        """Begin episodes of robots [K]."""
        self.poses[env_ids] = 0.0

    def add(self, env_ids: np.ndarray, nominal: np.ndarray, tried: np.ndarray, done: np.ndarray,
            counters: Counters, step: np.ndarray) -> None:
        """Add a move of robots [K].

        Args:
            env_ids: which robots.
            nominal: [K,4] displacements of their actions: dx, dy [m], dyaw, dpitch [rad].
            tried: [K,4] what the base made of them.
            done: [K,4] what came of that, as `Motion.delta`.
            counters: of their episodes.
            step: [K] decisions of the episodes so far.
        """
        motion, errors = done[:, :3], None
        if self._kind == 'commanded':
            motion = _commanded(nominal, tried, done)
        elif self._kind == 'drift':
            seeds, numbers, episodes = (part[:, None] for part in counters)
            errors = drift_errors_of_all(motion, self._drift, normal(
                seeds, Stream.EPISODE_ODOMETRY, numbers, episodes,
                3 * step[:, None] + np.arange(3)))
        self.poses[env_ids] = advance_all(self.poses[env_ids], motion, errors)


def _commanded(nominal: np.ndarray, tried: np.ndarray, done: np.ndarray) -> np.ndarray:
    """What really happened [K,3] without what the base made of the nominal moves; see `add`."""
    asked, got = (np.column_stack([np.hypot(part[:, 0], part[:, 1]), np.abs(part[:, 2])])[:, _AXES]
                  for part in (nominal, tried))
    moved = got > 0
    # Wheels that only slip are turned all the same.
    return np.where(moved, done[:, :3] * asked / np.where(moved, got, 1.0), nominal[:, :3])
