"""How a camera was held, and what it saw: orientation and focal length in a file's EXIF data."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from vn_msgs_py.camera import field_of_view

ORIENTATION_TAG, EXIF_TAG, FOCAL_35MM_TAG = 0x0112, 0x8769, 0xA405
FILM_DIAGONAL_MM = math.hypot(36, 24)
FOCAL_35MM_MM = 4, 3000  # mm, of a pinhole picture; 0 means unknown
FIELD_BYTES = 12
# What makes a stored picture upright, by the tag's value; 1 is upright already.
UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda picture: cv2.flip(picture, 1),
    3: lambda picture: cv2.rotate(picture, cv2.ROTATE_180),
    4: lambda picture: cv2.flip(picture, 0),
    5: cv2.transpose,
    6: lambda picture: cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE),
    7: lambda picture: cv2.flip(cv2.transpose(picture), -1),
    8: lambda picture: cv2.rotate(picture, cv2.ROTATE_90_COUNTERCLOCKWISE),
}


class Exif(NamedTuple):
    """What EXIF data says of how a picture was taken."""

    orientation: int = 1  # 1 to 8
    focal_35mm: int | None = None  # mm, of the lens with this diagonal view on 35 mm film

    def field_of_view(self, height: int, width: int) -> float | None:
        """Of the shorter side of a whole picture [rad]; None: unknown."""
        if self.focal_35mm is None:
            return None
        focal = math.hypot(height, width) / FILM_DIAGONAL_MM * self.focal_35mm
        return field_of_view(width, height, focal)


def read_exif(exif: bytes) -> Exif:
    """What EXIF data says that begins with its TIFF header.

    Broken or missing data says nothing: it is no fault of the pixels.
    """
    order = {b'II*\0': '<', b'MM\0*': '>'}.get(exif[:4])
    if order is None or len(exif) < 10:
        return Exif()
    begin = struct.unpack(f'{order}I', exif[4:8])[0]
    main = _read_fields(exif, order, begin)
    orientation = main.get(ORIENTATION_TAG, 1)
    focal = _read_fields(exif, order, main.get(EXIF_TAG, len(exif))).get(FOCAL_35MM_TAG, 0)
    return Exif(orientation if 1 <= orientation <= 8 else 1,
                focal if FOCAL_35MM_MM[0] <= focal <= FOCAL_35MM_MM[1] else None)


def _read_fields(exif: bytes, order: str, at: int) -> dict[int, int]:
    """The single whole numbers of a directory at a byte, by tag; the first of each."""
    found: dict[int, int] = {}
    if at + 2 > len(exif):
        return found
    fields = struct.unpack_from(f'{order}H', exif, at)[0]
    end = min(at + 2 + fields * FIELD_BYTES, len(exif) - FIELD_BYTES + 1)
    for field in range(at + 2, end, FIELD_BYTES):
        tag, kind, count = struct.unpack_from(f'{order}HHI', exif, field)
        if count == 1 and kind in (3, 4):  # 16 or 32 bits
            found.setdefault(tag, struct.unpack_from(
                f'{order}{"H" if kind == 3 else "I"}', exif, field + 8)[0])
    return found


def make_upright(picture: np.ndarray, orientation: int) -> np.ndarray:
    """Turn a stored picture [H,W,3] so that up is up; 5 to 8 swap its sides."""
    turn = UPRIGHT.get(orientation)
    return picture if turn is None else turn(picture)
