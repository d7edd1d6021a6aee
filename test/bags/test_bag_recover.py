"""`vn_nav bag recover` saves what is whole, tells what was lost, leaves the old bag alone."""

import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import time

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import IndexType
from paths import TESTS
from rosbags.highlevel import AnyReader
from small_bags import START, STRING, drive, make, records, serialised, write

from vn_nav import cli
from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.stream import Bag, BagError
from vn_nav.errors import UserError

CHUNK = 6


def contents(path):
    return [(m.topic, m.type, m.sequence, m.log_time, m.publish_time, m.data,
             m.connection.definition, m.connection.metadata) for m in Bag(path).messages()]


def test_a_sound_bag_comes_out_equal(tmp_path):
    path = write(tmp_path / 'a.mcap', drive())
    recovered = recover(path, tmp_path / 'out')
    assert contents(tmp_path / 'out') == contents(path)
    assert not recovered.lost and recovered.missing == 0
    assert recovered.counts == {'/odom': 80, '/image_raw': 40, '/camera_info': 40, '/cmd_vel': 20}
    recover(path, tmp_path / 'out.mcap')
    assert contents(tmp_path / 'out.mcap') == contents(path)
    info = yaml.safe_load((tmp_path / 'out' / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    assert info['version'] == 9 and info['message_count'] == 180
    with AnyReader([tmp_path / 'out']) as reader:
        assert sum(1 for _ in reader.messages()) == 180
    with open(tmp_path / 'out' / 'out_0.mcap', 'rb') as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == 180


def test_a_damaged_bag_loses_its_chunk_and_says_so(tmp_path, capsys):
    path = write(tmp_path / 'a.mcap', drive())
    data = bytearray(path.read_bytes())
    at, length = [(at, length) for at, opcode, length in records(data) if opcode == CHUNK][4]
    data[at + 9 + length // 2] ^= 0xFF
    path.write_bytes(data)
    before = path.read_bytes(), path.stat().st_mtime_ns
    assert cli.main(['bag', 'recover', str(path), str(tmp_path / 'out')]) == 0
    told = capsys.readouterr().out
    lost = 180 - len(contents(tmp_path / 'out'))
    assert 0 < lost < 30
    assert f'byte {at}' in told and '1 chunk' in told and f'lost messages: {lost}' in told
    assert 's from the start' in told
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    strict = ['bag', 'recover', str(path), str(tmp_path / 'out2'), '--strict']
    assert cli.main(strict) == 2 and (tmp_path / 'out2' / 'metadata.yaml').is_file()


def test_nothing_is_overwritten_and_nothing_is_left_behind(tmp_path):
    path = write(tmp_path / 'a.mcap', drive(0.5))
    (tmp_path / 'out').mkdir()
    with pytest.raises(UserError, match='new folder'):
        recover(path, tmp_path / 'out')
    folder = tmp_path / 'bag'
    folder.mkdir()
    shutil.copy(path, folder)
    with pytest.raises(UserError, match='as it is'):
        recover(folder, folder / 'out')
    with pytest.raises(UserError, match='can be written'):
        recover(path, tmp_path / 'not' / 'there')
    for data in (b'', b'no bag' * 100, path.read_bytes()[:60]):
        (tmp_path / 'b.mcap').write_bytes(data)
        with pytest.raises(BagError, match='no message'):
            recover(tmp_path / 'b.mcap', tmp_path / 'saved')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['a.mcap', 'b.mcap', 'bag', 'out']


def test_a_bag_with_a_file_gone_and_one_that_nobody_named(tmp_path, capsys):
    folder = tmp_path / 'bag'
    folder.mkdir()
    sent = drive(2.0)
    write(folder / 'bag_0.mcap', sent[:30])
    write(folder / 'bag_2.mcap', sent[60:], finish=False)
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {relative_file_paths: [bag_0.mcap, bag_1.mcap]}')
    assert cli.main(['bag', 'recover', str(folder), str(tmp_path / 'out'), '--strict']) == 2
    told = capsys.readouterr().out
    assert 'bag_1.mcap' in told and 'does not name it' in told and 'unknown' in told
    saved = contents(tmp_path / 'out')
    assert saved[:30] == contents(folder / 'bag_0.mcap') and len(saved) > 30


RECORDER = """
import sys, time
from small_bags import STRING, START, make, serialised
from mcap.writer import Writer
with open(sys.argv[1], 'wb', buffering=0) as file:
    writer = Writer(file, chunk_size=1 << 16)
    writer.start('ros2', 'test')
    schema = writer.register_schema(STRING, 'ros2msg', b'string data\\n')
    channel = writer.register_channel('/count', 'cdr', schema)
    for k in range(10**9):
        data = serialised(STRING, make(STRING, data=f'{k:8d}' + 'x' * 1000))
        writer.add_message(channel, START + k, data, START + k)
"""


def test_of_a_killed_recorder_at_most_one_chunk_is_lost(tmp_path):
    """No footer, no metadata.yaml, and the last record cut anywhere."""
    folder = tmp_path / 'bag'
    folder.mkdir()
    path = folder / 'bag_0.mcap'
    process = subprocess.Popen([sys.executable, '-c', RECORDER, str(path)],
                               env={**os.environ, 'PYTHONPATH': str(TESTS)})
    try:
        while not path.exists() or path.stat().st_size < 50_000:
            time.sleep(0.02)
            assert process.poll() is None
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    whole = path.read_bytes()
    ends, at = [], 8
    while at + 9 <= len(whole):
        length = int.from_bytes(whole[at + 1:at + 9], 'little')
        if whole[at] == CHUNK and at + 9 + length <= len(whole):
            ends.append(at + 9 + length)
        at += 9 + length
    assert len(ends) > 3
    per_chunk = None
    for cut in dict.fromkeys((len(whole), ends[-1], ends[-1] - 1, ends[-2] + 5)):
        path.write_bytes(whole[:cut])
        target = tmp_path / f'out{cut}'
        recovered = recover(folder, target)
        numbers = [int(m.data[8:16]) for m in Bag(target).messages()]
        assert numbers == list(range(len(numbers)))  # all from the first on
        chunks = sum(end <= cut for end in ends)
        per_chunk = per_chunk or len(numbers) // chunks
        assert abs(len(numbers) - chunks * per_chunk) <= 1
        assert 'was cut off' in ' '.join(recovered.lines())


def test_odd_things_are_kept_as_they_are(tmp_path):
    """Types nobody knows, other encodings, and times that differ."""
    sent = [('/odd', 'a/msg/B', START, b'{"not": "cdr"}'), ('/s', STRING, START + 5, serialised(
        STRING, make(STRING, data='x')))]
    path = write(tmp_path / 'a.mcap', sent, encoding='json', schema='jsonschema',
                 definitions={'a/msg/B': '{}'})
    recover(path, tmp_path / 'out')
    assert contents(tmp_path / 'out') == contents(path)


# Files without checksums, as rosbag2 writes them.


NO_CRC = {'enable_crcs': False}
LAYOUTS = {
    'chunks': {'compression': '', **NO_CRC},
    'chunks in zstd': {'compression': 'zstd', **NO_CRC},
    'chunks in lz4': {'compression': 'lz4', **NO_CRC},
    'no index': {'compression': '', 'index_types': IndexType.NONE, **NO_CRC},
    'killed': {'compression': '', 'finish': False, **NO_CRC},
    'no chunks': {'chunked': False, **NO_CRC},
    'no chunks, killed': {'chunked': False, 'finish': False, **NO_CRC}}


def lengths(data):
    """(place, bytes) of the numbers in a sound file that say how long something is."""
    at = 8
    while at + 9 < len(data):
        opcode, length = struct.unpack_from('<BQ', data, at)
        if opcode == 0x0F:  # what comes now is the summary
            return
        yield at + 1, 8
        if opcode == CHUNK:
            name = int.from_bytes(data[at + 37:at + 41], 'little')
            yield from ((at + 25, 8), (at + 37, 4), (at + 41 + name, 8))
            inner, end = at + 49 + name, at + 9 + length
            while not name and inner < end:
                yield inner + 1, 8
                inner += 9 + int.from_bytes(data[inner + 1:inner + 9], 'little')
        at += 9 + length


def flipped(data, chance):
    """The file with one bit of a length changed; lengths of messages are the most."""
    place, size = chance.choice(list(lengths(data)))
    bit = chance.randrange(8 * size if chance.random() < 0.3 else 18)
    changed = bytearray(data)
    changed[place + bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize('layout', LAYOUTS)
def test_no_message_is_invented_where_a_length_is_wrong(tmp_path, layout):
    """Sixty files with a bit of a length changed: no new message, and only the damaged ones go."""
    path, bad = write(tmp_path / 'a.mcap', drive(), **LAYOUTS[layout]), tmp_path / 'b.mcap'
    sound = [row[:6] for row in (
        (m.topic, m.type, m.sequence, m.log_time, m.publish_time, m.data)
        for m in Bag(path, strict=False).messages())]
    lost, worst = 0, 0
    for seed in range(60):
        bad.write_bytes(flipped(path.read_bytes(), random.Random(seed)))
        recover(bad, tmp_path / 'out.mcap')
        rows = [row[:6] for row in contents(tmp_path / 'out.mcap')]
        (tmp_path / 'out.mcap').unlink()
        rest = iter(sound)
        assert all(row in rest for row in rows), f'{seed}: a message that never was'
        lost, worst = lost + len(sound) - len(rows), max(worst, len(sound) - len(rows))
    print(f'{layout}: {lost} of {60 * len(sound)} messages lost, {worst} of a file')
    assert lost <= 60 and worst <= 2


def test_what_a_wrong_length_swallowed_is_told(tmp_path, capsys):
    path = write(tmp_path / 'a.mcap', drive(), **LAYOUTS['chunks'])
    data = bytearray(path.read_bytes())
    chunk = [at for at, opcode, _ in records(data) if opcode == CHUNK][4]
    at, message = chunk + 49, []
    while len(message) < 2:
        length = int.from_bytes(data[at + 1:at + 9], 'little')
        message += [at] * (data[at] == 5)
        at += 9 + length
    data[message[0] + 1:message[0] + 9] = (at - message[0] - 9).to_bytes(8, 'little')  # of both
    path.write_bytes(data)
    assert cli.main(['bag', 'recover', str(path), str(tmp_path / 'out')]) == 0
    told = capsys.readouterr().out
    assert f'byte {message[0]}' in told and f'({message[1] - message[0]} bytes, 1 message' in told
    assert 'lost messages: 1' in told and told.count('no checksums') == 1
    assert len(contents(tmp_path / 'out')) == 179
    with pytest.raises(BagError, match='counts'):
        list(Bag(path).messages())
    recover(write(tmp_path / 'b.mcap', drive()), tmp_path / 'sound')
    assert 'no checksums' not in ' '.join(recover(tmp_path / 'sound', tmp_path / 'c').lines())


def test_records_of_unknown_kinds_are_named(tmp_path):
    path = write(tmp_path / 'a.mcap', drive(1.0))
    data = path.read_bytes()
    path.write_bytes(data[:data.index(b'\x06')] + b'\x99' + (5).to_bytes(8, 'little') + b'mine!'
                     + data[data.index(b'\x06'):-37] + data[-37:-8])  # and no end
    told = recover(path, tmp_path / 'out').lines()
    assert any('0x99 (14 bytes)' in line for line in told)


def test_the_distribution_and_the_data_of_the_source_are_kept(tmp_path):
    folder = tmp_path / 'bag'
    folder.mkdir()
    write(folder / 'bag_0.mcap', drive(0.5))
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  relative_file_paths: [bag_0.mcap]\n'
        '  ros_distro: humble\n  custom_data: {robot: "7", site: Köln}\n')
    recover(folder, tmp_path / 'out')

    def information(name):
        return yaml.safe_load((tmp_path / name / 'metadata.yaml').read_text())[
            'rosbag2_bagfile_information']
    told = information('out')
    assert told['ros_distro'] == 'humble'
    assert told['custom_data'] == {'robot': '7', 'site': 'Köln'}
    (folder / 'metadata.yaml').unlink()
    recover(folder, tmp_path / 'bare')
    assert information('bare')['ros_distro'] == 'unknown'
