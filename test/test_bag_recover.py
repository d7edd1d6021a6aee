"""`vn_nav bag recover` saves what is whole, tells what was lost, leaves the old bag alone."""

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from small_bags import START, STRING, drive, make, records, serialised, write

from vn_nav import cli
from vn_nav.bags.recover import recover
from vn_nav.bags.stream import Bag, BagError
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
    with pytest.raises(UserError, match='new place'):
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
                               env={**os.environ, 'PYTHONPATH': str(os.path.dirname(__file__))})
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
