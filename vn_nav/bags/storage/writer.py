"""Writing rosbag2 bags (MCAP, zstd chunks, metadata version 9) from serialised messages."""

from __future__ import annotations

import collections
import errno
import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from vn_msgs_py.topics import Topic
from vn_nav.bags.storage.definitions import definition
from vn_nav.bags.storage.metadata import (
    RecordedChannel,
    RecordedFile,
    file_text,
    metadata_text,
    qos_text,
)
from vn_nav.bags.storage.output import CHUNK_BYTES, McapOutput
from vn_nav.errors import UserError

FLUSH_PERIOD_S = 1.0  # s between flushes: what a power cut may cost
MIN_FREE_BYTES = 1_000_000_000  # bytes
MAX_WAITING_BYTES = 64 << 20  # bytes that may wait for the disk before `write` does
# To the flush after the first message of a topic, so that metadata.yaml names it.
FIRST_FLUSH_S = 0.1


class RecordingStopped(UserError):
    """The disk has no room left, or failed; what was recorded before is whole."""

    def __init__(self, folder: Path, reason: str):
        super().__init__('a bag is recorded while its disk has room', reason,
                         f'{folder} is whole up to here: free some space and begin another bag')


class _Waiting(NamedTuple):
    channel: RecordedChannel
    data: bytes
    stamp: int
    sequence: int


