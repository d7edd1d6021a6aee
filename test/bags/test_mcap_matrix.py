"""Every legal MCAP file is read as the reference reads it: message for message, byte for byte.

Two matrices: the options of the writer of `mcap`, and the variants of the format's conformance
suite (its inputs and features, https://github.com/foxglove/mcap/tree/main/tests/conformance),
written record by record. Then what no writer here writes, and the specification allows.
"""

import io
import itertools
import struct
import zlib

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import CompressionType, IndexType, Writer
from small_bags import MAGIC, chunk_record, whole

from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.records import BagError
from vn_nav.bags.storage.stream import Bag, summary

PADDED = (1, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14)  # opcodes that later versions may extend


def reference(path, topics=None):
    with open(path, 'rb') as file:
        rows = make_reader(file).iter_messages(topics, log_time_order=False)
        return [(channel.topic, channel.message_encoding, schema.name if schema else '',
                 schema.encoding if schema else '', schema.data if schema else b'',
                 tuple(sorted(channel.metadata.items())), message.sequence, message.log_time,
                 message.publish_time, message.data) for schema, channel, message in rows]


def ours(path, topics=None, *, strict=True):
    bag = Bag(path, strict=strict)
    rows = [(m.topic, m.connection.encoding, m.type, m.connection.schema_encoding,
             m.connection.definition, m.connection.metadata, m.sequence, m.log_time,
             m.publish_time, m.data) for m in bag.messages(topics)]
    assert not bag.losses, bag.losses
    return rows


def assert_read_alike(path, name):
    """All messages, each topic alone, by time, passing over damage, and what is counted."""
    expected = reference(path)
    assert ours(path) == expected, name
    assert ours(path, strict=False) == expected, name
    topics = sorted({row[0] for row in expected})
    for topic in topics:
        assert ours(path, [topic]) == reference(path, [topic]), (name, topic)
    with open(path, 'rb') as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert [m.log_time for m in Bag(path).in_time_order()] == times, name
    counted = summary(path)
    assert {topic: counted[topic].count for topic in counted} == {
        topic: sum(row[0] == topic for row in expected) for topic in topics}, name
    assert {topic: counted[topic].type for topic in counted} == {
        row[0]: row[2] for row in expected}, name
    return expected


# The options of the writer.


COMPRESSIONS = {'zstd': CompressionType.ZSTD, 'lz4': CompressionType.LZ4,
                'none': CompressionType.NONE}
SWITCHES = ('repeat_channels', 'repeat_schemas', 'use_statistics', 'use_summary_offsets',
            'enable_crcs', 'enable_data_crcs')


