"""One MCAP file as a stream of messages; damage is an error, or passed over and accounted for."""

from __future__ import annotations

import bisect
import dataclasses
import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from vn_nav.bags.mcap_records import (
    A_BAG,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEAD,
    HEADER,
    MAX_RECORD,
    MAX_TIME,
    MESSAGE,
    PRIVATE,
    SCHEMA,
    STATISTICS,
    BagError,
    Connection,
    Damage,
    Declared,
    Fields,
    Message,
    chunk_fields,
    pairs,
    records,
    unpacked,
    words,
)

MAGIC = b'\x89MCAP0\r\n'
MAX_SUMMARY = 64 << 20  # bytes; the index of a longer one is not used, and nothing is skipped
MAX_LOSSES = 1000  # that are told one by one
WINDOW = 1 << 20  # bytes that are searched at a time
CANDIDATE = 256  # bytes of patience that a place costs which only looks like a record
_FOOTER = struct.Struct('<BQQQI')  # head, start of the summary, of its offsets, CRC
_TAIL = _FOOTER.size + len(MAGIC)
_DATA_END = struct.Struct('<BQI')  # head, CRC
_CHUNK_START = re.compile(rb'\x06.{7}\0.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)', re.DOTALL)
_MESSAGE_START = re.compile(rb'\x05.{4}\0{4}.{22}', re.DOTALL)


@dataclasses.dataclass
class Loss:
    """A stretch of a file that could not be used, or another fault of it (0 bytes)."""

    path: Path
    offset: int
    size: int  # bytes
    reason: str
    chunks: int = 0  # that are known to have been there
    harmless: bool = False  # no message can have been in it
    before: int | None = None  # ns, time of the last message before
    after: int | None = None  # ns, time of the first message after


