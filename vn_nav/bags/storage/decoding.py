"""Serialised messages to objects, by the definitions that a bag brings along.

`rosbags` generates Python code from definitions and runs it on the messages. Both come from a file
that is untrusted: a definition is checked before it becomes code, and a message before it
becomes objects.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from vn_nav.bags.roles import full_name
from vn_nav.bags.storage.bag_files import OtherFormat, converted
from vn_nav.bags.storage.records import BagError, Connection, Message

MAX_DEFINITION_BYTES = 256 << 10  # bytes; the longest of Jazzy and MoveIt have about 100 kB
MAX_UNROLLED_ELEMENTS = 4096  # elements of a fixed array for which code is generated one by one
MAX_FIXED_BYTES = 64 << 20  # bytes that a message has at least
MAX_NESTING = 32  # of types within types
# A list of numbers is one array, whatever its length; of anything else each element is a Python
# object, a hundred times larger than its bytes can be.
MAX_OBJECTS = 2_000_000
EMPTY = [('structure_needs_at_least_one_member', (Nodetype.BASE, ('uint8', 0)))]
ZSTD = b'\x28\xb5\x2f\xfd'


class _Kind(NamedTuple):
    """A type as it is read."""

    store: Typestore
    name: str
    limit: int  # bytes of a message
    stamped: bool  # it begins with a std_msgs/Header


class Ros1(OtherFormat):
    """A recording of ROS 1 in an MCAP file."""


class _Unusable(Exception):
    """A definition that must not become code: what is wrong with it."""


class Decoder:
    """Makes objects of messages; types are learned as they come."""

    def __init__(self):
        self._kinds: dict[Connection, _Kind] = {}

    def __call__(self, message: Message) -> Any:
        """The message as an object of `rosbags`.

        Raises:
            BagError: an unknown encoding, a definition that disagrees with the known type, or
                bytes that are no such message.
        """
        kind = self.learn(message.connection)
        if len(message.data) > kind.limit:
            raise _bad(message.connection, f'a message has {len(message.data)} bytes, which may '
                       f'be more than {MAX_OBJECTS} objects')
        try:
            # A view: rosbags would copy bytes.
            return kind.store.deserialize_cdr(memoryview(message.data), kind.name)
        except Exception as error:  # generated code: no end to how bytes can make it fail
            if message.data[:4] == ZSTD:
                raise _bad(message.connection, 'the messages are compressed one by one',
                           'convert the folder, with the metadata.yaml that says so, with '
                           f'{converted(message.connection.path.parent)}') from error
            raise _bad(message.connection, f'a message recorded at {message.log_time} ns is none: '
                       f'{error or type(error).__name__}') from error

    def learn(self, connection: Connection) -> _Kind:
        """How the messages of a channel are read.

        Raises:
            BagError: they cannot be.
        """
        if connection not in self._kinds:
            if connection.encoding == 'ros1' or connection.schema_encoding == 'ros1msg':
                raise Ros1(connection.path, f'a recording of ROS 1 (topic {connection.topic}: '
                           f'{connection.type}, encoding {connection.encoding})', 'convert the '
                           f'.bag it was made of with {converted(Path("FILE.bag"))}, which reads '
                           'no MCAP file of ROS 1')
            if connection.encoding != 'cdr':
                raise _bad(connection, f'its messages are {connection.encoding!r}, not cdr')
            try:
                self._kinds[connection] = _learn(connection.type, connection.schema_encoding,
                                                 connection.definition)
            except _Unusable as error:
                raise _bad(connection, str(error)) from error
        return self._kinds[connection]

    def header_stamp(self, message: Message) -> int | None:
        """The stamp of a message's header [ns], without decoding it; None: it has none."""
        if not self.learn(message.connection).stamped or len(message.data) < 12:
            return None
        order: Literal['little', 'big'] = 'little' if message.data[1] & 1 else 'big'
        return (int.from_bytes(message.data[4:8], order, signed=True) * 1_000_000_000
                + int.from_bytes(message.data[8:12], order))