class BagWriter:
    """A bag being recorded; a context manager.

    A thread of its own compresses and writes: a slow disk does not hold up the caller. Every full
    chunk is written at once. What has come is written every second, synchronised with the disk,
    and counted in metadata.yaml. When less than `min_free` is left, or writing fails, the thread
    finishes the bag, and `stopped` says why. A topic is in the bag from its first message on.

    Args:
        folder: of the bag; it must not exist. Its files are FOLDER_0.mcap, FOLDER_1.mcap...
        topics: what will be written; `add` takes more.
        max_bytes: a file that has grown so large is followed by another; 0: never.
        max_seconds: likewise, by the time since it was begun.
        min_free: bytes that stay free on the disk.

    Raises:
        UserError: the folder exists or cannot be made, there is no room, or a type is unknown.
    """

    def __init__(self, folder: str | Path, topics: Iterable[Topic] = (), *, max_bytes: int = 0,
                 max_seconds: float = 0.0, min_free: int = MIN_FREE_BYTES):
        self.folder = Path(folder)
        self._max_bytes, self._max_seconds, self._min_free = max_bytes, max_seconds, min_free
        self.stopped = ''  # why; empty: it goes on
        # By name in the bag; another counter every second.
        self.written: collections.Counter[str] = collections.Counter()
        self._added: dict[str, RecordedChannel] = {}
        for topic in topics:
            self.add(topic)
        self._files: list[RecordedFile] = []
        # In finished files.
        self._before: collections.Counter[RecordedChannel] = collections.Counter()
        self._file: McapOutput | None = None
        self._queue: collections.deque[_Waiting] = collections.deque()
        self._bytes = 0  # in the queue
        self._closing = False
        self._change = threading.Condition()
        try:
            self.folder.mkdir(parents=True)
        except OSError as error:
            raise UserError('a bag is recorded into a folder of its own', str(error),
                            'choose another folder, or remove it') from error
        try:
            self._check_room()
            self._begin_file()
        except OSError as error:
            for path in self.folder.iterdir():
                path.unlink()
            self.folder.rmdir()
            raise UserError('a bag is recorded where there is room', f'{folder}: {error}',
                            'free some space, or choose another disk') from error
        self._thread = threading.Thread(target=self._work, name='bag writer', daemon=True)
        self._thread.start()

    def add(self, topic: Topic) -> None:
        """Take another topic; one of the same name is written with this type from now on.

        Raises:
            UserError: its type is unknown.
        """
        name = topic.name if topic.name.startswith('/') else f'/{topic.name}'
        self._added[topic.name] = RecordedChannel(name, topic, *definition(topic.type))

    def write(self, name: str, data: bytes, stamp: int, sequence: int = 0) -> None:
        """Append one CDR message of a topic; it is not copied. Waits where the disk is slow.

        Args:
            name: of the topic, as it was added.
            data: the message.
            stamp: when it was published, ns since 1970.
            sequence: the publisher's number of it, if there is one.

        Raises:
            RecordingStopped: this message is not in the bag.
        """
        if not 0 <= stamp < 1 << 63:
            raise ValueError(f'a stamp is nanoseconds since 1970; received {stamp}')
        item = _Waiting(self._added[name], data, stamp, sequence)
        with self._change:
            while self._bytes > MAX_WAITING_BYTES and not self.stopped:
                self._change.wait()
            if self.stopped:
                raise RecordingStopped(self.folder, self.stopped)
            self._queue.append(item)
            self._bytes += len(data)
            self._change.notify_all()

    def close(self) -> None:
        """Finish the file and its metadata.

        Raises:
            RecordingStopped: messages that were taken may be missing.
        """
        with self._change:
            self._closing = True
            self._change.notify_all()
        self._thread.join()
        if self.stopped:
            raise RecordingStopped(self.folder, self.stopped)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind, *_):
        try:
            self.close()
        except RecordingStopped:
            if kind is None:  # else the exception on its way says more
                raise

    def _work(self) -> None:
        """The thread: never raises."""
        self._due, counted = time.monotonic() + FLUSH_PERIOD_S, 0
        try:
            while (item := self._take(self._due)) or not self._closing:
                if item:
                    self._put(item)
                if time.monotonic() >= self._due:
                    self._present.flush()
                    self._present.sync()
                    self._count()
                    self._check_room()
                    if counted != (counted := self.written.total()):
                        self._write_metadata()
                    self._due = time.monotonic() + FLUSH_PERIOD_S
            self._present.flush()
        except Exception as error:  # also a bug must not leave writers waiting for ever
            self._stop(error)
        try:
            # What metadata.yaml takes has to be free still when the file is finished.
            if self._file is not None:
                self._end_file(spare=len(self._metadata()) + 8192 if self.stopped else 0)
        except Exception as error:
            self._stop(error)

    @property
    def _present(self) -> McapOutput:
        """The file that is being written: there is one until the bag is finished."""
        assert self._file is not None
        return self._file

    def _take(self, due: float) -> _Waiting | None:
        """The next message, unless none comes in time or ever."""
        with self._change:
            while not self._queue and not self._closing and (left := due - time.monotonic()) > 0:
                self._change.wait(left)
            if not self._queue:
                return None
            item = self._queue.popleft()
            self._bytes -= len(item.data)
            self._change.notify_all()
            return item

    def _put(self, item: _Waiting) -> None:
        self._unchecked += len(item.data)
        if self._unchecked >= CHUNK_BYTES:
            self._check_room()
        if self._channels and (
                0 < self._max_bytes <= self._present.size
                or 0 < self._max_seconds <= time.monotonic() - self._begun):
            self._present.flush()
            self._end_file()
            self._begin_file()
        channel = item.channel
        if channel not in self._channels:
            self._channels[channel] = self._present.channel(
                channel.name, channel.topic.type, channel.definition,
                {'offered_qos_profiles': qos_text(channel.topic),
                 'topic_type_hash': channel.digest})
            self._due = min(self._due, time.monotonic() + FIRST_FLUSH_S)
        self._present.add(self._channels[channel], item.data, item.stamp, item.sequence)

    def _stop(self, error: Exception) -> None:
        # Not every OSError has a number and a text of the system.
        reason = ((error.strerror if isinstance(error, OSError) else None)
                  or f'{type(error).__name__}: {error}')
        with self._change:
            self.stopped = self.stopped or reason
            self._queue.clear()
            self._change.notify_all()

    def _check_room(self) -> None:
        self._unchecked = 0  # bytes since
        disk = os.statvfs(self.folder)
        free = disk.f_bavail * disk.f_frsize
        if free < self._min_free:
            raise OSError(errno.ENOSPC, f'{free / 1e9:.3f} GB free, less than '
                                        f'{self._min_free / 1e9:g} GB')

    def _begin_file(self) -> None:
        path = self.folder / f'{self.folder.name}_{len(self._files)}.mcap'
        self._file, self._begun = McapOutput(path), time.monotonic()
        self._channels: dict[RecordedChannel, int] = {}  # ids in the present file
        self._files.append(RecordedFile(path.name))
        self._write_metadata(folder=True)

    def _end_file(self, spare: int = 0) -> None:
        try:
            self._present.finish(spare)
        finally:
            self._count()
            self._file = None
            ended = self._files[-1]
            ended.text = file_text(ended)
            self._before += ended.counts
        self._write_metadata(folder=True)

    def _count(self) -> None:
        """Look at what the present file holds."""
        present, file = self._files[-1], self._present
        present.span = file.span
        present.counts = collections.Counter(
            {channel: file.counts[number] for channel, number in self._channels.items()
             if file.counts[number]})
        written: collections.Counter[str] = collections.Counter()
        for channel, count in self._counts().items():
            written[channel.name] += count
        self.written = written

    def _counts(self) -> collections.Counter[RecordedChannel]:
        present = self._files[-1]
        return self._before + (collections.Counter() if present.text else present.counts)

    def _write_metadata(self, *, folder: bool = False) -> None:
        """Replace metadata.yaml: whole at any moment, so that a killed recording is a bag.

        Args:
            folder: have the disk hold the names of the files as well.
        """
        path = self.folder / 'metadata.yaml'
        partial = path.with_suffix('.yaml.tmp')
        try:
            with open(partial, 'w', encoding='utf-8') as file:
                file.write(self._metadata())
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
        if folder:
            names = os.open(self.folder, os.O_RDONLY)
            try:
                os.fsync(names)
            finally:
                os.close(names)

    def _metadata(self) -> str:
        return metadata_text(self._files, self._counts())
