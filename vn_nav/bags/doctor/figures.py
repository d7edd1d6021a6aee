"""What `vn_nav bag doctor` keeps of a bag while it streams by, and what it says of it."""

from __future__ import annotations

import array
import collections
import dataclasses
import math
import statistics

import numpy as np

from vn_nav.bags.poses import COMMAND_TIMEOUT_S
from vn_nav.bags.stamped import PAIRING_TIMEOUT_S
from vn_nav.bags.storage.stream import Connection

ERROR, WARNING = 'error', 'warning'
DRIVER = 'check the driver, and record again'  # a remedy
MEDIAN_SAMPLES = 4096  # numbers that a median is taken of, at most
# A clock that goes back by this much was set back, see `set_back`.
SET_BACK_NS = round(1e9 * PAIRING_TIMEOUT_S)
ODOMETRY_NOISE_M_RAD = 0.0005  # m and rad: smaller steps of a standing robot must not add up


class Neighbours:
    """How many pictures have no pose within a time of their own stamp; stamps in ns."""

    def __init__(self, window: float):
        self.pictures = self.alone = 0
        self._window, self._pose = window, -math.inf
        self._waiting: collections.deque[int] = collections.deque(maxlen=MEDIAN_SAMPLES)

    def picture(self, stamp: int) -> None:
        self._waiting.append(stamp)

    def pose(self, stamp: int) -> None:
        while self._waiting and stamp <= self._pose - SET_BACK_NS:  # nothing more comes for these
            self.pictures += 1
            self.alone += abs(self._waiting.popleft() - self._pose) > self._window
        while self._waiting and self._waiting[0] <= stamp:
            at = self._waiting.popleft()
            self.pictures += 1
            self.alone += min(stamp - at, at - self._pose) > self._window
        self._pose = stamp


@dataclasses.dataclass
class Finding:
    """Something that is wrong."""

    severity: str  # ERROR: a training would fail or learn nonsense; WARNING: it would lose data
    topic: str  # '': the bag as a whole
    what: str
    when: float | None  # s since the bag's first message, the first time; None: all the time
    remedy: str
    count: int = 1


class Findings:
    """Findings of a bag; `start` [ns] is what their times count from."""

    def __init__(self):
        self.start: int | None = None
        self._found: dict[tuple[str, str], Finding] = {}

    def add(self, severity: str, topic: str, key: str, what: str, at: int | None, remedy: str,
            count: int = 1) -> None:
        """Note a finding; of the same `key` only the first is kept, and how many there are."""
        finding = self._found.get((topic, key))
        if finding is None:
            when = None if at is None else (at - (self.start or at)) * 1e-9
            self._found[topic, key] = Finding(severity, topic, what, when, remedy, count)
        else:
            finding.count += count

    def sorted(self) -> list[Finding]:
        """All of them, the worst first."""
        order = {ERROR: 0, WARNING: 1}
        return sorted(self._found.values(), key=lambda f: (
            order[f.severity], -1.0 if f.when is None else f.when))


@dataclasses.dataclass
class TopicFigures:
    """What a bag holds of a topic."""

    topic: str
    type: str
    count: int
    rate: float | None  # Hz, by the median time between messages
    worst_gap: float | None  # s
    bytes: int
    unordered: int | None  # header stamps that go back; None: it has no stamps
    repeated: int | None  # header stamps as before
    lag: float | None  # s from stamp to recording, median
    pictures: list[str]  # encodings and sizes


@dataclasses.dataclass
class Diagnosis:
    """All of it."""

    bag: str
    seconds: float
    topics: list[TopicFigures]
    findings: list[Finding]
    notes: list[str]  # what is no fault and worth knowing, see `Bag.notes`

    @property
    def usable(self) -> bool:
        """Whether there is no error."""
        return all(finding.severity != ERROR for finding in self.findings)


