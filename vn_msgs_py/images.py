"""`sensor_msgs/Image` and `CompressedImage` to arrays and back.

Everything that a message declares is checked before a byte is decoded: a hostile or broken picture
is an `ImageError`, never a crash, a huge allocation or a wrong picture.
"""

from __future__ import annotations

import array
import struct
import sys
from typing import Any, NamedTuple

import cv2
import numpy as np

MAX_PIXELS = 16_000_000  # a 389 kB PNG can otherwise claim gigabytes


class ImageError(ValueError):
    """A picture that cannot be used: states the rule, the value received and the remedy."""

    def __init__(self, rule: str, received: object, remedy: str):
        super().__init__(f'{rule}; received {received!r}; {remedy}')


class Encoding(NamedTuple):
    """How the bytes of an encoding are laid out."""

    dtype: type
    channels: int  # values per pixel in a row of `step` bytes; 4:2:2 has two
    to_rgb: int | None  # OpenCV conversion of the [H,W,channels] array; None: no colour picture
    planes: float = 1.0  # rows of the array per picture row (semi-planar 4:2:0 has 1.5)


ENCODINGS = {
    'rgb8': Encoding(np.uint8, 3, None),
    'bgr8': Encoding(np.uint8, 3, cv2.COLOR_BGR2RGB),
    'rgba8': Encoding(np.uint8, 4, cv2.COLOR_RGBA2RGB),
    'bgra8': Encoding(np.uint8, 4, cv2.COLOR_BGRA2RGB),
    'mono8': Encoding(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    'mono16': Encoding(np.uint16, 1, cv2.COLOR_GRAY2RGB),
    '8UC1': Encoding(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    '8UC3': Encoding(np.uint8, 3, cv2.COLOR_BGR2RGB),  # cv_bridge's meaning of 8UC3 is BGR
    '16UC1': Encoding(np.uint16, 1, None),
    '32FC1': Encoding(np.float32, 1, None),
    'yuv422': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    'nv12': Encoding(np.uint8, 1, cv2.COLOR_YUV2RGB_NV12, 1.5),
    'nv21': Encoding(np.uint8, 1, cv2.COLOR_YUV2RGB_NV21, 1.5),
    # OpenCV names a Bayer pattern by its second row's second and third pixel.
    'bayer_rggb8': Encoding(np.uint8, 1, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr8': Encoding(np.uint8, 1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': Encoding(np.uint8, 1, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg8': Encoding(np.uint8, 1, cv2.COLOR_BayerGB2RGB),
}
# Parts of a JPEG's size that it can be decoded to (libjpeg scales its inverse transform).
REDUCED = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4,
           8: cv2.IMREAD_REDUCED_COLOR_8}
COLOUR = tuple(name for name in ENCODINGS if name not in ('16UC1', '32FC1'))
DEPTH = ('16UC1', 'mono16', '32FC1')
LABELS = ('mono8', '8UC1', '16UC1', 'mono16')


def decode_rgb(message: Any, smallest: int | None = None) -> np.ndarray:
    """A picture as [H,W,3] uint8 RGB, from an Image or a CompressedImage.

    Args:
        message: the picture.
        smallest: pixels that its shorter side must keep. A JPEG is then decoded straight to a
            half, a quarter or an eighth of its size where that leaves as many, in a fraction of
            the time. None: whole.

    Raises:
        ImageError: anything that is not exactly a picture in a known encoding.
    """
    if hasattr(message, 'format'):
        return _decompress(message, smallest)
    raw = _raw_array(message, COLOUR)
    encoding = ENCODINGS[message.encoding]
    if message.encoding == 'rgb8':
        return np.ascontiguousarray(raw)
    if message.encoding == 'mono16':
        raw = (raw >> 8).astype(np.uint8)
    try:
        return cv2.cvtColor(np.ascontiguousarray(raw), encoding.to_rgb)
    except cv2.error as error:
        raise ImageError(f'a {message.encoding} picture has a size that its layout allows',
                         (message.height, message.width), 'check the camera driver') from error


def decode_depth(message: Any) -> np.ndarray:
    """A depth picture as [H,W] float32 metres; NaN where it is unknown (0 or not finite)."""
    raw = _raw_array(message, DEPTH)
    depth = (raw.astype(np.float32) * 1e-3 if raw.dtype == np.uint16  # millimetres, REP 118
             else raw.astype(np.float32))
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    return depth


def decode_labels(message: Any) -> np.ndarray:
    """Class ids as [H,W] uint8 or uint16."""
    return np.ascontiguousarray(_raw_array(message, LABELS))


def _raw_array(message: Any, allowed: tuple[str, ...]) -> np.ndarray:
    """The checked pixels: [H,W] or [H,W,C] in native byte order, padding removed."""
    name = message.encoding
    if name not in allowed:
        raise ImageError(f'the encoding is one of {", ".join(allowed)}', name,
                         'convert it with image_proc, or set the camera driver')
    encoding = ENCODINGS[name]
    height, width, step = int(message.height), int(message.width), int(message.step)
    _check_size(height, width)
    if encoding.planes != 1.0 and (height % 2 or width % 2):
        raise ImageError(f'{name} pictures have even sides', (height, width),
                         'check the camera driver')
    if encoding.channels == 2 and width % 2:
        raise ImageError(f'{name} pictures have an even width', width, 'check the camera driver')
    item = np.dtype(encoding.dtype).itemsize
    row_bytes = width * encoding.channels * item
    if step < row_bytes:
        raise ImageError(f'step is at least {row_bytes} bytes (width x bytes per pixel)', step,
                         'check the camera driver')
    rows = int(height * encoding.planes)
    if len(message.data) != step * rows:
        raise ImageError(f'data has step x rows = {step * rows} bytes', len(message.data),
                         'the message is truncated or mislabelled: check the camera driver')
    data = np.frombuffer(message.data, np.uint8).reshape(rows, step)[:, :row_bytes]
    if item > 1:
        data = np.ascontiguousarray(data).view(encoding.dtype)
        if bool(message.is_bigendian) != (sys.byteorder == 'big'):
            data = data.byteswap()
    if encoding.channels > 1:
        data = data.reshape(rows, width, encoding.channels)
    return data


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ImageError('a picture has at least one pixel', (height, width),
                         'check the camera driver')
    if height * width > MAX_PIXELS:
        raise ImageError(f'a picture has at most {MAX_PIXELS} pixels', (height, width),
                         'lower the resolution of the camera')


def _decompress(message: Any, smallest: int | None) -> np.ndarray:
    data = bytes(message.data)
    kind = str(message.format).lower()
    if 'compresseddepth' in kind:
        raise ImageError('a compressed picture is JPEG or PNG', message.format,
                         'republish depth as raw (image_transport republish)')
    scale = 1
    if data[:3] == b'\xff\xd8\xff':
        size, complete = _jpeg_size(data), data.rstrip(b'\0')[-2:] == b'\xff\xd9'
    elif data[:8] == b'\x89PNG\r\n\x1a\n':
        size, complete = _png_size(data), data[-8:-4] == b'IEND'
    else:
        raise ImageError('a compressed picture is JPEG or PNG', (message.format, data[:8]),
                         'set the format of the camera driver to jpeg or png')
    _check_size(*size)
    if not complete:
        raise ImageError('a compressed picture is complete to its end marker',
                         f'{len(data)} bytes without one', 'the message is truncated: check the '
                         'network and the camera driver')
    if smallest is not None and data[:3] == b'\xff\xd8\xff':
        scale = max((k for k in REDUCED if min(size) // k >= smallest), default=1)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), REDUCED.get(scale, cv2.IMREAD_COLOR))
    except cv2.error as error:
        raise ImageError('a compressed picture can be decoded', str(error).splitlines()[0],
                         'check the camera driver') from error
    if picture is None or picture.shape[:2] != tuple(-(-side // scale) for side in size):
        raise ImageError('a compressed picture can be decoded', f'{len(data)} bytes',
                         'the data is damaged: check the camera driver')
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _png_size(data: bytes) -> tuple[int, int]:
    if len(data) < 33 or data[12:16] != b'IHDR':
        raise ImageError('a PNG begins with its header', data[:16], 'check the camera driver')
    width, height = struct.unpack('>II', data[16:24])
    return height, width


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Height and width from the start-of-frame segment (ITU-T T.81, B.2.2)."""
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack('>HH', data[at + 5:at + 9])
            return height, width
        if marker in (0x01, *range(0xD0, 0xD9)):
            at += 2
            continue
        at += 2 + struct.unpack('>H', data[at + 2:at + 4])[0]
    raise ImageError('a JPEG has a frame header', f'{len(data)} bytes without one',
                     'the data is damaged: check the camera driver')


def fill_image(message: Any, picture: np.ndarray, encoding: str = 'rgb8') -> Any:
    """Put pixels into an Image; the header stays the caller's.

    Args:
        message: a `sensor_msgs/Image`.
        picture: [H,W] or [H,W,C] of the encoding's type.
        encoding: one whose layout is a plain array.

    Returns:
        The message.

    Raises:
        ImageError: the array does not have the encoding's shape and type.
    """
    layout = ENCODINGS.get(encoding)
    if layout is None or layout.planes != 1.0:
        raise ImageError('the encoding to write is a plain array', encoding, 'use rgb8')
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if picture.ndim not in (2, 3) or channels != layout.channels or (
            picture.dtype != layout.dtype):
        raise ImageError(f'{encoding} is {np.dtype(layout.dtype)} with {layout.channels} channels',
                         f'{picture.dtype} {picture.shape}', 'convert the array')
    _check_size(*picture.shape[:2])
    message.height, message.width = picture.shape[:2]
    message.encoding = encoding
    message.is_bigendian = int(sys.byteorder == 'big')
    message.step = picture.shape[1] * channels * picture.itemsize
    # array.array is what rclpy keeps as it is; a list would take forty times as long.
    message.data = array.array('B', np.ascontiguousarray(picture).tobytes())
    return message


def fill_compressed(message: Any, picture: np.ndarray, kind: str = 'jpeg', *,
                    quality: int = 90) -> Any:
    """Put an RGB picture [H,W,3] uint8 into a CompressedImage as 'jpeg' or 'png'."""
    if kind not in ('jpeg', 'png'):
        raise ImageError('pictures are compressed as jpeg or png', kind, 'choose one')
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == 'jpeg' else []
    done, data = cv2.imencode('.jpg' if kind == 'jpeg' else '.png',
                              cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise ImageError('a picture can be compressed', picture.shape, 'check the array')
    message.format = kind
    message.data = array.array('B', data.tobytes())
    return message
