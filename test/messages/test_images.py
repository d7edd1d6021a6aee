"""Pictures in every encoding, and every kind of broken picture."""

import array
import struct
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vn_msgs_py import images
from vn_msgs_py.images import ImageError, decode_depth, decode_labels, decode_rgb
from vn_nav.observation import preprocess


def image(**fields):
    """A message as rclpy or rosbags would give it."""
    message = SimpleNamespace(height=4, width=6, encoding='rgb8', is_bigendian=0, step=18,
                              data=array.array('B', bytes(range(72))))
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def compressed(data, kind='jpeg'):
    return SimpleNamespace(format=kind, data=array.array('B', data))


@pytest.fixture
def picture():
    """Smooth colours, 16 x 24, so that subsampled encodings can hold it."""
    y, x = np.mgrid[:16, :24]
    return np.stack([x * 10, y * 15, 255 - x * 5 - y * 5], axis=2).astype(np.uint8)


def test_rgb_is_read_as_it_stands():
    decoded = decode_rgb(image())
    assert decoded.shape == (4, 6, 3)
    assert decoded[1, 2].tolist() == [24, 25, 26]


@pytest.mark.parametrize('name, convert', [
    ('bgr8', cv2.COLOR_RGB2BGR), ('rgba8', cv2.COLOR_RGB2RGBA), ('bgra8', cv2.COLOR_RGB2BGRA),
    ('8UC3', cv2.COLOR_RGB2BGR), ('8UC4', cv2.COLOR_RGB2BGRA),
])
def test_channel_orders_come_back_as_rgb(picture, name, convert):
    message = images.fill_image(SimpleNamespace(), cv2.cvtColor(picture, convert), name)
    assert np.array_equal(decode_rgb(message), picture)


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('name, convert', [
    ('rgb16', None), ('bgr16', cv2.COLOR_RGB2BGR), ('rgba16', cv2.COLOR_RGB2RGBA),
    ('bgra16', cv2.COLOR_RGB2BGRA), ('16UC3', cv2.COLOR_RGB2BGR), ('16UC4', cv2.COLOR_RGB2BGRA),
])
def test_sixteen_bits_a_channel_keep_the_upper_eight(picture, name, convert, big):
    deep = picture.astype(np.uint16) * 256 + 77
    deep = deep if convert is None else cv2.cvtColor(deep, convert)
    message = image(height=16, width=24, step=24 * 2 * deep.shape[2], encoding=name,
                    is_bigendian=int(big), data=deep.astype('>u2' if big else '<u2').tobytes())
    assert np.array_equal(decode_rgb(message), picture)


def test_every_encoding_of_jazzy_that_carries_colour_is_known():
    # sensor_msgs/image_encodings.hpp; signed, 32- and 64-bit ones say nothing of colour.
    assert {'rgb8', 'rgba8', 'rgb16', 'rgba16', 'bgr8', 'bgra8', 'bgr16', 'bgra16', 'mono8',
            'mono16', '8UC1', '8UC3', '8UC4', '16UC3', '16UC4', 'yuv422', 'uyvy', 'yuv422_yuy2',
            'yuyv', 'nv21', 'nv24', *(f'bayer_{pattern}{bits}' for bits in (8, 16)
                                      for pattern in ('rggb', 'bggr', 'gbrg', 'grbg'))
            } <= set(images.COLOUR)


def test_grey_becomes_three_equal_channels(picture):
    grey = np.ascontiguousarray(picture[:, :, 0])
    for name in ('mono8', '8UC1'):
        decoded = decode_rgb(images.fill_image(SimpleNamespace(), grey, name))
        assert np.array_equal(decoded, np.repeat(grey[:, :, None], 3, axis=2))
    deep = images.fill_image(SimpleNamespace(), grey.astype(np.uint16) * 257, 'mono16')
    assert np.array_equal(decode_rgb(deep)[:, :, 0], grey)


@pytest.mark.parametrize('name, red, blue', [
    ('bayer_rggb8', (0, 0), (1, 1)), ('bayer_bggr8', (1, 1), (0, 0)),
    ('bayer_gbrg8', (1, 0), (0, 1)), ('bayer_grbg8', (0, 1), (1, 0)),
])
def test_bayer_patterns_put_red_where_it_belongs(name, red, blue):
    mosaic = np.full((16, 16), 100, np.uint8)
    mosaic[red[0]::2, red[1]::2] = 200
    mosaic[blue[0]::2, blue[1]::2] = 30
    message = image(height=16, width=16, step=16, encoding=name, data=mosaic.tobytes())
    assert np.abs(decode_rgb(message)[4:12, 4:12].astype(int) - [200, 100, 30]).max() <= 1
    deep = image(height=16, width=16, step=32, encoding=f'{name[:-1]}16',
                 data=(mosaic.astype('<u2') * 256 + 99).tobytes())
    assert np.array_equal(decode_rgb(deep), decode_rgb(message))


