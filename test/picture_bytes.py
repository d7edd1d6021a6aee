"""JPEG and PNG files made byte by byte: sound ones, and such as ask for more than they should."""

import struct
import zlib

import cv2
import numpy as np

SIGNATURE = b'\x89PNG\r\n\x1a\n'


def chunk(kind, data=b'', length=None):
    """A PNG chunk; `length` is what it says of itself."""
    return (struct.pack('>I', len(data) if length is None else length) + kind + data
            + struct.pack('>I', zlib.crc32(kind + data)))


def header(width, height, depth=8, colour=2, interlace=0):
    return chunk(b'IHDR', struct.pack('>IIBBBBB', width, height, depth, colour, 0, 0, interlace))


def png(width, height, stream, *, depth=8, colour=2, interlace=0, before=b'', after=b''):
    """A PNG around a zlib stream."""
    return b''.join((SIGNATURE, header(width, height, depth, colour, interlace), before,
                     chunk(b'IDAT', stream), after, chunk(b'IEND')))


def zeros(*counts):
    """A zlib stream of so many zero bytes, at the best ratio."""
    packer, block = zlib.compressobj(9), bytes(1 << 20)
    parts = []
    for count in counts:
        parts += [packer.compress(block) for _ in range(count >> 20)]
        parts.append(packer.compress(bytes(count % (1 << 20))))
    return b''.join((*parts, packer.flush()))


