"""Messages of an MCAP file as the reference reader and ours have them."""

from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema

from vn_nav.bags.storage.stream import Bag, summary


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


SCHEMA = Schema(id=1, name='Example', encoding='c', data=b'\4\5\6')
CHANNEL = Channel(id=1, schema_id=1, topic='example', message_encoding='a',
                  metadata={'foo': 'bar'})


def message_record(sequence, log_time, publish_time):
    return Message(channel_id=1, sequence=sequence, log_time=log_time,
                   publish_time=publish_time, data=b'\1\2\3')