def written(options):
    """Three channels (one comes late, one has no schema), times that overlap, and the rest."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=400, **options)
    writer.start('', 'matrix')
    first = writer.register_schema('pkg/msg/A', 'ros2msg', b'string a\n')
    a = writer.register_channel('/a', 'cdr', first, {'offered_qos_profiles': '[]', 'b': 'c'})
    plain = writer.register_channel('plain', 'json', 0)
    second, b = None, None
    for k in range(40):
        if k == 20:
            second = writer.register_schema('pkg/msg/B', '', b'')
            b = writer.register_channel('/b', '', second)
        channel = (a, plain, b)[k % 3] or a
        # Every fifth message is late: chunks overlap in time.
        time = 1000 + 10 * k - (60 if k % 5 == 4 else 0)
        writer.add_message(channel, time, bytes([k]) * (k * 7 % 50), time - 3, k)
        if k == 15:
            writer.add_attachment(1, 2, 'calibration', 'text/plain', b'\x06' * 100)
            writer.add_metadata('robot', {'name': 'x', 'y': ''})
    writer.finish()
    return stream.getvalue()


def option_rows():
    for chunking in ('zstd', 'lz4', 'none', 'no chunks'):
        for values in itertools.product((True, False), repeat=len(SWITCHES)):
            for index in (IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE):
                options = dict(zip(SWITCHES, values, strict=True), index_types=index)
                # An index of chunks promises their channels: the reference fails without.
                if chunking == 'no chunks':
                    if index != IndexType.ALL:
                        continue
                    options['use_chunking'] = False
                else:
                    options['compression'] = COMPRESSIONS[chunking]
                yield f'{chunking}, {index}, {values}', options


@pytest.mark.slow
def test_every_option_of_the_writer(tmp_path):
    path, count = tmp_path / 'a.mcap', 0
    for name, options in option_rows():
        path.write_bytes(written(options))
        try:
            expected = reference(path)
        except KeyError:  # its reader takes channels and schemas from the summary alone
            chunk_index = options['index_types'] & IndexType.CHUNK
            assert chunk_index and not (
                options['repeat_channels'] and options['repeat_schemas'])
            path.write_bytes(written({**options, 'repeat_channels': True,
                                      'repeat_schemas': True}))
            expected = reference(path)
            path.write_bytes(written(options))
            assert ours(path) == ours(path, strict=False) == expected, name
            for topic in ('/a', '/b', 'plain'):
                assert ours(path, [topic]) == [row for row in expected if row[0] == topic], name
            assert {k: v.type for k, v in summary(path).items()} == {
                '/a': 'pkg/msg/A', '/b': 'pkg/msg/B', 'plain': ''}, name
        else:
            assert_read_alike(path, name)
        assert len(expected) == 40
        count += 1
    assert count == 3 * 64 * 4 + 64


# The variants of the conformance suite.


FEATURES = ('ch', 'mx', 'st', 'rsh', 'rch', 'ax', 'mdx', 'chx', 'sum', 'pad')
SCHEMA = Schema(id=1, name='Example', encoding='c', data=b'\4\5\6')
CHANNEL = Channel(id=1, schema_id=1, topic='example', message_encoding='a',
                  metadata={'foo': 'bar'})


def _message(sequence, log_time, publish_time):
    return Message(channel_id=1, sequence=sequence, log_time=log_time,
                   publish_time=publish_time, data=b'\1\2\3')


INPUTS = {
    'NoData': [],
    'OneSchemalessMessage': [Channel(id=1, schema_id=0, topic='example', message_encoding='text',
                                     metadata={}), _message(10, 2, 1)],
    'OneMessage': [SCHEMA, CHANNEL, _message(10, 2, 1)],
    'OneAttachment': [Attachment(name='myFile', media_type='application/octet-stream',
                                 log_time=2, create_time=1, data=b'\1\2\3')],
    'OneMetadata': [Metadata(name='myMetadata', metadata={'foo': 'bar'})],
    'TenMessages': [SCHEMA, CHANNEL, *(_message(k, time, time) for k, time in enumerate(
        (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)))],
}


def variants():
    """(name, file) of every sensible combination."""
    for (name, records), chosen in itertools.product(
            INPUTS.items(), itertools.product((False, True), repeat=len(FEATURES))):
        features = {feature for feature, use in zip(FEATURES, chosen, strict=True) if use}
        kinds = {type(record) for record in records}
        needed = {'ax': Attachment, 'mdx': Metadata, 'rsh': Schema, 'rch': Channel}
        if any(f in features and kind not in kinds for f, kind in needed.items()):
            continue
        if features & {'ch', 'mx', 'chx'} and not kinds & {Message, Channel, Schema}:
            continue
        if features & {'mx', 'chx'} and 'ch' not in features:
            continue
        if 'sum' in features and not features & {'chx', 'rsh', 'rch', 'mdx', 'ax', 'st'}:
            continue
        yield '-'.join([name, *sorted(features)]), variant(records, features)


class Records:
    """Bytes of records, with three more in each that may have them, if `pad`."""

    def __init__(self, pad):
        self.data, self._pad = bytearray(MAGIC), pad

    def add(self, record):
        """Append it; its place and size."""
        builder = RecordBuilder()
        record.write(builder)
        data = bytearray(builder.end())
        if self._pad and data[0] in PADDED:
            data += b'\1\2\3'
            struct.pack_into('<Q', data, 1, len(data) - 9)
        self.data += data
        return len(self.data) - len(data), len(data)


def variant(records, features):
    file, chunk, index = Records('pad' in features), RecordBuilder(), []
    file.add(Header('', ''))
    attachments, metadata, indexes = [], [], []
    messages = [record for record in records if isinstance(record, Message)]
    for record in records:
        if isinstance(record, Attachment):
            at, size = file.add(record)
            attachments.append(AttachmentIndex(
                offset=at, length=size, log_time=2, create_time=1, data_size=3, name=record.name,
                media_type=record.media_type))
        elif isinstance(record, Metadata):
            at, size = file.add(record)
            metadata.append(MetadataIndex(offset=at, length=size, name=record.name))
        elif 'ch' in features:
            if isinstance(record, Message):
                index.append((record.log_time, chunk.count))
            record.write(chunk)
        else:
            file.add(record)
    times = [message.log_time for message in messages] or [0]
    if 'ch' in features:
        data = chunk.end()
        at, size = file.add(Chunk(
            compression='', data=data, message_start_time=min(times), message_end_time=max(times),
            uncompressed_crc=zlib.crc32(data), uncompressed_size=len(data)))
        offsets, length = {}, 0
        if 'mx' in features and index:
            offsets[1], length = file.add(MessageIndex(channel_id=1, records=index))
        if 'chx' in features:
            indexes.append(ChunkIndex(
                chunk_start_offset=at, chunk_length=size, message_index_offsets=offsets,
                message_index_length=length, message_start_time=min(times), compression='',
                message_end_time=max(times), compressed_size=len(data),
                uncompressed_size=len(data)))
    file.add(DataEnd(zlib.crc32(file.data)))
    start = len(file.data)
    kinds = {kind: [r for r in records if isinstance(r, kind)] for kind in (Schema, Channel)}
    statistics = Statistics(
        message_count=len(messages), schema_count=len(kinds[Schema]),
        channel_count=len(kinds[Channel]), attachment_count=len(attachments),
        metadata_count=len(metadata), chunk_count=int('ch' in features),
        message_start_time=min(times), message_end_time=max(times),
        channel_message_counts={1: len(messages)} if messages else {})
    groups = [(3, kinds[Schema] * ('rsh' in features)), (4, kinds[Channel] * ('rch' in features)),
              (11, [statistics] * ('st' in features)), (13, metadata * ('mdx' in features)),
              (10, attachments * ('ax' in features)), (8, indexes)]
    offsets = []
    for opcode, group in groups:
        places = [file.add(record) for record in group]
        if places:
            offsets.append(SummaryOffset(opcode, places[0][0], sum(size for _, size in places)))
    end = len(file.data)
    if 'sum' in features:
        for offset in offsets:
            file.add(offset)
    start, at = start if end > start else 0, end if 'sum' in features else 0
    tail = struct.pack('<BQQQ', 2, 20, start, at)
    file.add(Footer(start, at, zlib.crc32(bytes(file.data[start or end:]) + tail)))
    return bytes(file.data) + MAGIC


@pytest.mark.slow
def test_every_variant_of_the_conformance_suite(tmp_path):
    path, count = tmp_path / 'a.mcap', 0
    for name, data in variants():
        path.write_bytes(data)
        count += 1
        expected = 10 if name.startswith('Ten') else int(name.startswith('One') and not (
            name.startswith(('OneAttachment', 'OneMetadata'))))
        try:
            assert len(reference(path)) == expected, name
        except (KeyError, AttributeError):  # its reader takes channels from the summary alone
            assert 'chx' in name and not {'rch', 'rsh'} <= set(name.split('-')), name
            assert len(ours(path)) == expected, name
        else:
            assert_read_alike(path, name)
        assert len(ours(path, strict=False)) == expected, name
        if expected:
            recover(path, tmp_path / 'out.mcap')
            assert ours(tmp_path / 'out.mcap') == ours(path), name
            (tmp_path / 'out.mcap').unlink()
    assert count == 416


# What no writer here writes.


def raw(opcode, body=b''):
    return struct.pack('<BQ', opcode, len(body)) + body


def plain(*, schema=SCHEMA, channel=CHANNEL, before=b'', between=b'', count=3):
    """Records of a chunk."""
    builder = RecordBuilder()
    schema.write(builder)
    channel.write(builder)
    builder.write(before)
    for k in range(count):
        _message(k, 5 + k, 5).write(builder)
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
