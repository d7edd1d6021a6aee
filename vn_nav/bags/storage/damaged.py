"""An MCAP file that may be damaged, read from whole record to whole record."""

from __future__ import annotations

import collections
import dataclasses
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEAD,
    HEADER,
    MAX_RECORD,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    UNKNOWN,
    ChunkHead,
    Damage,
    Declared,
    Fields,
    Message,
    chunk_head,
    unpack,
)
from vn_nav.bags.storage.salvage import (
    DECLARATION_START,
    DELIMITED,
    IN_DATA,
    LOOK,
    MESSAGE_START,
    Evidence,
    Gap,
    declare,
    salvaged,
    swallowed,
)
from vn_nav.bags.storage.summary import MAGIC, WINDOW, Chunks, crc_of

MAX_LOSSES = 1000  # that are told one by one
CANDIDATE = 256  # bytes of patience that a place costs which only looks like a record
_CHUNK_START = re.compile(rb'\x06.{7}\0.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)', re.DOTALL)
_WITHOUT_MESSAGES = (HEADER, MESSAGE_INDEX, ATTACHMENT, METADATA)
_ENTRY = 16  # bytes that a message takes in an index: less than in a chunk


@dataclasses.dataclass
class Loss:
    """A stretch of a file that could not be used, or another fault of it (0 bytes)."""

    path: Path
    offset: int
    size: int  # bytes
    reason: str
    chunks: int = 0  # that are known to have been there
    messages: int | None = None  # that are known to have been there
    harmless: bool = False  # no message can have been in it
    before: int | None = None  # ns, time of the last message before
    after: int | None = None  # ns, time of the first message after


