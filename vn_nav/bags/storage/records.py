"""The records of MCAP files, read without trust: what they declare is checked, then believed.

Source: the MCAP specification, version 0 (https://mcap.dev/spec). The Python package `mcap` reads
sound files; here every length, size and checksum is checked before memory is taken for it, and
whatever is wrong is one error.
"""

from __future__ import annotations

import collections
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from vn_nav.errors import UserError

(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT,
 ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END) = range(1, 16)
A_BAG = 'a bag is a folder with metadata.yaml and MCAP files, or one MCAP file'
# This one and above: of later versions, or (from 0x80) of applications; passed over.
FIRST_UNKNOWN_OPCODE = 0x10
# A chunk of rosbag2 has 768 KiB; a picture at the cap of `vn_msgs_py.images` has 192 MB at most
# (16 million pixels of twelve bytes). What is larger is no recording of a robot's cameras.
MAX_RECORD_BYTES = 256 << 20  # of a message, or of a chunk, compressed or not
MAX_DECLARED_BYTES = 16 << 20  # of all schemas and channels of a file; a large robot has 1 MB
MAX_NAME_BYTES = 1024  # of the name of a topic or type; ROS allows 255
MAX_TIME_NS = 2**63 - 1  # ns: the year 2262, and what rosbag2's own times can hold

HEAD = struct.Struct('<BQ')  # opcode, length
MESSAGE_FIELDS = struct.Struct('<BQHIQQ')  # head, channel, sequence, log time, publish time
# Kinds that would hide messages, a message that is too short, and what is no kind at all.
NEVER_IN_CHUNKS = (0, MESSAGE, CHUNK, DATA_END, FOOTER)
CHANNEL_OVERHEAD_BYTES = 256  # of memory that a channel takes in addition to its texts


class BagError(UserError):
    """A bag that cannot be read, or not be trusted: names the file, and the byte if known."""

    def __init__(self, path: str | Path, fault: str, offset: int | None = None, *,
                 rule: str = 'a bag is readable',
                 remedy: str = 'save what is whole with `vn_nav bag recover`'):
        self.path, self.fault, self.offset = Path(path), fault, offset
        where = f'{path}' if offset is None else f'{path}, byte {offset}'
        super().__init__(rule, f'{where}: {fault}', remedy)


class Connection(NamedTuple):
    """A channel of a file with its schema."""

    path: Path  # of the file
    topic: str  # as recorded
    type: str  # such as sensor_msgs/msg/Image; '' where the file names none
    encoding: str  # of the messages: cdr
    schema_encoding: str  # of the definition: ros2msg
    definition: bytes
    metadata: tuple[tuple[str, str], ...]  # offered_qos_profiles and the like


class Message(NamedTuple):
    """A message as it was recorded."""

    connection: Connection
    sequence: int
    log_time: int  # when it was recorded, ns since 1970
    publish_time: int  # ns since 1970
    data: bytes

    @property
    def topic(self) -> str:
        """The topic as recorded."""
        return self.connection.topic

    @property
    def type(self) -> str:
        """The type, such as sensor_msgs/msg/Image."""
        return self.connection.type


class Damage(Exception):
    """What is wrong at a place.

    Args:
        fault: a text for people.
        end: where the record ends nevertheless, if that is believed.
        cost: bytes that were read to find out.
    """

    def __init__(self, fault: str, *, end: int | None = None, cost: int = 0):
        super().__init__(fault)
        self.fault, self.end, self.cost = fault, end, cost


