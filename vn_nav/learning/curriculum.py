"""Curricula on start distance: driven by success, or by frames as in the thesis."""

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
        self.window = window
        self.successes: collections.deque[bool] = collections.deque(maxlen=window)
        self._first = np.zeros(num_envs, np.int64)  # first episode that counts, by environment
        self._finished = np.zeros(num_envs, bool)

    @property
    def success(self) -> float:
        """Success over the window, nan while it is empty."""
        return float(np.mean(self.successes)) if self.successes else float('nan')

    def update(self, episodes: list[Episode], present: np.ndarray, progress: float) -> bool:
        """Count finished episodes; True when tau grew.

        Args:
            episodes: the newly finished ones.
            present: [N] number of the episode that each environment is in now; those began at the
                old tau.
            progress: share of the training that is over; of no concern here.
        """
        for episode in episodes:
            if episode.number >= self._first[episode.env]:
                self.successes.append(episode.success)
                self._finished[episode.env] = True
        if (self.tau >= 1.0 or len(self.successes) < self.window
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


class FrameCurriculum:
    """Raises the difficulty tau with the frames, whatever the policy can do (thesis, 4.5).

    The thesis keeps 0.3 until 5e6 of its 4e7 frames and reaches 1.0 at 1e7; the marks scale with
    the length of the training.

    Args:
        start: first tau.
        begin, end: shares of the training between which tau grows linearly to 1.
    """

    def __init__(self, *, start: float = 0.3, begin: float = 0.125, end: float = 0.25):
        self.start, self.begin, self.end = start, begin, end
        self.tau = start

    def update(self, episodes: list[Episode], present: np.ndarray, progress: float) -> bool:
        """Set tau for a share of the training that is over, see `Curriculum`."""
        share = min(max((progress - self.begin) / (self.end - self.begin), 0.0), 1.0)
        before, self.tau = self.tau, self.start + (1.0 - self.start) * share
        return self.tau != before

    def state_dict(self) -> dict:
        """Plain values."""
        return {'tau': self.tau}

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken."""
        self.tau = state['tau']
