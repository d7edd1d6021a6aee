"""A bag while it is recorded: chunks, seconds, splits, kills and full disks."""

import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
from faults import no_file_beyond, own_mounts
from foreign_readers import assert_every_reader_accepts, information
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from recordings import START, TEXT, read_linearly, text

from vn_msgs_py.topics import TOPICS
from vn_nav.bags.storage.definitions import definition
from vn_nav.bags.storage.output import CHUNK_BYTES, McapOutput
from vn_nav.bags.storage.reader import read_bag
from vn_nav.bags.storage.stream import Bag
from vn_nav.bags.storage.writer import BagWriter, RecordingStopped
from vn_nav.errors import UserError

HERE = Path(__file__).parent


def test_a_chunk_is_256_kib_or_one_message_and_all_but_the_last_are_in_the_file(tmp_path):
    """At every moment: what a killed recorder loses is the chunk that is being filled."""
    path = tmp_path / 'file.mcap'
    output = McapOutput(path)
    channel = output.channel('/scene', TEXT.type, definition(TEXT.type)[0], {})
    sizes = [20_000] * 40 + [400_000, 100, 300_000, 262_000] + [90_000] * 9
    for number, size in enumerate(sizes):
        output.add(channel, text(size, number), START + number, number + 1)
        kept = len(read_linearly(path))
        assert sum(size + 40 for size in sizes[kept:number + 1]) <= CHUNK_BYTES
    output.flush()
    output.finish()
    assert len(read_linearly(path)) == len(sizes)
    with open(path, 'rb') as file:
        chunks = [record for record in StreamReader(file, emit_chunks=True).records
                  if isinstance(record, Chunk)]
    assert {chunk.compression for chunk in chunks} == {'zstd'}
    assert all(chunk.uncompressed_crc for chunk in chunks)
    assert all(chunk.uncompressed_size <= CHUNK_BYTES or chunk.message_start_time
               == chunk.message_end_time for chunk in chunks)


def test_every_second_what_has_come_is_in_the_file_and_the_folder_is_a_bag(tmp_path):
    with BagWriter(tmp_path / 'bag', [TEXT]) as bag:
        assert information(tmp_path / 'bag')['relative_file_paths'] == ['bag_0.mcap']
        begun = time.monotonic()
        bag.write('scene', text(100), START)
        while not read_linearly(tmp_path / 'bag' / 'bag_0.mcap'):
            assert time.monotonic() < begun + 20
            time.sleep(0.05)
        assert not bag.stopped


RECORDING = """
import sys, time
sys.path[:0] = [sys.argv[1], sys.argv[1] + '/..']
from recordings import START, TEXT, text
from vn_msgs_py.topics import topic
from vn_nav.bags.storage.writer import BagWriter
bag = BagWriter(sys.argv[2], [TEXT, topic('reward')])
for number in range(10**9):
    bag.write('scene', text(1000, number), START + number)
    if number == 100:
        bag.write('reward', bytes(8), START + number)
    time.sleep(0.005)
"""


@pytest.mark.slow
def test_of_a_killed_recording_the_metadata_says_what_is_in_it(tmp_path):
    """`ros2 bag play` believes it: topics, counts and times, at most a second old."""
    process = subprocess.Popen([sys.executable, '-c', RECORDING, str(HERE),
                                str(tmp_path / 'bag')])
    path, end = tmp_path / 'bag' / 'metadata.yaml', time.monotonic() + 60
    try:
        while not path.exists() or len(
                information(tmp_path / 'bag')['topics_with_message_count']) < 2:
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.02)
        time.sleep(1.5)
    finally:
        process.kill()
        process.wait()
    there = read_linearly(tmp_path / 'bag' / 'bag_0.mcap')
    facts = information(tmp_path / 'bag')
    counts = {entry['topic_metadata']['name']: entry['message_count']
              for entry in facts['topics_with_message_count']}
    assert counts['/reward'] == 1
    assert 100 < sum(counts.values()) == facts['message_count'] <= len(there)
    assert facts['files'][0]['message_count'] == facts['message_count']
    last = START + facts['duration']['nanoseconds']
    assert last == there[facts['message_count'] - 1].log_time
    assert [p.name for p in sorted((tmp_path / 'bag').iterdir()) if p.suffix != '.tmp'] == [
        'bag_0.mcap', 'metadata.yaml']


def chunk_by_chunk(path, count, look=lambda k: None):
    """A file with a message a chunk, not finished."""
    output = McapOutput(path)
    channel = output.channel('/scene', TEXT.type, definition(TEXT.type)[0], {})
    for k in range(count):
        output.add(channel, text(10), START + k, k)
        output.flush()
        look(k)
    return output


