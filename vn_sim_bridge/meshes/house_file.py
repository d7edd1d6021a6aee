"""Files of many houses, one a line: `.jsonl`, `.jsonl.gz`. After one pass any house is at hand.

The pass goes as far as somebody asks. It notes where houses begin and, every few megabytes, a
point from which reading can go on: of a gzip file that is the state of its decompressor.
"""

from __future__ import annotations

import bisect
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

MOST_BYTES = 64 << 20  # of one house: those of ProcTHOR-10K have 0.1 MB
CHUNK, PIECE = 1 << 16, 1 << 18  # bytes read at a time, bytes that come of them at most
SPACING = 4 << 20  # bytes of text between points; the state of one has 50 KB
GZIP = 31  # of `zlib.decompressobj`: with gzip's header and checksum


class Point(NamedTuple):
    """Where reading can go on."""

    text: int  # bytes of text before it
    file: int  # bytes of the file before it
    inflate: Any = None  # the decompressor there; None: one that begins a new part


class HouseFile:
    """The houses of a file, as bytes.

    Args:
        path: of a file; `.gz` is unpacked. Without `.jsonl` it is one house.

    Attributes:
        passed: bytes of text that were read so far, again or not.
    """

    def __init__(self, path: Path):
        self.path, self.passed = path, 0
        self._lines, self._packed = '.jsonl' in path.suffixes, path.suffix == '.gz'
        self._begin()

    def _begin(self) -> None:
        self._stamp: tuple[int, int] | None = None  # of the file that is known
        self._spans: list[tuple[int, int]] = []  # of the text of each house
        self._points = [Point(0, 0)]
        self._pass = self._find()

    def text(self, number: int) -> bytes | None:
        """House `number`, from 0; None: there are not so many.

        Raises:
            OSError, EOFError, zlib.error: it cannot be read, or ends early.
            ValueError: a house is too long.
        """
        if not self.has(number):
            return None
        start, end = self._spans[number]
        point = self._points[bisect.bisect_right(self._points, start, key=lambda p: p.text) - 1]
        at, parts = point.text, []
        for piece, after in self._pieces(point):
            parts.append(piece[max(start - at, 0):end - at])
            at = after.text
            if at >= end:
                break
        return b''.join(parts)

    def has(self, number: int) -> bool:
        """Whether there are so many houses; raises as `text` does."""
        stat = self.path.stat()
        if self._stamp != (now := (stat.st_size, stat.st_mtime_ns)):  # another file than before
            self._begin()
            self._stamp = now
        try:
            while len(self._spans) <= number:
                if next(self._pass, None) is None:
                    return False
        except Exception:
            self._begin()
            raise
        return True

    def _find(self) -> Iterator[bool]:
        """The one pass: notes points and houses; a step for each piece."""
        start, end, blank = 0, 0, True  # of the line that is being read
        for piece, after in self._pieces(self._points[0]):
            begin, at = after.text - len(piece), 0
            while self._lines and (found := piece.find(b'\n', at)) >= 0:
                if not blank or piece[at:found].strip():
                    self._spans.append((start, begin + found))
                start, blank, at = begin + found + 1, True, found + 1
            blank = blank and not piece[at:].strip()
            if after.text - start >= MOST_BYTES:
                raise ValueError(f'a house has more than {MOST_BYTES >> 20} MiB')
            if after.text - self._points[-1].text >= SPACING:
                self._points.append(after._replace(
                    inflate=after.inflate and after.inflate.copy()))
            end = after.text
            yield True
        if not blank:
            self._spans.append((start, end))
            yield True

    def _pieces(self, point: Point) -> Iterator[tuple[bytes, Point]]:
        """The text from a point on, and the point after each piece."""
        text, inflate = point.text, point.inflate and point.inflate.copy()
        with self.path.open('rb') as file:
            file.seek(point.file)
            raw, full = b'', inflate is not None  # left to unpack; more may come of what was fed
            while True:
                if not raw and not full and not (raw := file.read(CHUNK)):
                    break
                if not self._packed:
                    piece, raw = raw, b''
                else:
                    if inflate is None:  # a part of the file; zeros may fill what follows it
                        if not (raw := raw.lstrip(b'\0')):
                            continue
                        inflate = zlib.decompressobj(GZIP)
                    piece = inflate.decompress(raw, PIECE)
                    full = len(piece) == PIECE
                    raw = inflate.unconsumed_tail
                    if inflate.eof:
                        raw, full, inflate = inflate.unused_data, False, None
                text += len(piece)
                self.passed += len(piece)
                yield piece, Point(text, file.tell() - len(raw), inflate)
        if inflate is not None:
            raise EOFError('the file ends early')
