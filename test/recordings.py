"""Messages that do not compress, and what a recording holds that may have no end."""

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader

from vn_msgs_py.topics import topic

TEXT = topic('scene')  # a string: as large as one likes
START = 1_800_000_000_000_000_000  # ns


def text(size, seed=0):
    """A CDR string that does not compress."""
    content = np.random.default_rng(seed).integers(32, 127, size, np.uint8).tobytes()
    return b'\0\1\0\0' + (size + 1).to_bytes(4, 'little') + content + b'\0'


def read_linearly(path):
    """The messages of a file that may have no end."""
    records = []
    try:
        with open(path, 'rb') as file:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Message):
                    records.append(record)
    except McapError:
        pass
    return records
