"""Whole bags out of damaged ones, and an account of what was lost."""

from __future__ import annotations

import collections
import dataclasses
import os
import shutil
from pathlib import Path

import yaml

from vn_nav.bags.storage.input import Loss
from vn_nav.bags.storage.output import McapOutput
from vn_nav.bags.storage.records import BagError, Connection
from vn_nav.bags.storage.stream import METADATA, Bag, load_yaml
from vn_nav.errors import UserError

MAX_QOS_BYTES = 16 << 10  # bytes of a channel's QoS profiles that are taken over


@dataclasses.dataclass
class Recovered:
    """What was saved of a bag, and what was not."""

    target: Path
    counts: dict[str, int]  # messages by topic
    span: tuple[int, int]  # ns, of the first and the last message
    losses: list[Loss]
    missing: int | None  # messages that the files counted and that are not there; None: unknown
    surplus: int  # messages that are there and that the files do not count
    notes: list[str]  # what is no damage

    @property
    def lost(self) -> bool:
        """Whether something was lost that was in the files, or was changed."""
        return bool(self.missing or self.surplus) or any(not loss.harmless for loss in self.losses)

    def lines(self) -> list[str]:
        """Summary lines of the account."""
        seconds = (self.span[1] - self.span[0]) * 1e-9
        return [f'{self.target}: {sum(self.counts.values())} messages of {len(self.counts)} '
                f'topics, {seconds:.1f} s', *(f'note: {note}' for note in self.notes),
                *map(self._line, self.losses), self._lost()]

    def _line(self, loss: Loss) -> str:
        stretch = f'{loss.size} bytes' if loss.size else ''
        if loss.chunks:
            stretch += f', {loss.chunks} chunk' + 's' * (loss.chunks > 1)
        if loss.messages:
            stretch += f', {loss.messages} message' + 's' * (loss.messages > 1)
        if loss.size and loss.before is not None and loss.after is not None:
            stretch += ', {:.2f} to {:.2f} s from the start'.format(
                *((time - self.span[0]) * 1e-9 for time in (loss.before, loss.after)))
        kind = 'note' if loss.harmless else 'lost'
        return (f'{kind}: {loss.path}, byte {loss.offset}: {loss.reason}'
                + f' ({stretch})' * bool(stretch))

    def _lost(self) -> str:
        if not self.lost:
            return 'lost: nothing that was in the file' + 's' * (len(self.losses) > 1)
        if self.missing is None:
            return 'lost messages: unknown, because a file without its end has no message counts'
        more = (f'; {self.surplus} more than the file counts: so many are corrupt or '
                'invented; which ones cannot be determined') * bool(self.surplus)
        return f'lost messages: {self.missing}{more}'


def recover(source: str | Path, target: str | Path) -> Recovered:
    """Write what is whole in a bag as a new bag; the old one is only read.

    Messages keep their bytes, times, numbers and order; attachments and metadata records are not
    taken over, and split files become one. The new bag appears whole or not at all.

    Args:
        source: a rosbag2 folder or an MCAP file, in whatever state.
        target: must not exist: a folder, or a file where the name ends in .mcap.

    Raises:
        UserError: no bag, nothing in it that is whole, or a target that cannot be written.
    """
    source, target = Path(source), Path(target)
    if target.exists() or target.is_symlink():
        raise UserError('a bag is recovered into a new folder', str(target), 'choose another')
    if source.is_dir() and source.resolve() in target.resolve().parents:
        raise UserError('a damaged bag is left as it is', f'{target}, within it',
                        'choose another place')
    bag = Bag(source, strict=False)
    partial = target.with_name(f'.{target.name}.{os.getpid()}.tmp')
    single = target.suffix == '.mcap'
    file = partial if single else partial / f'{target.name}_0.mcap'
    try:
        if not single:
            partial.mkdir()
        counts, span = _copy(bag, file)
        if not counts:
            raise BagError(source, 'no message in it is whole', remedy='it is lost')
        if not single:
            text = yaml.safe_dump(_metadata(file.name, counts, span, bag), sort_keys=False)
            (partial / METADATA).write_text(text)
        partial.rename(target)
    except OSError as error:
        raise UserError('a recovered bag can be written', f'{target}: {error.strerror}',
                        'free some space, or choose another place') from error
    finally:
        shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
    by_topic: collections.Counter[str] = collections.Counter()
    for connection, count in counts.items():
        by_topic[connection.topic] += count
    return Recovered(target, dict(by_topic), span, bag.losses, bag.missing,
                     bag.surplus, bag.notes)


def _copy(bag: Bag, file: Path) -> tuple[dict[Connection, int], tuple[int, int]]:
    """Write the messages of a bag; their number by channel, and their span [ns]."""
    numbers: dict[Connection, int] = {}  # several files of a bag, and of one channel
    counts: collections.Counter[Connection] = collections.Counter()
    first, last = 1 << 63, 0
    output = McapOutput(file, 'vn_nav bag recover')
    try:
        for message in bag.messages():
            channel = message.connection._replace(path=bag.path)
            if channel not in numbers:
                numbers[channel] = output.channel(
                    channel.topic, channel.type, channel.definition, dict(channel.metadata),
                    encoding=channel.encoding, schema=channel.schema_encoding)
            output.add(numbers[channel], message.data, message.log_time, message.sequence,
                       message.publish_time)
            counts[channel] += 1
            first, last = min(first, message.log_time), max(last, message.log_time)
        output.flush()
    except BaseException:
        output.abandon()
        raise
    output.finish()
    return dict(counts), (first, last)


def _metadata(name: str, counts: dict[Connection, int], span: tuple[int, int], bag: Bag) -> dict:
    """What metadata.yaml says (rosbag2, version 9); the distribution is that of the source."""
    def times() -> dict:  # twice the same object would become an alias
        return {'duration': {'nanoseconds': span[1] - span[0]},
                'starting_time': {'nanoseconds_since_epoch': span[0]}}

    total = sum(counts.values())
    return {'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', **times(), 'message_count': total,
        'topics_with_message_count': [
            {'topic_metadata': {
                'name': channel.topic, 'type': channel.type,
                'serialization_format': channel.encoding,
                'offered_qos_profiles': _quality(channel),
                'type_description_hash': dict(channel.metadata).get('topic_type_hash', '')},
             'message_count': count} for channel, count in counts.items()],
        'compression_format': '', 'compression_mode': '', 'relative_file_paths': [name],
        'files': [{'path': name, **times(), 'message_count': total}],
        'custom_data': bag.custom_data, 'ros_distro': bag.ros_distro or 'unknown'}}


def _quality(channel: Connection) -> list:
    """The QoS profiles that a channel was offered with; none where they cannot be read."""
    text = dict(channel.metadata).get('offered_qos_profiles', '')
    if len(text) > MAX_QOS_BYTES:
        return []
    try:
        profiles = load_yaml(text)
    except Exception:  # of an untrusted file; a bag plays without
        return []
    whole = isinstance(profiles, list) and all(isinstance(p, dict) for p in profiles)
    return profiles if whole else []
