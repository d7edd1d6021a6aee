"""Every legal MCAP file is read as the reference reads it: message for message, byte for byte.

Two matrices: the options of the writer of `mcap`, and the variants of the format's conformance
suite (its inputs and features, https://github.com/foxglove/mcap/tree/main/tests/conformance),
written record by record.
"""

import io
import itertools
import struct
import zlib

import pytest
from mcap.data_stream import RecordBuilder
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
from mcap_reference import CHANNEL, SCHEMA, assert_read_alike, message_record, ours, reference
from small_bags import MAGIC

from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.stream import summary

PADDED = (1, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14)  # opcodes that later versions may extend


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


INPUTS = {
    'NoData': [],
    'OneSchemalessMessage': [Channel(id=1, schema_id=0, topic='example', message_encoding='text',
                                     metadata={}), message_record(10, 2, 1)],
    'OneMessage': [SCHEMA, CHANNEL, message_record(10, 2, 1)],
    'OneAttachment': [Attachment(name='myFile', media_type='application/octet-stream',
                                 log_time=2, create_time=1, data=b'\1\2\3')],
    'OneMetadata': [Metadata(name='myMetadata', metadata={'foo': 'bar'})],
    'TenMessages': [SCHEMA, CHANNEL, *(message_record(k, time, time) for k, time in enumerate(
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
