"""The success-driven curriculum on start distance."""

from __future__ import annotations

import collections

import numpy as np

from vn_nav.learning.rollout import Episode


class Curriculum:
    """Raises the difficulty tau whenever the policy masters the present one.

    tau grows by `step` once the success over the last `window` episodes exceeds `threshold`. Only
    episodes that *began* at the present tau count. Short episodes end first and are mostly
    successes, so the first windows would flatter: every environment must also have finished at
    least one episode that began at this tau, and by then the slowest have had their say.

    Args:
        num_envs: environments.
        start: first tau; 1 switches the curriculum off.
        threshold: success to exceed.
        step: growth of tau.
        window: episodes.
    """

    def __init__(self, num_envs: int, *, start: float = 0.3, threshold: float = 0.75,
                 step: float = 0.1, window: int = 200):
        self.tau, self.threshold, self.step = start, threshold, step
        self.successes: collections.deque[bool] = collections.deque(maxlen=window)
        self._first = np.zeros(num_envs, np.int64)  # first episode that counts, by environment
        self._finished = np.zeros(num_envs, bool)

    @property
    def success(self) -> float:
        """Success over the window, nan while it is empty."""
        return float(np.mean(self.successes)) if self.successes else float('nan')

    def update(self, episodes: list[Episode], present: np.ndarray) -> bool:
        """Count finished episodes; True when tau grew.

        Args:
            episodes: the newly finished ones.
            present: [N] number of the episode that each environment is in now; those began at the
                old tau.
        """
        for episode in episodes:
            if episode.number >= self._first[episode.env]:
                self.successes.append(episode.success)
                self._finished[episode.env] = True
        if (self.tau >= 1.0 or len(self.successes) < self.successes.maxlen
                or not self._finished.all() or self.success <= self.threshold):
            return False
        self.tau = min(1.0, round(self.tau + self.step, 6))
        self.successes.clear()
        self._finished[:] = False
        self._first = present + 1
        return True

    def state_dict(self) -> dict:
        """Plain values."""
        return {'tau': self.tau, 'successes': [bool(x) for x in self.successes],
                'first': self._first.tolist(), 'finished': self._finished.tolist()}

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken."""
        self.tau = state['tau']
        self.successes.clear()
        self.successes.extend(state['successes'])
        self._first = np.array(state['first'], np.int64)
        self._finished = np.array(state['finished'], bool)