class Sample:
    """A median of numbers without end: every so manieth is kept."""

    def __init__(self):
        self._kept, self._stride, self._number = array.array('q'), 1, 0

    def add(self, value: int) -> None:
        if self._number % self._stride == 0:
            # Times reach 2^63 - 1, and their differences beyond.
            self._kept.append(max(-(2**63), min(value, 2**63 - 1)))
            if len(self._kept) == MEDIAN_SAMPLES:
                self._kept, self._stride = self._kept[::2], 2 * self._stride
        self._number += 1

    def median(self) -> float | None:
        return statistics.median(self._kept) if self._kept else None


class Times:
    """Times [ns] that should go on."""

    def __init__(self):
        self.last: int | None = None
        self.gaps = Sample()
        self.worst, self.worst_at = 0, 0
        self.back = self.same = 0

    def add(self, time: int, at: int) -> int:
        """Note a time that a message recorded `at` has; by how much it goes on."""
        gap = 0 if self.last is None else time - self.last
        if self.last is not None:
            self.gaps.add(gap)
            self.back += gap < 0
            self.same += gap == 0
            if gap > self.worst:
                self.worst, self.worst_at = gap, at
        self.last = time
        return gap


@dataclasses.dataclass
class SetBack:
    """Where a clock was set back."""

    count: int = 0
    first: int = 0  # ns, negative
    at: int = 0  # ns, when

    def add(self, step: int, at: int) -> None:
        self.count += 1
        if self.count == 1:
            self.first, self.at = step, at


class ReceivedTopic:
    """A topic as it comes by."""

    def __init__(self, connection: Connection, role: str | None):
        self.connection, self.role = connection, role
        self.usable = True  # its type is known, and the one of its role
        self.count = self.bytes = 0
        self.logged, self.stamps, self.lag = Times(), Times(), Sample()
        self.set_back, self.recorder_back = SetBack(), SetBack()
        self.jump: tuple[int, int] | None = None  # ns, of the stamps' clock, and when
        self.pictures: dict[str, None] = {}
        self.looked: int | None = None  # ns, when a picture was decoded
        self.before: np.ndarray | None = None  # bytes of the last picture
        self.moved_before = 0.0  # what the robot had gone when it was new

    def figures(self) -> TopicFigures:
        gap, stamped = self.logged.gaps.median(), self.stamps.last is not None
        lag = self.lag.median()
        return TopicFigures(
            self.connection.topic, self.connection.type, self.count, 1e9 / gap if gap else None,
            self.logged.worst * 1e-9 if self.count > 1 else None, self.bytes,
            self.stamps.back if stamped else None, self.stamps.same if stamped else None,
            None if lag is None else lag * 1e-9, list(self.pictures))


class Motion:
    """How far the robot has gone, m and rad added: `total`, and `reach` from where it began."""

    def __init__(self):
        self.total, self.reach, self.poses = 0.0, 0.0, 0
        self._first: np.ndarray | None = None
        self._last: np.ndarray | None = None

    def pose(self, values: np.ndarray) -> None:
        self.poses += 1
        if self._first is None or self._last is None:
            self._first = self._last = values[:3]
        self.reach = max(self.reach, _distance(self._first, values))
        step = _distance(self._last, values)
        if step >= ODOMETRY_NOISE_M_RAD:
            self.total += step
            self._last = values[:3]


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    turn = math.remainder(b[2] - a[2], 2 * math.pi)
    return math.hypot(b[0] - a[0], b[1] - a[1]) + abs(turn)


class Command:
    """How far the commands would move the robot."""

    def __init__(self):
        self.total = 0.0
        self._speed, self._since = 0.0, 0

    def add(self, velocity: np.ndarray, at: int) -> None:
        seconds = min(max((at - self._since) * 1e-9, 0.0), COMMAND_TIMEOUT_S)
        self.total += self._speed * seconds
        self._speed, self._since = float(np.abs(velocity[:3]).sum()), at
