"""What guarding the decoder of JPEG and PNG costs, and what hostile files cost.

    python bench/pictures.py --rounds 9

Each hostile file of `test/picture_bytes.py` is decoded in a child process of its own: CPU seconds
until it is refused, and the peak of memory (VmHWM) above what the child held before. Then the CPU
time to decode sound pictures, 640 x 480, compared with plain `cv2.imdecode` and the same
conversion to RGB; the two take turns. One JSON line a figure.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from common import ROUNDS, pin, report

from vn_msgs_py.image_error import ImageError
from vn_msgs_py.picture_file import decode_picture

HEIGHT, WIDTH = 480, 640
SECONDS = 0.15  # of decoding a picture again and again, a round
sys.path.append(str(Path(__file__).parents[1] / 'test'))


def peak() -> int:
    """The bytes that this process has held at most."""
    line = next(line for line in Path('/proc/self/status').read_text().splitlines()
                if line.startswith('VmHWM'))
    return int(line.split()[1]) << 10


def attempt() -> None:
    """The child: decode the file on standard input; print CPU seconds and bytes."""
    data = sys.stdin.buffer.read()
    for suffix in ('.jpg', '.png'):  # what is loaded and set up once
        decode_picture(cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    before, begun = peak(), time.process_time()
    try:
        decode_picture(data)
    except ImageError:
        print(time.process_time() - begun, peak() - before)
    else:
        raise SystemExit('a hostile file became a picture')


def hostile() -> None:
    """Slowest and largest of all hostile files."""
    import picture_bytes
    files = picture_bytes.hostile()
    took = {}
    for name, data in files.items():
        done = subprocess.run([sys.executable, __file__, '--attempt'], input=data,
                              capture_output=True, check=False)
        if done.returncode:
            raise SystemExit(f'{name}: {done.stderr.decode()[-500:]}')
        took[name] = [float(part) for part in done.stdout.split()]
    for k, (what, unit, scale) in enumerate((('CPU time', 's', 1.0), ('memory', 'MB', 1e6))):
        most = max(took, key=lambda name, k=k: took[name][k])
        report(f'hostile pictures, {what}', [row[k] / scale for row in took.values()],
               f'{len(files)} files, all refused; most: {took[most][k] / scale:.3g} {unit}, '
               f'{most}', unit=unit)


def plain(data: bytes) -> np.ndarray:
    """The picture, by OpenCV alone."""
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR),
                        cv2.COLOR_BGR2RGB)


def milliseconds(decode, data: bytes) -> float:
    """CPU time of decoding a file once, which other work on the machine hardly changes."""
    begun, count = time.process_time(), 0
    while (spent := time.process_time() - begun) < SECONDS:
        decode(data)
        count += 1
    return 1e3 * spent / count


def ratios(rounds: int) -> None:
    """Our decoder compared with OpenCV's, a figure for each kind of file."""
    import picture_bytes
    picture = picture_bytes.photo(HEIGHT, WIDTH)
    files = {'JPEG, quality 95': picture_bytes.encoded(picture, '.jpg'),
             'progressive JPEG': picture_bytes.encoded(
                 picture, '.jpg', cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
             "PNG, OpenCV's defaults": picture_bytes.encoded(picture, '.png')}
    for name in ('NONE', 'SUB', 'UP', 'AVG', 'PAETH', 'ALL'):
        option = f'IMWRITE_PNG_{"ALL_FILTERS" if name == "ALL" else f"FILTER_{name}"}'
        files[f'PNG, level 6, filter {name.lower()}'] = picture_bytes.encoded(
            picture, '.png', cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_FILTER,
            getattr(cv2, option))
    for name, data in files.items():
        if not np.array_equal(decode_picture(data), plain(data)):
            raise SystemExit(f'{name}: the two pictures differ')
        own, other = [], []
        for _ in range(rounds):
            own.append(milliseconds(decode_picture, data))
            other.append(milliseconds(plain, data))
        report(f'decoding, {name}', own, f'{WIDTH} x {HEIGHT}, {len(data)} bytes, one core',
               unit='ms', peer='cv2.imdecode', peer_values=other)


def main():
    """Hostile files, then sound ones."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--rounds', type=int, default=ROUNDS)
    parser.add_argument('--attempt', action='store_true', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    pin(1)
    cv2.setNumThreads(1)
    if arguments.attempt:
        attempt()
        return
    hostile()
    ratios(arguments.rounds)


if __name__ == '__main__':
    main()