def _bad(connection: Connection, fault: str, remedy: str = '') -> BagError:
    return BagError(connection.path, f'topic {connection.topic} ({connection.type}): {fault}',
                    rule='a message is read by its definition', remedy=remedy or 'leave the topic '
                    'out, or record it with ROS 2 Jazzy, whose definitions are known')


@functools.cache
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@functools.lru_cache(64)
def _learn(name: str, encoding: str, definition: bytes) -> _Kind:
    known = _jazzy()
    name = full_name(name)
    if not definition and name in known.fielddefs:  # recorded where the package had none
        return _kind(known, name)
    if encoding != 'ros2msg':
        raise _Unusable(f'its definition is {encoding!r}, not ros2msg')
    if len(definition) > MAX_DEFINITION_BYTES:
        raise _Unusable(f'its definition has {len(definition)} bytes, more than '
                        f'{MAX_DEFINITION_BYTES}')
    try:
        types = get_types_from_msg(definition.decode(), name)
        name = normalize_msgtype(name)
    except Exception as error:  # a parser that was made for sound definitions
        raise _Unusable(f'its definition cannot be read ({type(error).__name__})') from error
    for part, (_, fields) in types.items():
        if part in known.fielddefs and _same(fields) != _same(known.fielddefs[part][1]):
            raise _Unusable(f'its definition of {part} is not the one of Jazzy')
    if name in known.fielddefs:
        return _kind(known, name)
    store = get_typestore(Stores.ROS2_JAZZY)  # its own: other files may have other types
    fresh = {part: types[part] for part in types if part not in known.fielddefs}
    layouts = {part: own or EMPTY for part, (_, own) in fresh.items()}
    _least(name, {**{part: own for part, (_, own) in known.fielddefs.items()}, **layouts}, {})
    try:
        store.register(fresh)
        kind = _kind(store, name)
        store.get_msgdef(name)
    except Exception as error:
        raise _Unusable(f'its definition makes no type ({type(error).__name__})') from error
    return kind


def _same(fields) -> list:
    return [(name.lower(), kind) for name, kind in fields or EMPTY]


def _kind(store: Typestore, name: str) -> _Kind:
    types = {part: fields for part, (_, fields) in store.fielddefs.items()}
    least: dict[str, tuple[int, int]] = {}
    _, listed = _least(name, types, least)
    first = types[name][0][1]
    return _Kind(store, name, MAX_OBJECTS * listed if listed else 1 << 62,
                 first == (Nodetype.NAME, 'std_msgs/msg/Header'))


def _least(name: str, types: dict, known: dict[str, tuple[int, int]], depth: int = 0
           ) -> tuple[int, int]:
    """Bytes that a type has at least, and those of the smallest element of its lists (0: none).

    Raises:
        _Unusable: a type that is not there, is within itself, is too large or deep, or would make
            endless code.
    """
    if name in known:
        return known[name]
    if depth > MAX_NESTING:
        raise _Unusable(f'its definition has types within types, or within itself: {name}')
    if name not in types:
        raise _Unusable(f'its definition lacks {name}')
    size, smallest = 0, []
    for _, (node, what) in types[name]:
        element, count = what if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) else ((node, what), 1)
        if element[0] == Nodetype.NAME:
            own, listed = _least(element[1], types, known, depth + 1)
        elif element[1][0] != 'string' and element[1][0] not in SIZEMAP:
            raise _Unusable(f'its definition has the type {element[1][0]}')
        else:
            own, listed = 5 if element[1][0] == 'string' else SIZEMAP[element[1][0]], 0
        objects = element[0] == Nodetype.NAME or element[1][0] == 'string'
        smallest += [listed] if listed else []
        if node == Nodetype.SEQUENCE:
            size += 4
            smallest += [own] if objects else []
        else:
            if node == Nodetype.ARRAY and not 0 < count <= (MAX_UNROLLED_ELEMENTS if objects else
                                                            MAX_FIXED_BYTES):
                raise _Unusable(f'its definition has an array of {count} elements')
            size += own * count
        if size > MAX_FIXED_BYTES:
            raise _Unusable(f'its definition has more than {MAX_FIXED_BYTES} bytes')
    known[name] = max(size, 1), min(smallest, default=0)
    return known[name]
