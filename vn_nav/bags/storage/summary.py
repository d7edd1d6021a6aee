"""The end of an MCAP file: footer and summary, which every reader looks at first."""

from __future__ import annotations

import bisect
import itertools
import struct
import zlib
from array import array
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEAD,
    HEADER,
    MAX_DECLARED_BYTES,
    MAX_TIME_NS,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    STATISTICS,
    Damage,
    Declared,
    Fields,
    pairs,
)

MAGIC = b'\x89MCAP0\r\n'
READ_BYTES = 1 << 20  # bytes that are read at a time
MAX_SETS = 1 << 16  # sets of channels, and numbers in them, that are distinguished
_NEVER = (0, HEADER, FOOTER, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END)
_FOOTER = struct.Struct('<BQQQI')  # head, start of the summary, of its offsets, CRC
_TAIL = _FOOTER.size + len(MAGIC)
_DATA_END = struct.Struct('<BQI')  # head, CRC


class Chunks:
    """Where the chunks of a file begin and what is in them, as its summary says.

    Twenty bytes a chunk: an hour of pictures has 220,000.
    """

    def __init__(self):
        self._offsets, self._starts, self._sets = array('Q'), array('Q'), array('I')
        self._numbers: dict[frozenset[int], int] = {frozenset(): 0}  # of the sets of channels
        self._held: list[frozenset[int]] = []  # the sets by number
        self._members = 0
        self._skipped: frozenset[int] = frozenset()  # numbers of sets
        self._ahead: array[int] | None = None

    def __len__(self) -> int:
        return len(self._offsets)

    @property
    def start(self) -> int | None:
        """When the first message was recorded [ns]; None: unknown."""
        first = min(self._starts, default=MAX_TIME_NS)
        return None if first == MAX_TIME_NS else first

    def add(self, offset: int, first: int, held: frozenset[int]) -> None:
        """Note a chunk: its place, the time [ns] of its first message, its channels if known."""
        number = self._numbers.get(held)
        if number is None:
            self._members += len(held)
            number = 0  # as if unknown: such a chunk is always read
            if len(self._numbers) < MAX_SETS and self._members <= MAX_SETS:
                number = self._numbers[held] = len(self._numbers)
        self._offsets.append(offset)
        self._starts.append(min(first, MAX_TIME_NS))
        self._sets.append(number)

    def sort(self) -> None:
        """By their place: an index may be in any order."""
        if any(a > b for a, b in itertools.pairwise(self._offsets)):
            order = sorted(range(len(self)), key=self._offsets.__getitem__)
            self._offsets, self._starts, self._sets = (
                array(column.typecode, (column[k] for k in order))
                for column in (self._offsets, self._starts, self._sets))

    def skip(self, unwanted: Collection[int]) -> bool:
        """Pass over chunks of these channels alone from now on; whether there is one."""
        self._skipped = frozenset(number for held, number in self._numbers.items()
                                  if held and held.issubset(unwanted))
        earliest, ahead = MAX_TIME_NS, array('Q')
        for number, first in zip(reversed(self._sets), reversed(self._starts), strict=True):
            if number not in self._skipped:
                earliest = min(earliest, first)
            ahead.append(earliest)
        ahead.reverse()
        self._ahead = ahead
        return not self._skipped.isdisjoint(self._sets)

    def skips(self, at: int) -> bool:
        """Whether the chunk at a place is passed over."""
        return at in self and self._sets[bisect.bisect_left(self._offsets, at)] in self._skipped

    def ahead(self, at: int) -> int | None:
        """The earliest time [ns] in the chunk at a place and in those behind it; None: unknown."""
        if self._ahead is None or at not in self:
            return None
        return self._ahead[bisect.bisect_left(self._offsets, at)]

    def held(self, at: int) -> frozenset[int]:
        """The channels of the messages in the chunk at a place; empty: unknown."""
        if at not in self:
            return frozenset()
        if len(self._held) != len(self._numbers):
            self._held = list(self._numbers)
        return self._held[self._sets[bisect.bisect_left(self._offsets, at)]]

    def __contains__(self, at: int) -> bool:
        number = bisect.bisect_left(self._offsets, at)
        return number < len(self) and self._offsets[number] == at

    def next(self, at: int) -> int | None:
        """Where the first chunk at or behind a place begins."""
        number = bisect.bisect_left(self._offsets, at)
        return self._offsets[number] if number < len(self) else None

    def between(self, start: int, end: int) -> int:
        """How many chunks begin from one place to before another."""
        return bisect.bisect_left(self._offsets, end) - bisect.bisect_left(self._offsets, start)


