"""Writing rosbag2 bags (MCAP, zstd chunks, metadata version 9) from serialised messages."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, Topic
from vn_nav.errors import UserError

_FOREVER = QosTime(2147483647, 4294967295)


class BagWriter:
    """A bag being recorded; a context manager.

    Args:
        folder: of the bag; it must not exist.
        topics: what will be written.

    Raises:
        UserError: the folder exists or cannot be made.
    """

    def __init__(self, folder: str | Path, topics: Iterable[Topic]):
        try:
            self._writer = Writer(Path(folder), version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise UserError('a bag is recorded into a folder of its own', str(error),
                            'choose another folder, or remove it') from error
        store = get_typestore(Stores.ROS2_JAZZY)
        self._connections = {
            topic.name: self._writer.add_connection(
                topic.name if topic.name.startswith('/') else f'/{topic.name}', topic.type,
                typestore=store, offered_qos_profiles=[_quality(topic)])
            for topic in topics}

    def write(self, name: str, data: bytes, stamp: int) -> None:
        """Append one CDR message of a topic, published at `stamp` [ns since 1970]."""
        self._writer.write(self._connections[name], stamp, data)

    def close(self) -> None:
        """Finish the file and its metadata."""
        self._writer.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_):
        self.close()


def _quality(topic: Topic) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST, topic.depth,
        (QosReliability.BEST_EFFORT if topic.reliability == BEST_EFFORT
         else QosReliability.RELIABLE),
        QosDurability.TRANSIENT_LOCAL if topic.durability == LATCHED else QosDurability.VOLATILE,
        _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, False)
