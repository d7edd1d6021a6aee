"""The records of a chunk, or a declaration, that can be believed where no checksum covers them.

The index of a chunk's messages says where they begin, and so where to go on behind damage.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from vn_nav.bags.storage.evidence import (
    DECLARATION_START,
    DELIMITED,
    IN_CHUNKS,
    MESSAGE_START,
    Evidence,
    may_name,
)
from vn_nav.bags.storage.records import (
    CHANNEL,
    FIRST_UNKNOWN_OPCODE,
    HEAD,
    MESSAGE,
    MESSAGE_FIELDS,
    NEVER_IN_CHUNKS,
    SCHEMA,
    Damage,
    Declared,
    Fields,
    Message,
)

MAX_TRIES = 64  # places that look like a message and are looked at, within another or after damage
MAX_SWALLOWED_MESSAGES = 50_000  # messages that one may have swallowed, at most, to be found out


class Gap(NamedTuple):
    """Bytes of a chunk's records that could not be used; none where a fault was mended."""

    start: int
    end: int
    fault: str
    messages: int | None  # that began there, by the index; None: unknown


def salvaged(data: bytes, declared: Declared, index: Mapping[int, tuple[int, int]], *,
             sure: bool = False, span: tuple[int, int] | None = None) -> Iterator[Message | Gap]:
    """The messages of a chunk that are believed, and what lies between them.

    Args:
        data: the records.
        declared: channels; those of the chunk are noted.
        index: channel and time [ns] of messages, by their place.
        sure: a checksum says that the records are what was written.
        span: times [ns] of the first and last message; None: unknown.
    """
    def peek(at: int, size: int) -> bytes:
        return data[at:at + size]

    anchors = sorted(at for at, sign in index.items() if sign_of(data, at) == sign)
    places = sorted(at for at in index if at < len(data))
    evidence = Evidence(peek, len(data), declared, IN_CHUNKS, anchors, span=span)
    at, gap = 0, None
    while at < len(data):
        try:
            end, message, note = _record(data, at, declared, evidence, index, sure)
        except Damage as damage:
            gap = gap or (at, damage.fault)
            at = damage.end or _next(data, at + 1, evidence)
            continue
        if gap:
            yield _gap(gap, at, places)
            gap = None
        if note:
            yield Gap(at, at, note, 0)
        if message is not None:
            yield message
        at = end
    if gap:
        yield _gap(gap, at, places)


def swallowed(data: bytes, start: int, end: int, declared: Declared) -> int | None:
    """Where within a message the first of other messages begins that lead to its very end."""
    steps = MAX_SWALLOWED_MESSAGES
    for _ in range(MAX_TRIES):
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


def declare(declared: Declared, opcode: int, body: bytes, end: int) -> str:
    """Note a schema or channel; a length in it that one bit puts right is put right.

    Args:
        declared: what is known so far.
        opcode: of the two.
        body: of the record.
        end: of the record, that is believed whatever the body holds.

    Returns:
        A note about what was wrong and costs nothing; or ''.

    Raises:
        Damage: it cannot be read, and nothing else declares it.
    """
    note = declared.schema if opcode == SCHEMA else declared.channel
    kind = 'a schema' if opcode == SCHEMA else 'a channel'
    try:
        note(Fields(body))
    except Damage as damage:
        try:
            if (mended := _mended(opcode, body)) is not None:
                note(Fields(mended))
                return f'{kind} has a wrong length within'
        except Damage:
            pass
        if declared.knows(opcode, int.from_bytes(body[:2], 'little')):
            return f'{kind} cannot be read ({damage.fault}), and is declared elsewhere'
        raise Damage(damage.fault, end=end) from damage
    return ''


def sign_of(data: bytes, at: int) -> tuple[int, int] | None:
    """Channel and time [ns] of the message at a place; None: there is no room for one."""
    if at + MESSAGE_FIELDS.size > len(data):
        return None
    _, _, channel, _, log_time, _ = MESSAGE_FIELDS.unpack_from(data, at)
    return channel, log_time


