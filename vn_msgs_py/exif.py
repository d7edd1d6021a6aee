"""How a camera was held: the orientation in a picture file's EXIF data."""

from __future__ import annotations

import struct
from collections.abc import Callable

import cv2
import numpy as np

ORIENTATION_TAG = 0x0112
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


def read_orientation(exif: bytes) -> int:
    """The orientation, 1 to 8, of EXIF data that begins with its TIFF header.

    Broken or missing data is 1, as stored: it is no fault of the pixels.
    """
    order = {b'II*\0': '<', b'MM\0*': '>'}.get(exif[:4])
    if order is None or len(exif) < 10:
        return 1
    at = struct.unpack(f'{order}I', exif[4:8])[0]
    if at + 2 > len(exif):
        return 1
    fields = struct.unpack_from(f'{order}H', exif, at)[0]
    end = min(at + 2 + fields * FIELD_BYTES, len(exif) - FIELD_BYTES + 1)
    for field in range(at + 2, end, FIELD_BYTES):
        tag, kind, count = struct.unpack_from(f'{order}HHI', exif, field)
        if tag == ORIENTATION_TAG and count == 1 and kind in (3, 4):  # 16 or 32 bits
            value = struct.unpack_from(f'{order}{"H" if kind == 3 else "I"}', exif, field + 8)[0]
            return value if 1 <= value <= 8 else 1
    return 1


def make_upright(picture: np.ndarray, orientation: int) -> np.ndarray:
    """Turn a stored picture [H,W,3] so that up is up; 5 to 8 swap its sides."""
    turn = UPRIGHT.get(orientation)
    return picture if turn is None else turn(picture)
