"""What a robot's base makes of its actions: noise, slip, worn wheels."""

from __future__ import annotations

import numpy as np

from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, normal
from vn_sim_bridge.floor.contacts import motion_noise
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.episodes import draw_grip

Counters = tuple[np.ndarray, np.ndarray, np.ndarray]  # [K] seeds, numbers, episodes


class BaseMotion:
    """Displacements of actions, as they are really driven.

    Args:
        config: how noisy motion is, and how smooth the floor is.
        robot: the actions.
        exact_turns: of the simulator.

    Attributes:
        deltas: [A,4] dx, dy [m], dyaw, dpitch [rad] of the actions, exact.
    """

    def __init__(self, config: EnvConfig, robot: RobotSpec, *, exact_turns: bool = False):
        self._config, self._exact_turns = config, exact_turns
        self.deltas = np.array([[a.dx, a.dy, a.dyaw, a.dpitch] for a in robot.actions])
        self._sizes = np.array([abs(action.size) for action in robot.actions])

    def driven(self, actions: np.ndarray, counters: Counters, step: np.ndarray,
               scale: np.ndarray) -> np.ndarray:
        """Of actions [K] where motion is continuous: displacements [K,4].

        Args:
            actions: [K] their numbers.
            counters: of the episodes.
            step: [K] decisions of the episodes so far.
            scale: [K] what worn wheels make of a metre.
        """
        delta = self.deltas[actions]
        if self._config.noise:
            seeds, numbers, episodes = counters
            delta = motion_noise(delta, self._sizes[actions], self._config.noise * normal(
                seeds, Stream.MOTION_NOISE, numbers, episodes, step),
                exact_turns=self._exact_turns or not self._config.turn_noise)
        if self._config.randomisation.slip:
            scale = draw_grip(self._config.randomisation, *counters, step) * scale
        delta = delta.copy()
        delta[:, :3] *= scale[:, None]
        return delta