@pytest.mark.slow
def test_the_memory_of_a_recorder_does_not_grow_with_its_chunks(tmp_path):
    """800 bytes a chunk would be 175 MB an hour; the index is whole nevertheless."""
    taken = {}

    def look(k):
        if k in (3000, 12_999):
            taken[k] = tracemalloc.get_traced_memory()[0]
    tracemalloc.start()
    try:
        output = chunk_by_chunk(tmp_path / 'a.mcap', 13_000, look)
    finally:
        tracemalloc.stop()
    assert abs(taken[12_999] - taken[3000]) < 60 * 10_000
    output.finish()
    assert [path.name for path in tmp_path.iterdir()] == ['a.mcap']
    with open(tmp_path / 'a.mcap', 'rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert len(reader.get_summary().chunk_indexes) == 13_000
        assert reader.get_summary().statistics.message_count == 13_000
    assert [m.sequence for m in Bag(tmp_path / 'a.mcap').messages()] == list(range(13_000))


@pytest.mark.slow
def test_chunks_that_are_no_longer_in_memory_are_given_up_as_well(tmp_path):
    """Where the summary of 5,000 small chunks needs the place of thousands."""
    output = chunk_by_chunk(tmp_path / 'a.mcap', 5000)
    with no_file_beyond(output.size + 1000):
        output.finish()
    numbers = [m.sequence for m in Bag(tmp_path / 'a.mcap').messages()]
    assert numbers == list(range(len(numbers))) and 1000 < len(numbers) < 4000


@pytest.mark.slow  # it waits for the time to pass
def test_files_are_split_by_time(tmp_path):
    count, end = 0, time.monotonic() + 30
    with BagWriter(tmp_path / 'bag', [TEXT], max_seconds=0.2) as bag:
        # The clock of a split is the writing thread's, which a busy machine holds up at will.
        while len(list((tmp_path / 'bag').glob('*.mcap'))) < 4 and time.monotonic() < end:
            bag.write('scene', text(10), START + count)
            count += 1
            time.sleep(0.05)
    facts = information(tmp_path / 'bag')
    assert len(facts['files']) >= 4
    assert facts['message_count'] == count
    assert all(file['message_count'] for file in facts['files'])
    assert_every_reader_accepts(tmp_path / 'bag')


def test_an_empty_recording_is_a_bag(tmp_path):
    BagWriter(tmp_path / 'bag', TOPICS).close()
    assert_every_reader_accepts(tmp_path / 'bag')
    assert list(read_bag(tmp_path / 'bag')) == []


def test_a_stamp_that_is_none_is_refused_where_it_is_given(tmp_path):
    with BagWriter(tmp_path / 'bag', [TEXT]) as bag:
        with pytest.raises(ValueError, match='1970'):
            bag.write('scene', text(10), -1)
        bag.write('scene', text(10), START)
    assert information(tmp_path / 'bag')['message_count'] == 1


def write_until_it_stops(bag, count=2000):
    """Pieces of 20 kB; how many were taken."""
    for number in range(count):
        try:
            bag.write('scene', text(20_000, number), START + number, number + 1)
        except RecordingStopped as error:
            assert 'whole' in str(error)
            return number
    raise AssertionError(f'{count} pieces fitted')


def assert_whole_from_the_first(folder, least):
    """Every reader accepts it, and it holds the first messages without a gap."""
    assert_every_reader_accepts(folder)
    with open(folder / f'{folder.name}_0.mcap', 'rb') as file:
        numbers = [message.sequence for _, _, message in make_reader(file).iter_messages()]
    assert numbers == list(range(1, len(numbers) + 1)) and len(numbers) >= least


def test_a_disk_that_fails_a_write_leaves_a_whole_bag(tmp_path):
    with no_file_beyond(2_000_000):
        bag = BagWriter(tmp_path / 'bag', [TEXT])
        taken = write_until_it_stops(bag)
        with pytest.raises(RecordingStopped, match='File too large'):
            bag.close()
    # Twelve messages a chunk: one did not fit, one or two made room for the summary.
    assert_whole_from_the_first(tmp_path / 'bag', 2_000_000 // 20_000 - 4 * 13)
    assert bag.written.total() == information(tmp_path / 'bag')['message_count'] < taken


def test_a_failure_for_which_the_system_has_no_words_stops_a_recording_too(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError('the card is gone')  # no number: strerror is None

    monkeypatch.setattr(McapOutput, 'add', fail)
    bag = BagWriter(tmp_path / 'bag', [TEXT])
    bag.write('scene', text(20, 0), START)
    with pytest.raises(RecordingStopped, match='OSError: the card is gone'):
        bag.close()


def test_no_bag_is_begun_without_room(tmp_path):
    with pytest.raises(UserError, match='GB free'):
        BagWriter(tmp_path / 'bag', [TEXT], min_free=1 << 50)
    assert not (tmp_path / 'bag').exists()


FULL_DISK = """
import os, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + '/..']
from test_bag_writer import TEXT, BagWriter, RecordingStopped, write_until_it_stops
disk, reserve = sys.argv[2], int(sys.argv[3])
bag = BagWriter(disk + '/bag', [TEXT], min_free=reserve)
write_until_it_stops(bag)
try:
    bag.close()
except RecordingStopped as error:
    print(error.received)
facts = os.statvfs(disk)
print(facts.f_bavail * facts.f_frsize)
"""


@pytest.mark.parametrize('reserve', [0, 3_000_000])
def test_a_full_disk_and_one_below_the_limit_leave_a_whole_bag(reserve, tmp_path):
    inside = own_mounts(tmp_path)
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'script.py').write_text(FULL_DISK)
    done = subprocess.run(
        [*inside, 'sh', '-c', 'mount -t tmpfs -o size=8m tmpfs "$1/disk" && '
         '"$2" "$1/script.py" "$3" "$1/disk" "$4" && cp -a "$1/disk/bag" "$1/bag"', 'sh',
         tmp_path, sys.executable, HERE, str(reserve)],
        capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr[-2000:]
    reason, free = done.stdout.splitlines()
    assert ('GB free' if reserve else 'No space left on device') in reason
    assert int(free) > reserve - CHUNK_BYTES - 100_000
    least = (8 * 2**20 - reserve) // 20_100 - 5 * 13
    assert_whole_from_the_first(tmp_path / 'bag', least)
