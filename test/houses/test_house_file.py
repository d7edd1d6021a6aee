"""Files of many houses: each is near at hand, whatever the order, and the file is read once."""

import gzip
import zlib

import numpy as np
import pytest

from vn_sim_bridge.meshes import house_file
from vn_sim_bridge.meshes.house_file import HouseFile


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Many pieces and points in a file of some hundred kilobytes."""
    for name, value in (('CHUNK', 700), ('PIECE', 1500), ('SPACING', 20_000)):
        monkeypatch.setattr(house_file, name, value)


def houses(count=300, seed=0):
    """Lines of 10 to 3,000 bytes that gzip makes smaller, but not much."""
    rng = np.random.default_rng(seed)
    return [b'{%d: ' % k + bytes(rng.integers(97, 123, rng.integers(10, 3000)).astype(np.uint8))
            + b'}' for k in range(count)]


def write(path, lines, parts=1):
    """A file of lines; packed in several parts, one after another, as `cat` makes them."""
    text = b'\n  \n\n'.join(lines) + b'\n'
    if path.suffix == '.gz':
        cuts = np.linspace(0, len(text), parts + 1).astype(int)
        text = b''.join(gzip.compress(text[a:b]) for a, b in zip(cuts, cuts[1:], strict=False))
    path.write_bytes(text)
    return path


@pytest.mark.parametrize(('name', 'parts'), [('a.jsonl', 1), ('a.jsonl.gz', 1), ('a.jsonl.gz', 5)])
def test_every_house_is_found_in_any_order(tmp_path, name, parts):
    lines = houses()
    file = HouseFile(write(tmp_path / name, lines, parts))
    assert file.text(7).strip() == lines[7]
    size = sum(map(len, lines))
    assert file.passed < size / 10, 'no farther than needed'
    assert file.has(299) and not file.has(300) and file.text(300) is None
    assert size <= file.passed <= 1.2 * size, 'one pass'
    before = file.passed
    for k in np.random.default_rng(1).permutation(300):
        assert file.text(k).strip() == lines[k]
    # From the nearest point, not from the start.
    assert file.passed - before < 300 * (20_000 + 1500 + 6000)


def test_a_file_of_one_house_has_one(tmp_path):
    for name in ('house.json', 'house.json.gz'):
        file = HouseFile(write(tmp_path / name, [b'{"a":', b'1}']))
        assert file.text(0).split() == [b'{"a":', b'1}'] and file.text(1) is None
    (tmp_path / 'none.jsonl').write_bytes(b' \n\n')
    assert not HouseFile(tmp_path / 'none.jsonl').has(0)


def test_what_is_not_whole_is_an_error_each_time(tmp_path):
    path = write(tmp_path / 'a.jsonl.gz', houses())
    whole = path.read_bytes()
    file = HouseFile(path)
    assert file.has(299)
    path.write_bytes(whole + bytes(512))  # zeros after it are what tapes leave
    assert file.has(299) and not file.has(300)
    path.write_bytes(whole[:-40])
    for _ in range(2):
        with pytest.raises(EOFError):
            file.has(300)
    assert file.text(3).strip() == houses()[3], 'what comes before is there'
    path.write_bytes(whole[:2000] + b'\0' * 100 + whole[2100:])
    with pytest.raises(zlib.error):
        file.has(300)
    path.write_bytes(whole[:-8] + bytes(4) + whole[-4:])  # another checksum
    with pytest.raises(zlib.error):
        file.has(300)


def test_another_file_is_read_anew(tmp_path):
    path = write(tmp_path / 'a.jsonl.gz', houses())
    file = HouseFile(path)
    assert file.text(299).strip() == houses()[299]
    write(path, houses(200, seed=2))
    assert file.text(150).strip() == houses(200, seed=2)[150] and not file.has(299)


def test_a_house_that_is_too_long_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(house_file, 'MOST_BYTES', 1 << 20)
    path = tmp_path / 'a.jsonl.gz'
    path.write_bytes(gzip.compress(bytes([65]) * (3 << 20)))
    file = HouseFile(path)
    with pytest.raises(ValueError, match='more than 1 MiB'):
        file.has(0)
    assert file.passed < 2 << 20
