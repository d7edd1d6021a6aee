"""One MCAP file as a stream of messages; damage is an error, or passed over and accounted for."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from vn_nav.bags.storage.chunk import unpacked
from vn_nav.bags.storage.count import Count, compared
from vn_nav.bags.storage.damage import Loss
from vn_nav.bags.storage.damaged import DamagedFile
from vn_nav.bags.storage.evidence import IN_CHUNKS, IN_DATA, Evidence
from vn_nav.bags.storage.records import (
    A_BAG,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEAD,
    MAX_RECORD_BYTES,
    MESSAGE,
    SCHEMA,
    BagError,
    Connection,
    Damage,
    Declared,
    Message,
    reason_of,
    records,
)
from vn_nav.bags.storage.salvage import mistaken
from vn_nav.bags.storage.summary import MAGIC, Summary, crc_of, peek

__all__ = ['Loss', 'McapFile']


class McapFile:
    """An MCAP file; reading begins with `messages`.

    Args:
        path: of the file.
        strict: damage is an error. Otherwise it is passed over, to the next record that is whole,
            and `losses` and `missing` list it.

    Raises:
        BagError: no such file; if strict, also one without its end, or with a bad index.
    """

    def __init__(self, path: str | Path, *, strict: bool = True):
        self.path, self.strict = Path(path), strict
        self.losses: list[Loss] = []
        self.missing: int | None = None  # messages that the file counts and that were not read
        self.surplus = 0  # messages that were read and that the file does not count
        self.unchecked = 0  # messages that no checksum covers, of those that were read; not strict
        self.passed: dict[int, int] = {}  # bytes of records of unknown kinds; not strict
        self._ahead_of: DamagedFile | None = None
        self._ahead: int | None = None
        self._summary = Summary(self.path)
        try:
            if not self.path.is_file():
                raise BagError(path, 'no such file', rule=A_BAG,
                               remedy='give the path of a recording')
            with open(self.path, 'rb') as file:
                self._size = os.fstat(file.fileno()).st_size
                self._look_at_the_ends(file)
        except (OSError, MemoryError) as error:
            raise BagError(path, reason_of(error)) from error
        self._opening = list(self.losses)

    @property
    def start(self) -> int | None:
        """When the first message was recorded [ns], by the index; None: unknown."""
        return self._summary.chunks.start

    @property
    def ahead(self) -> int | None:
        """The time [ns] before which nothing is still to be read, if it is known."""
        return self._ahead if self._ahead_of is None else self._ahead_of.ahead

    @property
    def channels(self) -> dict[int, Connection]:
        """The channels that the summary declares with their schemas, by number."""
        return self._summary.declared.channels

    @property
    def counts(self) -> dict[int, int] | None:
        """Messages by channel, as the file counts them."""
        return self._summary.counts

    def messages(self, topics: frozenset[str] | None = None) -> Iterator[Message]:
        """The messages in the order of the file.

        Args:
            topics: names without the leading slash; None: all. Chunks that hold none of them are
                not decompressed, if the file has an index.

        Raises:
            BagError: damage, if strict; or a file that cannot be read at all.
        """
        self.losses, self._ahead, self._ahead_of = list(self._opening), None, None
        declared = self._summary.declared.again(
            lambda name: topics is None or name.lstrip('/') in topics,
            forgiving=not self.strict)
        # A chunk that is passed over may declare a schema that the summary lacks.
        unwanted = [number for number, chosen in declared.chosen.items() if chosen is None]
        skipped = self._summary.chunks.skip(unwanted if declared.whole else ())
        read = self._strictly if self.strict else self._leniently
        try:
            with open(self.path, 'rb') as file:
                yield from read(file, declared, bool(self._summary.data_crc) and not skipped)
        except (OSError, MemoryError) as error:
            raise BagError(self.path, reason_of(error)) from error

    def _look_at_the_ends(self, file: BinaryIO) -> None:
        """Check the first and last bytes, and read the summary that the last point to."""
        if file.read(len(MAGIC)) != MAGIC:
            if self.strict:
                raise BagError(self.path, 'does not begin as an MCAP file does', 0, rule=A_BAG,
                               remedy='give the path of a recording')
            self.losses.append(Loss(self.path, 0, 0, 'does not begin as an MCAP file does',
                                    harmless=True))
        try:
            self._summary.read(file, self._size)
        except Damage as damage:
            if self.strict:
                raise BagError(self.path, damage.fault, self._size) from damage
            self.losses.append(Loss(self.path, self._size, 0, damage.fault, harmless=True))
            self._summary = Summary(self.path)  # or half of it

    @property
    def _limit(self) -> int:
        """Where the data end, as far as the end of the file says."""
        ends = (self._summary.data_mark, self._summary.data_end, self._size)
        return next(end for end in ends if end is not None)

    def _strictly(self, file: BinaryIO, declared: Declared, crcs: bool) -> Iterator[Message]:
        chunks, limit, at = self._summary.chunks, self._limit, len(MAGIC)
        crc = zlib.crc32(MAGIC) if crcs else None
        # A checksum or a count finds out whether a record is taken for one of another kind.
        evidence = None if crcs or self._summary.total is not None else Evidence(
            lambda place, size: peek(file, place, min(size, limit - place)), limit, declared,
            IN_DATA, first=len(MAGIC))
        following = chunks.next(at)
        try:
            while at < limit:
                opcode, length, head = self._head(file, at, limit)
                end = at + HEAD.size + length
                if following is not None and following <= at:
                    if opcode != CHUNK:
                        raise Damage(f'a chunk, by the index, has the kind {opcode}')
                    following = chunks.next(at + 1)
                if following is not None and end > following:
                    raise Damage(f'a record declares {length} bytes, over the chunk that the '
                                 f'index has at byte {following}')
                if evidence is not None:
                    _check_kind(evidence, at, opcode, length)
                    file.seek(at + HEAD.size)
                if opcode == CHUNK and not chunks.skips(at):
                    body = _read(file, length)
                    crc = None if crc is None else zlib.crc32(body, zlib.crc32(head, crc))
                    data, chunk = unpacked(body)
                    del body
                    if (ahead := chunks.ahead(at)) is not None:
                        self._ahead = ahead
                    yield from records(data, declared)
                    if evidence is not None and not chunk.crc:
                        _check_kinds(data, declared, chunk.span)
                elif opcode in (SCHEMA, CHANNEL, MESSAGE):
                    record = head + _read(file, length)
                    crc = None if crc is None else zlib.crc32(record, crc)
                    yield from records(record, declared)
                elif opcode in (DATA_END, FOOTER):
                    raise Damage('the data section ends too early')
                elif crc is not None:
                    crc = crc_of(file, at, end - at, crc)
                at = end
        except Damage as damage:
            raise BagError(self.path, damage.fault, at) from damage
        count = self._compare(declared)
        for fault in (*count.faults, *count.doubts, *self._data_fault(crc)):
            raise BagError(self.path, fault)

    def _leniently(self, file: BinaryIO, declared: Declared, crcs: bool) -> Iterator[Message]:
        reading = self._ahead_of = DamagedFile(
            self.path, file, self._limit, self._summary, declared, self.losses, crc=crcs)
        yield from reading.messages()
        count = self._compare(declared)
        self.losses += [Loss(self.path, self._size, 0, doubt, harmless=True)
                        for doubt in count.doubts]
        if count.surplus or not any(loss.size and not loss.harmless for loss in self.losses):
            self.losses += [Loss(self.path, 0, 0, fault)
                            for fault in (*count.faults, *self._data_fault(reading.crc))]
        self.passed = dict(reading.passed)
        checked = reading.crc is not None and reading.crc == self._summary.data_crc
        self.unchecked = 0 if checked else reading.unchecked

    def _head(self, file: BinaryIO, at: int, limit: int) -> tuple[int, int, bytes]:
        """Opcode and length of the record at a place, and the bytes that they stand in."""
        file.seek(at)
        head = file.read(HEAD.size)
        left = limit - at - HEAD.size
        if len(head) < HEAD.size or left < 0:
            raise Damage('the file ends within a record')
        opcode, length = HEAD.unpack(head)
        if not opcode:
            raise Damage('there is no record of kind 0')
        if length > left:
            raise Damage(f'a record declares {length} bytes where {left} are left')
        if length > MAX_RECORD_BYTES and opcode in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
            raise Damage(f'a record has {length} bytes, more than {MAX_RECORD_BYTES}')
        return opcode, length, head

    def _compare(self, declared: Declared) -> Count:
        """Compare what was read with what the file counts."""
        count = compared(self._summary.total, self.counts, declared)
        self.missing, self.surplus = count.missing, count.surplus
        return count

    def _data_fault(self, crc: int | None) -> list[str]:
        wrong = crc is not None and crc != self._summary.data_crc
        return ['the checksum of its data does not match'] * wrong


def _read(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise Damage('the file became shorter while it was read')
    return data


def _check_kind(evidence: Evidence, at: int, opcode: int, length: int) -> None:
    if (kind := evidence.kind(at, opcode, length)) != opcode:
        raise Damage(mistaken(opcode, kind))


def _check_kinds(data: bytes, declared: Declared, span: tuple[int, int]) -> None:
    """The same of the records of a chunk, which are whole."""
    evidence = Evidence(lambda at, size: data[at:at + size], len(data), declared, IN_CHUNKS,
                        span=span)
    at = 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        _check_kind(evidence, at, opcode, length)
        at += HEAD.size + length
