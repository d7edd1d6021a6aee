"""A goal as a file: the picture that somebody took of the place to go to."""

from __future__ import annotations

import itertools
import os
import shlex
from pathlib import Path

from vn_msgs_py.heic_file import MissingExtraError, decode_heic, is_heic
from vn_msgs_py.image_error import ForeignFormatError, ImageError, TooLargeError
from vn_msgs_py.picture_file import DecodedPicture, decode_with_lens
from vn_nav.errors import UserError

MAX_FILE_BYTES = 128_000_000
MAX_JPEG_PX = 256_000_000  # of a phone's largest camera; decoded at a reduced size
TEXT_BYTES = 256  # that are looked at: is it text?
READ_BY_IMAGEMAGICK = {  # by the names of `ForeignFormatError`, its own names
    'HEIC': 'heic', 'AVIF': 'avif', 'GIF': 'gif', 'BMP': 'bmp', 'TIFF': 'tiff', 'WebP': 'webp',
    'JPEG XL': 'jxl', 'JPEG 2000': 'jp2'}
SEVERAL = ('GIF', 'TIFF', 'WebP')  # may hold several pictures
KEPT_SIDE_PX = 1000  # of the shorter side: no policy sees more of a picture


def read_goal_picture(path: Path) -> DecodedPicture:
    """The picture of a JPEG, PNG or HEIC file, upright, and its field of view if the file says it.

    A JPEG whose shorter side is 2,000 pixels or more is decoded at a half, a quarter or an eighth
    of its size. HEIC needs the extra `heic`.

    Raises:
        UserError: there is no such file, it holds something else, or the extra is missing.
    """
    rule = 'a goal picture is a JPEG, PNG or HEIC file'
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
        if is_heic(data):
            return decode_heic(data, smallest=KEPT_SIDE_PX)
        return decode_with_lens(data, smallest=KEPT_SIDE_PX, largest=MAX_JPEG_PX)
    except MissingExtraError as error:
        raise UserError("a HEIC goal picture is read with the extra 'heic', pillow-heif",
                        str(path), f"pip install pillow-heif, or "
                        f"{_conversion(path, 'HEIC')}") from error
    except ForeignFormatError as error:
        kind = _received(data, error)
        raise UserError(rule, f'{path}: {kind}', _conversion(path, kind)) from error
    except TooLargeError as error:
        raise UserError(f'{rule}; {error.rule}', f'{path}: {error.received}',
                        _smaller(path)) from error
    except ImageError as error:
        raise UserError(rule, f'{path}: {error.rule}, not {error.received}',
                        'copy the file again, or give another one') from error


def _received(data: bytes, error: ForeignFormatError) -> str:
    """What a file that is neither JPEG nor PNG holds, for people."""
    if not data:
        return 'an empty file'
    try:
        text = data[:TEXT_BYTES].decode('utf-8')
    except UnicodeDecodeError as broken:  # the last letter may be cut
        text = data[:broken.start].decode('utf-8') if broken.start > TEXT_BYTES - 4 else ''
    if text and all(letter.isprintable() or letter in '\t\r\n' for letter in text):
        return f'text that begins with {text.strip()[:20]!r}'
    return str(error.received)


def _conversion(path: Path, kind: str) -> str:
    """How to make a JPEG of a file; out of what is no picture none can be made."""
    if kind not in READ_BY_IMAGEMAGICK:
        return 'copy it again, or give another one'
    # By its kind, whatever the name says; of several pictures the first one.
    source = shlex.quote(f'{READ_BY_IMAGEMAGICK[kind]}:{path}' + '[0]' * (kind in SEVERAL))
    target = shlex.quote(_argument(_free_name(path)))
    return f'convert it: `convert {source} {target}` (ImageMagick)'


def _free_name(path: Path, part: str = '') -> Path:
    """A JPEG in the folder of a file whose name is free: a command overwrites what is there."""
    for number in itertools.count():
        more = '_'.join(filter(None, (part, str(number) if number else '')))
        found = path.with_name(f'{path.stem}{f"_{more}" if more else ""}.jpg')
        if not os.path.lexists(found):
            return found
    raise AssertionError('names without end')


def _argument(path: Path) -> str:
    """A path as an argument of a command: one that begins with - would be an option."""
    return f'./{path}' if str(path).startswith('-') else str(path)


def _smaller(path: Path) -> str:
    source, target = (shlex.quote(_argument(name)) for name in (path, _free_name(path, 'small')))
    return (f'make it smaller: `convert {source} -auto-orient -resize 2000x2000 {target}` '
            '(ImageMagick)')