def exif(orientation, order='>'):
    """EXIF data with its TIFF header and this orientation."""
    start = b'MM\0*' if order == '>' else b'II*\0'
    return start + struct.pack(f'{order}IHHHIHHI', 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def lens_exif(orientation, focal_35mm, order='>'):
    """EXIF data with an orientation, and a focal length in the directory that it points to."""
    start = b'MM\0*' if order == '>' else b'II*\0'
    field = f'{order}HHIHH'
    return (start + struct.pack(f'{order}IH', 8, 2)
            + struct.pack(field, 0x0112, 3, 1, orientation, 0)
            + struct.pack(f'{order}HHII', 0x8769, 4, 1, 38)
            + struct.pack(f'{order}I', 0)
            + struct.pack(f'{order}H', 1) + struct.pack(field, 0xA405, 3, 1, focal_35mm, 0)
            + struct.pack(f'{order}I', 0))


def segment(marker, body, length=None):
    """A JPEG segment; `length` is what it says of itself."""
    return b'\xff' + bytes([marker]) + struct.pack(
        '>H', len(body) + 2 if length is None else length) + body


def with_exif(file, orientation, order='>', focal_35mm=None):
    """The same JPEG or PNG, held another way, or of a lens that is told [mm]."""
    data = (exif(orientation, order) if focal_35mm is None
            else lens_exif(orientation, focal_35mm, order))
    if file[:2] == b'\xff\xd8':
        return file[:2] + segment(0xE1, b'Exif\0\0' + data) + file[2:]
    return file[:33] + chunk(b'eXIf', data) + file[33:]


def frame(width, height, marker=0xC2, components=3, sampling=0x11):
    return segment(marker, struct.pack('>BHHB', 8, height, width, components) + b''.join(
        bytes([k + 1, sampling, 0]) for k in range(components)))


def scan(components, first, last, data, bits=0):
    """A scan of the spectral band from `first` to `last`."""
    return segment(0xDA, bytes([len(components)]) + b''.join(
        bytes([k, 0]) for k in components) + bytes([first, last, bits])) + data


def jpeg(width, height, scans=0, *, marker=0xC2, components=3, data=None, extra=b''):
    """A grey-blue JPEG; progressive ones with so many empty scans of one component each."""
    units = -(-width // 8) * -(-height // 8)
    whole = tuple(range(1, components + 1))
    parts = [b'\xff\xd8', segment(0xDB, b'\0' + b'\1' * 64),
             frame(width, height, marker, components), extra,
             segment(0xC4, b'\0' + bytes([1] + [0] * 15) + b'\0'),  # one bit: no difference
             segment(0xC4, b'\x10' + bytes([1] + [0] * 15)  # one bit: the rest is zero
                     + (b'\xe0' if marker == 0xC2 else b'\0'))]
    if data is None:
        data = bytes(units * components * (1 if marker == 0xC2 else 2) // 8 + 8)
    parts.append(scan(whole, 0, 0 if marker == 0xC2 else 63, data))
    parts += [scan((1 + k % components,), 1, 63, bytes(2 * (units // 16384 + 2)))
              for k in range(scans)]
    return b''.join((*parts, b'\xff\xd9'))


def photo(height=48, width=64, seed=0):
    """Smooth colours with a little noise, [H,W,3] uint8 RGB."""
    chance = np.random.default_rng(seed)
    smooth = cv2.resize(chance.integers(0, 256, (5, 7, 3), np.uint8), (width, height),
                        interpolation=cv2.INTER_CUBIC)
    return np.clip(smooth + chance.normal(0, 3, smooth.shape), 0, 255).astype(np.uint8)


def encoded(picture, suffix, *options):
    """As OpenCV writes an RGB or grey picture."""
    if picture.ndim == 3 and picture.shape[2] == 3:
        picture = np.ascontiguousarray(picture[..., ::-1])
    return cv2.imencode(suffix, picture, list(options))[1].tobytes()


GIGABYTE = zeros(25 * 8, 1 << 30)  # the rows of an RGB picture of 8 x 8, and 1 GiB more


def hostile():
    """Files that ask for more than they should get, by name; none is a picture."""
    rows = zlib.compress(bytes(25 * 8))
    small = png(8, 8, rows)
    page = zeros(480 * 1921, 600 << 20)
    baseline = encoded(photo(), '.jpg')
    after_header = SIGNATURE + header(8, 8)
    return {
        'a chunk length of 4 GB, before the pixels':
            after_header + chunk(b'tEXt', b'a\0b', 2**32 - 2**20) + small[33:],
        'a chunk length of 2 GB, of the pixels':
            after_header + chunk(b'IDAT', rows, 2**31 - 1) + chunk(b'IEND'),
        'a gigabyte behind the rows of a small PNG': png(8, 8, GIGABYTE),
        'the same in IDAT chunks of a byte': b''.join((
            after_header, *(chunk(b'IDAT', GIGABYTE[k:k + 1]) for k in range(30_000)),
            chunk(b'IEND'))),
        '600 MB behind the rows of 640 x 480': png(640, 480, page),
        'the same, interlaced': png(640, 480, page, interlace=1),
        'the same, 16 bits': png(320, 480, page, depth=16),
        'empty chunks': after_header + chunk(b'teXt') * 100_000 + small[33:],
        'empty IDAT chunks': after_header + chunk(b'IDAT') * 100_000 + small[33:],
        'a size of 4 gigapixels': SIGNATURE + header(65_000, 65_000) + small[33:],
        'a side of 16 million': SIGNATURE + header(1, 16_000_000) + chunk(
            b'IDAT', zeros(64_000_000)) + chunk(b'IEND'),
        'a few bytes for 16 megapixels': png(4000, 4000, zeros(4000)),
        'the same, interlaced and 16 bits': png(2600, 2600, zeros(4000), depth=16, colour=6,
                                                interlace=1),
        '16 megapixels of 16 bits': png(4000, 4000, zeros(4000 * 24001), depth=16),
        '16 megapixels and a byte': png(4000, 4000, zeros(4000 * 12001, 1)[:-4] + bytes(4)),
        'two headers': after_header + header(4000, 4000) + small[33:],
        'a header after the pixels': small[:-12] + header(4000, 4000) + small[-12:],
        'pixels in two places':
            after_header + chunk(b'IDAT', rows[:5]) + chunk(b'tEXt', b'a\0b') + chunk(
                b'IDAT', rows[5:]) + chunk(b'IEND'),
        'a JPEG segment beyond its end': baseline[:2] + segment(0xE1, b'x', 0xFFFF) + b'\xff\xd9',
        'a JPEG segment of length 0': baseline[:2] + segment(0xE1, b'', 0) * 1000 + baseline[2:],
        'segments without end': baseline[:2] + segment(0xFE, b'') * 200_000 + baseline[2:],
        '1,000 scans': jpeg(640, 480, 1000),
        '60 scans of 16 megapixels': jpeg(4000, 4000, 60),
        'a few bytes for a JPEG of 16 megapixels': jpeg(4000, 4000, data=bytes(100)),
        'the same, baseline': jpeg(4000, 4000, marker=0xC0, data=bytes(100)),
        'two frame headers': jpeg(8, 8, extra=frame(4000, 4000)),
        'a second frame header behind a scan':
            jpeg(8, 8, 2)[:-2] + frame(4000, 4000) + b'\xff\xd9',
        'a JPEG of 4 gigapixels': jpeg(65_000, 65_000, data=bytes(100)),
        'four progressive components of 4 x 4 samples': jpeg(
            4000, 4000, components=4, extra=b'')[:2] + segment(0xDB, b'\0' + b'\1' * 64) + (
            frame(4000, 4000, components=4, sampling=0x55)) + b'\xff\xd9',
        'a scan without a frame': b'\xff\xd8' + scan((1,), 0, 63, bytes(9)) + b'\xff\xd9',
        'arithmetic codes': jpeg(8, 8, marker=0xC9),
        'fill bytes alone': b'\xff\xd8' + b'\xff' * 1_000_000,
    }