def _record(data: bytes, at: int, declared: Declared, evidence: Evidence,
            index: Mapping[int, tuple[int, int]], sure: bool
            ) -> tuple[int, Message | None, str]:
    """Where the record at a place ends, the message that it is, if asked for, and a note."""
    if len(data) - at < HEAD.size:
        raise Damage('the records of a chunk end within one')
    stated, length = HEAD.unpack_from(data, at)
    opcode = stated if sure else evidence.kind(at, stated, length)
    note = '' if opcode == stated else mistaken(stated, opcode)
    end = at + HEAD.size + length
    if opcode == MESSAGE:
        if at in index and sign_of(data, at) != index[at]:
            raise Damage('a message is not what the index says of it')
        end = end if sure and end <= len(data) else evidence.message_end(at)
        if not (sure or evidence.anchors) and (
                inner := swallowed(data, at + MESSAGE_FIELDS.size, end, declared)):
            raise Damage('a message declares a length over others', end=inner)
        _, _, channel, sequence, log_time, publish_time = MESSAGE_FIELDS.unpack_from(data, at)
        if channel not in declared.chosen:
            raise Damage(declared.unknown(channel), end=end)
        connection = declared.chosen[channel]
        if connection is None:
            return end, None, note
        declared.read[channel] += 1
        return end, Message(connection, sequence, log_time, publish_time,
                            data[at + MESSAGE_FIELDS.size:end]), note
    if opcode in (SCHEMA, CHANNEL):
        if not sure or end > len(data):
            end = evidence.declaration_end(at, opcode, length)
            note = note or 'a declaration in a chunk has a wrong length' * (
                end != at + HEAD.size + length)
        own = declare(declared, opcode, data[at + HEAD.size:end], end)
        return end, None, note or own
    following = evidence.anchor(at + 1)
    over = end > len(data) or following is not None and end > following
    if over or opcode in NEVER_IN_CHUNKS or at in index or not sure and (
            opcode < FIRST_UNKNOWN_OPCODE or not evidence.begins(end)):
        raise Damage(f'a chunk holds a record of kind {opcode} with {length} bytes')
    return end, None, note


def mistaken(stated: int, opcode: int) -> str:
    """What is said of a record whose opcode is not believed."""
    return f'a record has the kind {stated}, and the fields of kind {opcode}'


def _mended(kind: int, body: bytes) -> bytes | None:
    """A schema or channel with the one bit of its lengths changed that lets them end with it.

    None: there is none, or there are several.
    """
    found = []
    for place in _lengths(kind, body)[0]:
        for bit in range(32):
            changed = bytearray(body)
            changed[place + bit // 8] ^= 1 << bit % 8
            if _lengths(kind, changed)[1]:
                found.append(bytes(changed))
    return found[0] if len(found) == 1 else None


def _lengths(kind: int, body: bytes | bytearray) -> tuple[list[int], bool]:
    """The places of lengths in a schema or channel as far as they lead; whether they fit."""
    at = DELIMITED[kind][0]
    places: list[int] = []
    for number in range(3):
        size = int.from_bytes(body[at:at + 4], 'little')
        start, at = at + 4, at + 4 + size
        if start > len(body):
            return places, False
        places.append(start - 4)
        if at > len(body) or number < 2 and not may_name(body[start:at], size, empty=True):
            return places, False
    if kind == CHANNEL:  # a map of texts is the last
        count, stop, at = 0, at, start
        while at + 4 <= stop:
            places.append(at)
            at, count = at + 4 + int.from_bytes(body[at:at + 4], 'little'), count + 1
        if at != stop or count % 2:
            return places, False
    return places, at == len(body)


def _next(data: bytes, at: int, evidence: Evidence) -> int:
    """Where a record begins next: a declaration, or a message by the index or by its looks."""
    anchor = evidence.anchor(at)
    top = len(data) if anchor is None else anchor
    place = at
    for _ in range(MAX_TRIES):
        match = DECLARATION_START.search(data, place, top)
        if match is None:
            break
        if evidence.declares(match.start()):
            top = match.start()
            break
        place = match.start() + 1
    if evidence.anchors:
        return top
    for _ in range(MAX_TRIES):
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
