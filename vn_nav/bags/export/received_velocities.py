"""Velocities of a drive as they were received, to be looked up by time."""

from __future__ import annotations

import collections

import numpy as np

from vn_nav.bags.poses import COMMAND_TIMEOUT_S
from vn_nav.bags.stamped import set_back

# Velocities that wait for their picture: minutes at any rate.
MAX_WAITING_VELOCITIES = 65_536


class ReceivedVelocities:
    """Received velocities, until they are no longer needed."""

    def __init__(self):
        # Rows come later than velocities: two runs, where a clock was set back in between.
        self._runs: list[collections.deque[tuple[float, np.ndarray]]] = [
            collections.deque(maxlen=MAX_WAITING_VELOCITIES)]

    def add(self, at: float, velocity: np.ndarray) -> None:
        run = self._runs[-1]
        if run and set_back(at, run[-1][0]):
            self._runs = [run, collections.deque(maxlen=MAX_WAITING_VELOCITIES)]
            run = self._runs[-1]
        if not run or at > run[-1][0]:
            run.append((at, velocity))

    def _run(self, at: float) -> collections.deque[tuple[float, np.ndarray]]:
        """The run that a time lies in, or next to."""
        return min(self._runs, key=lambda run: max(
            run[0][0] - at, at - run[-1][0], 0.0) if run else np.inf)

    def forget(self, before: float) -> None:
        """Drop what is older than the last one at or before a time."""
        run = self._run(before)
        while len(run) > 1 and run[1][0] <= before:
            run.popleft()
        if run is self._runs[-1]:
            self._runs = [run]

    def near(self, at: float) -> np.ndarray:
        """The one nearest to a time, [3]; zero where there is none."""
        run = self._run(at)
        after = next((entry for entry in run if entry[0] >= at), None)
        before = next((entry for entry in reversed(run) if entry[0] <= at), None)
        both = [entry for entry in (before, after) if entry is not None]
        return (min(both, key=lambda entry: abs(entry[0] - at))[1] if both else np.zeros(3))

    def mean(self, begin: float, end: float) -> np.ndarray:
        """Of velocities that hold until the next one, or for `COMMAND_TIMEOUT_S` s.

        Args:
            begin: s.
            end: s; `begin` for what holds then.

        Returns:
            [3] vx, vy [m/s], wz [rad/s].
        """
        end = max(end, begin + 1e-3)  # times since 1970 differ by at least 2e-7 s
        span, total = end - begin, np.zeros(3)
        entries = [entry for entry in self._run(begin) if entry[0] < end]
        for k, (at, velocity) in enumerate(entries):
            until = entries[k + 1][0] if k + 1 < len(entries) else np.inf
            until = min(until, at + COMMAND_TIMEOUT_S, end)
            total += velocity * max(until - max(at, begin), 0.0) / span
        return total
