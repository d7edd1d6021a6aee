"""Bags as streams of messages: rosbag2 folders of MCAP files, or one such file.

Memory is bounded by a chunk (and by a second of recording, where messages come in the order of
time), whatever the size of the bag. Every checksum that a file has is compared. What is damaged,
or not what it says, is a `BagError`; with `strict=False` it is passed over and accounted for.
"""

from __future__ import annotations

import collections
import heapq
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from vn_nav.bags.decoding import Decoder
from vn_nav.bags.mcap_input import Loss, McapFile
from vn_nav.bags.mcap_records import A_BAG, BagError, Connection, Message

__all__ = ['Bag', 'BagError', 'Connection', 'Decoded', 'Loss', 'Message', 'Topic', 'in_time_order',
           'messages', 'summary']

METADATA = 'metadata.yaml'
UNLISTED = 'metadata.yaml does not name it'
MAX_METADATA = 1 << 20  # bytes; a day of hourly files with a hundred topics has 200 kB
MAX_NESTED = 32  # brackets within brackets
ORDER_WINDOW = 1_000_000_000  # ns by which recorders write a message late, at most
MAX_HELD = 64 << 20  # bytes that wait to be put in order: two seconds of raw 640 x 480 at 30 Hz


class Topic(NamedTuple):
    """What a bag holds of a topic."""

    type: str
    count: int


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
        strict: damage is an error. Otherwise it is passed over; `losses` and `missing` tell of it
            after reading.

    Raises:
        BagError: no bag, one in another format, or (if strict) one that was not finished.
    """

    def __init__(self, path: str | Path, *, strict: bool = True):
        self.path, self._own, self._reading = Path(path), [], 0
        self.ros_distro: str | None = None  # as metadata.yaml has it
        self.custom_data: dict[str, str] | None = None  # likewise
        paths = self._paths(strict) if self.path.is_dir() else [_mcap(self.path)]
        self.files = []
        for file in paths:
            try:
                self.files.append(McapFile(file, strict=strict))
            except BagError as error:
                if strict:
                    raise
                self._own.append(Loss(file, 0, 0, error.fault))
        if not self.files:
            fault = 'none of its files can be read' if paths else 'holds no MCAP file'
            raise BagError(path, fault, rule=A_BAG, remedy='give the path of a recording')

    @property
    def losses(self) -> list[Loss]:
        """What was passed over, file by file."""
        return self._own + [loss for file in self.files for loss in file.losses]

    @property
    def missing(self) -> int | None:
        """Messages that the files count and that were not read; None: a file does not count."""
        known = [file.missing for file in self.files]
        return None if None in known else sum(known)

    @property
    def notes(self) -> list[str]:
        """What is no damage and worth knowing, after reading with `strict=False`."""
        notes, passed = [], collections.Counter()
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

    def in_time_order(self, topics: Iterable[str] | None = None) -> Iterator[Message]:
        """The messages by the time of recording, as playing a bag has them; see `in_time_order`.

        Where the files have an index the order is exact, within `MAX_HELD`.
        """
        return in_time_order(self.messages(topics), ahead=self._ahead)

    def _ahead(self) -> int | None:
        """The time [ns] before which nothing is still to be read; None: unknown."""
        known = [self.files[self._reading].ahead,
                 *(file.start for file in self.files[self._reading + 1:])]
        return None if None in known else min(known)

    def topics(self) -> dict[str, Topic]:
        """The topics that have messages, by their names as recorded.

        From the summaries of the files; one without has to be read through.
        """
        found: dict[str, Topic] = {}

        def count(connection: Connection, number: int) -> None:
            before = found.get(connection.topic, Topic(connection.type, 0))
            found[connection.topic] = before._replace(count=before.count + number)

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

    def _paths(self, strict: bool) -> list[Path]:
        """The files of a folder: as its metadata.yaml has them, or by their numbers."""
        there = sorted(self.path.glob('*.mcap'), key=lambda path: [
            int(part) if part.isdecimal() else part for part in re.split(r'([0-9]+)', path.name)])
        if not (self.path / METADATA).is_file():
            if not there:
                _refuse_other_formats(self.path, [path.name for path in self.path.iterdir()])
            return there  # the files tell all; the recorder may have been killed before it did
        try:
            information, listed = _listed(self.path)
            self.ros_distro, self.custom_data = _source(information)
        except BagError as error:
            if strict:
                raise
            self._own.append(Loss(error.path, 0, 0, error.fault, harmless=True))
            return there
        gone = [path for path in listed if not path.is_file()]
        if gone and strict:
            raise BagError(gone[0], 'metadata.yaml names it, and it is not there', remedy='copy '
                           'the bag again, or read what is left with `vn_nav bag recover`')
        self._own += [Loss(path, 0, 0, 'the file is not there') for path in gone]
        more = [] if strict else [path for path in there if path not in listed]
        self._own += [Loss(path, 0, 0, UNLISTED, harmless=True)
                      for path in more]
        return [path for path in listed if path not in gone] + more


def messages(bag: str | Path, topics: Iterable[str] | None = None, *, strict: bool = True
             ) -> Iterator[Decoded]:
    """The messages of a bag as objects, in the order of the time of recording.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: names, with or without the leading slash; None: all.
        strict: as of `Bag`.

    Raises:
        BagError: no readable bag, or a message that is not what its topic says.
    """
    decode = Decoder()
    for message in Bag(bag, strict=strict).in_time_order(topics):
        yield Decoded(message.connection.topic, decode(message), message.log_time * 1e-9,
                      message.log_time, message.publish_time)


def summary(bag: str | Path) -> dict[str, Topic]:
    """The topics of a bag that have messages, by their names as recorded.

    Raises:
        BagError: no readable bag.
    """
    return Bag(bag).topics()


def in_time_order(stream: Iterable[Message], window: int = ORDER_WINDOW, limit: int = MAX_HELD,
                  ahead: Callable[[], int | None] = lambda: None) -> Iterator[Message]:
    """Messages by the time of recording.

    A message is held until nothing earlier can come. Without an index that is believed when one
    has come that is `window` ns younger: recorders write nearly in order. What is later than that
    comes when it comes, and so it is where more than `limit` bytes would have to be held.

    Args:
        stream: messages in the order of a file.
        window: ns.
        limit: bytes.
        ahead: the time [ns] before which nothing is still to come, if it is known.
    """
    held: list[tuple[int, int, Message]] = []
    newest, size = 0, 0
    for number, message in enumerate(stream):
        heapq.heappush(held, (message.log_time, number, message))
        newest, size = max(newest, message.log_time), size + len(message.data)
        settled = ahead()
        if settled is None:
            settled = newest - window
        while held and (held[0][0] <= settled or size > limit):
            first = heapq.heappop(held)[2]
            size -= len(first.data)
            yield first
    while held:
        yield heapq.heappop(held)[2]


def load_yaml(text: str) -> Any:
    """What a YAML text of a bag says.

    Raises:
        ValueError: what takes quadratic or exponential time to read, and no bag needs.
        Exception: many others; the text is nobody's to vouch for.
    """
    depth = deepest = 0
    for bracket in re.findall(r'[][{}]', text):
        depth += 1 if bracket in '[{' else -1
        deepest = max(deepest, depth)
    if deepest > MAX_NESTED or '<<' in text:
        raise ValueError('brackets within brackets, or merged mappings')
    return yaml.safe_load(text)


def _source(information: dict) -> tuple[str | None, dict[str, str] | None]:
    """The ROS distribution and the user's own data of a bag; None: it does not say."""
    distro, data = information.get('ros_distro'), information.get('custom_data')
    whole = isinstance(data, dict) and all(
        isinstance(word, (str, int, float)) for pair in data.items() for word in pair)
    return (distro if isinstance(distro, str) and distro.isprintable() else None,
            {str(key): str(value) for key, value in data.items()} if whole and data else None)


