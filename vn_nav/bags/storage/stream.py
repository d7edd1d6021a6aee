"""Bags as streams of messages: rosbag2 folders of MCAP files, or one such file.

Memory is bounded by a chunk (and by a second of recording, where messages come in the order of
time), whatever the size of the bag. Every checksum that a file has is compared. What is damaged,
or not what it says, is a `BagError`; with `strict=False` it is passed over and accounted for.
"""

from __future__ import annotations

import collections
import heapq
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from vn_nav.bags.storage.bag_files import METADATA, UNLISTED, files_of, load_yaml
from vn_nav.bags.storage.decoding import Decoder
from vn_nav.bags.storage.input import Loss, McapFile
from vn_nav.bags.storage.records import BagError, Connection, Message

__all__ = ['METADATA', 'UNLISTED', 'Bag', 'BagError', 'Connection', 'Decoded', 'Loss', 'Message',
           'Topic', 'in_time_order', 'load_yaml', 'messages', 'summary']

ORDER_WINDOW_NS = 1_000_000_000  # ns by which recorders write a message late, at most
# Two seconds of raw 640 x 480 at 30 Hz may wait to be put in order.
MAX_HELD_BYTES = 64 << 20


class Topic(NamedTuple):
    """What a bag holds of a topic."""

    type: str  # where its publishers disagree: all of them, with ' and ' between
    count: int  # type: ignore[assignment]  # instead of the tuple's method


class Decoded(NamedTuple):
    """A message of a bag."""

    topic: str  # as recorded
    message: Any
    time: float  # s since 1970, when it was recorded
    log_time: int  # ns since 1970, the same
    publish_time: int  # ns since 1970


class Bag:
    """A bag to read.

    Args:
        path: a rosbag2 folder or an MCAP file.
        strict: damage is an error. Otherwise it is passed over; `losses` and `missing` list it
            after reading.

    Attributes:
        ros_distro, custom_data: as metadata.yaml has them; None: it does not say.

    Raises:
        BagError: no bag, one in another format, or (if strict) one that was not finished.
    """

    def __init__(self, path: str | Path, *, strict: bool = True):
        self.path, self._reading, self.files = Path(path), 0, []
        found = files_of(path, strict=strict)
        self._own = list(found.losses)
        self.ros_distro, self.custom_data = found.ros_distro, found.custom_data
        unreadable: BagError | None = None
        for file in found.paths:
            try:
                self.files.append(McapFile(file, strict=strict))
            except BagError as error:
                unreadable = unreadable or error
                if strict:
                    raise
                self._own.append(Loss(file, 0, 0, error.fault))
        if not self.files:
            raise unreadable or BagError(path, 'metadata.yaml names no file')

    @property
    def losses(self) -> list[Loss]:
        """What was passed over, file by file."""
        return self._own + [loss for file in self.files for loss in file.losses]

    @property
    def missing(self) -> int | None:
        """Messages that the files count and that were not read; None: a file does not count."""
        known = [file.missing for file in self.files if file.missing is not None]
        return sum(known) if len(known) == len(self.files) else None

    @property
    def surplus(self) -> int:
        """Messages that were read and that the files do not count."""
        return sum(file.surplus for file in self.files)

    @property
    def notes(self) -> list[str]:
        """What is no damage and worth knowing, after reading with `strict=False`."""
        notes: list[str] = []
        passed: collections.Counter[int] = collections.Counter()
        if without := sum(file.unchecked > 0 for file in self.files):
            which = f'{without} of {len(self.files)} files have' if len(self.files) > 1 else (
                f'{self.files[0].path} has')
            notes.append(f'{which} no checksums: what changed within a message cannot be known')
        for file in self.files:
            passed.update(file.passed)
        if passed:
            notes.append('left out are records of kinds that are not known here: ' + ', '.join(
                f'{kind:#04x} ({size} bytes)' for kind, size in sorted(passed.items())))
        return notes

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[Message]:
        """The messages in the order of the files.

        Args:
            topics: names, with or without the leading slash; None: all.

        Raises:
            BagError: damage, if strict.
        """
        wanted = None if topics is None else frozenset(name.lstrip('/') for name in topics)
        for number, file in enumerate(self.files):
            self._reading = number
            yield from file.messages(wanted)

    def in_time_order(self, topics: Iterable[str] | None = None, clocks: Iterable[str] = ()
                      ) -> Iterator[Message]:
        """The messages by the time of recording, as playing a bag has them; see `in_time_order`.

        Where the files have an index the order is exact, within `MAX_HELD_BYTES`.
        """
        return in_time_order(self.messages(topics), ahead=self._ahead, clocks=clocks)

    def _ahead(self) -> int | None:
        """The time [ns] before which nothing is still to be read; None: unknown."""
        ahead = [self.files[self._reading].ahead,
                 *(file.start for file in self.files[self._reading + 1:])]
        known = [time for time in ahead if time is not None]
        return min(known) if len(known) == len(ahead) else None

    def topics(self) -> dict[str, Topic]:
        """The topics that have messages, by their names as recorded.

        From the summaries of the files; one without has to be read through.
        """
        found: dict[str, Topic] = {}

        def count(connection: Connection, number: int) -> None:
            before = found.get(connection.topic, Topic(connection.type, 0))
            kinds = dict.fromkeys([*before.type.split(' and '), connection.type])
            found[connection.topic] = Topic(' and '.join(kinds), before.count + number)

        for file in self.files:
            declared = file.channels
            if file.counts is not None and file.counts.keys() <= declared.keys():
                for channel, number in file.counts.items():
                    if number:
                        count(declared[channel], number)
            else:
                for message in file.messages():
                    count(message.connection, 1)
        return found


