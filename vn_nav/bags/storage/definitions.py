"""What a message type is made of, as bags carry it, with or without a ROS installation."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from vn_nav.errors import UserError


@functools.cache
def definition(kind: str) -> tuple[str, str]:
    """The ros2msg text of a type with everything it is made of, and its RIHS01 hash (REP 2016).

    Types that Jazzy's common packages lack are read from the message packages installed here.

    Args:
        kind: package/msg/Type.

    Raises:
        UserError: a type that is nowhere, or whose definition cannot be read.
    """
    try:
        _learn(kind)
        return (_store().generate_msgdef(kind, ros_version=2)[0], _store().hash_rihs01(kind))
    except TypesysError as error:
        raise UserError('a recorded type has a definition that can be read', f'{kind}: {error}',
                        'correct its .msg file') from error


@functools.cache
def _store():
    return get_typestore(Stores.ROS2_JAZZY)


def _learn(kind: str) -> None:
    """Register a type and what it is made of."""
    if kind in _store().types:
        return
    package, _, name = kind.rpartition('/msg/')
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(':')), sys.prefix]
    files = [Path(prefix, 'share', package, 'msg', f'{name}.msg') for prefix in prefixes]
    found = next((path for path in files if package and path.is_file()), None)
    if found is None:
        raise UserError('a recorded type is of a message package that is installed', kind,
                        'install or source its package, or leave the topic out')
    types = get_types_from_msg(found.read_text(encoding='utf-8'), kind)
    for part in {part for _, fields in types.values() for _, field in fields
                 for part in _parts(field)} - set(types):
        _learn(part)
    _store().register(types)


def _parts(field: tuple) -> Iterator[str]:
    """Names of the types in a field's description."""
    node, detail = field
    if node == Nodetype.NAME:
        yield detail
    elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        yield from _parts(detail[0])
