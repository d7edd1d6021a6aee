"""Which camera frames may be used, judged by their stamps; and what was dropped, by kind."""

from __future__ import annotations

import math

OLD, AHEAD, REORDERED, UNUSABLE = 'old stamp', 'stamp ahead', 'reordered stamp', 'unusable picture'
CURE = 'set use_sim_time with a simulator, set both clocks by NTP, or raise'
MAX_TEXT_CHARACTERS = 200  # characters: a hostile message must not grow the diagnostics


class FrameGate:
    """Judges stamps against the last one and against a clock. No ROS.

    Args:
        max_age: older frames are dropped [s].
        max_ahead: frames stamped later than the clock are dropped [s].

    Attributes:
        dropped: frames that were dropped, by kind: never more than four keys.
        last: why the newest of them was.
    """

    def __init__(self, max_age: float, max_ahead: float):
        self.max_age, self.max_ahead = max_age, max_ahead
        self.dropped: dict[str, int] = {}
        self.last = ''
        self._stamp = -math.inf

    def forget(self) -> None:
        """Another time has begun: stamps may be anything."""
        self._stamp = -math.inf

    def went_back(self, stamp: float, clock: float | None) -> float:
        """Seconds by which a frame shows that its clock was set back; 0: it was not.

        Two frames that both agree with one clock lie within `max_age` + `max_ahead` of each
        other: a frame that agrees with it, and lies further back, is of another time.
        """
        back = self._stamp - stamp
        agrees = clock is None or -self.max_ahead <= clock - stamp <= self.max_age
        return back if agrees and back > self.max_age + self.max_ahead else 0.0

    def admit(self, stamp: float, clock: float | None) -> bool:
        """Whether a frame may be used. One that may not is counted, and is as good as none.

        Args:
            stamp: of the frame [s].
            clock: of this node now [s]; None: only the order is judged.
        """
        offset = 0.0 if clock is None else clock - stamp
        if offset > self.max_age:
            self._drop(OLD, f"stamps lie {_seconds(offset)} behind this node's clock: "
                            f'{CURE} max_frame_age ({self.max_age:g} s)')
        elif offset < -self.max_ahead:
            self._drop(AHEAD, f"stamps lie {_seconds(-offset)} ahead of this node's clock: "
                              f'{CURE} max_frame_ahead ({self.max_ahead:g} s)')
        elif not stamp > self._stamp:  # also NaN
            self._drop(REORDERED, 'the stamp is not later than the one before')
        else:
            self._stamp = stamp
            return True
        return False

    def unusable(self, why: str) -> None:
        """Count a frame that could not be decoded."""
        self._drop(UNUSABLE, why)

    def summary(self) -> str:
        """What was dropped, and why the newest was; empty: nothing."""
        if not self.dropped:
            return ''
        counts = ', '.join(f'{n} for {kind}' for kind, n in self.dropped.items())
        return f'dropped {counts}; the last: {self.last}'

    def _drop(self, kind: str, why: str) -> None:
        self.dropped[kind] = self.dropped.get(kind, 0) + 1
        self.last = shorten(why)


def shorten(text: str, most: int = MAX_TEXT_CHARACTERS) -> str:
    """One line of at most so many characters."""
    text = ' '.join(str(text[:4 * most]).split())
    return text if len(text) <= most else text[:most - 1] + '…'


def _seconds(value: float) -> str:
    return f'{value:.2f} s' if value < 100 else f'{value:.3g} s'
