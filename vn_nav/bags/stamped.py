"""What a topic said lately, by its header stamps; a clock that was set back does no harm."""

from __future__ import annotations

import bisect
import collections
from typing import Any, NamedTuple

STAMP_WINDOW_S = 0.05  # s between the stamps of a picture and of what belongs to it
PAIRING_TIMEOUT_S = 1.0  # s of recording time that a picture waits for what belongs to it
EPISODE_GAP_S = 1.0  # s without a picture end an episode
STAMP_HISTORY_S = 2 * PAIRING_TIMEOUT_S  # s of stamps that are remembered
RUN_EXPIRY_S = 3 * PAIRING_TIMEOUT_S  # s of recording time after which a run is over


def set_back(stamp: float, last: float) -> bool:
    """Whether a clock was set back: a simulator that was reset, or another take in one bag.

    The one rule for every topic. A stamp that goes back by less is late or repeated.

    Args:
        stamp: s.
        last: the newest one before [s].
    """
    return stamp <= last - PAIRING_TIMEOUT_S


class Entry(NamedTuple):
    """A message."""

    stamp: float  # s
    time: float  # s, of recording
    value: Any


class _Run:
    """Messages whose stamps go on, without gaps above `EPISODE_GAP_S`."""

    def __init__(self):
        self.stamps: collections.deque[float] = collections.deque()
        self.entries: collections.deque[Entry] = collections.deque()

    def add(self, entry: Entry) -> None:
        self.stamps.append(entry.stamp)
        self.entries.append(entry)
        while self.stamps[-1] - self.stamps[0] > STAMP_HISTORY_S:
            self.drop()

    def drop(self) -> None:
        self.stamps.popleft()
        self.entries.popleft()

    def around(self, stamp: float) -> tuple[Entry, Entry]:
        """The entries before and after a stamp; at an end the same one twice."""
        after = bisect.bisect_left(self.stamps, stamp)
        before = max(after - 1, 0)
        return self.entries[before], self.entries[min(after, len(self.stamps) - 1)]


class Stamped:
    """Messages of one topic by their stamps, as far as a picture may still ask for them.

    Stamps go on in a run. Where they go back as `set_back` says, or leave a gap, another run
    begins; the one before is kept for the pictures that were taken in it and are still to come.

    Args:
        window: s between the stamps of a picture and of what belongs to it.
    """

    def __init__(self, window: float = STAMP_WINDOW_S):
        self._window = window
        self._runs: list[_Run] = []  # the one that went on last is the last

    def add(self, stamp: float, time: float, value: Any) -> None:
        """Take a message in the order of recording; late and repeated ones are left out."""
        self._runs = [run for run in self._runs[:-1] if abs(
            time - run.entries[-1].time) <= RUN_EXPIRY_S] + self._runs[-1:]
        if self._runs:
            last = self._runs[-1].stamps[-1]
            if stamp <= last and not set_back(stamp, last):
                return
        # After one stray stamp the run before it goes on.
        for k in reversed(range(len(self._runs))):
            if 0 < stamp - self._runs[k].stamps[-1] <= EPISODE_GAP_S:
                self._runs.append(self._runs.pop(k))
                break
        else:
            self._runs.append(_Run())
        self._runs[-1].add(Entry(stamp, time, value))

    def reaches(self, stamp: float) -> bool:
        """Whether nothing nearer to a stamp can come any more."""
        return any(run.stamps[0] - self._window <= stamp <= run.stamps[-1] for run in self._runs)

    def around(self, stamp: float, time: float) -> tuple[Entry, Entry] | None:
        """The messages before and after a stamp; None: the nearer is not within the window.

        Args:
            stamp: of a picture [s].
            time: when it was recorded [s], which distinguishes two takes with the same stamps.
        """
        found = self._near(stamp, time)
        return None if found is None else found[1]

    def nearest(self, stamp: float, time: float) -> Any:
        """The message nearest to a stamp, within the window, or None; drops older ones."""
        found = self._near(stamp, time)
        if found is None:
            return None
        run, pair = found
        while run.stamps[0] < pair[0].stamp:
            run.drop()
        return min(pair, key=lambda entry: abs(entry.stamp - stamp)).value

    def _near(self, stamp: float, time: float) -> tuple[_Run, tuple[Entry, Entry]] | None:
        pairs = [(run, run.around(stamp)) for run in self._runs]
        near = [(run, pair) for run, pair in pairs
                if min(abs(entry.stamp - stamp) for entry in pair) <= self._window]
        return min(near, key=lambda found: abs(found[1][0].time - time), default=None)


def header_stamp(message: Any) -> tuple[int, int]:
    """Seconds and nanoseconds of a message's header: by which a goal and its camera belong."""
    return message.header.stamp.sec, message.header.stamp.nanosec
