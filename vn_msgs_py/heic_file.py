"""HEIC, as iPhones write it: decoded by pillow-heif (libheif), the extra `heic`.

A goal picture alone is read in this format: no camera driver sends it.
"""

from __future__ import annotations

import cv2
import numpy as np

from vn_msgs_py.exif import read_exif
from vn_msgs_py.image_error import ImageError, check_size, damaged
from vn_msgs_py.picture_file import HEIF_BRANDS, DecodedPicture

MAX_HEIC_PX = 52_000_000  # of a phone's largest: it is decoded whole, unlike a JPEG
EXIF_PREFIX = b'Exif\0\0'


class MissingExtraError(ImportError):
    """pillow-heif is not installed."""


def is_heic(data: bytes) -> bool:
    """Whether a file says of itself that it is HEIC."""
    return data[4:8] == b'ftyp' and data[8:12] in HEIF_BRANDS


def decode_heic(data: bytes, *, smallest: int) -> DecodedPicture:
    """The first picture of a HEIC file, upright, and its field of view.

    Args:
        data: the file.
        smallest: pixels that its shorter side must keep; a larger picture is made a half, a
            quarter or an eighth as large.

    Raises:
        MissingExtraError: pillow-heif is not installed.
        ImageError: it is damaged, truncated or too large.
    """
    try:
        import pillow_heif
    except ImportError as error:
        raise MissingExtraError(str(error)) from error
    try:
        file = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)  # its structure alone
        width, height = file.size
        check_size(height, width, MAX_HEIC_PX)
        mode, picture = file.mode, np.asarray(file)
    except ImageError:
        raise
    except Exception as error:  # whatever libheif finds
        raise ImageError('a HEIC file can be decoded', str(error)[:80],
                         'copy the file again') from error
    if picture.dtype != np.uint8 or picture.shape[:2] != (height, width):
        raise damaged('a HEIC file has the size that it says', f'{picture.dtype} {picture.shape}')
    # libheif has turned it: in this format EXIF's orientation repeats what the file itself says.
    if mode == 'L':
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    scale = 1
    while scale < 8 and min(height, width) // (2 * scale) >= smallest:
        scale *= 2
    if scale > 1:
        picture = cv2.resize(picture, (-(-width // scale), -(-height // scale)),
                             interpolation=cv2.INTER_AREA)
    exif = read_exif((file.info.get('exif') or b'').removeprefix(EXIF_PREFIX))
    return DecodedPicture(np.ascontiguousarray(picture[..., :3]),
                          exif.field_of_view(height, width))
