"""What can be believed of records that no checksum covers.

A length that was damaged makes one message out of several, or cuts one: such a message never
existed. A length is therefore believed where another record begins behind it. The index of a
chunk's messages says where they begin, and so where to go on.
"""

from __future__ import annotations

import bisect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    HEAD,
    HEADER,
    MAX_NAME,
    MAX_TIME,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_INDEX,
    METADATA,
    NEVER_IN_CHUNKS,
    SCHEMA,
    UNKNOWN,
    Damage,
    Declared,
    Fields,
    Message,
)

NEAR = 86_400 * 10**9  # ns between neighbours in a file, at most, where time is evidence
LOOK = 128  # bytes of a record that are enough to tell what it is
STEPS = 4  # unknown records in a row that are believed
TRIES = 64  # places that look like a message and are looked at, within another or after damage
CHAIN = 50_000  # messages that one may have swallowed, at most, to be found out
COMPRESSIONS = (b'\0\0\0\0', b'\3\0\0\0lz4', b'\4\0\0\0zstd')
MESSAGE_START = re.compile(rb'\x05.{4}\0{4}.{22}', re.DOTALL)
DECLARATION_START = re.compile(rb'[\3\4].{4}\0{4}', re.DOTALL)
# Kinds that say themselves where they end: bytes before texts, texts, a long text, bytes behind.
DELIMITED = {
    HEADER: (0, 2, False, 0),
    SCHEMA: (2, 3, False, 0),
    CHANNEL: (4, 3, False, 0),
    CHUNK: (28, 1, True, 0),
    MESSAGE_INDEX: (2, 1, False, 0),
    METADATA: (0, 2, False, 0),
    ATTACHMENT: (16, 2, True, 4)}
IN_CHUNKS = frozenset((SCHEMA, CHANNEL, MESSAGE))
IN_DATA = IN_CHUNKS | {CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END}


class Gap(NamedTuple):
    """Bytes of a chunk's records that could not be used; none where a length was mended."""

    start: int
    end: int
    fault: str
    messages: int | None  # that began there, by the index; None: unknown


