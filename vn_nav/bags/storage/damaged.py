"""An MCAP file that may be damaged, read from whole record to whole record."""

from __future__ import annotations

import collections
import re
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import BinaryIO

from vn_nav.bags.storage.chunk import ChunkHead, chunk_head, mended_head, right_size, unpack
from vn_nav.bags.storage.damage import Account, Loss
from vn_nav.bags.storage.evidence import (
    COMPRESSIONS,
    DECLARATION_START,
    DELIMITED,
    IN_DATA,
    MESSAGE_START,
    Evidence,
)
from vn_nav.bags.storage.index import Index, index_of
from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FIRST_UNKNOWN_OPCODE,
    FOOTER,
    HEAD,
    HEADER,
    MAX_RECORD_BYTES,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Damage,
    Declared,
    Message,
)
from vn_nav.bags.storage.salvage import Gap, declare, mistaken, salvaged, swallowed
from vn_nav.bags.storage.summary import MAGIC, READ_BYTES, Summary, crc_of, peek

CANDIDATE_COST_BYTES = 256  # bytes of patience that a place costs which only looks like a record
_CHUNK_START = re.compile(rb'\x06.{7}\0.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)', re.DOTALL)
_WITHOUT_MESSAGES = (HEADER, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END)
_MARK = 4  # bytes of the body of the record that ends the data


