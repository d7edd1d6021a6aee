"""A goal as a file: the picture that somebody took of the place to go to."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np

from vn_msgs_py.image_error import ForeignFormatError, ImageError, TooLargeError
from vn_msgs_py.picture_file import decode_picture
from vn_nav.errors import UserError

MAX_FILE_BYTES = 128_000_000
MAX_JPEG_PX = 256_000_000  # of a phone's largest camera; decoded at a reduced size
KEPT_SIDE_PX = 1000  # of the shorter side: no policy sees more of a picture


def read_goal_picture(path: Path) -> np.ndarray:
    """The picture [H,W,3] uint8 RGB of a JPEG or PNG file, upright.

    A JPEG whose shorter side is 2,000 pixels or more is decoded at a half, a quarter or an eighth
    of its size.

    Raises:
        UserError: there is no such file, or it holds something else.
    """
    rule = 'a goal picture is a JPEG or PNG file'
    source, target = (shlex.quote(str(name)) for name in (path, path.with_suffix('.jpg')))
    if not path.is_file():
        raise UserError(rule, f'{path}: no such file', 'give another one')
    try:
        with path.open('rb') as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise UserError(rule, f'{path}: {error.strerror}', 'give another one') from error
    if len(data) > MAX_FILE_BYTES:
        raise UserError(f'{rule} of at most {MAX_FILE_BYTES} bytes', str(path), _smaller(path))
    try:
        return decode_picture(data, smallest=KEPT_SIDE_PX, largest=MAX_JPEG_PX)
    except ForeignFormatError as error:
        remedy = f'convert it: `convert {source} {target}` (ImageMagick)'
        if error.received == 'HEIC':
            remedy += ', or in Python with pillow-heif'
        raise UserError(rule, f'{path}: {error.received}', remedy) from error
    except TooLargeError as error:
        raise UserError(f'{rule}; {error.rule}', f'{path}: {error.received}',
                        _smaller(path)) from error
    except ImageError as error:
        raise UserError(rule, f'{path}: {error.rule}, not {error.received}',
                        'copy the file again, or give another one') from error


def _smaller(path: Path) -> str:
    target = path.with_name(f'{path.stem}_small.jpg')
    return (f'make it smaller: `convert {shlex.quote(str(path))} -auto-orient -resize 2000x2000 '
            f'{shlex.quote(str(target))}` (ImageMagick)')
