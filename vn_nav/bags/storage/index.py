"""The index of a chunk's messages, compared with the messages: either may be damaged."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

from vn_nav.bags.storage.evidence import PEEK_BYTES, Evidence
from vn_nav.bags.storage.records import HEAD, MESSAGE_INDEX, Damage, Declared, Fields
from vn_nav.bags.storage.salvage import sign_of

_ENTRY = 16  # bytes that a message takes in an index: less than in a chunk


class Index(NamedTuple):
    """What the index records behind a chunk say."""

    messages: dict[int, tuple[int, int]]  # channel and time [ns], by the place in the chunk
    faults: list[str]  # of the index itself, that were mended


def index_of(peek: Callable[[int, int], bytes], evidence: Evidence, at: int, data: bytes,
             declared: Declared, held: Collection[int], span: tuple[int, int]) -> Index:
    """The index of a chunk that ends at a place of the file.

    Where an index record and the messages disagree, a third statement decides, if there is one:
    the channels that the summary says are in the chunk, those that the other records are of, or
    the chunk's times. Without, the index is believed, and `salvaged` leaves the message out.

    Args:
        peek: bytes of the file at a place, at most so many.
        evidence: of the file.
        at: the place.
        data: the records of the chunk.
        declared: the channels so far.
        held: channels of the chunk, as the summary says; empty: unknown.
        span: times [ns] of its first and last message, as the chunk says.
    """
    found = _records(peek, evidence, at, len(data))
    listed = [channel for channel, _ in found]
    index, faults = {}, []
    for channel, entries in found:
        signs = [sign_of(data, place) for _, place in entries]
        others = {sign[0] for (time, _), sign in zip(entries, signs, strict=True)
                  if sign is not None and sign[1] == time}
        if len(others) == 1 and channel not in others:
            other, = others
            if other in declared and _is_wrong(channel, other, listed, held, len(entries)):
                faults.append(f'an index is of channel {channel}, and its messages of {other}')
                channel = other
        for (time, place), sign in zip(entries, signs, strict=True):
            if sign is not None and sign[0] == channel and sign[1] != time and (
                    span[0] <= sign[1] <= span[1] and not span[0] <= time <= span[1]):
                faults.append("an index has a time that is not the chunk's")
                time = sign[1]
            if (channel, time) == sign or place not in index:
                index[place] = channel, time
    return Index(index, faults)


def _is_wrong(channel: int, other: int, listed: list[int], held: Collection[int], count: int
              ) -> bool:
    """Whether the channel of an index record is wrong, and not that of its messages."""
    if other in listed:  # which has a record of its own
        return False
    if count > 1 or listed.count(channel) > 1:
        return True
    return other in held and channel not in held


def _records(peek: Callable[[int, int], bytes], evidence: Evidence, at: int, size: int
             ) -> list[tuple[int, list[tuple[int, int]]]]:
    """Channel, and time [ns] and place of each message, of the records from a place on."""
    found, left = [], size // _ENTRY + 64 * HEAD.size
    while left > 0:
        head = peek(at, HEAD.size)
        if len(head) < HEAD.size:
            break
        opcode, length = HEAD.unpack(head)
        if evidence.kind(at, opcode, length) != MESSAGE_INDEX:
            break
        entries: list[tuple[int, int]] = []
        try:
            end = evidence.delimited_end(at, MESSAGE_INDEX, length)
            if end - at > size + PEEK_BYTES:
                break
            fields = Fields(peek(at + HEAD.size, end - at - HEAD.size))
            channel, = fields.numbers('<H')
            pairs = Fields(fields.data())
            found.append((channel, entries))
            while pairs.left:
                time, place = pairs.numbers('<QQ')
                entries.append((time, place))
                left -= 1
        except Damage as damage:
            if damage.end is None:
                break
            end = damage.end
        at, left = end, left - 1
    return found
