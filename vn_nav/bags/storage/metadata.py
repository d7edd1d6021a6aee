"""The text of metadata.yaml (rosbag2_storage, metadata version 9)."""

from __future__ import annotations

import collections
import dataclasses
import functools
import textwrap
from collections.abc import Sequence

import yaml

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, Topic

_ENDLESS = {'sec': 9223372036, 'nsec': 854775807}  # as Jazzy writes a duration without end


@dataclasses.dataclass(frozen=True)
class RecordedChannel:
    """A topic as the bag has it."""

    name: str
    topic: Topic
    definition: str
    digest: str  # RIHS01


@dataclasses.dataclass
class RecordedFile:
    """A file of the bag as metadata.yaml has it."""

    name: str
    span: tuple[int, int] | None = None  # least and greatest stamp
    counts: collections.Counter[RecordedChannel] = dataclasses.field(
        default_factory=collections.Counter)
    text: str = ''  # once it is finished


def metadata_text(files: Sequence[RecordedFile],
                  counts: collections.Counter[RecordedChannel]) -> str:
    """The text of a bag's metadata.yaml.

    Written every second: what stays the same is text already, as a dumper would take a hundred
    times as long.

    Args:
        files: of the bag, in order.
        counts: messages of each channel in all of them.
    """
    spans = [file.span for file in files if file.span]
    span = (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None
    topics = [f'{_topic_text(channel)}      message_count: {count}\n'
              for channel, count in counts.items()]
    return ''.join((
        'rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n',
        _times_text(span, '  '), f'  message_count: {counts.total()}\n',
        '  topics_with_message_count:', '\n' if topics else ' []\n', *topics,
        # Of chunks: rosbag2 leaves that to MCAP.
        "  compression_format: ''\n  compression_mode: ''\n", '  relative_file_paths:\n',
        *(f'    - {_scalar(file.name)}\n' for file in files), '  files:\n',
        *(file.text or file_text(file) for file in files),
        '  custom_data: null\n  ros_distro: jazzy\n'))


def qos_text(topic: Topic) -> str:
    """The QoS of a topic as YAML, for its channel in an MCAP file."""
    return _yaml([_quality(topic)])


class _NoAliases(yaml.SafeDumper):
    """Repeats equal parts, as rosbag2 does, instead of referring to the first."""

    def ignore_aliases(self, data):
        return True


def _yaml(data: object) -> str:
    return yaml.dump(data, Dumper=_NoAliases, sort_keys=False, width=1000)


@functools.cache
def _scalar(text: str) -> str:
    """A text as YAML has it, in quotes where it needs them."""
    return _yaml([text]).removeprefix('- ').strip()


@functools.cache
def _topic_text(channel: RecordedChannel) -> str:
    return textwrap.indent(_yaml([{'topic_metadata': {
        'name': channel.name, 'type': channel.topic.type, 'serialization_format': 'cdr',
        'offered_qos_profiles': [_quality(channel.topic)],
        'type_description_hash': channel.digest}}]), '    ')


def file_text(file: RecordedFile) -> str:
    """What metadata.yaml says of a file."""
    return (f'    - path: {_scalar(file.name)}\n{_times_text(file.span, "      ")}'
            f'      message_count: {file.counts.total()}\n')


def _times_text(span: tuple[int, int] | None, indent: str) -> str:
    first, last = span or (0, 0)
    return (f'{indent}duration:\n{indent}  nanoseconds: {last - first}\n'
            f'{indent}starting_time:\n{indent}  nanoseconds_since_epoch: {first}\n')


def _quality(topic: Topic) -> dict:
    """The QoS of a topic as rosbag2 writes it."""
    return {'history': 'keep_last', 'depth': topic.depth,
            'reliability': 'best_effort' if topic.reliability == BEST_EFFORT else 'reliable',
            'durability': 'transient_local' if topic.durability == LATCHED else 'volatile',
            'deadline': _ENDLESS, 'lifespan': _ENDLESS, 'liveliness': 'automatic',
            'liveliness_lease_duration': _ENDLESS, 'avoid_ros_namespace_conventions': False}