class Evidence:
    """Whether a record begins at a place, by what stands there.

    Args:
        peek: the bytes at a place, at most so many.
        limit: where the records end.
        declared: the channels so far.
        kinds: that may occur.
        anchors: sorted places where messages begin without doubt.
        cut: the records may end within one.
    """

    def __init__(self, peek: Callable[[int, int], bytes], limit: int, declared: Declared,
                 kinds: frozenset[int], anchors: Sequence[int] = (), *, cut: bool = False):
        self._peek, self._limit, self._declared = peek, limit, declared
        self._kinds, self.anchors, self._cut = kinds, anchors, cut

    def begins(self, at: int, near: int | None = None, steps: int = STEPS) -> bool:
        """Whether a record begins here, or the records end.

        Args:
            at: the place.
            near: time [ns] of a message nearby; None: of its own, the other one.
            steps: unknown records that may lead to one that is known.
        """
        if at == self._limit or self._anchored(at):
            return True
        if at > self._limit:
            return False
        head = self._peek(at, min(LOOK, self._limit - at))
        if len(head) < HEAD.size:
            return self._cut and head[0] in self._kinds and not any(head[5:])
        opcode, length = HEAD.unpack_from(head)
        fits = length <= self._limit - at - HEAD.size
        if self._message(head, fits, near):
            return True
        if opcode >= UNKNOWN:
            return fits and steps > 0 and self.begins(at + HEAD.size + length, near, steps - 1)
        if opcode not in self._kinds or opcode == MESSAGE:
            return self._cut and len(head) < MESSAGE_FIELDS.size and opcode == MESSAGE
        body = head[HEAD.size:]
        if opcode == CHUNK:
            return body[28:].startswith(COMPRESSIONS)
        if opcode == DATA_END:
            return length == 4
        before, *_ = DELIMITED[opcode]
        size = int.from_bytes(body[before:before + 4], 'little')
        if not fits and not self._cut or before + 4 + size > length:
            return False
        text = body[before + 4:before + 4 + size]
        return size % 16 == 0 if opcode == MESSAGE_INDEX else (
            size <= MAX_NAME and not any(byte < 32 for byte in text))

    def message_end(self, at: int) -> int:
        """Where the message at a place ends.

        Raises:
            Damage: its length is not believed, nor what else stands there.
        """
        head = self._peek(at, MESSAGE_FIELDS.size)
        if len(head) < MESSAGE_FIELDS.size:
            raise Damage('the records end within a message')
        _, length, _, _, log_time, publish_time = MESSAGE_FIELDS.unpack(head)
        end = at + HEAD.size + length
        following = self.anchor(at + 1)
        if (length < MESSAGE_FIELDS.size - HEAD.size or log_time > MAX_TIME
                or publish_time > MAX_TIME or end > self._limit
                or following is not None and end > following):
            raise Damage(f'a message declares {length} bytes, over the next record')
        if not self.begins(end, log_time):
            raise Damage(f'a message declares {length} bytes, and no record follows it')
        return end

    def delimited_end(self, at: int, opcode: int, length: int) -> int:
        """Where a record that says so twice ends: by its length and by its fields.

        Raises:
            Damage: neither is believed; `end` of it is set where the length may be.
        """
        by_length, by_fields = at + HEAD.size + length, self._fields_end(at, opcode)
        following = self.anchor(at + 1)
        top = self._limit if following is None else min(following, self._limit)
        if by_fields is not None and by_fields <= top and (
                by_fields == by_length or self.begins(by_fields)):
            return by_fields
        if by_length <= top and self.begins(by_length):
            if by_fields is not None and by_fields < by_length:  # fields of a later version
                return by_length
            raise Damage(f'the fields of a record of kind {opcode} go beyond it', end=by_length)
        raise Damage(f'a record of kind {opcode} declares {length} bytes, and no record follows')

    def declares(self, at: int) -> bool:
        """Whether a schema or channel begins here that ends with its fields, before a record."""
        head = self._peek(at, HEAD.size)
        if len(head) < HEAD.size or head[0] not in (SCHEMA, CHANNEL):
            return False
        end = at + HEAD.size + HEAD.unpack(head)[1]
        return self.begins(at) and end == self._fields_end(at, head[0]) and self.begins(end)

    def anchor(self, at: int) -> int | None:
        """The first place at or behind this one where a message begins without doubt."""
        number = bisect.bisect_left(self.anchors, at)
        return self.anchors[number] if number < len(self.anchors) else None

    def _anchored(self, at: int) -> bool:
        return bool(self.anchors) and self.anchor(at) == at

    def _message(self, head: bytes, fits: bool, near: int | None) -> bool:
        """Three of four: kind, length, channel, time."""
        if len(head) < MESSAGE_FIELDS.size:
            return False
        opcode, length, channel, _, log_time, publish_time = MESSAGE_FIELDS.unpack_from(head)
        near = publish_time if near is None else near
        signs = (opcode == MESSAGE, fits and length >= MESSAGE_FIELDS.size - HEAD.size,
                 channel in self._declared, abs(log_time - near) < NEAR)
        return sum(signs) >= 3 and max(log_time, publish_time) <= MAX_TIME

    def _fields_end(self, at: int, opcode: int) -> int | None:
        before, texts, long, behind = DELIMITED[opcode]
        end = at + HEAD.size + before
        for width in (4,) * texts + (8,) * long:
            size = self._peek(end, width)
            if len(size) < width:
                return None
            end += width + int.from_bytes(size, 'little')
        return end + behind if end + behind <= self._limit else None


def salvaged(data: bytes, declared: Declared, index: Mapping[int, tuple[int, int]], *,
             sure: bool = False) -> Iterator[Message | Gap]:
    """The messages of a chunk that are believed, and what lies between them.

    Args:
        data: the records.
        declared: channels; those of the chunk are noted.
        index: channel and time [ns] of messages, by their place.
        sure: a checksum says that the records are what was written.
    """
    def peek(at: int, size: int) -> bytes:
        return data[at:at + size]

    anchors = sorted(at for at, sign in index.items() if _sign(data, at) == sign)
    places = sorted(at for at in index if at < len(data))
    evidence = Evidence(peek, len(data), declared, IN_CHUNKS, anchors)
    at, gap = 0, None
    while at < len(data):
        try:
            end, message = _record(data, at, declared, evidence, index, sure)
        except Damage as damage:
            gap = gap or (at, damage.fault)
            at = damage.end or _next(data, at + 1, evidence)
            continue
        if gap:
            yield _gap(gap, at, places)
            gap = None
        if message is not None:
            yield message
        elif end != at + HEAD.size + int.from_bytes(data[at + 1:at + HEAD.size], 'little'):
            yield Gap(at, at, 'a declaration in a chunk has a wrong length', 0)
        at = end
    if gap:
        yield _gap(gap, at, places)


