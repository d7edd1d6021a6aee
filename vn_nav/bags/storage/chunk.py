"""A chunk of an MCAP file: what it declares of its records, and these, decompressed."""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import lz4.frame
import zstandard

from vn_nav.bags.storage.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    HEAD,
    MAX_RECORD_BYTES,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Damage,
    Fields,
    reason_of,
)

_CHUNK = struct.Struct('<QQQI')  # start, end, size, CRC
# Bytes that a byte can stand for at most: a block of 128 KiB in 4 bytes; a match of 255 bytes.
_MOST = {'zstd': 1 << 15, 'lz4': 255}


class ChunkHead(NamedTuple):
    """What a chunk says of its records."""

    span: tuple[int, int]  # ns, of the first and last message; (0, 0) where it has none
    size: int  # bytes of the records
    crc: int  # of them; 0: unknown
    compression: str
    at: int  # where they begin in the chunk's body
    stored: int  # bytes that they take there


def chunk_head(body: bytes) -> ChunkHead:
    """The fields of a chunk before its records; what it declares is not compared yet."""
    fields = Fields(body)
    start, end, size, crc = fields.numbers(_CHUNK)
    compression = fields.text(name=True)
    stored, = fields.numbers('<Q')
    return ChunkHead((start, end), size, crc, compression, fields.at, stored)


def unpacked(body: bytes) -> tuple[bytes, ChunkHead]:
    """The records of a chunk. Fields that a later version appended are passed over."""
    head = chunk_head(body)
    left = len(body) - head.at - head.stored
    if left < 0:
        raise Damage(f'a chunk declares {head.stored} bytes and has {left + head.stored}')
    if left >= HEAD.size and begins_record(body[-left:]):
        raise Damage('a chunk extends beyond its records, over other records of the file')
    return unpack(memoryview(body)[head.at:head.at + head.stored], head), head


def begins_record(data: bytes) -> bool:
    """Whether bytes look like a record that may follow a chunk."""
    opcode, length = HEAD.unpack_from(data)
    return opcode in (CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END, SCHEMA, CHANNEL,
                      MESSAGE) and length < 1 << 40


def unpack(stored: memoryview, head: ChunkHead) -> bytes:
    """The records of a chunk out of the bytes that it stores them in."""
    size, cost = head.size, len(stored) + head.size
    if size > MAX_RECORD_BYTES:
        raise Damage(f'a chunk declares {size} bytes, more than {MAX_RECORD_BYTES}')
    try:
        data = _inflate(stored, head.compression, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise Damage(f'a chunk cannot be decompressed ({head.compression}): {reason_of(error)}',
                     cost=cost) from error
    if len(data) != size:
        raise Damage(f'a chunk declares {size} bytes and holds another number', cost=cost)
    if head.crc and zlib.crc32(data) != head.crc:
        raise Damage('the checksum of a chunk does not match', cost=cost)
    return data


def _inflate(stored: memoryview, compression: str, size: int) -> bytes:
    """The `size` bytes that a chunk declares; never takes memory for more.

    They may be in several frames; what follows them is not part of it.
    """
    if compression == '':
        return bytes(stored)
    if size > _MOST.get(compression, size) * len(stored):
        raise ValueError(f'{len(stored)} bytes cannot stand for {size}')
    if compression == 'zstd':
        # The frame's own size, if it has one, goes before max_output_size.
        declared = zstandard.frame_content_size(stored)
        if declared > size:
            raise ValueError(f'the frame declares {declared} bytes, the chunk {size}')
        data = zstandard.ZstdDecompressor().decompress(stored, max_output_size=max(size, 1))
        if len(data) >= size:
            return data
        with zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True) as whole:
            return whole.read(size + 1)
    if compression == 'lz4':
        parts: list[bytes] = []
        while size > 0 or not parts:
            decompressor = lz4.frame.LZ4FrameDecompressor()
            parts.append(decompressor.decompress(stored, max_length=size + 1))
            if not decompressor.eof:
                raise ValueError('the frame is not complete')
            size -= len(parts[-1])
            stored = memoryview(decompressor.unused_data or b'')
        return b''.join(parts)
    raise ValueError('the compression is zstd, lz4 or none')


def mended_head(body: bytes, length: int) -> tuple[ChunkHead, bool]:
    """The fields of a chunk, and whether the name of its compression had to be mended.

    It is the one that lets the lengths agree.
    """
    for name in (b'', b'lz4', b'zstd'):
        begin = 28 + 4 + len(name)
        if int.from_bytes(body[begin:begin + 8], 'little') == length - begin - 8:
            right = body[:28] + len(name).to_bytes(4, 'little') + name + body[begin:]
            return chunk_head(right), right != body
    return chunk_head(body), False


def right_size(head: ChunkHead, stored: bytes) -> ChunkHead:
    """The fields with the size of the records mended, where one bit of it is wrong.

    A checksum of one bit is one that was not there, and a bit that is wrong.
    """
    head = head._replace(crc=0) if head.crc.bit_count() == 1 else head
    size = len(stored)
    try:
        if head.compression == 'zstd':
            size = zstandard.frame_content_size(stored)
        elif head.compression == 'lz4':
            size = lz4.frame.get_frame_info(stored)['content_size']
    except (zstandard.ZstdError, RuntimeError, ValueError):
        return head
    return head._replace(size=size) if size > 0 and (size ^ head.size).bit_count() == 1 else head
