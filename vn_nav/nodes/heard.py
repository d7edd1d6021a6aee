"""What comes on one topic while `vn_nav doctor` listens."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from vn_msgs_py.images import ImageError, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array
from vn_nav.bags.storage.losses import Losses
from vn_nav.doctor.seen import Stream
from vn_nav.policy.frame_gate import shorten

DECODERS: dict[str, Callable[[Any], Any]] = {
    'image_raw': decode_rgb, 'image_raw/compressed': decode_rgb, 'goal_image': decode_rgb,
    'odom': odometry_to_array}
MAX_KINDS = 5  # of encodings, sizes and frames that are kept


class Heard:
    """Counts messages as they come; the last one is looked into afterwards.

    Args:
        contract: name of the topic in the contract.
        simulated: the simulated time now [ns], or None.

    Attributes:
        last: the newest message; None: none came.
        history: of odometry: reception [s, steady clock] and message.
    """

    def __init__(self, contract: str, simulated: Callable[[], int | None]):
        self._contract, self._simulated = contract, simulated
        self._count = self._bytes = self._zero = self._repeated = self._back = 0
        self._numbers: list[int] = []  # that the publishers gave
        self._received: list[int] = []  # ns
        self._lags: list[int] = []  # ns
        self._simulated_lags: list[int] = []  # ns
        self._stamp: int | None = None  # ns
        self._kinds: dict[str, None] = {}
        self._frames: dict[tuple[str, str], None] = {}
        self.last: Any = None
        self.history: list[tuple[float, Any]] = []

    def take(self, message: Any, info: Any) -> None:
        """A message has come."""
        # When the middleware had it, not when its turn came here.
        received = info.get('received_timestamp') or time.time_ns()
        self._count += 1
        self._received.append(received)
        number = info.get('publication_sequence_number')
        if number is not None and self._contract != 'goal_image':  # that is heard more than once
            self._numbers.append(number)
        self.last = message
        self._stamped(message.header.stamp, received)
        if hasattr(message, 'encoding'):
            self._kind(f'{shorten(message.encoding, 40)} {message.width} x {message.height}')
        if hasattr(message, 'data'):
            self._bytes = max(self._bytes, len(message.data))
        if self._contract == 'odom':
            self.history.append((time.monotonic(), message))
            if len(self._frames) < MAX_KINDS:
                self._frames[message.header.frame_id, message.child_frame_id] = None

    def _kind(self, kind: str) -> None:
        if len(self._kinds) < MAX_KINDS:
            self._kinds[kind] = None

    def _stamped(self, header, received: int) -> None:
        stamp = header.sec * 10**9 + header.nanosec
        self._zero += stamp == 0
        self._lags.append(received - stamp)
        simulated = self._simulated()
        if simulated is not None:
            self._simulated_lags.append(simulated - stamp)
        if self._stamp is not None:
            self._repeated += stamp == self._stamp
            self._back += stamp < self._stamp
        self._stamp = stamp

    def stream(self, publishers: int) -> Stream:
        """What came from so many publishers, with the last message decoded."""
        if not self._count:
            return Stream()
        losses = Losses()
        lost = sum(losses.add(number, max(publishers, 1)) for number in self._numbers)
        fault = ''
        if self._contract in DECODERS:
            try:
                decoded = DECODERS[self._contract](self.last)
                if hasattr(self.last, 'format'):
                    self._kind(f'{shorten(self.last.format, 40)} {decoded.shape[1]} x '
                               f'{decoded.shape[0]}')
            except (ImageError, MotionError) as error:
                fault = shorten(str(error))
        gaps = [b - a for a, b in zip(self._received, self._received[1:], strict=False)]
        return Stream(
            self._count, statistics.median(gaps) * 1e-9 if gaps else None,
            max(gaps, default=0) * 1e-9, lost, self._bytes, _median(self._lags),
            _median(self._simulated_lags), self._zero, self._repeated, self._back, fault,
            tuple(self._kinds), tuple(self._frames))


def _median(nanoseconds: list[int]) -> float | None:
    return statistics.median(nanoseconds) * 1e-9 if nanoseconds else None