def messages(bag: str | Path, topics: Iterable[str] | None = None, *, strict: bool = True,
             clocks: Iterable[str] = ()) -> Iterator[Decoded]:
    """The messages of a bag as objects, in the order of the time of recording.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: names, with or without the leading slash; None: all.
        strict: as of `Bag`.
        clocks: as of `in_time_order`.

    Raises:
        BagError: no readable bag, or a message that is not what its topic says.
    """
    decode = Decoder()
    for message in Bag(bag, strict=strict).in_time_order(topics, clocks):
        yield Decoded(message.connection.topic, decode(message), message.log_time * 1e-9,
                      message.log_time, message.publish_time)


def summary(bag: str | Path) -> dict[str, Topic]:
    """The topics of a bag that have messages, by their names as recorded.

    Raises:
        BagError: no readable bag.
    """
    return Bag(bag).topics()


def in_time_order(stream: Iterable[Message], window: int = ORDER_WINDOW_NS,
                  limit: int = MAX_HELD_BYTES,
                  ahead: Callable[[], int | None] = lambda: None, clocks: Iterable[str] = ()
                  ) -> Iterator[Message]:
    """Messages by the time of recording.

    A message is held until nothing earlier can come. Without an index that is believed when one
    has come that is `window` ns younger: recorders write nearly in order. What is later than that
    comes when it comes, and so it is where more than `limit` bytes would have to be held.

    Args:
        stream: messages in the order of a file.
        window: ns.
        limit: bytes.
        ahead: the time [ns] before which nothing is still to come, if it is known.
        clocks: topics whose own times go on. Where one goes back by `window` the recorder's clock
            was set back, and another take begins: what came before it comes first.
    """
    held: list[tuple[int, int, int, Message]] = []
    newest, size, take = 0, 0, 0
    last: dict[str, int] = dict.fromkeys(filter(None, clocks), 0)
    for number, message in enumerate(stream):
        name, time = message.connection.topic, message.log_time
        if name in last:
            if time <= last[name] - window:
                take, newest, last = take + 1, 0, dict.fromkeys(last, 0)
            last[name] = time
        heapq.heappush(held, (take, time, number, message))
        newest, size = max(newest, time), size + len(message.data)
        settled = ahead()
        if settled is None:
            settled = newest - window
        while held and (held[0][0] < take or held[0][1] <= settled or size > limit):
            first = heapq.heappop(held)[3]
            size -= len(first.data)
            yield first
    while held:
        yield heapq.heappop(held)[3]
