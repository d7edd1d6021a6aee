"""Picture files: upright, whole with whatever lies behind their end, at a bounded cost.

A child process decodes hostile and mutated files and measures its peak of memory.
VN_NAV_PICTURE_MUTATIONS=100000 is the long form (`make soak`).
"""

import json
import math
import os
import random
import struct
import subprocess
import sys
import time
import traceback
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import picture_bytes
import pytest
from paths import TESTS
from picture_bytes import chunk, encoded, jpeg, photo, png, segment, with_exif
from small_bags import START, make, write

from vn_msgs_py.exif import read_exif
from vn_msgs_py.image_error import ForeignFormatError, ImageError
from vn_msgs_py.images import decode_rgb
from vn_msgs_py.picture_file import decode_picture, decode_with_lens
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.goal_picture import KEPT_SIDE_PX, MAX_JPEG_PX

MUTATIONS = int(os.environ.get('VN_NAV_PICTURE_MUTATIONS', 3000))
MEMORY = 200_000_000  # bytes beyond what the process has when it begins, the file itself included
SECONDS = 0.2  # of CPU for a file that is refused; twice as much may pass on a loaded machine
# As a viewer has to turn the stored picture: NumPy's own words, not the decoder's.
TURNS = {1: lambda p: p, 2: np.fliplr, 3: lambda p: np.rot90(p, 2), 4: np.flipud,
         5: lambda p: p.swapaxes(0, 1), 6: lambda p: np.rot90(p, -1),
         7: lambda p: np.rot90(p, 2).swapaxes(0, 1), 8: lambda p: np.rot90(p, 1)}


@pytest.fixture(scope='module')
def files():
    """Sound files of one picture, by name."""
    return sound()


def sound():
    shot = photo()
    grey = np.ascontiguousarray(shot[:, :, 0])
    rows = b''.join(b'\0' + row.tobytes() for row in shot)
    alpha = np.dstack([shot, grey])
    return {
        'baseline': encoded(shot, '.jpg', cv2.IMWRITE_JPEG_QUALITY, 95),
        'progressive': encoded(shot, '.jpg', cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        'restarts': encoded(shot, '.jpg', cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        'grey jpeg': encoded(grey, '.jpg'),
        'png': encoded(shot, '.png'), 'all filters': encoded(shot, '.png', 16, 6),
        'no filter': png(64, 48, zlib.compress(rows)),
        'stored': png(64, 48, zlib.compress(rows, 0)),
        'grey png': encoded(grey, '.png'),
        'alpha': encoded(np.ascontiguousarray(alpha[..., [2, 1, 0, 3]]), '.png'),
        '16 bits': encoded(shot.astype(np.uint16) * 257, '.png'),
        'one bit': encoded((grey > 128).astype(np.uint8) * 255, '.png', cv2.IMWRITE_PNG_BILEVEL,
                           1),
        'interlaced': interlaced(shot),
    }


def interlaced(picture):
    """An Adam7 PNG without filters."""
    rows = []
    for x, y, across, down in ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4),
                               (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)):
        rows += [b'\0' + row.tobytes() for row in picture[y::down, x::across] if row.size]
    return png(picture.shape[1], picture.shape[0], zlib.compress(b''.join(rows)), interlace=1)


def test_every_kind_is_decoded_as_opencv_does(files):
    for name, data in files.items():
        plain = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(decode_picture(data), plain[..., ::-1]), name
    for name in ('png', 'all filters', 'no filter', 'stored', 'alpha', '16 bits', 'interlaced'):
        assert np.array_equal(decode_picture(files[name]), photo()), name


@pytest.mark.parametrize('size', [(1, 1), (1, 70), (70, 1), (3, 5), (129, 67)])
def test_pngs_of_every_size_come_back_bit_for_bit(size):
    shot = photo(*size)
    for options in ((), (16, 6), (cv2.IMWRITE_PNG_STRATEGY, 3)):
        assert np.array_equal(decode_picture(encoded(shot, '.png', *options)), shot)
    assert np.array_equal(decode_picture(interlaced(shot)), shot)