class Summary:
    """What a file says of itself; nothing, until `read`.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path):
        self.declared = Declared(path, lambda _: True)
        self.chunks = Chunks()
        self.counts: dict[int, int] | None = None  # messages by channel
        self.total: int | None = None  # messages
        self.span: tuple[int, int] | None = None  # ns, of the first and last message
        self.data_end: int | None = None  # where the summary or the footer begins
        self.data_crc = 0  # of what is before `data_mark`
        self.data_mark: int | None = None  # where the record is that ends the data

    def read(self, file: BinaryIO, size: int) -> None:
        """Read the footer and the summary that it points to.

        Raises:
            Damage: there is no footer, or something is wrong with one of them.
        """
        at = max(size - _TAIL, 0)
        start, crc = self._footer(file, at)
        if not start:
            return
        # The checksum is of everything up to itself.
        if crc and crc_of(file, start, at + _FOOTER.size - 4 - start) != crc:
            raise Damage('the checksum of the summary does not match')
        file.seek(start)
        at_record = start
        while at_record < at:
            head = file.read(min(HEAD.size, at - at_record))
            opcode, length = Fields(head).numbers(HEAD)
            at_record += HEAD.size + length
            if at_record > at or opcode in _NEVER:
                raise Damage(f'the summary holds a record of kind {opcode}, {length} bytes')
            if opcode in (SCHEMA, CHANNEL, STATISTICS, CHUNK_INDEX):
                if length > MAX_DECLARED_BYTES:
                    raise Damage('a record of the summary has more than '
                                 f'{MAX_DECLARED_BYTES} bytes')
                self._record(opcode, Fields(file.read(length)))
            else:
                file.seek(at_record)
        self.chunks.sort()

    def _footer(self, file: BinaryIO, at: int) -> tuple[int, int]:
        """Where the summary starts (0: nowhere), and its CRC (0: unknown)."""
        file.seek(at)
        tail = file.read(_TAIL)
        if len(tail) < _TAIL or tail[_FOOTER.size:] != MAGIC:
            raise Damage('the file has no end: it was cut off, or the recorder was killed')
        opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
        if (opcode, length) != (FOOTER, _FOOTER.size - HEAD.size) or (
                start and not len(MAGIC) <= start <= at):
            raise Damage('the footer is damaged')
        # The end mark of the data stands before it, in all files but the smallest of examples.
        end = (start or at) - _DATA_END.size
        file.seek(max(end, 0))
        mark = file.read(_DATA_END.size)
        self.data_end = start or at
        if mark[:HEAD.size] == HEAD.pack(DATA_END, 4) and end > 0:
            self.data_mark, self.data_crc = end, _DATA_END.unpack(mark)[2]
        return start, crc

    def _record(self, opcode: int, fields: Fields) -> None:
        if opcode == SCHEMA:
            self.declared.schema(fields)
        elif opcode == CHANNEL:
            self.declared.channel(fields)
        elif opcode == STATISTICS:
            self.total, *_, first, last = fields.numbers('<QHIIIIQQ')
            if 0 < last >= first:
                self.span = first, last
            self.counts = dict(struct.iter_unpack('<HQ', pairs(fields)))
            if self.total and not self.counts:  # not available
                self.counts = None
        else:
            first, last, offset, _ = fields.numbers('<QQQQ')
            held = frozenset(k for k, _ in struct.iter_unpack('<HQ', pairs(fields)))
            self.chunks.add(offset, first if first <= last else MAX_TIME_NS, held)


def peek(file: BinaryIO, at: int, size: int) -> bytes:
    """The bytes at a place, at most so many; none where the size is not positive."""
    if size <= 0:  # the place may be none that a file can have
        return b''
    file.seek(at)
    return file.read(size)


def crc_of(file: BinaryIO, start: int, size: int, crc: int = 0) -> int:
    """The checksum of a stretch of a file, behind one that has `crc`."""
    file.seek(start)
    while size > 0:
        data = file.read(min(size, READ_BYTES))
        if not data:
            raise Damage('the file became shorter while it was read')
        crc, size = zlib.crc32(data, crc), size - len(data)
    return crc
