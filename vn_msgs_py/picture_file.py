"""The one decoder of JPEG and PNG: camera messages, bags and goal pictures go through it.

The file's structure is walked first, so that a hostile or broken one is an `ImageError` before a
decoder takes memory for it. What comes out is upright, as the file's EXIF orientation says.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from vn_msgs_py import jpeg_file, png_file
from vn_msgs_py.exif import make_upright
from vn_msgs_py.image_error import MAX_PIXELS, ForeignFormatError, ImageError, check_size

# Parts of a JPEG's size that it can be decoded to (libjpeg scales its inverse transform).
REDUCED = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4,
           8: cv2.IMREAD_REDUCED_COLOR_8}
JPEG_SIGNATURE = b'\xff\xd8\xff'
FOREIGN = ((b'GIF8', 'GIF'), (b'BM', 'BMP'), (b'II*\0', 'TIFF'), (b'MM\0*', 'TIFF'),
           (b'\xff\x0a', 'JPEG XL'), (b'\0\0\0\x0cJXL ', 'JPEG XL'),
           (b'\0\0\0\x0cjP  ', 'JPEG 2000'))  # by the first bytes
HEIF_BRANDS = (b'heic', b'heix', b'heim', b'heis', b'hevc', b'hevx', b'mif1', b'msf1')


class DecodedPicture(NamedTuple):
    """A picture, upright, and what its file says of the camera."""

    picture: np.ndarray  # [H,W,3] uint8 RGB
    fov: float | None  # of its shorter side [rad], by the EXIF focal length; None: unknown


def decode_picture(data: bytes, *, smallest: int | None = None, largest: int = MAX_PIXELS,
                   mosaic: int | None = None) -> np.ndarray:
    """The picture [H,W,3] uint8 RGB in a whole JPEG or PNG file.

    Args:
        data: the file; bytes behind its end are ignored.
        smallest: pixels that its shorter side must keep. A JPEG is then decoded straight to a
            half, a quarter or an eighth of its size where that leaves as many. None: whole.
        largest: pixels that a JPEG may have. One of more than `MAX_PIXELS` is reduced until it
            has no more, whatever `smallest` says.
        mosaic: OpenCV's conversion of the Bayer mosaic that a grey picture holds; None: none.

    Raises:
        ImageError: it is damaged, truncated, too large or in another format.
    """
    return decode_with_lens(data, smallest=smallest, largest=largest, mosaic=mosaic).picture


def decode_with_lens(data: bytes, *, smallest: int | None = None, largest: int = MAX_PIXELS,
                     mosaic: int | None = None) -> DecodedPicture:
    """The picture in a file, and its field of view; see `decode_picture`."""
    grey = False
    try:
        if data[:3] == JPEG_SIGNATURE:
            jpeg = jpeg_file.examine_jpeg(data, largest)
            grey, exif = jpeg.components == 1, jpeg.exif
            fov = exif.field_of_view(jpeg.height, jpeg.width)
            picture = _decode_jpeg(data, jpeg, None if mosaic is not None and grey else smallest)
        elif data[:8] == png_file.SIGNATURE:
            png = png_file.examine_png(data)
            grey, exif = png.colour == 0, png.exif
            fov = exif.field_of_view(png.height, png.width)
            picture = png_file.decode_png(data, png)
            if picture is not None and picture.shape[:2] != (png.height, png.width):
                picture = None
        else:
            raise ForeignFormatError('a compressed picture is JPEG or PNG', _name_format(data),
                                     'set the format of the camera driver to jpeg or png')
        if picture is not None and mosaic is not None and grey:
            picture = cv2.cvtColor(np.ascontiguousarray(picture[:, :, 0]), mosaic)
    except cv2.error as error:
        raise ImageError('a compressed picture can be decoded', str(error).splitlines()[0],
                         'check the camera driver') from error
    if picture is None:
        raise ImageError('a compressed picture can be decoded', f'{len(data)} bytes',
                         'the data is damaged: check the camera driver, or copy the file again')
    return DecodedPicture(make_upright(picture, exif.orientation), fov)


def _decode_jpeg(data: bytes, jpeg: jpeg_file.JpegFile, smallest: int | None) -> np.ndarray | None:
    scale, shorter = 1, min(jpeg.height, jpeg.width)
    while scale < 8 and ((smallest is not None and shorter // (2 * scale) >= smallest)
                         or jpeg.height * jpeg.width > MAX_PIXELS * scale * scale):
        scale *= 2
    height, width = -(-jpeg.height // scale), -(-jpeg.width // scale)
    check_size(height, width)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8, jpeg.end),
                           REDUCED[scale] | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None or picture.shape[:2] != (height, width):
        return None
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _name_format(data: bytes) -> str:
    if data[4:8] == b'ftyp':
        brand = data[8:12]
        return ('HEIC' if brand in HEIF_BRANDS else 'AVIF' if brand in (b'avif', b'avis')
                else f'a file of brand {brand!r}')
    if data[:4] == b'RIFF' and data[8:12] == b'WEBP':  # sounds and films begin alike
        return 'WebP'
    for signature, name in FOREIGN:
        if data.startswith(signature):
            return name
    return f'{len(data)} bytes that begin with {data[:8]!r}'