def test_a_png_of_many_idat_chunks_that_are_split_anywhere():
    stream = zlib.compress(b''.join(b'\1' + row.tobytes() for row in photo()))
    whole = decode_picture(png(64, 48, stream))
    for step in (1, 2, 3, 5, 7, len(stream) - 1, len(stream) - 4):
        split = b''.join(chunk(b'IDAT', stream[k:k + step]) for k in range(0, len(stream), step))
        file = png(64, 48, b'')
        file = file[:33] + chunk(b'IDAT') + split + file[-12:]
        assert np.array_equal(decode_picture(file), whole), step


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
@pytest.mark.parametrize('orientation', range(1, 9))
def test_a_picture_is_upright_however_the_camera_was_held(suffix, orientation):
    plain = encoded(photo(480, 640), suffix)
    stored = decode_picture(plain)
    for order in '<>':
        upright = decode_picture(with_exif(plain, orientation, order))
        assert np.array_equal(upright, TURNS[orientation](stored))
    assert upright.shape == ((640, 480, 3) if orientation >= 5 else (480, 640, 3))
    small = decode_picture(with_exif(plain, orientation), smallest=100)
    if suffix == '.jpg':
        assert small.shape == ((160, 120, 3) if orientation >= 5 else (120, 160, 3))
    message = SimpleNamespace(format='jpeg', data=with_exif(plain, orientation))
    assert np.array_equal(decode_rgb(message), upright)


def test_broken_exif_is_no_fault_of_the_pixels(files):
    plain = decode_picture(files['baseline'])
    for data in (b'', b'II*\0', b'MM\0*\xff\xff\xff\xff', b'MM\0*\0\0\0\x08\xff\xff',
                 picture_bytes.exif(0), picture_bytes.exif(9), picture_bytes.exif(6)[:-7]):
        for name in ('baseline', 'png'):
            file = files[name]
            held = (file[:2] + segment(0xE1, b'Exif\0\0' + data) + file[2:] if name != 'png'
                    else file[:33] + chunk(b'eXIf', data) + file[33:])
            assert np.array_equal(decode_picture(held), decode_picture(file))
    assert plain.shape == (48, 64, 3)


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
@pytest.mark.parametrize('order', '<>')
def test_a_picture_says_how_wide_its_lens_is(suffix, order):
    plain = encoded(photo(480, 640), suffix)
    assert decode_with_lens(plain).fov is None
    for orientation, smallest in ((1, None), (6, None), (6, 100)):
        file = with_exif(plain, orientation, order, 26)
        picture, fov = decode_with_lens(file, smallest=smallest)
        # By the diagonal of 24 x 36 mm; the shorter side is 3 of 5.
        wanted = 2 * math.atan(math.hypot(24, 36) / 2 / 26 * 0.6)
        assert fov == pytest.approx(wanted) and math.degrees(fov) == pytest.approx(53.06, abs=0.01)
        assert np.array_equal(picture, decode_picture(file, smallest=smallest))
    for nonsense in (0, 1, 65535):
        assert decode_with_lens(with_exif(plain, 1, order, nonsense)).fov is None
    data = picture_bytes.lens_exif(6, 26, order)
    for end in range(len(data)):  # cut anywhere, or pointing anywhere
        read_exif(data[:end])
    for place in range(8, len(data)):
        read_exif(data[:place] + b'\xff\xff\xff\xff' + data[place + 4:])


def test_bytes_behind_the_end_are_somebody_elses(files):
    trailers = {'padding': bytes(4096), 'ones': b'\xff' * 4096, 'line': b'\r\n',
                'samsung': b'\0\0\x01\x0aImage_UTC_Data1700000000000SEFHk\0\0\0SEFT',
                'motion photo': b'MotionPhoto_Data\0\0\0\x18ftypmp42' + bytes(range(256)) * 40,
                'second picture': files['progressive'], 'markers': b'\xff\xda\xff\xc0\xff\xd9'}
    for name, data in files.items():
        whole = decode_picture(data)
        for trailer in trailers.values():
            assert np.array_equal(decode_picture(data + trailer), whole), name