class DamagedFile:
    """What is whole in a file, in its order; after reading, an account of the rest.

    Args:
        path: of the file.
        file: the same, open.
        limit: where the data end, or the file.
        ended: `limit` is where the data end.
        crc: have the checksum of all records in `crc`.
        chunks: where chunks begin, as far as the summary says.
        declared: the channels that the summary declares.
    """

    def __init__(self, path: Path, file: BinaryIO, limit: int, chunks: Chunks,
                 declared: Declared, *, ended: bool, crc: bool = False):
        self._path, self._file, self._limit, self._ended = path, file, limit, ended
        self._chunks, self._declared = chunks, declared
        self.losses: list[Loss] = []
        self.count = 0  # messages
        self.unchecked = 0  # messages that no checksum of a chunk covers
        self.passed: collections.Counter[int] = collections.Counter()  # bytes by unknown kind
        self.ahead: int | None = None
        # Of all records; None: some were left out.
        self.crc: int | None = zlib.crc32(MAGIC) if crc else None
        self._seen: int | None = None  # ns
        self._chunked = bool(chunks)
        self._patience = 4 * limit + (64 << 20)  # bytes that may be read in vain
        self._evidence = Evidence(self._peek, limit, declared, IN_DATA, cut=not ended)

    def messages(self) -> Iterator[Message]:
        """The messages that are asked for; ends, and never raises `Damage`."""
        at, trusted = len(MAGIC), True
        while at < self._limit:
            opcode = 0
            try:
                opcode, length = self._head(at)
                if opcode != CHUNK and at in self._chunks:
                    self._mended(at, f'a chunk, by the index, has the kind {opcode}')
                    opcode = CHUNK
                if opcode in (DATA_END, FOOTER) and length == (4 if opcode == DATA_END else 20):
                    if self._ended:
                        raise Damage('the data end before their end')
                    break
                end = yield from self._record(at, opcode, length, trusted)
                if self.crc is not None:
                    self.crc = crc_of(self._file, at, end - at, self.crc)
                at, trusted = end, True
            except Damage as damage:
                self.crc = None
                self._patience -= damage.cost + CANDIDATE
                end = damage.end if trusted else None
                trusted = end is not None
                harmless = trusted and opcode in _WITHOUT_MESSAGES
                if end is None:
                    end = self._search(at + 1)
                    trusted = end in self._chunks
                self._lose(at, end, damage.fault, opcode, harmless)
                at = end

    def _record(self, at: int, opcode: int, length: int, trusted: bool
                ) -> Iterator[Message]:
        """The messages of a record; returns where it ends."""
        if opcode == CHUNK:
            self._chunked = True
            if self._chunks.skips(at):
                self.crc = None
                return self._evidence.delimited_end(at, opcode, length)
            return (yield from self._chunk(at, length, trusted))
        following = self._chunks.next(at + 1)
        if opcode == MESSAGE:
            end = self._evidence.message_end(at)
            if end - at > MAX_RECORD or following is not None and end > following:
                raise Damage(f'a message declares {length} bytes, over other records')
            record = self._peek(at, end - at)
            if inner := swallowed(record, MESSAGE_FIELDS.size, len(record), self._declared):
                raise Damage('a message declares a length over others', end=at + inner)
            yield from self._messages(record, at, end)
            return end
        if opcode == HEADER and at == len(MAGIC) or opcode in DELIMITED and opcode != HEADER:
            end = self._evidence.delimited_end(at, opcode, length)
            if end != at + HEAD.size + length:
                self._mended(at, f'a record of kind {opcode} declares a wrong length')
            if opcode in (SCHEMA, CHANNEL):
                if end - at > MAX_RECORD:
                    raise Damage(f'a record has more than {MAX_RECORD} bytes')
                declare(self._declared, opcode, self._peek(at + HEAD.size, end - at - HEAD.size),
                        end)
        else:
            end = at + HEAD.size + length
            if end > self._limit or not self._evidence.begins(end):
                raise Damage(f'there is no record of kind {opcode}')
            if opcode < UNKNOWN:
                raise Damage(f'a record of kind {opcode} does not belong here', end=end)
            self.passed[opcode] += end - at
        if following is not None and end > following:
            raise Damage(f'a record of kind {opcode} declares {length} bytes, over a chunk')
        return end

    def _messages(self, record: bytes, at: int, end: int) -> Iterator[Message]:
        """The message of a record, if it is asked for."""
        _, _, channel, sequence, log_time, publish_time = MESSAGE_FIELDS.unpack_from(record)
        if channel not in self._declared.chosen:
            raise Damage(self._declared.unknown(channel), end=end)
        self._go_on((log_time, log_time))
        connection = self._declared.chosen[channel]
        if connection is not None:
            self.count += 1
            self.unchecked += 1
            yield Message(connection, sequence, log_time, publish_time,
                          record[MESSAGE_FIELDS.size:])

    def _chunk(self, at: int, length: int, trusted: bool) -> Iterator[Message]:
        """The messages of a chunk; returns where it ends."""
        data, head, end = self._unpacked(at, length)
        sure = bool(head.crc)
        index = {} if sure else self._index(end, len(data))
        if not (trusted or sure) and any(isinstance(part, Gap) for part in salvaged(
                data, self._declared, index)):  # it may only look like a chunk
            raise Damage('a chunk is not whole')
        self._go_on(head.span)
        self.ahead = self._chunks.ahead(at) if at in self._chunks else self.ahead
        for part in salvaged(data, self._declared, index, sure=sure):
            if isinstance(part, Gap) and part.start == part.end:
                self._mended(at, part.fault)
            elif isinstance(part, Gap):
                self.crc = None
                self._lose_within(at, head, part)
            else:
                self.count += 1
                self.unchecked += not sure
                yield part
        return end

    def _unpacked(self, at: int, length: int) -> tuple[bytes, ChunkHead, int]:
        """The records of a chunk, its fields, where it ends: what two of three lengths say."""
        head, mended = _head_of(self._peek(at + HEAD.size, 64), length)
        begin = at + HEAD.size + head.at
        rest = length - head.at
        following = self._chunks.next(at + 1)
        top = self._limit if following is None else min(following, self._limit)
        sizes = [head.stored, rest] + [head.size] * (head.compression == '')
        believed = [size for size in dict.fromkeys(sizes) if 0 <= size <= top - begin and (
            sizes.count(size) > 1 or self._evidence.begins(begin + size))]
        if not believed:
            raise Damage(f'a chunk declares {length} and {head.stored} bytes, and {top - at} are '
                         'left' if min(length, head.stored) > top - begin else
                         f'a chunk declares {length} and {head.stored} bytes, and no record '
                         'follows')
        size = believed[0]
        end = begin + size
        if size < rest <= top - begin and not self._evidence.begins(end) and (
                self._evidence.begins(begin + rest)):
            end = begin + rest  # fields of a later version
        try:
            if size > MAX_RECORD:
                raise Damage(f'a chunk has {size} bytes, more than {MAX_RECORD}')
            stored = self._peek(begin, size)
            right = _right_size(head, stored)
            data = unpack(memoryview(stored), right)
        except Damage as damage:
            raise Damage(damage.fault, end=end, cost=damage.cost) from damage
        if mended or right != head or end != at + HEAD.size + length:
            self._mended(at, 'a chunk declares a wrong length')
        return data, head, end

    def _index(self, at: int, size: int) -> dict[int, tuple[int, int]]:
        """Channel and time [ns] of the messages of a chunk that ends here, by their place."""
        found: dict[int, tuple[int, int]] = {}
        left = size // _ENTRY + 64 * HEAD.size
        while left > 0:
            head = self._peek(at, HEAD.size)
            if len(head) < HEAD.size or head[0] != MESSAGE_INDEX:
                break
            try:
                end = self._evidence.delimited_end(at, *HEAD.unpack(head))
                if end - at > size + LOOK:
                    break
                fields = Fields(self._peek(at + HEAD.size, end - at - HEAD.size))
                channel, = fields.numbers('<H')
                entries = Fields(fields.data())
                while entries.left:
                    time, place = entries.numbers('<QQ')
                    found[place] = channel, time
                    left -= 1
            except Damage as damage:
                if damage.end is None:
                    break
                end = damage.end
            at, left = end, left - 1
        return found

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode and length of the record at a place."""
        head = self._peek(at, HEAD.size)
        if len(head) < HEAD.size:
            raise Damage('the file ends within a record')
        return HEAD.unpack(head)

    def _peek(self, at: int, size: int) -> bytes:
        self._file.seek(at)
        return self._file.read(max(min(size, self._limit - at), 0))

    def _search(self, at: int) -> int:
        """Where the next chunk begins, by the index or by its looks; `limit`: nowhere.

        A file without chunks has its messages and declarations searched as well.
        """
        known = self._chunks.next(at)
        if self._patience <= 0 or known is not None and known < self._limit:
            return self._limit if self._patience <= 0 else known
        patterns = (_CHUNK_START, MESSAGE_START, DECLARATION_START)[:1 if self._chunked else 3]
        while at < self._limit and self._patience > 0:
            data = self._peek(at, WINDOW)
            found = min((place for pattern in patterns if (
                place := self._first(pattern, data, at)) is not None), default=None)
            if found is not None:
                return found
            if len(data) < WINDOW:
                break
            at += WINDOW - 64  # a pattern may lie across the edge
        return self._limit

    def _first(self, pattern: re.Pattern, data: bytes, base: int) -> int | None:
        """The first place that looks like a record and is believed."""
        position = 0
        while (match := pattern.search(data, position)) and self._patience > 0:
            at, position = base + match.start(), match.start() + 1
            self._patience -= CANDIDATE
            if self._looks_right(at, pattern):
                return at
        return None

    def _looks_right(self, at: int, pattern: re.Pattern) -> bool:
        try:
            _, length = self._head(at)
            if pattern is DECLARATION_START:
                return self._evidence.declares(at)
            if pattern is _CHUNK_START:
                head = chunk_head(self._peek(at + HEAD.size, 64))
                return (head.stored == length - head.at and length <= self._limit - at - HEAD.size
                        and max(head.size, length) <= MAX_RECORD)
            self._evidence.message_end(at)
            return self._evidence.begins(at, self._seen, 0)
        except Damage:
            return False

    def _go_on(self, span: tuple[int, int]) -> None:
        """Note that the messages of a time [ns] follow."""
        start, end = span
        if start > end or (start, end) == (0, 0):  # a chunk without messages
            return
        if self.losses and self.losses[-1].after is None and self.losses[-1].size:
            self.losses[-1].after = start
        self._seen = end if self._seen is None else max(self._seen, end)

    def _mended(self, at: int, words: str) -> None:
        """Note a fault that cost nothing."""
        self.crc = None
        if len(self.losses) < MAX_LOSSES:
            self.losses.append(Loss(self._path, at, 0, words, harmless=True))

    def _lose(self, start: int, end: int, fault: str, opcode: int, harmless: bool) -> None:
        chunks = max(int(opcode == CHUNK), self._chunks.between(start, end))
        last = self.losses[-1] if self.losses else None
        if last is not None and (len(self.losses) >= MAX_LOSSES or (
                last.size and last.offset + last.size == start)):
            last.size += end - start
            last.chunks += chunks
            last.after = last.messages = None
            last.harmless &= harmless
        else:
            self.losses.append(Loss(self._path, start, end - start, fault, chunks,
                                    harmless=harmless, before=self._seen))

    def _lose_within(self, at: int, head: ChunkHead, gap: Gap) -> None:
        """Note bytes of a chunk's records; the place is exact where they are not compressed."""
        place = f'byte {gap.start} of the records of a chunk: {gap.fault}'
        if not head.compression:
            at, place = at + HEAD.size + head.at + gap.start, f'in a chunk: {gap.fault}'
        if len(self.losses) >= MAX_LOSSES:
            self.losses[-1].size += gap.end - gap.start
            self.losses[-1].messages, self.losses[-1].harmless = None, False
        else:
            self.losses.append(Loss(self._path, at, gap.end - gap.start, place,
                                    messages=gap.messages, before=head.span[0],
                                    after=head.span[1]))


def _head_of(body: bytes, length: int) -> tuple[ChunkHead, bool]:
    """The fields of a chunk, and whether the name of its compression had to be mended.

    It is the one that lets the lengths agree.
    """
    for name in (b'', b'lz4', b'zstd'):
        begin = 28 + 4 + len(name)
        if int.from_bytes(body[begin:begin + 8], 'little') == length - begin - 8:
            right = body[:28] + len(name).to_bytes(4, 'little') + name + body[begin:]
            return chunk_head(right), right != body
    return chunk_head(body), False


def _right_size(head: ChunkHead, stored: bytes) -> ChunkHead:
    """The fields with the size of the records mended, where one bit of it is wrong."""
    size = len(stored)
    try:
        if head.compression == 'zstd':
            size = zstandard.frame_content_size(stored)
        elif head.compression == 'lz4':
            size = lz4.frame.get_frame_info(stored)['content_size']
    except (zstandard.ZstdError, RuntimeError, ValueError):
        return head
    return head._replace(size=size) if size > 0 and (size ^ head.size).bit_count() == 1 else head