@pytest.mark.parametrize('name, order', [
    ('yuv422', (1, 0, 3, 2)), ('uyvy', (1, 0, 3, 2)), ('yuv422_yuy2', (0, 1, 2, 3)),
    ('yuyv', (0, 1, 2, 3)),
])
def test_packed_yuv(name, order):
    # One flat colour: Y 120, U 90, V 200 in BT.601 is a strong red.
    row = np.array([120, 90, 120, 200], np.uint8)[list(order)]
    message = image(height=2, width=4, step=8, encoding=name, data=np.tile(row, 4).tobytes())
    rgb = decode_rgb(message)
    assert rgb.shape == (2, 4, 3)
    assert rgb[0, 0, 0] > 200 and rgb[0, 0, 1] < 110 and rgb[0, 0, 2] < 90


@pytest.mark.parametrize('name', ['nv12', 'nv21'])
def test_semi_planar_yuv(name):
    chroma = (90, 200) if name == 'nv12' else (200, 90)
    planes = np.concatenate([np.full((4, 4), 120), np.tile(chroma, (2, 2))]).astype(np.uint8)
    rgb = decode_rgb(image(height=4, width=4, step=4, encoding=name, data=planes.tobytes()))
    assert rgb.shape == (4, 4, 3) and rgb[0, 0, 0] > 200 and rgb[0, 0, 2] < 90


@pytest.mark.parametrize('padding', [0, 3])
def test_semi_planar_yuv_of_full_resolution(padding):
    """Of V4L2's NV24 a chroma row takes two steps; each pixel has a colour of its own."""
    chance = np.random.default_rng(0)
    luma, chroma = (chance.integers(16, 236, size, np.uint8) for size in ((3, 5), (3, 5, 2)))
    rows = np.zeros((9, 5 + padding), np.uint8)
    rows[:3, :5] = luma
    rows[3:].reshape(3, -1)[:, :10] = chroma.reshape(3, 10)
    rgb = decode_rgb(image(height=3, width=5, step=5 + padding, encoding='nv24',
                           data=rows.tobytes()))
    y, u, v = luma - 16.0, chroma[..., 0] - 128.0, chroma[..., 1] - 128.0
    right = np.stack([1.164 * y + 1.596 * v, 1.164 * y - 0.813 * v - 0.391 * u,
                      1.164 * y + 2.018 * u], axis=2).clip(0, 255)
    assert rgb.shape == (3, 5, 3) and np.abs(rgb - right).max() <= 2


def test_padding_at_the_end_of_rows_is_dropped(picture):
    height, width = picture.shape[:2]
    padded = np.full((height, width * 3 + 5), 7, np.uint8)
    padded[:, :width * 3] = picture.reshape(height, -1)
    message = image(height=height, width=width, step=width * 3 + 5, data=padded.tobytes())
    assert np.array_equal(decode_rgb(message), picture)


@pytest.mark.parametrize('big', [False, True])
def test_depth_in_both_byte_orders(big):
    millimetres = np.array([[0, 1500], [65535, 1]], '>u2' if big else '<u2')
    depth = decode_depth(image(height=2, width=2, step=4, encoding='16UC1', is_bigendian=int(big),
                               data=millimetres.tobytes()))
    assert np.isnan(depth[0, 0]) and np.allclose(depth[0, 1], 1.5) and np.allclose(
        depth[1], [65.535, 0.001])
    metres = np.array([[2.5, np.inf]], '>f4' if big else '<f4')
    depth = decode_depth(image(height=1, width=2, step=8, encoding='32FC1', is_bigendian=int(big),
                               data=metres.tobytes()))
    assert depth[0, 0] == 2.5 and np.isnan(depth[0, 1])


def test_labels():
    message = images.fill_image(SimpleNamespace(), np.array([[3, 9]], np.uint8), 'mono8')
    assert decode_labels(message).tolist() == [[3, 9]]


