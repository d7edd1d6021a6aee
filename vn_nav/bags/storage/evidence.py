"""What the bytes at a place are evidence of, where no checksum covers them.

A length that was damaged makes one message out of several, or cuts one: such a message never
existed. A length is therefore believed where another record begins behind it.

An opcode that was damaged makes a message out of an index, or hides a chunk. The rule: a record is
of the kind that its opcode says unless its fields are of another one. A kind that counts its own
bytes (a chunk, a channel, an index, ...) is recognised where these counts end exactly where the
record ends; a message, where an opcode says anything that does not fit, by a channel that is
declared and a time within the time that is stated. Unknown kinds are legal: see `_is_private`.
"""

from __future__ import annotations

import bisect
import re
from collections.abc import Callable, Sequence

from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FIRST_UNKNOWN_OPCODE,
    HEAD,
    HEADER,
    MAX_NAME_BYTES,
    MAX_RECORD_BYTES,
    MAX_TIME_NS,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Damage,
    Declared,
)

# Between neighbours in a file, at most, where time is evidence.
MAX_NEIGHBOUR_GAP_NS = 86_400 * 10**9
PEEK_BYTES = 128  # of a record: enough to know its kind
MAX_UNKNOWN_RECORDS = 4  # unknown records in a row that are believed
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
# In the order of trust; a header has the fields of a metadata record, and never comes again.
_KNOWN_BY_FIELDS = (CHUNK, MESSAGE_INDEX, CHANNEL, SCHEMA, ATTACHMENT, METADATA)
_DATA_END_SIZE = 4  # bytes of its body