class McapFile:
    """An MCAP file; reading begins with `messages`.

    Args:
        path: of the file.
        strict: damage is an error. Otherwise it is passed over, to the next chunk that is whole,
            and `losses` and `missing` tell of it.

    Raises:
        BagError: no such file; if strict, also one without its end, or with a bad index.
    """

    def __init__(self, path: str | Path, *, strict: bool = True):
        self.path, self.strict = Path(path), strict
        self.losses: list[Loss] = []
        self.missing: int | None = None  # messages that the file counts and that were not read
        self.counts: dict[int, int] | None = None  # messages by channel, as the file counts them
        self._total: int | None = None
        self._declared = Declared(self.path, _every)
        self._chunks: dict[int, frozenset[int]] = {}  # channels in the chunk at an offset
        self._starts: dict[int, int] = {}  # ns, time of the first message in it
        self.ahead: int | None = None  # ns, before which nothing is still to be read, if known
        self._data_end: int | None = None
        self._data_crc = 0
        try:
            if not self.path.is_file():
                raise BagError(path, 'no such file', rule=A_BAG,
                               remedy='give the path of a recording')
            with open(self.path, 'rb') as file:
                self._size = os.fstat(file.fileno()).st_size
                self._look_at_the_ends(file)
        except (OSError, MemoryError) as error:
            raise BagError(path, words(error)) from error
        self._opening = list(self.losses)
        self._offsets = sorted(self._chunks)

    @property
    def start(self) -> int | None:
        """When the first message was recorded [ns], by the index; None: unknown."""
        return min(self._starts.values(), default=None)

    @property
    def channels(self) -> dict[int, Connection]:
        """The channels that the summary declares, by number."""
        return self._declared.channels

    def messages(self, topics: frozenset[str] | None = None) -> Iterator[Message]:
        """The messages in the order of the file.

        Args:
            topics: names without the leading slash; None: all. Chunks that hold none of them are
                not decompressed, if the file has an index.

        Raises:
            BagError: damage, if strict; or a file that cannot be read at all.
        """
        wanted = _every if topics is None else lambda name: name.lstrip('/') in topics
        self.losses, self.ahead = list(self._opening), None
        try:
            with open(self.path, 'rb') as file:
                yield from self._messages(file, self._declared.again(wanted))
        except (OSError, MemoryError) as error:
            raise BagError(self.path, words(error)) from error

    def _look_at_the_ends(self, file: BinaryIO) -> None:
        """Check the first and last bytes, and read the summary that the last point to."""
        if file.read(len(MAGIC)) != MAGIC:
            if self.strict:
                raise BagError(self.path, 'does not begin as an MCAP file does', 0, rule=A_BAG,
                               remedy='give the path of a recording')
            self.losses.append(Loss(self.path, 0, 0, 'does not begin as an MCAP file does',
                                    harmless=True))
        at = self._size
        try:
            at = max(self._size - _TAIL, 0)
            start, crc = self._footer(file, at)
            if start and at - start <= MAX_SUMMARY:
                self._read_summary(file, start, at, crc)
        except Damage as damage:
            if self.strict:
                raise BagError(self.path, damage.fault, at) from damage
            self.losses.append(Loss(self.path, at, 0, damage.fault, harmless=True))
            self._declared = Declared(self.path, _every)  # or half of it
            self._chunks, self._starts, self.counts, self._total = {}, {}, None, None

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
        end = (start or at) - _DATA_END.size
        file.seek(max(end, 0))
        mark = file.read(_DATA_END.size)
        if len(mark) < _DATA_END.size or mark[:HEAD.size] != HEAD.pack(DATA_END, 4):
            raise Damage('the data have no end mark before the summary')
        self._data_end, self._data_crc = end, _DATA_END.unpack(mark)[2]
        return start, crc

    def _read_summary(self, file: BinaryIO, start: int, end: int, crc: int) -> None:
        file.seek(start)
        data = file.read(end + _FOOTER.size - start)
        # The CRC is of everything up to itself.
        if crc and zlib.crc32(data[:-4]) != crc:
            raise Damage('the checksum of the summary does not match')
        at, end, sets = 0, end - start, {}
        while at < end:
            opcode, length = Fields(data, at).numbers(HEAD)
            at += HEAD.size
            if length > end - at:
                raise Damage('a record of the summary goes beyond its end')
            fields = Fields(data[at:at + length])
            if opcode == SCHEMA:
                self._declared.schema(fields)
            elif opcode == CHANNEL:
                self._declared.channel(fields)
            elif opcode == STATISTICS:
                self._total, *_ = fields.numbers('<QHIIIIQQ')
                self.counts = dict(struct.iter_unpack('<HQ', pairs(fields)))
            elif opcode == CHUNK_INDEX:
                first, last, offset, _ = fields.numbers('<QQQQ')
                if first <= last:  # it has messages
                    self._starts[offset] = first
                held = frozenset(k for k, _ in struct.iter_unpack('<HQ', pairs(fields)))
                self._chunks[offset] = sets.setdefault(held, held)
            at += length

    def _messages(self, file: BinaryIO, declared: Declared) -> Iterator[Message]:
        unwanted = {number for number, chosen in declared.chosen.items() if chosen is None}
        skipped = {at for at, held in self._chunks.items() if held and held <= unwanted}
        crc = zlib.crc32(MAGIC) if self._data_crc and not skipped else None
        ahead = self._look_ahead(skipped)
        limit = self._size if self._data_end is None else self._data_end
        patience = [4 * self._size + (64 << 20)]  # bytes that may be read in vain
        at, count, chunked, trusted = len(MAGIC), 0, bool(self._chunks), True
        seen: int | None = None
        while at < limit:
            opcode, end = 0, at
            try:
                opcode, length, head = self._head(file, at, limit)
                end = at + HEAD.size + length
                chunked |= opcode == CHUNK
                if opcode == CHUNK and at not in skipped:
                    body = _read(file, length)
                    crc = None if crc is None else zlib.crc32(body, zlib.crc32(head, crc))
                    data, span = unpacked(body)
                    seen = self._go_on(span, seen)
                    del body
                    self.ahead = ahead.get(at, self.ahead)
                    if not trusted:  # it may only look like a chunk: believe it whole or not
                        for _ in records(data, declared):
                            pass
                    for message in records(data, declared):
                        count += 1
                        yield message
                elif opcode in (SCHEMA, CHANNEL, MESSAGE):
                    record = head + _read(file, length)
                    crc = None if crc is None else zlib.crc32(record, crc)
                    for message in records(record, declared):
                        seen = self._go_on((message.log_time, message.log_time), seen)
                        count += 1
                        yield message
                elif opcode in (DATA_END, FOOTER):
                    if self._data_end is not None or length not in (4, 20):
                        raise Damage('the data end before their end')
                    break
                elif crc is not None:
                    crc = _crc_of(file, length, zlib.crc32(head, crc))
                at, trusted = end, True
            except Damage as damage:
                if self.strict:
                    raise BagError(self.path, damage.fault, at) from damage
                crc, start = None, at
                patience[0] -= damage.cost + CANDIDATE
                believed = damage.whole and trusted and self._plausible(file, end, limit)
                at, trusted = (end, True) if believed else (self._next_record(
                    file, at + 1, limit, None if chunked else declared, patience), False)
                self._lose(start, at, damage.fault, opcode == CHUNK, seen)
        self._account(count, crc, declared)

    def _look_ahead(self, skipped: set[int]) -> dict[int, int]:
        """Of each chunk the earliest time [ns] in it and in those that follow it."""
        ahead, earliest = {}, MAX_TIME
        for offset in reversed(self._offsets):
            if offset not in skipped:
                earliest = min(earliest, self._starts.get(offset, MAX_TIME))
            ahead[offset] = earliest
        return ahead

    def _head(self, file: BinaryIO, at: int, limit: int) -> tuple[int, int, bytes]:
        """Opcode and length of the record at a place, and the bytes that they stand in."""
        file.seek(at)
        head = file.read(HEAD.size)
        left = limit - at - HEAD.size
        if len(head) < HEAD.size or left < 0:
            raise Damage('the file ends within a record')
        opcode, length = HEAD.unpack(head)
        if not HEADER <= opcode <= DATA_END and opcode < PRIVATE:
            raise Damage(f'there is no record of kind {opcode}')
        if length > left:
            raise Damage(f'a record declares {length} bytes where {left} are left')
        if length > MAX_RECORD and opcode in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
            raise Damage(f'a record has {length} bytes, more than {MAX_RECORD}')
        return opcode, length, head

    def _plausible(self, file: BinaryIO, at: int, limit: int) -> bool:
        try:
            return at == limit or self._head(file, at, limit)[0] < PRIVATE
        except Damage:
            return False

    def _next_record(self, file: BinaryIO, at: int, limit: int, declared: Declared | None,
                     patience: list[int]) -> int:
        """Where the next chunk begins, by the index or by its looks; `limit`: nowhere.

        A file without chunks has its messages searched instead, those of `declared` channels.
        """
        if patience[0] <= 0:
            return limit
        known = bisect.bisect_left(self._offsets, at)
        if known < len(self._offsets) and self._offsets[known] < limit:
            return self._offsets[known]
        while at < limit and patience[0] > 0:
            file.seek(at)
            data = file.read(min(WINDOW, limit - at))
            for pattern in (_CHUNK_START, _MESSAGE_START)[:1 if declared is None else 2]:
                position = 0
                while (match := pattern.search(data, position)) and patience[0] > 0:
                    found, position = at + match.start(), match.start() + 1
                    patience[0] -= CANDIDATE
                    if self._looks_right(file, found, limit, declared):
                        return found
            if len(data) < WINDOW:
                break
            at += WINDOW - 64  # a pattern may lie across the edge
        return limit

    def _looks_right(self, file: BinaryIO, at: int, limit: int, declared: Declared | None
                     ) -> bool:
        try:
            opcode, length, head = self._head(file, at, limit)
            end = at + HEAD.size + length
            if opcode == CHUNK:
                chunk_fields(file.read(min(length, 64)), length)
                return True
            channel = int.from_bytes(file.read(2), 'little')
            return channel in declared.channels and self._plausible(file, end, limit)
        except Damage:
            return False

    def _go_on(self, span: tuple[int, int], seen: int | None) -> int | None:
        """Note that the messages of a time [ns] follow; the time of the last one so far."""
        start, end = span
        if start > end:  # a chunk without messages
            return seen
        if self.losses and self.losses[-1].after is None and self.losses[-1].size:
            self.losses[-1].after = start
        return end if seen is None else max(seen, end)

    def _lose(self, start: int, end: int, fault: str, chunk: bool, seen: int | None) -> None:
        known = [bisect.bisect_left(self._offsets, offset) for offset in (start, end)]
        chunks = max(int(chunk), known[1] - known[0])
        last = self.losses[-1] if self.losses else None
        if last is not None and (len(self.losses) >= MAX_LOSSES or (
                last.size and last.offset + last.size == start)):
            last.size += end - start
            last.chunks += chunks
            last.after = None
        else:
            self.losses.append(Loss(self.path, start, end - start, fault, chunks, before=seen))

    def _account(self, count: int, crc: int | None, declared: Declared) -> None:
        """Compare what was read with what the file says of itself."""
        expected = self._total
        if any(chosen is None for chosen in declared.chosen.values()):
            expected = None if self.counts is None else sum(
                self.counts.get(k, 0) for k, c in declared.chosen.items() if c is not None)
        self.missing = None if expected is None else expected - count
        faults = []
        if self.missing:
            faults.append(f'it counts {expected} messages, and {count} were read')
        if crc is not None and crc != self._data_crc:
            faults.append('the checksum of its data does not match')
        for fault in faults:
            if self.strict:
                raise BagError(self.path, fault)
            if not any(loss.size for loss in self.losses):
                self.losses.append(Loss(self.path, 0, 0, fault))


def _every(_: str) -> bool:
    return True


def _read(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise Damage('the file became shorter while it was read')
    return data


def _crc_of(file: BinaryIO, size: int, crc: int) -> int:
    while size > 0:
        data = _read(file, min(size, WINDOW))
        crc, size = zlib.crc32(data, crc), size - len(data)
    return crc
