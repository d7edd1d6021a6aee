"""One MCAP file, written so that whatever ends the writing leaves it whole up to a chunk.

Built on the record types of `mcap`, not on its `Writer`: that ends a chunk only once it has grown
too large, compresses at zstd's default level (seven times slower than level 1 on a picture with
sensor noise), and cannot finish a file after a write that failed.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import collections
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from vn_nav.bags.storage.file_parts import FileParts, Part

CHUNK_BYTES = 256 * 1024  # bytes of records, or one message if that is larger
ZSTD_LEVEL = 1  # of zstd
MAGIC = b'\x89MCAP0\r\n'
MESSAGE_HEAD_BYTES = 31  # bytes of a message's record before its data


class McapOutput:
    """Chunks of messages, unbuffered.

    A method that raises `OSError` has lost the messages of the present chunk alone; `finish` is
    then the one thing to do.

    Args:
        path: must not exist.
        library: what writes it, for the header.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path, library: str = 'vn_nav'):
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._parts = FileParts(path.parent)
        self._known: list[Schema | Channel] = []  # in the parts
        self._chunks = 0
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._schemas: dict[tuple[str, str, bytes], int] = {}  # ids
        self._channels = 0
        self._begin_chunk()
        self.counts: collections.Counter[int] = collections.Counter()  # in the file, by channel
        head = RecordBuilder()
        head.write(MAGIC)
        Header('ros2', library).write(head)
        try:
            self._append(head.end(), Part())
        except OSError:
            os.close(self._file)
            os.unlink(path)
            raise

    @property
    def size(self) -> int:
        """Bytes in the file, without the present chunk."""
        return self._parts.last.end

    @property
    def span(self) -> tuple[int, int] | None:
        """Least and greatest stamp in the file."""
        return self._parts.last.span

    def channel(self, topic: str, kind: str, definition: str | bytes, metadata: dict[str, str],
                *, encoding: str = 'cdr', schema: str = 'ros2msg') -> int:
        """Declare a channel, which needs a message in the same chunk; its id.

        Args:
            topic: name, with the leading slash.
            kind: package/msg/Type.
            definition: ros2msg text with all that the type is made of.
            metadata: of the channel.
            encoding: of the messages.
            schema: encoding of the definition.
        """
        text = definition.encode() if isinstance(definition, str) else definition
        key = kind, schema, text
        if key not in self._schemas and any(key):  # else there is none: the number 0
            self._schemas[key] = len(self._schemas) + 1
            self._declare(Schema(id=self._schemas[key], data=text, encoding=schema, name=kind))
        self._channels += 1
        self._declare(Channel(id=self._channels, topic=topic, message_encoding=encoding,
                              metadata=metadata, schema_id=self._schemas.get(key, 0)))
        return self._channels

    def add(self, channel: int, data: bytes, stamp: int, sequence: int = 0,
            published: int | None = None) -> None:
        """Append a message; a chunk that is full, or would be overfull, is written.

        Args:
            channel: its id.
            data: CDR.
            stamp: ns since 1970.
            sequence: number that its publisher gave it.
            published: ns since 1970; None: as `stamp`.
        """
        if self._index and self._chunk.count + MESSAGE_HEAD_BYTES + len(data) > CHUNK_BYTES:
            self.flush()
        index = self._index.setdefault(channel, MessageIndex(channel_id=channel, records=[]))
        index.records.append((stamp, self._chunk.count))
        Message(channel_id=channel, log_time=stamp, data=data,
                publish_time=stamp if published is None else published,
                sequence=sequence & 0xFFFFFFFF).write(self._chunk)
        if self._chunk.count >= CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the present chunk, if there is a message in it."""
        if not self._index:
            return
        records, indexes, declared = self._chunk.end(), self._index, self._declared
        self._begin_chunk()
        stamps = [stamp for index in indexes.values() for stamp, _ in index.records]
        chunk = Chunk(compression='zstd', data=self._compressor.compress(records),
                      message_start_time=min(stamps), message_end_time=max(stamps),
                      uncompressed_crc=zlib.crc32(records), uncompressed_size=len(records))
        last, builder = self._parts.last, RecordBuilder()
        chunk.write(builder)
        length, offsets = builder.count, {}
        for channel, index in indexes.items():
            offsets[channel] = last.end + builder.count
            index.write(builder)
        written = builder.end()
        ChunkIndex(chunk_start_offset=last.end, chunk_length=length,
                   message_index_offsets=offsets, message_index_length=len(written) - length,
                   message_start_time=chunk.message_start_time,
                   message_end_time=chunk.message_end_time, compression='zstd',
                   compressed_size=len(chunk.data), uncompressed_size=len(records)).write(builder)
        stamps += last.span or ()
        counts = tuple((channel, len(index.records)) for channel, index in indexes.items())
        self._append(written, Part(span=(min(stamps), max(stamps)), declared=tuple(declared),
                                   index=builder.end(), counts=counts))
        self.counts.update(dict(counts))

    def sync(self) -> None:
        """Have the disk hold what was written, whatever happens to the power."""
        os.fdatasync(self._file)

    def finish(self, spare: int = 0) -> None:
        """Write summary and footer, and close; messages since the last `flush` are left out.

        Where the disk is full, chunks are given up from the end until the summary fits.

        Args:
            spare: bytes that shall be free on the disk afterwards.

        Raises:
            OSError: not even a file without a message can be finished.
        """
        try:
            while True:
                end = self._parts.last.end
                try:
                    for piece in self._summary():
                        end = self._write(piece, end)
                    self._write(bytes(spare), end)
                    break
                except OSError:
                    if not self._give_up(sum(map(len, self._summary())) + spare):
                        raise
            os.truncate(self._file, end)
            os.fsync(self._file)
        finally:
            self._parts.close()
            os.close(self._file)

    def abandon(self) -> None:
        """Close a file that shall not be finished."""
        self._parts.close()
        os.close(self._file)

    def _begin_chunk(self) -> None:
        self._chunk = RecordBuilder()
        self._index: dict[int, MessageIndex] = {}
        self._declared: list[Schema | Channel] = []

    def _declare(self, record: Schema | Channel) -> None:
        record.write(self._chunk)
        self._declared.append(record)

    def _append(self, data: bytes, part: Part) -> None:
        """Write a part whose end and checksum are yet to be filled in."""
        last = self._parts.last
        self._write(data, last.end)
        self._parts.push(part._replace(end=last.end + len(data),
                                       crc=zlib.crc32(data, last.crc)))
        self._known += part.declared
        self._chunks += bool(part.index)

    def _write(self, data: bytes, offset: int) -> int:
        """Write, and say where that ends; if it fails, the file ends with the last part."""
        rest = memoryview(data)
        try:
            while rest:
                count = os.pwrite(self._file, rest, offset)
                rest, offset = rest[count:], offset + count
        except OSError:
            os.truncate(self._file, self._parts.last.end)
            raise
        return offset

    def _give_up(self, size: int) -> bool:
        """Drop chunks from the end that take so many bytes; whether there was one."""
        end, dropped = self._parts.last.end, False
        while self._parts.last.index and end - self._parts.last.end < size:
            part = self._parts.pop()
            self.counts.subtract(dict(part.counts))
            del self._known[len(self._known) - len(part.declared):]
            self._chunks -= 1
            dropped = True
        os.truncate(self._file, self._parts.last.end)
        return dropped

    def _summary(self) -> Iterator[bytes]:
        """From the end of the data to the end of the file, piece by piece."""
        last, builder = self._parts.last, RecordBuilder()
        schemas = [record for record in self._known if isinstance(record, Schema)]
        channels = [record for record in self._known if isinstance(record, Channel)]
        counts = {channel: count for channel, count in self.counts.items() if count}
        first, latest = last.span or (0, 0)
        statistics = Statistics(
            message_count=sum(counts.values()), schema_count=len(schemas),
            channel_count=len(channels), attachment_count=0, metadata_count=0,
            chunk_count=self._chunks, message_start_time=first, message_end_time=latest,
            channel_message_counts=counts)
        DataEnd(last.crc).write(builder)
        data_end = builder.end()
        yield data_end
        start = at = last.end + len(data_end)
        crc, offsets = 0, []
        for opcode, group in ((Opcode.SCHEMA, schemas), (Opcode.CHANNEL, channels),
                              (Opcode.STATISTICS, [statistics])):
            for record in group:
                record.write(builder)
            if group:
                offsets.append(SummaryOffset(opcode, at, builder.count))
            piece = builder.end()
            at, crc = at + len(piece), zlib.crc32(piece, crc)
            yield piece
        begin = at
        for part in self._parts:
            at, crc = at + len(part.index), zlib.crc32(part.index, crc)
            builder.write(part.index)
            if builder.count >= CHUNK_BYTES:
                yield builder.end()
        yield builder.end()
        if at > begin:
            offsets.append(SummaryOffset(Opcode.CHUNK_INDEX, begin, at - begin))
        for offset in offsets:
            offset.write(builder)
        piece = builder.end()
        # The checksum of the summary covers the footer up to the checksum's own place.
        crc = zlib.crc32(piece + struct.pack('<BQQQ', Opcode.FOOTER, 20, start, at), crc)
        Footer(start, at, crc).write(builder)
        yield piece + builder.end() + MAGIC