def swallowed(data: bytes, start: int, end: int, declared: Declared) -> int | None:
    """Where within a message the first of other messages begins that lead to its very end."""
    steps = CHAIN
    for _ in range(TRIES):
        match = MESSAGE_START.search(data, start, end)
        if match is None:
            break
        at = start = match.start()
        while at + MESSAGE_FIELDS.size <= end and (steps := steps - 1):
            opcode, length, channel, *_ = MESSAGE_FIELDS.unpack_from(data, at)
            if opcode not in IN_CHUNKS or opcode == MESSAGE and channel not in declared:
                break
            at += HEAD.size + length
        if at == end:
            return start
        start += 1
    return None


def _record(data: bytes, at: int, declared: Declared, evidence: Evidence,
            index: Mapping[int, tuple[int, int]], sure: bool) -> tuple[int, Message | None]:
    """Where the record at a place ends, and the message that it is, if it is asked for."""
    if len(data) - at < HEAD.size:
        raise Damage('the records of a chunk end within one')
    opcode, length = HEAD.unpack_from(data, at)
    end = at + HEAD.size + length
    if opcode == MESSAGE:
        if at in index and _sign(data, at) != index[at]:
            raise Damage('a message is not what the index says of it')
        end = end if sure and end <= len(data) else evidence.message_end(at)
        if not (sure or evidence.anchors) and (
                inner := swallowed(data, at + MESSAGE_FIELDS.size, end, declared)):
            raise Damage('a message declares a length over others', end=inner)
        _, _, channel, sequence, log_time, publish_time = MESSAGE_FIELDS.unpack_from(data, at)
        if channel not in declared.chosen:
            raise Damage(declared.unknown(channel), end=end)
        connection = declared.chosen[channel]
        return end, None if connection is None else Message(
            connection, sequence, log_time, publish_time, data[at + MESSAGE_FIELDS.size:end])
    if opcode in (SCHEMA, CHANNEL):
        end = end if sure and end <= len(data) else evidence.delimited_end(at, opcode, length)
        declare(declared, opcode, data[at + HEAD.size:end], end)
        return end, None
    following = evidence.anchor(at + 1)
    over = end > len(data) or following is not None and end > following
    if over or opcode in NEVER_IN_CHUNKS or at in index or not sure and (
            opcode < UNKNOWN or not evidence.begins(end)):
        raise Damage(f'a chunk holds a record of kind {opcode} with {length} bytes')
    return end, None


def declare(declared: Declared, opcode: int, body: bytes, end: int) -> None:
    """Note a schema or channel; damage says that its end is believed nevertheless."""
    try:
        (declared.schema if opcode == SCHEMA else declared.channel)(Fields(body))
    except Damage as damage:
        raise Damage(damage.fault, end=end) from damage


def _sign(data: bytes, at: int) -> tuple[int, int] | None:
    """Channel and time [ns] of the message at a place; None: there is none."""
    if at + MESSAGE_FIELDS.size > len(data) or data[at] != MESSAGE:
        return None
    _, _, channel, _, log_time, _ = MESSAGE_FIELDS.unpack_from(data, at)
    return channel, log_time


def _next(data: bytes, at: int, evidence: Evidence) -> int:
    """Where a record begins next: a declaration, or a message by the index or by its looks."""
    anchor = evidence.anchor(at)
    top = len(data) if anchor is None else anchor
    place = at
    for _ in range(TRIES):
        match = DECLARATION_START.search(data, place, top)
        if match is None:
            break
        if evidence.declares(match.start()):
            top = match.start()
            break
        place = match.start() + 1
    if evidence.anchors:
        return top
    for _ in range(TRIES):
        match = MESSAGE_START.search(data, at, top)
        if match is None:
            break
        try:
            evidence.message_end(match.start())
            if evidence.begins(match.start(), None, 0):
                return match.start()
        except Damage:
            pass
        at = match.start() + 1
    return top


def _gap(gap: tuple[int, str], end: int, places: list[int]) -> Gap:
    start, fault = gap
    count = bisect.bisect_left(places, end) - bisect.bisect_left(places, start)
    return Gap(start, end, fault, count if places else None)