class Evidence:
    """Whether a record begins at a place, where it ends and what it is, by what stands there.

    Args:
        peek: the bytes at a place, at most so many.
        limit: where the records end.
        declared: the channels so far.
        kinds: that may occur.
        anchors: sorted places where messages begin without doubt.
        cut: the records may end within one.
        span: times [ns] of the first and last message, as they are stated; None: unknown.
        first: where a header stands; None: nowhere.
    """

    def __init__(self, peek: Callable[[int, int], bytes], limit: int, declared: Declared,
                 kinds: frozenset[int], anchors: Sequence[int] = (), *, cut: bool = False,
                 span: tuple[int, int] | None = None, first: int | None = None):
        self._peek, self._limit, self._declared = peek, limit, declared
        self._kinds, self.anchors, self._cut = kinds, anchors, cut
        self._span, self._first = span, first

    def kind(self, at: int, opcode: int, length: int) -> int:
        """What a record is; its opcode, unless its fields are of another kind."""
        end = at + HEAD.size + length
        if end > self._limit:
            return opcode
        if self._anchored(at):
            return MESSAGE
        body = self._peek(at + HEAD.size, min(length, PEEK_BYTES))
        if at == self._first:
            return HEADER if self._fits(at, HEADER, length, body) else opcode
        if opcode in _KNOWN_BY_FIELDS and (self._fits(at, opcode, length, body, later=True)
                                           or self._fields_end(at, opcode) == end):
            return opcode
        for kind in _KNOWN_BY_FIELDS:
            if kind in self._kinds and self._fits(at, kind, length, body):
                private = opcode >= FIRST_UNKNOWN_OPCODE and _is_private(opcode, kind)
                return opcode if private else kind
        if opcode != MESSAGE and self._is_message(at, opcode, length):
            return MESSAGE
        if length == _DATA_END_SIZE and end == self._limit and DATA_END in self._kinds:
            return DATA_END
        return opcode

    def in_span(self, time: int) -> bool:
        """Whether a message may be of a time [ns]; True where nothing is stated."""
        return self._span is None or self._span[0] <= time <= self._span[1]

    def begins(self, at: int, near: int | None = None, steps: int = MAX_UNKNOWN_RECORDS) -> bool:
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
        head = self._peek(at, min(PEEK_BYTES, self._limit - at))
        if len(head) < HEAD.size:
            return self._cut and head[0] in self._kinds and not any(head[5:])
        opcode, length = HEAD.unpack_from(head)
        fits = length <= self._limit - at - HEAD.size
        if self._message(head, fits, near) or fits and self.kind(at, opcode, length) != opcode:
            return True
        if opcode >= FIRST_UNKNOWN_OPCODE:
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
        text = body[before + 4:before + 4 + size]
        if (fits or self._cut) and before + 4 + size <= length and (
                size % 16 == 0 if opcode == MESSAGE_INDEX else
                size <= MAX_NAME_BYTES and not any(byte < 32 for byte in text)):
            return True
        # Damaged within, maybe: its length is right if it leads to the next record.
        return fits and length > before and steps > 0 and self.begins(
            at + HEAD.size + length, near, steps - 1)

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
        if (length < MESSAGE_FIELDS.size - HEAD.size or log_time > MAX_TIME_NS
                or publish_time > MAX_TIME_NS or end > self._limit
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

    def declaration_end(self, at: int, opcode: int, length: int) -> int:
        """Where a schema or channel ends, whatever the lengths within say.

        Raises:
            Damage: no end is believed.
        """
        try:
            return self.delimited_end(at, opcode, length)
        except Damage as damage:
            if damage.end is None:
                raise
            return damage.end

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
                 channel in self._declared,
                 abs(log_time - near) < MAX_NEIGHBOUR_GAP_NS
                 and max(log_time, publish_time) <= MAX_TIME_NS)
        return sum(signs) >= 3

    def _fields_end(self, at: int, opcode: int) -> int | None:
        before, texts, long, behind = DELIMITED[opcode]
        end = at + HEAD.size + before
        for width in (4,) * texts + (8,) * long:
            size = self._peek(end, width)
            if len(size) < width:
                return None
            end += width + int.from_bytes(size, 'little')
        return end + behind if end + behind <= self._limit else None

    def _fits(self, at: int, kind: int, length: int, body: bytes, *, later: bool = False
              ) -> bool:
        """Whether the fields of a kind end exactly where the record ends, and may be its own.

        If `later`, fields of a later version may follow them. `body` is what the record begins
        with, behind its head.
        """
        before, *_ = DELIMITED[kind]
        size = int.from_bytes(body[before:before + 4], 'little')
        if len(body) < before + 4 or before + 4 + size > length:
            return False
        if kind == CHUNK:
            if not body[28:].startswith(COMPRESSIONS):
                return False
        elif kind == MESSAGE_INDEX:  # places in a chunk: times would be larger
            places = range(before + 12, min(before + 4 + size, len(body) - 7), 16)
            if size % 16 or later and not size or any(
                    int.from_bytes(body[k:k + 8], 'little') > MAX_RECORD_BYTES for k in places):
                return False
        elif not may_name(body[before + 4:before + 4 + size], size, empty=kind == HEADER):
            return False
        end, fields_end = at + HEAD.size + length, self._fields_end(at, kind)
        return fields_end is not None and (fields_end <= end if later else fields_end == end)

    def _is_message(self, at: int, opcode: int, length: int) -> bool:
        """Whether a record with another opcode has the fields of a message."""
        if length < MESSAGE_FIELDS.size - HEAD.size:
            return False
        _, _, channel, _, log_time, publish_time = MESSAGE_FIELDS.unpack(
            self._peek(at, MESSAGE_FIELDS.size))
        if opcode == MESSAGE_INDEX and publish_time <= MAX_RECORD_BYTES:  # a place in a chunk
            return False
        return (channel in self._declared and max(log_time, publish_time) <= MAX_TIME_NS and (
            abs(log_time - publish_time) < MAX_NEIGHBOUR_GAP_NS if self._span is None
            else self.in_span(log_time)))


def _is_private(opcode: int, kind: int) -> bool:
    """Whether a record of an unknown kind is left one, though its fields are those of another.

    Applications have records of a name and a value, too. A chunk hides messages; a declaration
    is believed where one bit of its opcode is wrong; without the rest no message is lost.
    """
    return kind != CHUNK and (kind not in (SCHEMA, CHANNEL) or (opcode ^ kind).bit_count() > 1)


def may_name(text: bytes | bytearray, size: int, *, empty: bool) -> bool:
    """Whether bytes may be the beginning of a name of a size."""
    return (empty or size > 0) and size <= MAX_NAME_BYTES and not any(byte < 32 for byte in text)
