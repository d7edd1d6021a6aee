"""The structure of a JPEG, walked before a decoder takes memory or time for it (ITU-T T.81).

Each data unit of 8 x 8 values costs at least two bits (one in a progressive DC scan), so a file
that is too short for the size it declares is known to be truncated without decoding it.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from vn_msgs_py.exif import Exif, read_exif
from vn_msgs_py.image_error import (
    MAX_PIXELS,
    ImageError,
    TooLargeError,
    check_size,
    damaged,
    truncated,
)

MAX_SEGMENTS = 5_000  # an ICC profile takes up to 255, a large XMP block some hundred
MAX_SCANS = 64  # encoders write 1 to 20
MAX_SCANNED_PX = 40 * MAX_PIXELS  # pixels times scans: each scan passes over the whole picture
MAX_COEFFICIENT_BYTES = 150_000_000  # what a decoder keeps of a picture in several scans
UNIT_BYTES = 128  # of coefficients a data unit
SEARCH_BYTES = 1 << 18  # bytes searched at once for the end of a scan
EXIF = b'Exif\0\0'
BASELINE, EXTENDED, PROGRESSIVE = 0xC0, 0xC1, 0xC2
OTHER_FRAMES = {0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF, 0xDE}
SOI, EOI, SOS, APP1 = 0xD8, 0xD9, 0xDA, 0xE1
TABLES = {0xC4, 0xDB, 0xDD, 0xE0, 0xE2, 0xFE}  # Huffman codes, quantisation, JFIF, ICC ...
ALONE = {0x01, *range(0xD0, 0xD8)}  # markers without a segment


class JpegFile(NamedTuple):
    """What a JPEG says of itself."""

    height: int  # pixels, as stored
    width: int
    components: int  # 1: grey
    exif: Exif
    end: int  # bytes up to and with the end marker; what follows is not part of it


class _Frame:
    """A frame header, and what its scans have brought so far."""

    def __init__(self, marker: int, body: bytes, most: int):
        if len(body) < 6 or len(body) != 6 + 3 * body[5]:
            raise damaged('a JPEG frame header lists its components', f'{len(body)} bytes')
        precision, self.height, self.width, count = struct.unpack_from('>BHHB', body)
        check_size(self.height, self.width, most)
        if precision != 8 or count not in (1, 3, 4):
            raise ImageError('a JPEG has 8 bits and 1, 3 or 4 components', (precision, count),
                             'set the camera driver to 8-bit grey or colour')
        self.progressive = marker == PROGRESSIVE
        across, down = [side >> 4 for side in body[7::3]], [side & 15 for side in body[7::3]]
        self.sampling = dict(zip(body[6::3], zip(across, down, strict=True), strict=True))
        self._most = max(across), max(down)
        if len(self.sampling) != count or max(self._most) > 4 or not (min(across) and min(down)):
            raise damaged('JPEG components differ and are sampled 1 to 4 times', body[6:].hex())
        self._seen: set[int] = set()  # components of which a (DC) scan has come
        self._scans = 0

    def units(self, components: tuple[int, ...]) -> int:
        """Data units of a scan of these components."""
        across, down = self._most
        if len(components) > 1:
            return (-(-self.width // (8 * across)) * -(-self.height // (8 * down))
                    * sum([self.sampling[k][0] * self.sampling[k][1] for k in components]))
        h, v = self.sampling[components[0]]
        if len(self.sampling) == 1:
            h, v, across, down = 1, 1, 1, 1
        return -(-self.width * h // (8 * across)) * -(-self.height * v // (8 * down))

    def begin_scan(self, body: bytes) -> int:
        """Check a scan header; the bits that the scan has at least."""
        count = body[0] if body else 0
        if not 1 <= count <= 4 or len(body) != 4 + 2 * count:
            raise damaged('a JPEG scan header lists its components', body[:16].hex())
        components = tuple(body[1:1 + 2 * count:2])
        new = set(components)
        if len(new) != count or not new <= self.sampling.keys():
            raise damaged("a JPEG scan is of the frame's components", components)
        self._scans += 1
        if self._scans > MAX_SCANS or self._scans * self.height * self.width > MAX_SCANNED_PX:
            raise ImageError(f'a JPEG has at most {MAX_SCANS} scans, fewer if it is large',
                             f'{self._scans} of {self.width} x {self.height}',
                             'save it as a baseline JPEG')
        if self._scans == 1 and (self.progressive or count < len(self.sampling)):
            kept = UNIT_BYTES * self.units(tuple(self.sampling))
            if kept > MAX_COEFFICIENT_BYTES:
                raise TooLargeError(
                    f'a JPEG in several scans takes at most {MAX_COEFFICIENT_BYTES} bytes', kept,
                    'save it as a baseline JPEG, or lower its resolution')
        if not self.progressive:
            if new & self._seen:
                raise damaged('a baseline JPEG has each component in one scan', components)
            self._seen |= new
            return 2 * self.units(components)
        if body[-3] == 0:
            self._seen |= new
            return self.units(components)
        return 0

    def finish(self) -> None:
        """The end marker has come: has everything else?"""
        if self._seen != self.sampling.keys():
            raise _truncated(f'scans of {len(self._seen)} of {len(self.sampling)} components')


def examine_jpeg(data: bytes, most: int = MAX_PIXELS) -> JpegFile:
    """Walk a JPEG from its first to its end marker.

    Args:
        data: the file; bytes after the end marker are not looked at.
        most: pixels that it may have.

    Raises:
        ImageError: it is truncated, contradicts itself or asks for more than is given.
    """
    view = np.frombuffer(data, np.uint8)
    at, frame, exif, segments = 2, None, Exif(), 0
    while True:
        if at + 4 > len(data) and data[at:at + 2] != b'\xff\xd9':
            raise _truncated(f'{len(data)} bytes without an end marker')
        if data[at] != 0xFF:
            raise damaged('a JPEG segment begins with a marker', f'byte {at}: {data[at]:#04x}')
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in ALONE:
            at += 2
            continue
        if marker == EOI:
            break
        segments += 1
        length = struct.unpack_from('>H', data, at + 2)[0]
        if marker in (0, SOI) or length < 2 or segments > MAX_SEGMENTS:
            raise damaged(f'a JPEG has up to {MAX_SEGMENTS} segments with a length each',
                          f'segment {segments} at byte {at}: {marker:#04x}, {length}')
        if at + 2 + length > len(data):
            raise _truncated(f'a segment of {length} bytes at byte {at} of {len(data)}')
        if marker in TABLES:  # the decoder's business
            at += 2 + length
            continue
        body = data[at + 4:at + 2 + length]
        at += 2 + length
        if marker in (BASELINE, EXTENDED, PROGRESSIVE):
            if frame is not None:
                raise damaged('a JPEG has one frame header', 'two')
            frame = _Frame(marker, body, most)
        elif marker in OTHER_FRAMES:
            raise ImageError('a JPEG is baseline or progressive, with Huffman codes',
                             f'frame {marker:#04x}', 'save it as a baseline JPEG')
        elif marker == SOS:
            if frame is None:
                raise damaged('a JPEG has a frame header', 'a scan without one')
            bits, begin = frame.begin_scan(body), at
            at = _scan_end(view, at)
            if 8 * (at - begin) < bits:
                raise _truncated(f'a scan of {at - begin} bytes for {frame.width} x '
                                 f'{frame.height} pixels')
        elif marker == APP1 and exif == Exif() and body[:6] == EXIF:
            exif = read_exif(body[6:])
    if frame is None:
        raise damaged('a JPEG has a frame header', f'{len(data)} bytes without one')
    frame.finish()
    return JpegFile(frame.height, frame.width, len(frame.sampling), exif, at + 2)


def _scan_end(view: np.ndarray, at: int) -> int:
    """Where the first marker is that ends the coded data from `at` on."""
    while at + 1 < len(view):
        part = view[at:at + SEARCH_BYTES]
        marks = (part[:-1] == 0xFF) & (part[1:] != 0)
        first = int(marks.argmax())
        if marks[first]:
            kind = int(part[first + 1])
            if kind != 0xFF and kind not in ALONE:  # most scans hold no marker but their end
                return at + first
            marks &= (part[1:] > 0x01) & (part[1:] != 0xFF) & (part[1:] & 0xF8 != 0xD0)
            first = int(marks.argmax())
            if marks[first]:
                return at + first
        at += len(part) - 1
    raise _truncated(f'{len(view)} bytes without an end marker')


def _truncated(received: object) -> ImageError:
    return truncated('a JPEG is complete to its end marker', received)