class DamagedFile:
    """What is whole in a file, in its order; after reading, an account of the rest.

    Args:
        path: of the file.
        file: the same, open.
        limit: where the data end, or the file.
        summary: what the file says of itself.
        declared: the channels that the summary declares.
        losses: those so far; more are appended.
        crc: have the checksum of all records in `crc`.
    """

    def __init__(self, path: Path, file: BinaryIO, limit: int, summary: Summary,
                 declared: Declared, losses: list[Loss], *, crc: bool = False):
        self._file, self._limit, self._ended = file, limit, summary.data_end is not None
        self._chunks, self._declared = summary.chunks, declared
        self._account = Account(path, losses)
        self.unchecked = 0  # messages that no checksum of a chunk covers
        self.passed: collections.Counter[int] = collections.Counter()  # bytes by unknown kind
        self.ahead: int | None = None
        # Of all records; None: some were left out.
        self.crc: int | None = zlib.crc32(MAGIC) if crc else None
        self._chunked = bool(self._chunks)
        self._looked: tuple[int, bool] = -1, False  # whether a chunk is where the index has one
        self._patience = 4 * limit + (64 << 20)  # bytes that may be read in vain
        self._evidence = Evidence(self._peek, limit, declared, IN_DATA, cut=not self._ended,
                                  span=summary.span, first=len(MAGIC))

    def messages(self) -> Iterator[Message]:
        """The messages that are asked for; ends, and never raises `Damage`."""
        at, trusted = len(MAGIC), True
        end: int | None
        while at < self._limit:
            opcode = 0
            try:
                opcode, length = self._kind(at, trusted)
                if opcode == DATA_END and length == _MARK or opcode == FOOTER and length == 20:
                    if self._ended and at + HEAD.size + length < self._limit:
                        raise Damage('the data section ends too early')
                    break
                end = yield from self._record(at, opcode, length, trusted)
                if self.crc is not None:
                    self.crc = crc_of(self._file, at, end - at, self.crc)
                at, trusted = end, True
            except Damage as damage:
                self.crc = None
                self._patience -= damage.cost + CANDIDATE_COST_BYTES
                end = damage.end if trusted else None
                trusted = end is not None
                harmless = trusted and opcode in _WITHOUT_MESSAGES
                if end is None:
                    end = self._search(at + 1)
                    trusted = self._indexed(end)
                chunks = max(int(opcode == CHUNK), self._chunks.between(at, end))
                self._account.lose(at, end, damage.fault, chunks, harmless=harmless)
                at = end

    def _kind(self, at: int, trusted: bool) -> tuple[int, int]:
        """What the record at a place is, and the length that it declares."""
        stated, length = self._head(at)
        opcode = self._evidence.kind(at, stated, length) if trusted else stated
        if opcode != CHUNK and self._indexed(at):
            opcode = CHUNK
        if opcode != stated:
            self._mended(at, mistaken(stated, opcode))
        return opcode, length

    def _record(self, at: int, opcode: int, length: int, trusted: bool
                ) -> Generator[Message, None, int]:
        """The messages of a record; returns where it ends."""
        if opcode == CHUNK:
            self._chunked |= self._is_chunk(at)
            if self._chunks.skips(at):
                self.crc = None
                return self._evidence.delimited_end(at, opcode, length)
            return (yield from self._chunk(at, length, trusted))
        following = self._next_chunk(at + 1)
        if opcode == MESSAGE:
            end = self._evidence.message_end(at)
            if end - at > MAX_RECORD_BYTES or following is not None and end > following:
                raise Damage(f'a message declares {length} bytes, over other records')
            record = self._peek(at, end - at)
            if inner := swallowed(record, MESSAGE_FIELDS.size, len(record), self._declared):
                raise Damage('a message declares a length over others', end=at + inner)
            yield from self._messages(record, at, end)
            return end
        if opcode == HEADER and at == len(MAGIC) or opcode in DELIMITED and opcode != HEADER:
            declares = opcode in (SCHEMA, CHANNEL)
            end = (self._evidence.declaration_end if declares else self._evidence.delimited_end)(
                at, opcode, length)
            if end != at + HEAD.size + length:
                self._mended(at, f'a record of kind {opcode} declares a wrong length')
            if declares:
                if end - at > MAX_RECORD_BYTES:
                    raise Damage(f'a record has more than {MAX_RECORD_BYTES} bytes')
                body = self._peek(at + HEAD.size, end - at - HEAD.size)
                if note := declare(self._declared, opcode, body, end):
                    self._mended(at, note)
                self._tell_disputes(at)
        else:
            end = at + HEAD.size + length
            if end > self._limit or not self._evidence.begins(end):
                raise Damage(f'there is no record of kind {opcode}')
            if opcode < FIRST_UNKNOWN_OPCODE:
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
        if self._chunked and not self._evidence.in_span(log_time):
            raise Damage('a message outside the chunks is of a time that the file does not state',
                         end=end)
        self._account.go_on((log_time, log_time))
        connection = self._declared.chosen[channel]
        if connection is not None:
            self._declared.read[channel] += 1
            self.unchecked += 1
            yield Message(connection, sequence, log_time, publish_time,
                          record[MESSAGE_FIELDS.size:])

    def _chunk(self, at: int, length: int, trusted: bool) -> Generator[Message, None, int]:
        """The messages of a chunk; returns where it ends."""
        data, head, end = self._unpacked(at, length)
        sure = bool(head.crc)
        index = Index({}, []) if sure else index_of(
            self._peek, self._evidence, end, data, self._declared, self._chunks.held(at),
            head.span)
        span = None if head.span == (0, 0) else head.span
        if not (trusted or sure) and any(isinstance(part, Gap) for part in salvaged(
                data, self._declared.again(lambda _: True, forgiving=True), index.messages,
                span=span)):  # it may only look like a chunk
            raise Damage('a chunk is not whole')
        self._account.go_on(head.span)
        self.ahead = self._chunks.ahead(at) if at in self._chunks else self.ahead
        for fault in index.faults:
            self._mended(end, fault)
        for part in salvaged(data, self._declared, index.messages, sure=sure, span=span):
            if isinstance(part, Gap) and part.start == part.end:
                self._mended(at, part.fault)
            elif isinstance(part, Gap):
                self.crc = None
                begin = None if head.compression else at + HEAD.size + head.at
                self._account.lose_within(begin, at, part, head.span)
            else:
                self.unchecked += not sure
                yield part
        self._tell_disputes(at)
        return end

    def _unpacked(self, at: int, length: int) -> tuple[bytes, ChunkHead, int]:
        """The records of a chunk, its fields, where it ends: what two of three lengths say."""
        head, mended = mended_head(self._peek(at + HEAD.size, 64), length)
        begin = at + HEAD.size + head.at
        rest = length - head.at
        following = self._next_chunk(at + 1)
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
            if size > MAX_RECORD_BYTES:
                raise Damage(f'a chunk has {size} bytes, more than {MAX_RECORD_BYTES}')
            stored = self._peek(begin, size)
            right = right_size(head, stored)
            data = unpack(memoryview(stored), right)
        except Damage as damage:
            raise Damage(damage.fault, end=end, cost=damage.cost) from damage
        if mended or right != head or end != at + HEAD.size + length:
            self._mended(at, 'a chunk declares a wrong length or checksum')
        return data, right, end

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode and length of the record at a place."""
        head = self._peek(at, HEAD.size)
        if len(head) < HEAD.size:
            raise Damage('the file ends within a record')
        return HEAD.unpack(head)

    def _peek(self, at: int, size: int) -> bytes:
        return peek(self._file, at, min(size, self._limit - at))

    def _search(self, at: int) -> int:
        """Where the next chunk begins, by the index or by its looks; `limit`: nowhere.

        A file without chunks has its messages and declarations searched as well.
        """
        known = self._next_chunk(at)
        if self._patience <= 0:
            return self._limit
        if known is not None and known < self._limit:
            return known
        patterns = (_CHUNK_START, MESSAGE_START, DECLARATION_START)[:1 if self._chunked else 3]
        while at < self._limit and self._patience > 0:
            data = self._peek(at, READ_BYTES)
            found = min((place for pattern in patterns if (
                place := self._first(pattern, data, at)) is not None), default=None)
            if found is not None:
                return found
            if len(data) < READ_BYTES:
                break
            at += READ_BYTES - 64  # a pattern may lie across the edge
        return self._limit

    def _first(self, pattern: re.Pattern, data: bytes, base: int) -> int | None:
        """The first place that looks like a record and is believed."""
        position = 0
        while (match := pattern.search(data, position)) and self._patience > 0:
            at, position = base + match.start(), match.start() + 1
            self._patience -= CANDIDATE_COST_BYTES
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
                        and max(head.size, length) <= MAX_RECORD_BYTES)
            self._evidence.message_end(at)
            return self._evidence.begins(at, self._account.seen, 0)
        except Damage:
            return False

    def _next_chunk(self, at: int) -> int | None:
        """The first place at or behind this one where the index has a chunk, and one is."""
        while (place := self._chunks.next(at)) is not None and not self._is_chunk(place):
            at = place + 1
        return place

    def _indexed(self, at: int) -> bool:
        return at in self._chunks and self._is_chunk(at)

    def _is_chunk(self, at: int) -> bool:
        """Whether a chunk begins at a place, by its opcode and fields or by the latter alone."""
        if self._looked[0] != at:
            head = self._peek(at, 64)
            found = False
            if len(head) >= HEAD.size:
                opcode, length = HEAD.unpack_from(head)
                found = (opcode == CHUNK and (length <= self._limit - at - HEAD.size
                                              or head[HEAD.size + 28:].startswith(COMPRESSIONS))
                         or self._evidence.kind(at, opcode, length) == CHUNK)
            self._looked = at, found
        return self._looked[1]

    def _tell_disputes(self, at: int) -> None:
        for fault, sure in self._declared.disputes:
            self._account.fault(at, fault, harmless=sure)
            self.crc = None
        self._declared.disputes.clear()

    def _mended(self, at: int, note: str) -> None:
        """Note a fault that cost nothing."""
        self.crc = None
        self._account.fault(at, note)
