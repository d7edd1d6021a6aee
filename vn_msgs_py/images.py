"""`sensor_msgs/Image` and `CompressedImage` to arrays and back.

Everything that a message declares is checked before a byte is decoded: a hostile or broken picture
is an `ImageError`, never a crash, a huge allocation or a wrong picture.
"""

from __future__ import annotations

import array
import sys
from typing import Any, NamedTuple

import cv2
import numpy as np

from vn_msgs_py.image_error import ImageError, check_size
from vn_msgs_py.picture_file import decode_picture


class Encoding(NamedTuple):
    """How the bytes of an encoding are laid out."""

    dtype: type
    channels: int  # values per pixel in a row of `step` bytes; 4:2:2 has two
    to_rgb: int | None  # OpenCV conversion of the [H,W,channels] array; None: no colour picture
    planes: float = 1.0  # rows of the array per picture row (semi-planar: 4:2:0 1.5, 4:4:4 3)


# All of `sensor_msgs/image_encodings` that carry colour or grey. What cv_bridge gives to 8UC3,
# 8UC4 and the like is in OpenCV's order, BGR. Of 16 bits the upper 8 are kept.
ENCODINGS = {
    'rgb8': Encoding(np.uint8, 3, None),
    'bgr8': Encoding(np.uint8, 3, cv2.COLOR_BGR2RGB),
    'rgba8': Encoding(np.uint8, 4, cv2.COLOR_RGBA2RGB),
    'bgra8': Encoding(np.uint8, 4, cv2.COLOR_BGRA2RGB),
    'rgb16': Encoding(np.uint16, 3, None),
    'bgr16': Encoding(np.uint16, 3, cv2.COLOR_BGR2RGB),
    'rgba16': Encoding(np.uint16, 4, cv2.COLOR_RGBA2RGB),
    'bgra16': Encoding(np.uint16, 4, cv2.COLOR_BGRA2RGB),
    'mono8': Encoding(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    'mono16': Encoding(np.uint16, 1, cv2.COLOR_GRAY2RGB),
    '8UC1': Encoding(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    '8UC3': Encoding(np.uint8, 3, cv2.COLOR_BGR2RGB),
    '8UC4': Encoding(np.uint8, 4, cv2.COLOR_BGRA2RGB),
    '16UC3': Encoding(np.uint16, 3, cv2.COLOR_BGR2RGB),
    '16UC4': Encoding(np.uint16, 4, cv2.COLOR_BGRA2RGB),
    '16UC1': Encoding(np.uint16, 1, None),
    '32FC1': Encoding(np.float32, 1, None),
    'yuv422': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    'uyvy': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    'yuyv': Encoding(np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    'nv12': Encoding(np.uint8, 1, cv2.COLOR_YUV2RGB_NV12, 1.5),
    'nv21': Encoding(np.uint8, 1, cv2.COLOR_YUV2RGB_NV21, 1.5),
    'nv24': Encoding(np.uint8, 1, cv2.COLOR_YUV2RGB_YUY2, 3.0),
    # OpenCV names a Bayer pattern by its second row's second and third pixel.
    **{f'bayer_{pattern}{bits}': Encoding(dtype, 1, code)
       for bits, dtype in ((8, np.uint8), (16, np.uint16))
       for pattern, code in (('rggb', cv2.COLOR_BayerBG2RGB), ('bggr', cv2.COLOR_BayerRG2RGB),
                             ('gbrg', cv2.COLOR_BayerGR2RGB), ('grbg', cv2.COLOR_BayerGB2RGB))},
}
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
    if message.encoding == 'nv24':
        raw = _yuyv_of_nv24(message, raw)
    if raw.dtype == np.uint16:
        raw = (raw >> 8).astype(np.uint8)
    if encoding.to_rgb is None:
        return np.ascontiguousarray(raw)
    try:
        picture = cv2.cvtColor(np.ascontiguousarray(raw), encoding.to_rgb)
    except cv2.error as error:
        raise ImageError(f'a {message.encoding} picture has a size that its layout allows',
                         (message.height, message.width), 'check the camera driver') from error
    return picture[:, ::2].copy() if message.encoding == 'nv24' else picture


def _yuyv_of_nv24(message: Any, rows: np.ndarray) -> np.ndarray:
    """Each pixel of 4:4:4 as two of 4:2:2, [H,2W,2]: OpenCV has no conversion of nv24 itself.

    Args:
        message: the picture.
        rows: [3H,step], padding kept: a row of its chroma plane takes two.
    """
    height, width = int(message.height), int(message.width)
    luma = rows[:height, :width]
    chroma = rows[height:].reshape(height, -1)[:, :2 * width].reshape(height, width, 2)
    return np.stack([luma, chroma[..., 0], luma, chroma[..., 1]], axis=2).reshape(
        height, 2 * width, 2)


def decode_depth(message: Any) -> np.ndarray:
    """A depth picture as [H,W] float32 metres; NaN where it is unknown (0 or not finite)."""
    raw = _raw_array(message, DEPTH)
    depth = (raw.astype(np.float32) * 1e-3 if raw.dtype == np.uint16  # millimetres, REP 118
             else raw.astype(np.float32))
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    return depth


def label_encoding(labels: np.ndarray) -> str:
    """The encoding of class ids [H,W] uint8 or uint16."""
    return 'mono8' if labels.dtype == np.uint8 else '16UC1'


def decode_labels(message: Any) -> np.ndarray:
    """Class ids as [H,W] uint8 or uint16."""
    return np.ascontiguousarray(_raw_array(message, LABELS))


def _raw_array(message: Any, allowed: tuple[str, ...]) -> np.ndarray:
    """The checked pixels: [H,W] or [H,W,C] in native byte order, padding removed."""
    name = message.encoding
    if name not in allowed:
        some = ', '.join(allowed[:6]) + (', ... (docs/bags.md)' if len(allowed) > 6 else '')
        raise ImageError(f'the encoding is one of {some}', name,
                         'convert it with image_proc, or set the camera driver')
    encoding = ENCODINGS[name]
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_size(height, width)
    if encoding.planes == 1.5 and (height % 2 or width % 2):
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
    data: np.ndarray = np.frombuffer(message.data, np.uint8).reshape(rows, step)
    if encoding.planes == 3.0:
        return data  # two of its rows of padding may lie together
    data = data[:, :row_bytes]
    if item > 1:
        data = np.ascontiguousarray(data).view(encoding.dtype)
        if bool(message.is_bigendian) != (sys.byteorder == 'big'):
            data = data.byteswap()
    if encoding.channels > 1:
        data = data.reshape(rows, width, encoding.channels)
    return data


def _decompress(message: Any, smallest: int | None) -> np.ndarray:
    words = str(message.format).lower()
    if 'compresseddepth' in words:
        raise ImageError('a compressed picture is JPEG or PNG', message.format,
                         'republish depth as raw (image_transport republish)')
    # image_transport: '<encoding>; jpeg compressed <encoding of the file>'
    name = words.partition(';')[0].strip()
    if name in ('16uc1', '32fc1'):
        raise ImageError('a compressed picture is grey or colour', message.format,
                         'name the topic of the camera, not of its depth')
    mosaic = ENCODINGS[name].to_rgb if name.startswith('bayer_') and name in ENCODINGS else None
    return decode_picture(bytes(message.data), smallest=smallest, mosaic=mosaic)


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
    check_size(*picture.shape[:2])
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
