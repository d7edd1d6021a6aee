"""Notices that a clock was set: back, or ahead by more than time that has passed."""

from __future__ import annotations

MAX_STEP_BACK_S = 0.1  # a step of NTP below this moves no robot
MAX_STEP_AHEAD_S = 1.0
MAX_CLOCK_RATE = 10.0  # a simulator may run this many times faster than the steady clock


class ClockWatch:
    """Compares a clock with the steady clock, look by look. No ROS.

    Args:
        simulated: the clock is a simulator's, which may run faster than time passes.
    """

    def __init__(self, *, simulated: bool):
        self._fastest = MAX_CLOCK_RATE if simulated else 1.0
        self._clock: float | None = None
        self._steady = 0.0

    def look(self, clock: float, steady: float) -> str:
        """What happened to the clock since the last look, a text; empty: nothing.

        Args:
            clock: what it says now [s]; 0: it has not begun.
            steady: the steady clock now [s].
        """
        if clock <= 0.0 and self._clock is None:
            return ''
        before, self._clock = self._clock, clock
        passed, self._steady = steady - self._steady, steady
        if before is None:
            return ''
        change = clock - before
        if change < -MAX_STEP_BACK_S:
            return f'the clock went back by {-change:.4g} s'
        if change > MAX_STEP_AHEAD_S + self._fastest * passed:
            return f'the clock jumped ahead by {change:.4g} s'
        return ''
