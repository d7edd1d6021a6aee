"""What the MCAP specification allows and no writer here writes, and what it forbids."""

import struct

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Statistics
from mcap_reference import CHANNEL, SCHEMA, assert_read_alike, message_record, ours, reference
from small_bags import MAGIC, chunk_record, whole

from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.records import BagError
from vn_nav.bags.storage.stream import Bag, summary


def raw(opcode, body=b''):
    return struct.pack('<BQ', opcode, len(body)) + body


def plain(*, schema=SCHEMA, channel=CHANNEL, before=b'', between=b'', count=3):
    """Records of a chunk."""
    builder = RecordBuilder()
    schema.write(builder)
    channel.write(builder)
    builder.write(before)
    for k in range(count):
        message_record(k, 5 + k, 5).write(builder)
        builder.write(between)
    return builder.end()


def frames(data, parts=3):
    size = len(data) // parts + 1
    return [data[k:k + size] for k in range(0, len(data), size)]


LEGAL = {
    'unknown kinds in the data': whole(raw(0x10), plain(), raw(0x55, b'abc'), raw(0x80),
                                       raw(0xFF, b'private')),
    'unknown kinds in a chunk': whole(chunk_record(plain(
        before=raw(0x10, b'x') + raw(0x7F), between=raw(0x99, b'y' * 40)))),
    'the same without its checksum': whole(chunk_record(plain(
        before=raw(0x10, b'x') + raw(0x7F), between=raw(0x99, b'y' * 40)), crc=0)),
    'a schema with the number 0': whole(raw(3, bytes(14)), chunk_record(
        raw(3, bytes(10) + b'\1\0\0\0\xff') + plain())),
    'bytes behind a zstd frame': whole(chunk_record(
        plain(), stored=zstandard.compress(plain()) + b'more')),
    'bytes behind an lz4 frame': whole(chunk_record(
        plain(), stored=lz4.frame.compress(plain()) + b'more', compression='lz4')),
    'no end mark of the data': MAGIC + raw(1, bytes(8)) + plain() + raw(2, bytes(20)) + MAGIC,
    'header and footer alone': MAGIC + raw(1, bytes(8)) + raw(2, bytes(20)) + MAGIC,
    'a chunk without messages': whole(chunk_record(plain(count=0), time=0), chunk_record(
        plain())),
    'a channel before its schema is needed': whole(plain(), plain()),
    'a chunk that holds other records': whole(chunk_record(plain(between=raw(7, b'\1\0\0\0\0\0')
                                                                 + raw(12, bytes(8))))),
}


@pytest.mark.parametrize('name', LEGAL)
def test_what_the_specification_allows_besides(tmp_path, name):
    path = tmp_path / 'a.mcap'
    path.write_bytes(LEGAL[name])
    expected = assert_read_alike(path, name)
    if expected:
        recover(path, tmp_path / 'out.mcap')
        assert ours(tmp_path / 'out.mcap') == expected


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_of_several_frames(tmp_path, compression):
    """Which the library in C++ reads, and that in Python does not."""
    compress = zstandard.compress if compression == 'zstd' else lz4.frame.compress
    path = tmp_path / 'a.mcap'
    path.write_bytes(whole(chunk_record(plain(), compression=compression, stored=b''.join(
        map(compress, frames(plain()))))))
    assert len(ours(path)) == 3


def test_a_statistic_that_is_not_there_is_no_zero(tmp_path):
    """An empty map of counts means that they are not available."""
    data = bytearray(whole(plain()))
    del data[-37:]
    start = len(data)
    builder = RecordBuilder()
    SCHEMA.write(builder)
    CHANNEL.write(builder)
    Statistics(message_count=3, schema_count=1, channel_count=1, attachment_count=0,
               metadata_count=0, chunk_count=0, message_start_time=5, message_end_time=7,
               channel_message_counts={}).write(builder)
    Footer(start, 0, 0).write(builder)
    path = tmp_path / 'a.mcap'
    path.write_bytes(data + builder.end() + MAGIC)
    assert summary(path)['example'].count == 3 and len(assert_read_alike(path, 'empty')) == 3


ILLEGAL = {
    'a message before its channel': (whole(chunk_record(plain()[-102:]), chunk_record(plain())),
                                     'nothing declares'),
    'a channel whose schema never comes': (whole(chunk_record(plain(channel=Channel(
        id=1, schema_id=9, topic='x', message_encoding='', metadata={})))), 'schema 9'),
    'the kind 0': (whole(plain(), raw(0)), 'kind 0'),
    'the kind 0 in a chunk': (whole(chunk_record(plain(between=raw(0)))), 'kind 0'),
}


@pytest.mark.parametrize('name', ILLEGAL)
def test_what_it_forbids_is_an_error(tmp_path, name):
    path = tmp_path / 'a.mcap'
    data, words = ILLEGAL[name]
    path.write_bytes(data)
    with pytest.raises(BagError, match=words):
        list(Bag(path).messages())
    if 'kind' not in name:
        with pytest.raises((McapError, KeyError)):
            reference(path)


@pytest.mark.slow
def test_an_index_of_any_length_is_used(tmp_path):
    """600,000 chunks: an index of 70 MB. A topic of the last chunk is found by it at once."""
    builder = RecordBuilder()
    other = Channel(id=2, schema_id=1, topic='other', message_encoding='a', metadata={})
    data = bytearray(MAGIC + raw(1, bytes(8)))
    at = len(data)
    first, head = chunk_record(plain(), crc=0), raw(5, bytes(25))[:9]
    last = chunk_record(plain(channel=other).replace(head + b'\1', head + b'\2'))
    broken = first[:-10] + bytes(10)
    data += broken + last
    end = len(data)
    DataEnd(0).write(builder)
    for record in (SCHEMA, CHANNEL, other):
        record.write(builder)

    def entry(place, length, channel):
        entry = RecordBuilder()
        ChunkIndex(chunk_start_offset=place, chunk_length=length, message_start_time=5,
                   message_index_offsets={channel: end}, message_end_time=7,
                   message_index_length=0, compression='x' * 30, compressed_size=1,
                   uncompressed_size=1).write(entry)
        return entry.end()
    # The same broken chunk again and again: one that nobody asks for.
    builder.write(entry(at, len(broken), 1) * 599_999)
    builder.write(entry(at + len(broken), len(last), 2))
    Footer(end + 13, 0, 0).write(builder)
    path = tmp_path / 'a.mcap'
    path.write_bytes(data + builder.end() + MAGIC)
    assert path.stat().st_size > 64 << 20
    assert [m.topic for m in Bag(path).messages(['other'])] == ['other'] * 3
