"""The structure of a PNG, walked before a decoder takes memory or time for it (PNG 3rd edition).

libpng inflates whatever a file holds, a gigabyte behind the last row of a small picture too. So
the pixels are inflated here, once, to no more than the header's size asks for, and the decoder
gets them in stored blocks. Chunks that change no pixel never reach it.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import cv2
import numpy as np

from vn_msgs_py.exif import Exif, read_exif
from vn_msgs_py.image_error import ImageError, TooLargeError, check_size, damaged, truncated

SIGNATURE = b'\x89PNG\r\n\x1a\n'
MAX_CHUNKS = 20_000  # 16 million pixels in IDAT chunks of 8 kB are about 12,000
MAX_INFLATED_BYTES = 66_000_000  # 16 million pixels of four bytes, with their rows' filter bytes
MAX_EXPANSION = 1032  # bytes that a byte of deflate can become: 258 for two bits
SUB_BYTES = 1 << 23  # rows of the filter Sub that are put together here; two copies are needed
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type: grey, RGB, palette, and with alpha
DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}  # bits
ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
         (0, 1, 1, 2))  # first column and row, steps between columns and rows of each pass
END = b'\0\0\0\0IEND\xaeB`\x82'
STORED_BYTES = 65_535  # a stored block's longest
SUB = 1  # filter: each byte is the difference from the pixel on its left


class PngFile(NamedTuple):
    """What a PNG says of itself."""

    height: int  # pixels, as stored
    width: int
    depth: int  # bits of a value
    colour: int  # colour type
    interlaced: bool
    exif: Exif
    header: bytes  # signature, IHDR and PLTE, as they stand
    pixels: list[tuple[int, int]]  # where the compressed data lies: first byte, byte after


def examine_png(data: bytes) -> PngFile:
    """Walk a PNG from its signature to its end chunk; what follows is not looked at.

    Raises:
        ImageError: it is truncated, contradicts itself or asks for more than is given.
    """
    if data[8:16] != b'\0\0\0\x0dIHDR':
        raise damaged('a PNG begins with its header', data[8:16])
    if len(data) < 33:
        raise _truncated(f'{len(data)} bytes without an end chunk')
    shape = _read_header(data[16:29])
    header, exif, at, chunks = [SIGNATURE], Exif(), 8, 0
    pixels: list[tuple[int, int]] = []  # where the chunks of pixels begin and end
    while True:
        chunks += 1
        if chunks > MAX_CHUNKS:
            raise ImageError(f'a PNG has at most {MAX_CHUNKS} chunks', 'more', 'save it anew')
        if at + 12 > len(data):
            raise _truncated(f'{len(data)} bytes without an end chunk')
        length, kind = struct.unpack_from('>I4s', data, at)
        begin, end = at + 8, at + 8 + length
        if end + 4 > len(data):
            raise _truncated(f'a chunk of {length} bytes at byte {at} of {len(data)}')
        if kind == b'IDAT':
            if pixels and pixels[-1][1] + 12 != begin:
                raise damaged('the IDAT chunks of a PNG lie together', f'one at byte {at}')
            pixels.append((begin, end))
        elif kind in (b'IHDR', b'PLTE'):
            if zlib.crc32(data[at + 4:end]) != struct.unpack_from('>I', data, end)[0]:
                raise damaged('a PNG chunk fits its checksum', f'{kind!r} at byte {at}')
            if pixels or len(header) != (1 if kind == b'IHDR' else 2) or length > 768:
                raise damaged('a PNG has IHDR, then PLTE, before its pixels', f'byte {at}')
            header.append(data[at:end + 4])
        elif kind == b'IEND':
            if data[at:at + 12] != END:
                raise _truncated(f'{data[at:at + 12]!r} for an end chunk')
            break
        elif kind == b'eXIf':
            exif = read_exif(data[begin:end])
        elif not (kind.isalpha() and kind[:1].islower()):
            raise damaged('every critical chunk of a PNG is known', f'{kind!r} at byte {at}')
        at = end + 4
    png = PngFile(*shape, exif, b''.join(header), pixels)
    _check_amount(png)
    return png


def _read_header(fields: bytes) -> tuple[int, int, int, int, bool]:
    """Height, width, depth, colour type and interlacing."""
    width, height, depth, colour, compression, filtering, interlace = struct.unpack(
        '>IIBBBBB', fields)
    check_size(height, width)
    if depth not in DEPTHS.get(colour, ()) or compression or filtering or interlace > 1:
        raise damaged('a PNG header has a valid colour type and bit depth',
                      (depth, colour, compression, filtering, interlace))
    return height, width, depth, colour, bool(interlace)


def _row_bytes(png: PngFile, width: int) -> int:
    """Bytes of a row of `width` pixels, with its filter byte."""
    return 1 + -(-width * png.depth * CHANNELS[png.colour] // 8)


def _inflated_bytes(png: PngFile) -> int:
    """Bytes of all rows, as the header's size asks for."""
    if not png.interlaced:
        return png.height * _row_bytes(png, png.width)
    size = 0
    for x, y, across, down in ADAM7:
        columns, rows = -(-(png.width - x) // across), -(-(png.height - y) // down)
        if columns > 0 and rows > 0:
            size += rows * _row_bytes(png, columns)
    return size


def _check_amount(png: PngFile) -> None:
    size, given = _inflated_bytes(png), sum(end - begin for begin, end in png.pixels)
    if size > MAX_INFLATED_BYTES:
        raise TooLargeError(f'the pixels of a PNG take at most {MAX_INFLATED_BYTES} bytes', size,
                            'lower its resolution, or save it with 8 bits')
    if given * MAX_EXPANSION < size:
        raise _truncated(f'{given} bytes for {png.width} x {png.height} pixels')


def decode_png(data: bytes, png: PngFile) -> np.ndarray | None:
    """The pixels [H,W,3] uint8 RGB as stored, or None where the decoder fails.

    Raises:
        ImageError: the compressed data is damaged, or not as much as the header declares.
    """
    parts, checksum = _inflate(data, png)
    line = _row_bytes(png, png.width)
    if (png.depth == 8 and png.colour in (0, 2, 6) and not png.interlaced
            and png.height * line <= SUB_BYTES and set(parts[0][:4 * line:line]) == {SUB}):
        rows = b''.join(parts)
        lines = np.frombuffer(rows, np.uint8).reshape(png.height, line)
        if (lines[:, 0] == SUB).all():  # so OpenCV writes them; faster than by libpng
            if zlib.adler32(rows) != struct.unpack('>I', checksum)[0]:
                raise damaged("a PNG's pixels fit their checksum", 'others')
            return _undo_sub(lines, png)
    _store(parts, checksum)
    file = b''.join((png.header, *parts, END))
    del parts[:]
    return _decode(file)


def _decode(file: bytes) -> np.ndarray | None:
    picture = cv2.imdecode(np.frombuffer(file, np.uint8),
                           cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if picture is None else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _inflate(data: bytes, png: PngFile) -> tuple[list[bytes], bytes]:
    """All rows with their filter bytes, exactly, and their Adler-32 as it stands in the file.

    The checksum is not compared here: whoever uses the rows does.
    """
    size, view = _inflated_bytes(png), memoryview(data)
    stream, parts, left = zlib.decompressobj(-zlib.MAX_WBITS), [], size
    head = after = b''  # of the zlib stream: two bytes before what is inflated, four behind it
    try:
        for begin, end in png.pixels:
            if len(head) < 2:
                begin, head = begin + 2 - len(head), head + view[begin:end][:2 - len(head)]
                if begin >= end:
                    continue
            if stream.eof:
                after += view[begin:end][:4]
            else:
                parts.append(stream.decompress(view[begin:end], left + 1))
                left -= len(parts[-1])
                if left < 0:
                    raise damaged(f'the pixels of {png.width} x {png.height} in a PNG are '
                                  f'{size} bytes', 'more')
                after = stream.unused_data[:4]
            if len(after) >= 4:
                break
    except zlib.error as error:
        raise damaged("a PNG's pixels can be inflated", str(error)) from error
    if len(head) < 2 or head[0] & 15 != 8 or head[1] & 32 or int.from_bytes(head, 'big') % 31:
        raise damaged('the pixels of a PNG are a zlib stream', head)
    if left or len(after) < 4:
        raise _truncated(f'{size - left} of {size} bytes of pixels')
    return parts, after[:4]


def _store(parts: list[bytes], checksum: bytes) -> None:
    """Make an IDAT chunk of the rows, in place: they are stored, not compressed."""
    blocks: list[bytes] = []
    size = 6
    for part in parts:
        for at in range(0, len(part), STORED_BYTES):
            block = part[at:at + STORED_BYTES]  # itself, where it is no longer
            blocks += (struct.pack('<BHH', 0, len(block), len(block) ^ 0xFFFF), block)
            size += 5 + len(block)
    blocks[-2] = b'\1' + blocks[-2][1:]  # the last
    blocks.append(checksum)
    parts[:] = [b'IDAT\x78\x01', *blocks]
    check = 0
    for part in parts:
        check = zlib.crc32(part, check)
    parts.insert(0, struct.pack('>I', size))
    parts.append(struct.pack('>I', check))


def _undo_sub(lines: np.ndarray, png: PngFile) -> np.ndarray:
    """Pixels [H,W,3] of rows that all have the filter Sub: sums along each row, modulo 256."""
    channels = CHANNELS[png.colour]
    pixels = lines[:, 1:].reshape(png.height, png.width, channels)
    columns = cv2.transpose(pixels).reshape(png.width, -1)
    for x in range(1, png.width):
        np.add(columns[x - 1], columns[x], columns[x])
    picture = cv2.transpose(columns.reshape(png.width, png.height, channels))
    if channels == 3:
        return picture
    return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB if channels == 1 else cv2.COLOR_RGBA2RGB)


def _truncated(received: object) -> ImageError:
    return truncated('a PNG is complete to its end chunk', received)
