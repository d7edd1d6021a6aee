"""The parts of an MCAP file that stand, so that a full disk can take back the last ones."""

from __future__ import annotations

import os
import pickle
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.records import Channel, Schema

MIN_PARTS_IN_MEMORY = 512  # parts in memory, at least: what a full disk may take back at once


class Part(NamedTuple):
    """A stretch of the file that stands: what opens it, or a chunk with its message indexes."""

    end: int = 0  # offset
    crc: int = 0  # of the file up to there
    span: tuple[int, int] | None = None  # least and greatest stamp up to there
    declared: tuple[Schema | Channel, ...] = ()
    index: bytes = b''  # type: ignore[assignment]  # its record in the summary
    counts: tuple[tuple[int, int], ...] = ()  # channel, messages


class FileParts:
    """The parts of a file, the last ones in memory.

    A picture is a chunk, and an hour has 220,000: the others wait in a nameless file in the same
    folder, of which nothing is left when the recorder is killed.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._last: list[Part] = [Part()]
        self._blocks: list[tuple[int, int]] = []  # place, size of earlier parts

    @property
    def last(self) -> Part:
        return self._last[-1]

    def push(self, part: Part) -> None:
        self._last.append(part)
        if len(self._last) < 2 * MIN_PARTS_IN_MEMORY:
            return
        block = zlib.compress(pickle.dumps(
            [tuple(part) for part in self._last[:MIN_PARTS_IN_MEMORY]]), 1)
        place = sum(self._blocks[-1]) if self._blocks else 0
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)
            if os.pwrite(self._file.fileno(), block, place) < len(block):
                return
        except OSError:  # a full disk, which the bag itself meets next; they stay in memory
            return
        self._blocks.append((place, len(block)))
        del self._last[:MIN_PARTS_IN_MEMORY]

    def pop(self) -> Part:
        part = self._last.pop()
        if not self._last:
            self._last = self._block(*self._blocks.pop())
        return part

    def __iter__(self) -> Iterator[Part]:
        for block in self._blocks:
            yield from self._block(*block)
        yield from self._last

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _block(self, place: int, size: int) -> list[Part]:
        assert self._file is not None  # where blocks are
        data = os.pread(self._file.fileno(), size, place)
        return [Part(*values) for values in pickle.loads(zlib.decompress(data))]