def test_what_is_truncated_is_refused_whatever_follows(files):
    for name, data in files.items():
        for keep in (12, 40, len(data) // 3, len(data) // 2, len(data) - 14, len(data) - 2):
            for after in (b'', bytes(100), data):
                with pytest.raises(ImageError):
                    decode_picture(data[:keep] + after)
                    pytest.fail(f'{name}: {keep} of {len(data)} bytes')


def test_metadata_however_large_is_left_out(files):
    whole = decode_picture(files['png'])
    bomb = picture_bytes.zeros(100 << 20)
    for kind, data in ((b'zTXt', b'a\0\0' + bomb), (b'iCCP', b'a\0\0' + bomb),
                       (b'iTXt', b'a\0\1\0\0\0' + bomb), (b'tEXt', b'a\0' + bytes(1 << 20)),
                       (b'acTL', struct.pack('>II', 1 << 30, 0))):
        for place in (33, len(files['png']) - 12):
            data_with = files['png'][:place] + chunk(kind, data) + files['png'][place:]
            assert np.array_equal(decode_picture(data_with), whole)


@pytest.mark.parametrize('pattern, red, blue', [('rggb', (0, 0), (1, 1)), ('bggr', (1, 1), (0, 0)),
                                                ('gbrg', (1, 0), (0, 1)),
                                                ('grbg', (0, 1), (1, 0))])
def test_a_mosaic_in_a_compressed_picture_is_no_grey_picture(pattern, red, blue):
    mosaic = np.full((32, 32), 100, np.uint8)
    mosaic[red[0]::2, red[1]::2], mosaic[blue[0]::2, blue[1]::2] = 200, 30
    for kind, bits, data in (('png', 8, encoded(mosaic, '.png')),
                             ('png', 16, encoded(mosaic.astype(np.uint16) << 8, '.png')),
                             ('jpeg', 8, encoded(mosaic, '.jpg', 1, 100))):
        message = SimpleNamespace(format=f'bayer_{pattern}{bits}; {kind} compressed ', data=data)
        for smallest in (None, 4):  # a mosaic cannot be reduced before it is decoded
            picture = decode_rgb(message, smallest)
            assert picture.shape == (32, 32, 3)
            assert np.abs(picture[8:24, 8:24].astype(int) - [200, 100, 30]).max() <= 3
    colour = SimpleNamespace(format=f'bayer_{pattern}8; jpeg compressed bgr8',
                             data=encoded(photo(), '.jpg'))
    assert np.array_equal(decode_rgb(colour), decode_picture(colour.data))
    with pytest.raises(ImageError, match='depth'):
        decode_rgb(SimpleNamespace(format='16UC1; png compressed ', data=encoded(
            mosaic.astype(np.uint16), '.png')))


@pytest.mark.parametrize('data, name', [
    (b'\0\0\0\x18ftypheic\0\0\0\0mif1heic', 'HEIC'), (b'\0\0\0\x1cftypavif', 'AVIF'),
    (b'RIFF\0\0\0\0WEBP', 'WebP'), (b'GIF89a', 'GIF'), (b'', '0 bytes'), (b'hello', 'hello')])
def test_other_formats_are_named(data, name):
    with pytest.raises(ForeignFormatError, match=name):
        decode_picture(data)


def test_the_doctor_of_bags_names_a_hostile_picture(tmp_path):
    kind = 'sensor_msgs/msg/CompressedImage'
    bomb = np.frombuffer(png(8, 8, picture_bytes.zeros(200, 20 << 20)), np.uint8)
    sent = [('/image_raw/compressed', kind, START, make(kind, format='png', data=bomb))]
    findings = diagnose(write(tmp_path / 'a.mcap', sent)).findings
    assert any('the pixels of 8 x 8 in a PNG are 200 bytes' in f.what for f in findings), findings


def test_jpegs_that_a_camera_may_write_are_read():
    """Separate scans of the components, fill bytes, empty scans within reason."""
    assert decode_picture(jpeg(64, 48, 30)).shape == (48, 64, 3)
    assert decode_picture(jpeg(61, 47, marker=0xC0)).shape == (47, 61, 3)
    assert decode_picture(jpeg(61, 47, marker=0xC0, components=1)).shape == (47, 61, 3)
    file = encoded(photo(), '.jpg')
    filled = file[:2] + b'\xff\xff' + file[2:-2] + b'\xff' + file[-2:]
    assert np.array_equal(decode_picture(filled), decode_picture(file))


def mutated(data, chance):
    """A file with one or a few things wrong; a third of PNGs with checksums that fit again."""
    data = bytearray(data)
    kind = chance.choice(('flip', 'flip', 'cut', 'extreme', 'remove', 'repeat'))
    at = chance.randrange(len(data) if chance.random() < 0.5 else min(len(data), 200))
    if kind == 'flip':
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(at, min(at + 40, len(data)))] = chance.randrange(256)
    elif kind == 'cut':
        del data[at + 1:]
    elif kind == 'extreme':
        value = chance.choice((0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**32 - 1, 4000))
        width = chance.choice((1, 2, 4))
        data[at:at + width] = (value % (1 << 8 * width)).to_bytes(width, 'big')
    else:
        end = min(at + chance.randint(1, 300), len(data))
        data[at:end] = b'' if kind == 'remove' else data[at:end] * 2
    return mended(data) if chance.random() < 0.3 else bytes(data)


