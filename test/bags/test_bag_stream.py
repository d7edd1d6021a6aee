"""Reading bags: every layout, order, damage in one error, damage passed over, bounded memory."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Message, Schema
from mcap.writer import IndexType
from rosbags.highlevel import AnyReader
from small_bags import (
    FIXTURE,
    IMAGE,
    ODOMETRY,
    START,
    STORE,
    STRING,
    chunk_record,
    drive,
    make,
    records,
    serialised,
    whole,
    write,
)

from vn_nav.bags.storage.stream import Bag, BagError, in_time_order, messages, summary

CHUNK = 6


def text(words):
    return make(STRING, data=words)


def chunks_of(path):
    return [(at, length) for at, opcode, length in records(path.read_bytes()) if opcode == CHUNK]


def damaged(path, at, value=None):
    """Change a byte of a file in place."""
    data = bytearray(path.read_bytes())
    data[at] = data[at] ^ 0xFF if value is None else value
    path.write_bytes(data)
    return path


def split_bag(folder, sent, parts, **options):
    folder.mkdir()
    names = [f'part_{k}.mcap' for k in range(parts)]
    for k, name in enumerate(names):
        write(folder / name, sent[k * len(sent) // parts:(k + 1) * len(sent) // parts], **options)
    lines = ''.join(f'  - {name}\n' for name in names)
    (folder / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n'
        f'  compression_mode: ""\n  relative_file_paths:\n{lines}')
    return folder


@pytest.mark.parametrize('options', [
    {'compression': 'zstd'}, {'compression': 'lz4'}, {'compression': ''}, {'chunked': False},
    {'enable_data_crcs': True}], ids=['zstd', 'lz4', 'none', 'no chunks', 'data crc'])
def test_every_layout_gives_what_was_written(tmp_path, options):
    sent = drive()
    expected = [(topic, kind, time, time - 1000, serialised(kind, message))
                for topic, kind, time, message in sent]
    for path in (write(tmp_path / 'a.mcap', sent, **options),
                 split_bag(tmp_path / 'split', sent, 3, **options)):
        bag = Bag(path)
        assert [(m.topic, m.type, m.log_time, m.publish_time, m.data)
                for m in bag.messages()] == expected
        assert bag.losses == [] and bag.missing == 0
        assert {name: topic.count for name, topic in summary(path).items()} == {
            '/odom': 80, '/image_raw': 40, '/camera_info': 40, '/cmd_vel': 20}
        some = [m.log_time for m in bag.messages(['cmd_vel'])]
        assert some == [row[2] for row in expected if row[0] == '/cmd_vel']


def test_a_recording_comes_in_the_order_of_time_as_rosbags_has_it():
    """Its latched topics were recorded seconds after they were published."""
    with AnyReader([FIXTURE]) as reader:
        expected = sorted((time, connection.topic, bytes(data))
                          for connection, time, data in reader.messages())
    ours = [(m.log_time, m.topic, m.data) for m in Bag(FIXTURE).in_time_order()]
    assert sorted(ours) == expected
    assert [row[0] for row in ours] == [row[0] for row in expected]
    decoded = next(messages(FIXTURE, ['odom']))
    assert decoded.topic == '/odom' and decoded.message.pose.pose.orientation.w != 0
    assert decoded.time == pytest.approx(decoded.log_time * 1e-9)


def test_without_an_index_late_messages_are_put_in_order_within_a_window(tmp_path):
    times = [0.0, 0.1, 0.5, 0.3, 0.2, 0.9, 2.0, 0.4]  # the last is too late
    sent = [('/a', STRING, START + int(t * 1e9), text(str(t))) for t in times]
    path = write(tmp_path / 'a.mcap', sent, finish=False, chunked=False)
    stream = in_time_order(Bag(path, strict=False).messages())
    assert [(m.log_time - START) * 1e-9 for m in stream] == pytest.approx(
        [0.0, 0.1, 0.2, 0.3, 0.5, 0.9, 0.4, 2.0])
    few = in_time_order(Bag(path, strict=False).messages(), limit=0)
    assert [(m.log_time - START) * 1e-9 for m in few] == pytest.approx(times)


def test_chunks_without_a_wanted_topic_are_not_even_looked_into(tmp_path):
    sent = [('/a', STRING, START + k, text('a' * 5000)) for k in range(3)]
    sent += [('/b', STRING, START + 10 + k, text('b' * 5000)) for k in range(3)]
    path = write(tmp_path / 'a.mcap', sent)
    at, length = chunks_of(path)[0]
    damaged(path, at + 9 + length - 20)
    assert len(list(Bag(path).messages(['b']))) == 3
    with pytest.raises(BagError) as error:
        list(Bag(path).messages(['a']))
    assert error.value.offset == at and str(path) in str(error.value)


def test_damage_is_one_error_that_names_file_and_place(tmp_path):
    sent = drive(1.0)
    path = write(tmp_path / 'a.mcap', sent)
    for at, length in chunks_of(path)[:3]:
        copy = tmp_path / 'b.mcap'
        shutil.copy(path, copy)
        damaged(copy, at + 9 + length // 2)
        with pytest.raises(BagError, match='readable.*recover') as error:
            list(messages(copy))
        assert error.value.offset == at and error.value.path == copy
    for size in (0, 5, 100, path.stat().st_size - 1):
        (tmp_path / 'cut.mcap').write_bytes(path.read_bytes()[:size])
        with pytest.raises(BagError):
            Bag(tmp_path / 'cut.mcap')


@pytest.mark.parametrize('options', [{}, {'compression': 'lz4'}, {'compression': ''}])
@pytest.mark.parametrize('ended', [True, False])
def test_damage_is_passed_over_and_accounted_for(tmp_path, options, ended):
    sent = drive()
    path = write(tmp_path / 'a.mcap', sent, finish=ended, **options)
    everything = [m.data for m in Bag(path, strict=False).messages()]
    chunks = chunks_of(path) if ended else [
        (at, length) for at, op, length in records(path.read_bytes() + bytes(8)) if op == CHUNK]
    at, length = chunks[5]
    damaged(path, at + 9 + length // 2)
    damaged(path, chunks[9][0] + 4)  # the length of another
    bag = Bag(path, strict=False)
    left = [m.data for m in bag.messages()]
    assert len(chunks) > 12 and 0 < len(everything) - len(left) < len(everything) / 4
    rest = iter(everything)
    assert all(data in rest for data in left)  # in order, and nothing invented
    loss, = (loss for loss in bag.losses if not loss.harmless)
    assert (loss.offset, loss.chunks) == (at, 1) and loss.before < loss.after
    # What a chunk's other lengths say mends the one that is wrong, and that is told.
    assert [loss.offset for loss in bag.losses if 'wrong length' in loss.reason] == [chunks[9][0]]
    assert bag.missing == (len(everything) - len(left) if ended else None)
    with pytest.raises(BagError):
        list(Bag(path).messages())


def test_a_file_without_chunks_goes_on_after_damage(tmp_path):
    sent = drive(2.0)
    path = write(tmp_path / 'a.mcap', sent, chunked=False)
    places = [at for at, opcode, _ in records(path.read_bytes()) if opcode == 5]
    damaged(path, places[20] + 9, 0x6F)  # its channel: nothing declares that
    bag = Bag(path, strict=False)
    assert len(list(bag.messages())) == len(sent) - 1 and bag.missing == 1


def test_what_the_file_counts_has_to_be_there(tmp_path):
    """A chunk that became a record of another kind: the count tells, and its fields save it."""
    path = write(tmp_path / 'a.mcap', drive(1.0), index_types=IndexType.NONE)
    damaged(path, chunks_of(path)[2][0], 0x86)
    with pytest.raises(BagError, match='counts'):
        list(Bag(path).messages())
    bag = Bag(path, strict=False)
    assert len(list(bag.messages())) == len(drive(1.0)) and bag.missing == 0
    assert bag.losses[0].harmless and 'fields of kind 6' in bag.losses[0].reason


def test_what_the_index_calls_a_chunk_is_one(tmp_path):
    path = write(tmp_path / 'a.mcap', drive(1.0))
    before = [m.data for m in Bag(path).messages()]
    at, _ = chunks_of(path)[2]
    damaged(path, at, 0x86)
    with pytest.raises(BagError, match='kind 134') as error:
        list(Bag(path).messages())
    assert error.value.offset == at
    bag = Bag(path, strict=False)
    assert [m.data for m in bag.messages()] == before and bag.missing == 0
    loss, = bag.losses
    assert loss.offset == at and loss.harmless


def test_other_formats_are_refused_with_a_remedy(tmp_path):
    def folder(name, text=None, *files):
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).write_bytes(b'')
        if text is not None:
            (tmp_path / name / 'metadata.yaml').write_text(text)
        return tmp_path / name

    info = 'rosbag2_bagfile_information: {relative_file_paths: [%s], compression_mode: "%s"}'
    for path, words in (
            (tmp_path / 'nothing', 'metadata.yaml'),
            (folder('empty'), 'metadata.yaml'),
            (folder('sqlite', None, 'x_0.db3'), 'rosbags-convert --src'),
            (folder('ros1', None, 'x.bag'), 'rosbags-convert'),
            (folder('whole', info % ('x.mcap.zstd', 'FILE')), 'zstd -d'),
            (folder('each', info % ('x.mcap', 'MESSAGE')), 'one by one'),
            (folder('outside', info % ('../../etc/passwd', '')), 'outside the folder'),
            (folder('gone', info % ('x.mcap', '')), 'not there'),
            (folder('deep', '[' * 900_000), 'not the metadata'),
            (folder('nested', '- ' * 5_000), 'not the metadata'),
            (folder('long', ' ' * 2_000_000), 'more than'),
            (folder('bomb', 'a0: &a0 {x: 1}\n' + ''.join(
                f'a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n' for k in range(1, 60))),
             'not the metadata'),
            (folder('other', '{a: 1}'), 'not the metadata')):
        with pytest.raises(BagError, match=words):
            Bag(path)
    (tmp_path / 'x.mcap').write_bytes(b'something else' * 10)
    with pytest.raises(BagError, match='does not begin'):
        Bag(tmp_path / 'x.mcap')


def test_types_are_read_by_the_definitions_in_the_file(tmp_path):
    own = 'my_robot/msg/Wheels'
    definition = 'std_msgs/Header header\nfloat32[] speeds\n' + '=' * 80 + (
        '\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n'
        + '=' * 80 + '\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n')
    data = (b'\0\1\0\0' + (7).to_bytes(4, 'little') + (9).to_bytes(4, 'little')
            + (2).to_bytes(4, 'little') + b'a\0' + b'\0\0' + (2).to_bytes(4, 'little')
            + b'\0\0\x80?' * 2)
    path = write(tmp_path / 'a.mcap', [('/w', own, START, data)], definitions={own: definition})
    message = next(messages(path)).message
    assert message.header.stamp.sec == 7 and message.speeds.tolist() == [1.0, 1.0]


BOMB = 'a/msg/T0 x\n' + ''.join(
    f'{"=" * 80}\nMSG: a/T{k}\na/msg/T{k + 1}[1000] x\n' for k in range(12))


@pytest.mark.parametrize('kind, definition, options, words', [
    (STRING, 'int32 data\n', {}, 'not the one of Jazzy'),
    (STRING, 'string data\n', {'schema': 'ros2idl'}, 'not ros2msg'),
    (STRING, 'string data\n', {'encoding': 'json'}, 'not cdr'),
    ('a/msg/B', 'nonsense\n', {}, 'cannot be read'),
    ('a/msg/B', 'b/msg/C c\n', {}, 'lacks b/msg/C'),
    ('a/msg/B', 'a/msg/B[] c\n', {}, 'within itself'),
    ('a/msg/B', 'string[400000000] c\n', {}, 'array of'),
    ('a/msg/B', 'float64[0] c\n', {}, 'array of'),
    ('a/msg/B', 'float64[40000000] c\n', {}, 'bytes'),
    ('a/msg/B', BOMB, {}, 'lacks|bytes'),
    ('a/msg/B', '# ' + 'x' * 300_000, {}, 'more than'),
    ('a/msg/B', 'wstring x', {}, 'definition'),
    ('', 'string data\n', {}, 'cannot be read')])
def test_a_definition_that_does_not_fit_is_an_error_with_topic_and_type(
        tmp_path, kind, definition, options, words):
    path = write(tmp_path / 'a.mcap', [('/topic', kind, START, b'\0\1\0\0' + bytes(64))],
                 definitions={kind: definition}, **options)
    with pytest.raises(BagError, match=words) as error:
        list(messages(path))
    assert f'/topic ({kind})' in str(error.value)


@pytest.mark.parametrize('data', [
    b'', b'\0\1\0\0', b'\0\1\0\0\xff\xff\xff\xff', b'\0\1\0\0\5\0\0\0\xff\xfe\xfd\xfcx',
    b'\0\1\0\0\2\0\0\0a\0' + bytes(50), b'\0\7\0\0\2\0\0\0a\0', b'(\xb5/\xfd' + bytes(20)])
def test_bytes_that_are_no_such_message_are_an_error_with_topic_and_type(tmp_path, data):
    path = write(tmp_path / 'a.mcap', [('/topic', STRING, START, data)])
    with pytest.raises(BagError, match=r'/topic \(std_msgs/msg/String\)'):
        list(messages(path))


MANY = """
import resource, sys
from pathlib import Path
from vn_nav.bags.storage.stream import messages
next(messages(sys.argv[1]))  # what is loaded once
pages = int(Path('/proc/self/statm').read_text().split()[0])
limit = pages * resource.getpagesize() + (64 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
count, size = 0, 0
for message in messages(sys.argv[1]):
    count, size = count + 1, size + len(message.message.data)
print(count, size / limit)
"""


def test_a_bag_four_times_the_memory_limit_streams(tmp_path):
    builder = RecordBuilder()
    Schema(id=1, name=IMAGE, encoding='ros2msg',
           data=STORE.generate_msgdef(IMAGE, ros_version=2)[0].encode()).write(builder)
    Channel(id=1, schema_id=1, topic='/image_raw', message_encoding='cdr',
            metadata={}).write(builder)
    declared = builder.end()
    large = make(IMAGE, data=np.zeros(4 << 20, np.uint8), encoding='rgb8')
    Message(channel_id=1, sequence=0, log_time=START, publish_time=START,
            data=serialised(IMAGE, large)).write(builder)
    count = 300
    path = tmp_path / 'a.mcap'
    path.write_bytes(whole(declared, chunk_record(builder.end(), crc=0) * count))
    environment = {**os.environ, 'OPENBLAS_NUM_THREADS': '1'}
    done = subprocess.run([sys.executable, '-c', MANY, str(path)], env=environment,
                          capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr[-2000:]
    read, times = done.stdout.split()
    assert int(read) == count and float(times) > 4


def test_odometry_keeps_its_place_among_files(tmp_path):
    """A topic filter over several files, by time: each message once."""
    sent = drive(3.0)
    bag = Bag(split_bag(tmp_path / 'split', sent, 4))
    times = [m.log_time for m in bag.in_time_order(['/odom'])]
    assert times == sorted(row[2] for row in sent if row[1] == ODOMETRY)