def _listed(folder: Path) -> tuple[dict, list[Path]]:
    """What metadata.yaml says, and the files that it names."""
    path = folder / METADATA
    try:
        if path.stat().st_size > MAX_METADATA:
            raise BagError(path, f'has more than {MAX_METADATA} bytes')
        information = load_yaml(path.read_text())['rosbag2_bagfile_information']
        names = [str(name) for name in information['relative_file_paths']]
        mode, storage = (str(information.get(key) or '').lower()
                         for key in ('compression_mode', 'storage_identifier'))
    except BagError:
        raise
    except Exception as error:  # no end to what YAML can be instead
        raise BagError(path, f'is not the metadata of a bag ({type(error).__name__})',
                       remedy='take it away: the MCAP files tell all that is in it') from error
    _refuse_other_formats(folder, names)
    if mode == 'message':
        raise BagError(path, 'its messages are compressed one by one', rule=A_BAG, remedy='write '
                       'the bag anew with `ros2 bag convert`, without compression_mode message')
    if storage not in ('mcap', ''):
        raise BagError(path, f'its storage is {storage!r}', rule=A_BAG, remedy='write the bag '
                       'anew with `ros2 bag convert`, storage_id mcap')
    for name in names:
        if Path(name).name != name or name in ('', '..'):
            raise BagError(path, f'it names {name!r}, which is not within the folder',
                           remedy='correct relative_file_paths')
    return information, [folder / name for name in names]


def _mcap(path: Path) -> Path:
    _refuse_other_formats(path.parent, [path.name])
    return path


def _refuse_other_formats(folder: Path, names: list[str]) -> None:
    for name in names:
        for suffix, what, remedy in (
                ('.mcap.zstd', 'a file that is compressed as a whole', 'decompress it (`zstd -d '
                 '--rm FILE.mcap.zstd`), take metadata.yaml away, and read the .mcap file'),
                ('.db3', 'a bag in SQLite', 'write it anew with `ros2 bag convert`, storage_id '
                 'mcap, or with `rosbags-convert --dst-storage mcap`'),
                ('.db3.zstd', 'a bag in SQLite', 'write it anew with `ros2 bag convert`, '
                 'storage_id mcap'),
                ('.bag', 'a bag of ROS 1', 'write it anew with `rosbags-convert --dst-storage '
                 'mcap`')):
            if name.endswith(suffix):
                raise BagError(folder / name, what, rule=A_BAG, remedy=remedy)