@pytest.mark.parametrize('broken, word', [
    ({'encoding': 'mystery'}, 'encoding'),
    ({'height': 0}, 'at least one pixel'),
    ({'width': 0, 'step': 0}, 'at least one pixel'),
    ({'step': 17}, 'step'),
    ({'data': bytes(71)}, 'step x rows'),
    ({'data': bytes(73)}, 'step x rows'),
    ({'height': 100_000, 'width': 100_000, 'step': 300_000}, 'at most'),
    ({'encoding': 'nv12', 'height': 3}, 'even'),
    ({'encoding': 'yuv422', 'width': 5, 'step': 18}, 'even'),
])
def test_broken_messages_are_refused_with_the_rule(broken, word):
    with pytest.raises(ImageError, match=word) as caught:
        decode_rgb(image(**broken))
    assert 'received' in str(caught.value)


@pytest.mark.parametrize('kind', ['jpeg', 'png'])
def test_compressed_round_trip(picture, kind):
    message = images.fill_compressed(SimpleNamespace(), picture, kind, quality=95)
    decoded = decode_rgb(message)
    assert np.abs(decoded.astype(int) - picture).max() <= (0 if kind == 'png' else 12)


def test_a_jpeg_is_decoded_no_larger_than_needed():
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 256, (12, 16, 3), np.uint8), (640, 480),
                         interpolation=cv2.INTER_CUBIC)
    message = images.fill_compressed(SimpleNamespace(), picture, 'jpeg', quality=95)
    whole = decode_rgb(message)
    for smallest, shape in ((None, (480, 640)), (241, (480, 640)), (240, (240, 320)),
                            (84, (120, 160)), (60, (60, 80)), (10, (60, 80))):
        small = decode_rgb(message, smallest)
        assert small.shape[:2] == shape
        gap = np.abs(preprocess(small, 60).astype(int) - preprocess(whole, 60))
        assert gap.mean() < 1 and gap.max() <= 12
    odd = images.fill_compressed(SimpleNamespace(), picture[:483 - 6, :637], 'jpeg')
    assert decode_rgb(odd, 100).shape == (120, 160, 3)
    png = images.fill_compressed(SimpleNamespace(), picture, 'png')
    assert np.array_equal(decode_rgb(png, 84), picture)


def test_truncated_and_foreign_compressed_pictures(picture):
    for kind in ('jpeg', 'png'):
        data = bytes(images.fill_compressed(SimpleNamespace(), picture, kind).data)
        with pytest.raises(ImageError):
            decode_rgb(compressed(data[:len(data) * 2 // 3], kind))
    with pytest.raises(ImageError, match='JPEG or PNG'):
        decode_rgb(compressed(b'GIF89a' + bytes(50)))
    with pytest.raises(ImageError, match='JPEG or PNG'):
        decode_rgb(compressed(b'\x89PNG', '16UC1; compressedDepth png'))


def test_a_huge_png_is_refused_by_its_header(picture):
    data = bytearray(images.fill_compressed(SimpleNamespace(), picture, 'png').data)
    data[16:24] = struct.pack('>II', 30_000, 30_000)
    with pytest.raises(ImageError, match='at most'):
        decode_rgb(compressed(bytes(data), 'png'))


def test_mutated_messages_end_in_a_picture_or_an_image_error(picture):
    rng = np.random.default_rng(0)
    names = [*images.ENCODINGS, 'nonsense']
    originals = {k: bytes(images.fill_compressed(SimpleNamespace(), picture, k).data)
                 for k in ('jpeg', 'png')}
    refused = 0
    for _ in range(4000):
        if rng.random() < 0.5:
            message = image(height=int(rng.integers(0, 9)), width=int(rng.integers(0, 9)),
                            step=int(rng.integers(0, 40)), is_bigendian=int(rng.integers(2)),
                            encoding=names[rng.integers(len(names))],
                            data=rng.bytes(int(rng.integers(0, 200))))
        else:
            kind = ('jpeg', 'png')[rng.integers(2)]
            data = bytearray(originals[kind])
            for _ in range(int(rng.integers(1, 6))):
                data[rng.integers(len(data))] = rng.integers(256)
            message = compressed(bytes(data[:int(rng.integers(1, len(data) + 1))]), kind)
        try:
            decoded = decode_rgb(message)
            assert decoded.dtype == np.uint8 and decoded.ndim == 3
        except ImageError:
            refused += 1
    assert 0 < refused < 4000


def test_fill_refuses_what_is_no_such_picture(picture):
    with pytest.raises(ImageError):
        images.fill_image(SimpleNamespace(), picture.astype(np.float32), 'rgb8')
    with pytest.raises(ImageError):
        images.fill_image(SimpleNamespace(), picture, 'nv12')
    with pytest.raises(ImageError):
        images.fill_image(SimpleNamespace(), picture[:, :, 0], 'nv24')
    message = images.fill_image(SimpleNamespace(), picture, 'rgb8')
    assert message.is_bigendian == int(sys.byteorder == 'big')