class Fields:
    """The fields of a record, one after the other; damage where they go beyond its end."""

    def __init__(self, data: bytes, at: int = 0):
        self._data, self.at = data, at

    @property
    def left(self) -> int:
        return len(self._data) - self.at

    def numbers(self, layout: str | struct.Struct) -> tuple[int, ...]:
        layout = struct.Struct(layout) if isinstance(layout, str) else layout
        if layout.size > self.left:
            raise Damage('a record ends within its fields')
        self.at += layout.size
        return layout.unpack_from(self._data, self.at - layout.size)

    def data(self) -> bytes:
        size, = self.numbers('<I')
        if size > self.left:
            raise Damage(f'a field declares {size} bytes where {self.left} are left')
        self.at += size
        return bytes(self._data[self.at - size:self.at])

    def text(self, *, name: bool = False) -> str:
        data = self.data()
        try:
            text = data.decode()
        except UnicodeDecodeError as error:
            raise Damage(f'a text is not UTF-8: {data[:32]!r}') from error
        if name and (len(data) > MAX_NAME_BYTES or not text.isprintable()):
            raise Damage(f'a name is not printable, or longer than {MAX_NAME_BYTES}: '
                         f'{data[:32]!r}')
        return text


class Declared:
    """The schemas and channels of a file as they come by.

    A channel may come before its schema: summaries repeat channels, and not always schemas.

    Args:
        path: of the file.
        wanted: whether the messages of a topic are asked for.
        forgiving: two declarations of one number that differ are no damage but a dispute.

    Attributes:
        read: messages that were read, by channel, of those that are asked for.
        disputes: texts, and whether it is known which declaration is right.
    """

    def __init__(self, path: Path, wanted: Callable[[str], bool], *, forgiving: bool = False):
        self._path, self._wanted, self._size, self._forgiving = path, wanted, 0, forgiving
        self.read: collections.Counter[int] = collections.Counter()
        self.disputes: list[tuple[str, bool]] = []
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._declared: dict[int, tuple] = {}  # schema, topic, encoding, metadata of a channel
        self._waiting: dict[int, list[int]] = {}  # channels whose schema has not come, by schema
        self.channels: dict[int, Connection] = {}  # whose schema has come
        self.chosen: dict[int, Connection | None] = {}  # None: not asked for

    @property
    def whole(self) -> bool:
        """Whether every channel has its schema."""
        return not self._waiting

    def __contains__(self, channel: int) -> bool:
        return channel in self._declared

    def schema(self, fields: Fields) -> None:
        number, = fields.numbers('<H')
        if number == 0:  # invalid, and to be ignored, as the specification has it
            return
        schema = fields.text(name=True), fields.text(name=True), fields.data()
        if self._schemas.setdefault(number, schema) is schema:
            self._grow(sum(map(len, schema)))
            for channel in self._waiting.pop(number, ()):
                self._settle(channel)
        elif self._schemas[number] != schema:
            self._dispute(f'schema {number} ({schema[0]}) is declared twice, and differently')

    def channel(self, fields: Fields) -> None:
        number, schema = fields.numbers('<HH')
        topic, encoding = fields.text(name=True), fields.text(name=True)
        pairs, metadata = Fields(fields.data()), []
        while pairs.left:
            metadata.append((pairs.text(), pairs.text()))
        channel = schema, topic, encoding, tuple(sorted(metadata))
        if self._declared.setdefault(number, channel) is not channel:
            if self._declared[number] == channel or not self._replaces(number, channel):
                return
            self._declared[number] = channel
        self._grow(len(topic) + sum(len(a) + len(b) for a, b in metadata) + CHANNEL_OVERHEAD_BYTES)
        if not self._wanted(topic):
            self.chosen[number] = None
        if schema and schema not in self._schemas:
            self._waiting.setdefault(schema, []).append(number)
        else:
            self._settle(number)

    def knows(self, opcode: int, number: int) -> bool:
        """Whether a schema or channel is declared."""
        return number in (self._schemas if opcode == SCHEMA else self._declared)

    def again(self, wanted: Callable[[str], bool], *, forgiving: bool = False) -> Declared:
        """The same declarations, with other topics asked for."""
        copy = Declared(self._path, wanted, forgiving=forgiving)
        copy._size, copy._schemas = self._size, dict(self._schemas)
        copy._declared, copy.channels = dict(self._declared), dict(self.channels)
        copy._waiting = {schema: list(numbers) for schema, numbers in self._waiting.items()}
        for number, (_, topic, *_) in self._declared.items():
            if not wanted(topic):
                copy.chosen[number] = None
            elif number in self.channels:
                copy.chosen[number] = self.channels[number]
        return copy

    def unknown(self, channel: int) -> str:
        """What is wrong with a message of a channel that is not in `chosen`."""
        if channel not in self._declared:
            return f'a message is of channel {channel}, which nothing declares'
        schema, topic, *_ = self._declared[channel]
        return f'the channel of {topic} has schema {schema}, which nothing declares'

    def _replaces(self, number: int, channel: tuple) -> bool:
        """Whether another declaration of a channel is the right one; the first is forgotten.

        It is where its schema is declared and that of the first one is not.
        """
        schema, topic, *_ = channel
        first = self._declared[number][0]
        right, other = schema in self._schemas, not first or first in self._schemas
        self._dispute(f'channel {number} ({topic}) is declared twice, and differently',
                      sure=right != other)
        if other or not right:
            return False
        self._waiting[first].remove(number)
        if not self._waiting[first]:
            del self._waiting[first]
        self.chosen.pop(number, None)
        return True

    def _dispute(self, text: str, *, sure: bool = False) -> None:
        if not self._forgiving:
            raise Damage(text)
        self.disputes.append((text, sure))

    def _settle(self, number: int) -> None:
        schema, topic, encoding, metadata = self._declared[number]
        name, schema_encoding, definition = self._schemas.get(schema, ('', '', b''))
        connection = Connection(self._path, topic, name, encoding, schema_encoding, definition,
                                metadata)
        self.channels[number] = connection
        self.chosen.setdefault(number, connection)

    def _grow(self, size: int) -> None:
        self._size += size
        if self._size > MAX_DECLARED_BYTES:
            raise Damage(f'schemas and channels have more than {MAX_DECLARED_BYTES} bytes')


