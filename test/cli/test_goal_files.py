"""Goal pictures as people bring them: from phones, too large, in other formats."""

import io
import math
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import picture_bytes
import pytest
from picture_bytes import encoded, jpeg, photo, png, with_exif, zeros

from vn_msgs_py import heic_file
from vn_nav import goal_picture
from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture


def refused(path, *words):
    with pytest.raises(UserError) as caught:
        read_goal_picture(path)
    text = str(caught.value)
    assert '\n' not in text and 'goal picture' in text and path.name in text, text
    for word in words:
        assert word in text, text


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
def test_a_phone_held_upright(tmp_path, suffix):
    path = tmp_path / f'goal{suffix}'
    stored = encoded(photo(480, 640), suffix)
    path.write_bytes(with_exif(stored, 6) + b'SEFT' * 100)
    plain = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.array_equal(read_goal_picture(path).picture, np.rot90(plain, -1))


def test_a_phone_says_how_wide_it_sees(tmp_path):
    path = tmp_path / 'goal.jpg'
    path.write_bytes(with_exif(encoded(photo(480, 640), '.jpg'), 6, focal_35mm=24))
    picture, fov = read_goal_picture(path)
    assert picture.shape == (640, 480, 3)
    assert math.degrees(fov) == pytest.approx(56.8, abs=0.1)


def heic(picture, **options):
    """As pillow-heif writes it."""
    pillow_heif = pytest.importorskip(
        'pillow_heif', reason='expected: pillow-heif, of the extra `heic`, is not installed')
    from PIL import Image
    file = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(picture)).save(file, quality=95, **options)
    return file.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize('orientation, turns', [(1, 0), (6, -1), (3, 2), (8, 1)])
def test_heic_is_upright_and_says_its_lens(tmp_path, orientation, turns):
    path, shot = tmp_path / 'IMG_1.HEIC', photo(120, 160)
    path.write_bytes(heic(shot, exif=b'Exif\0\0' + picture_bytes.lens_exif(orientation, 26)))
    picture, fov = read_goal_picture(path)
    upright = np.rot90(shot, turns)
    assert picture.shape == upright.shape and picture.dtype == np.uint8
    assert np.abs(picture.astype(int) - upright).mean() < 6
    assert math.degrees(fov) == pytest.approx(53.06, abs=0.01)


