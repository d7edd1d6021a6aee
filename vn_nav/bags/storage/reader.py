"""The messages of a finished bag under the names that nodes use."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from vn_nav.bags.storage.stream import messages


class Record(NamedTuple):
    """One message of a bag."""

    topic: str  # as recorded, without the leading slash
    message: Any
    stamp: int  # when it was recorded, ns since 1970


def read_bag(folder: str | Path, topics: tuple[str, ...] | None = None) -> Iterator[Record]:
    """The messages of a bag in the order of time.

    Args:
        folder: of the bag.
        topics: names without the leading slash; None: all.

    Raises:
        UserError: no bag, or one that cannot be read.
    """
    for record in messages(folder, topics):
        yield Record(record.topic.lstrip('/'), record.message, record.log_time)