def mended(data):
    """Chunks of a PNG with checksums that fit, as far as their lengths lead."""
    at = 8
    while data[:4] == b'\x89PNG' and at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at:at + 4], 'big')
        if end + 4 > len(data):
            break
        data[end:end + 4] = struct.pack('>I', zlib.crc32(data[at + 4:end]))
        at = end + 4
    return bytes(data)


def memory(kind):
    """Bytes that this process holds (VmRSS), or has held at most (VmHWM).

    Not `getrusage`: a child's maximum there begins with its parent's.
    """
    line = next(line for line in Path('/proc/self/status').read_text().splitlines()
                if line.startswith(kind))
    return int(line.split()[1]) << 10


def attempt(name, data, found):
    """Decode a file; the CPU seconds if it was refused."""
    begin = time.process_time()
    try:
        picture = decode_picture(data)
        assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
        found['pictures'] += 1
        return 0.0
    except ImageError as error:
        assert '\n' not in str(error), error
        found['refused'] += 1
    except BaseException:  # the very thing that must not happen
        found['other'].append(f'{name}: {traceback.format_exc()[-1500:]}')
    return time.process_time() - begin


def run(count):
    """The child: prints what came of its files."""
    cv2.setNumThreads(1)
    files, chance = list(sound().values()), random.Random(7)
    found = {'pictures': 0, 'refused': 0, 'other': [], 'slowest': 0.0}
    for data in files:  # what is loaded once
        decode_picture(data)
    hostile = {} if count else picture_bytes.hostile()
    begin = memory('VmHWM')
    for number in range(count):
        data = mutated(chance.choice(files), chance)
        attempt(number, data, found)
    for name, data in hostile.items():
        before = found['pictures']
        seconds = attempt(name, data, found)
        found['slowest'] = max(found['slowest'], seconds)
        taken = memory('VmHWM') - begin
        if found['pictures'] > before or seconds > 2 * SECONDS or taken > MEMORY:
            found['other'].append(f'{name}: {seconds:.2f} s, {taken} bytes, '
                                  f'{found["pictures"] - before} pictures')
    found['memory'] = memory('VmHWM') - begin
    print(json.dumps(found))


def run_largest():
    """The child: prints what sound pictures took that take most, and their sizes."""
    big = [picture_bytes.png(4000, 4000, picture_bytes.zeros(4000 * 16001), colour=6),
           jpeg(4000, 4000, 20)]
    phone = jpeg(8000, 6000, marker=0xC0)
    decode_picture(jpeg(8, 8))
    begin = memory('VmHWM')
    sizes = [decode_picture(file).shape for file in big]
    sizes.append(decode_picture(phone, smallest=KEPT_SIDE_PX, largest=MAX_JPEG_PX).shape)
    print(memory('VmHWM') - begin, sizes)


def child(count):
    done = subprocess.run([sys.executable, __file__, str(count)], capture_output=True, text=True,
                          env={**os.environ, 'OMP_NUM_THREADS': '1',
                               'PYTHONPATH': str(TESTS)})
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert not found['other'], f'{len(found["other"])}: ' + '\n'.join(found['other'][:3])
    assert found['memory'] < MEMORY, found
    print(found)
    return found


@pytest.mark.slow
def test_hostile_files_are_refused_within_time_and_memory():
    found = child(0)
    assert found['refused'] > 25 and found['pictures'] == 0


@pytest.mark.slow
@pytest.mark.timeout(max(120, MUTATIONS // 50))
def test_no_mutated_picture_escapes_the_one_error():
    found = child(MUTATIONS)
    assert found['refused'] > MUTATIONS / 4 and found['pictures'] > 0


@pytest.mark.slow
def test_the_largest_pictures_stay_within_the_memory():
    """Those that take most: 16 megapixels of four bytes, progressive ones in three components."""
    done = subprocess.run([sys.executable, __file__, 'largest'], capture_output=True, text=True,
                          env={**os.environ, 'PYTHONPATH': str(TESTS)})
    assert done.returncode == 0, done.stderr[-3000:]
    print(done.stdout)
    assert int(done.stdout.split()[0]) < MEMORY
    assert '(4000, 4000, 3), (4000, 4000, 3), (1500, 2000, 3)' in done.stdout


if __name__ == '__main__':
    run_largest() if sys.argv[1] == 'largest' else run(int(sys.argv[1]))