@pytest.mark.slow
def test_heic_is_made_smaller_and_broken_ones_are_one_line(tmp_path, monkeypatch):
    path = tmp_path / 'goal.jpg'  # the name says nothing
    file = heic(photo(400, 600))
    path.write_bytes(file)
    assert read_goal_picture(path).picture.shape == (400, 600, 3)
    monkeypatch.setattr(goal_picture, 'KEPT_SIDE_PX', 100)
    assert read_goal_picture(path).picture.shape == (100, 150, 3)
    for end in (40, 300, len(file) // 2, len(file) - 10):
        path.write_bytes(file[:end])
        refused(path, 'HEIC')
    monkeypatch.setattr(heic_file, 'MAX_HEIC_PX', 200_000)
    path.write_bytes(file)
    refused(path, '(400, 600)', 'convert')


def test_small_ones_are_read_whole(tmp_path):
    path = tmp_path / 'goal.png'
    path.write_bytes(encoded(photo(1999, 40), '.png'))
    assert np.array_equal(read_goal_picture(path).picture, photo(1999, 40))
    path.write_bytes(encoded(photo(1300, 1900), '.jpg'))
    assert read_goal_picture(path).picture.shape == (1300, 1900, 3)


@pytest.mark.slow
@pytest.mark.parametrize('width, height, shape', [
    (4000, 3000, (1500, 2000, 3)), (8000, 6000, (1500, 2000, 3)), (16320, 12240, (1530, 2040, 3)),
    (30_000, 1500, (750, 15_000, 3))])  # the last one fits at a half only
def test_large_jpegs_are_decoded_at_a_part_of_their_size(tmp_path, width, height, shape):
    path = tmp_path / 'goal.jpg'
    path.write_bytes(jpeg(width, height, marker=0xC0))
    assert read_goal_picture(path).picture.shape == shape


def test_what_is_too_large_is_refused_with_the_command(tmp_path):
    path = tmp_path / 'my goal.png'
    path.write_bytes(png(8000, 6000, zeros(8000)))
    refused(path, '(6000, 8000)', f"convert '{path}'", '-resize')
    path = tmp_path / 'goal.jpg'
    path.write_bytes(jpeg(30_000, 30_000, marker=0xC0, data=bytes(9)))
    refused(path, '(30000, 30000)', '-resize')


def test_a_file_without_end_is_not_read_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr(goal_picture, 'MAX_FILE_BYTES', 1000)
    path = tmp_path / 'goal.png'
    path.write_bytes(encoded(photo(), '.png'))
    refused(path, '1000 bytes')


HEIC = b'\0\0\0\x24ftypheic\0\0\0\0mif1MiHBheic'


def test_other_formats_are_named_with_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pillow_heif', None)  # the extra is not installed
    path = tmp_path / 'IMG 1.HEIC'
    path.write_bytes(HEIC)
    refused(path, 'HEIC', f"`convert 'heic:{path}' '{path.with_suffix('.jpg')}'`",
            'pip install pillow-heif')
    path = tmp_path / 'goal.jpg'  # the name says nothing
    path.write_bytes(b'RIFF\0\0\0\0WEBPVP8 ')
    refused(path, 'WebP', f"`convert 'webp:{path}[0]' ")


@pytest.mark.parametrize('name', ['goal.jpg', "it's $HOME.jpg", '-goal.jpg', 'a.b.heic'])
@pytest.mark.parametrize('data', [HEIC, b'GIF89a\x08\0\x08\0', png(8000, 6000, zeros(8000))])
def test_no_command_overwrites_a_file(tmp_path, monkeypatch, name, data):
    monkeypatch.setitem(sys.modules, 'pillow_heif', None)
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(data)
    (tmp_path / 'a.b.jpg').write_bytes(b'')  # its owner's
    with pytest.raises(UserError) as caught:
        read_goal_picture(Path(name))
    words = shlex.split(caught.value.remedy.split('`')[1])
    assert words[0] == 'convert' and name in words[1] and not words[-1].startswith('-')
    assert not Path(words[-1]).exists() and Path(words[-1]).suffix == '.jpg'


@pytest.mark.parametrize('data, words', [
    (b'', 'an empty file'), (b'<!DOCTYPE html>\n<html>' * 20, "begins with '<!DOCTYPE"),
    (b'BMW\n', "text that begins with 'BMW'"),
    *((('x' * k + 'gr\u00fc\u00df' * 99).encode(), 'text that begins') for k in range(3)),
    (b'RIFF\x24\0\0\0WAVEfmt ', "begin with b'RIFF"), (b'\0\0\0\x20ftypisom', 'isom')])
def test_what_is_no_picture_gets_no_conversion(tmp_path, data, words):
    path = tmp_path / 'goal.jpg'
    path.write_bytes(data)
    refused(path, words, 'give another one')
    with pytest.raises(UserError) as caught:
        read_goal_picture(path)
    assert 'convert' not in str(caught.value)


@pytest.mark.parametrize('name', ['a gigabyte behind the rows of a small PNG', 'two frame headers',
                                  'a chunk length of 4 GB, before the pixels'])
def test_hostile_ones_are_one_line(tmp_path, name):
    path = tmp_path / 'goal.png'
    path.write_bytes({
        'a gigabyte behind the rows of a small PNG': png(8, 8, zeros(200, 100 << 20)),
        'two frame headers': jpeg(8, 8, extra=picture_bytes.frame(4000, 4000)),
        'a chunk length of 4 GB, before the pixels': (
            encoded(photo(), '.png')[:33] + picture_bytes.chunk(b'tEXt', b'a', 2**32 - 2**20)),
    }[name])
    refused(path)
    refused(tmp_path, 'no such file')