def reason_of(error: Exception) -> str:
    """What an error of the system or of a decompressor says."""
    return 'it takes more memory than there is' if isinstance(error, MemoryError) else str(error)


def pairs(fields: Fields) -> bytes:
    """The bytes of a map of 16-bit to 64-bit numbers."""
    data = fields.data()
    if len(data) % 10:
        raise Damage('a map of the summary has half an entry')
    return data


def records(data: bytes, declared: Declared) -> Iterator[Message]:
    """The messages that are asked for among records; declarations are noted."""
    at, end, chosen, size = 0, len(data), declared.chosen, MESSAGE_FIELDS.size
    read = declared.read
    while at < end:
        if data[at] == MESSAGE and end - at >= size:
            _, length, channel, sequence, log_time, publish_time = (
                MESSAGE_FIELDS.unpack_from(data, at))
            at += size
            stop = at + length - (size - HEAD.size)
            if not at <= stop <= end or log_time > MAX_TIME_NS or publish_time > MAX_TIME_NS:
                raise Damage(f'a message declares {length} bytes and the times {log_time} and '
                             f'{publish_time} ns')
            if channel not in chosen:
                raise Damage(declared.unknown(channel))
            connection = chosen[channel]
            if connection is not None:
                read[channel] += 1
                yield Message(connection, sequence, log_time, publish_time, data[at:stop])
            at = stop
            continue
        fields = Fields(data, at)
        opcode, length = fields.numbers(HEAD)
        if length > fields.left or opcode in NEVER_IN_CHUNKS:
            raise Damage(f'a chunk holds a record of kind {opcode} with {length} bytes')
        at = fields.at + length
        if opcode in (SCHEMA, CHANNEL):
            fields = Fields(data[fields.at:at])
            declared.schema(fields) if opcode == SCHEMA else declared.channel(fields)
