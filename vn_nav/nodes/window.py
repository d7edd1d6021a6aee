"""What happened in the last seconds: rates and values for the diagnostics."""

from __future__ import annotations

import collections
import statistics


class Window:
    """Events of the last seconds, each with a value.

    Args:
        seconds: how long they are kept.
        most: how many, at most.
    """

    def __init__(self, seconds: float, most: int = 1000):
        self._seconds = seconds
        self._events: collections.deque[tuple[float, float]] = collections.deque(maxlen=most)

    def add(self, now: float, value: float = 0.0) -> None:
        """An event at steady time `now` [s]."""
        self._events.append((now, value))

    def rate(self, now: float) -> float:
        """Events a second [Hz]."""
        recent = [at for at, _ in self._recent(now)]
        if len(recent) < 2:
            return 0.0
        return (len(recent) - 1) / max(now - recent[0], 1e-9)

    def median(self, now: float) -> float | None:
        """Of the values; None: there are none."""
        values = [value for _, value in self._recent(now)]
        return statistics.median(values) if values else None

    def largest(self, now: float) -> float | None:
        """Of the values; None: there are none."""
        return max((value for _, value in self._recent(now)), default=None)

    def _recent(self, now: float) -> list[tuple[float, float]]:
        return [event for event in tuple(self._events) if now - event[0] <= self._seconds]
