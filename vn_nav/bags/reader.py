"""Reading rosbag2 bags without a ROS installation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.typesys import Stores, get_typestore

from vn_nav.errors import UserError


class Record(NamedTuple):
    """One message of a bag."""

    topic: str  # as recorded, without the leading slash
    message: Any
    stamp: int  # when it was published, ns since 1970


def read_bag(folder: str | Path, topics: tuple[str, ...] | None = None) -> Iterator[Record]:
    """The messages of a bag in the order of time.

    Args:
        folder: of the bag.
        topics: names without the leading slash; None: all.

    Raises:
        UserError: no bag, or one that cannot be read.
    """
    folder = Path(folder)
    if not (folder / 'metadata.yaml').is_file():
        raise UserError('a bag is a folder with metadata.yaml', str(folder),
                        'give the folder of a finished recording')
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            wanted = [c for c in reader.connections
                      if topics is None or c.topic.lstrip('/') in topics]
            for connection, stamp, data in reader.messages(connections=wanted):
                yield Record(connection.topic.lstrip('/'),
                             reader.deserialize(data, connection.msgtype), stamp)
    except (AnyReaderError, ReaderError, OSError) as error:
        raise UserError('a bag is readable', f'{folder}: {error}',
                        'record it again, or recover it with another tool') from error
