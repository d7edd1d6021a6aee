"""Bags that are written here: what is in them, and what other readers say of them."""

import numpy as np
import pytest
import yaml
from foreign_readers import assert_every_reader_accepts, information
from mcap.reader import make_reader
from paths import ROOT
from recordings import START, TEXT, text
from rosbags.highlevel import AnyReader

from vn_msgs_py.topics import TOPICS, Topic, topic
from vn_nav.bags.storage.definitions import definition
from vn_nav.bags.storage.losses import Losses
from vn_nav.bags.storage.output import CHUNK_BYTES
from vn_nav.bags.storage.reader import read_bag
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import drives_from_bag

BAGS = ROOT / 'bags'
FIXTURE = BAGS / 'house_drive'
FIXTURES = sorted(path.parent.name for path in BAGS.glob('*/metadata.yaml'))


@pytest.mark.parametrize('name', FIXTURES)
def test_the_fixtures_are_small_and_every_reader_counts_the_same(name):
    folder = BAGS / name
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000
    told = information(folder)
    assert told['version'] == 9 and told['storage_identifier'] == 'mcap'
    ours = sum(1 for _ in read_bag(folder))
    with AnyReader([folder]) as reader:
        assert reader.message_count == ours == told['message_count'] > 0
    with open(folder / told['relative_file_paths'][0], 'rb') as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == ours


def test_an_episode_comes_out_of_the_drive():
    drive, = drives_from_bag(FIXTURE, pictures=True)
    recorded, = drive.episodes
    assert drive.scene['house'] == 7 and recorded.episode.decisions == 10
    assert not recorded.episode.success and recorded.episode.path_length > 0.5
    assert recorded.goal_picture.shape == (84, 84, 3)
    assert len(recorded.pictures) >= 10
    assert np.isfinite(recorded.trajectory).all()


def test_a_bag_without_the_bridges_topics_or_with_damage_is_one_error(tmp_path):
    with pytest.raises(UserError, match='metadata.yaml'):
        drives_from_bag(tmp_path)
    broken = tmp_path / 'broken'
    broken.mkdir()
    (broken / 'metadata.yaml').write_text((FIXTURE / 'metadata.yaml').read_text())
    file, = FIXTURE.glob('*.mcap')
    (broken / file.name).write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    with pytest.raises(UserError, match='readable'):
        list(read_bag(broken))


# Writing.


def test_what_is_written_again_is_the_same_and_every_reader_accepts_it(tmp_path):
    """All messages of the drive through the writer, split into files."""
    names = {f'/{entry.name.lstrip("/")}': entry.name for entry in TOPICS}
    with AnyReader([FIXTURE]) as reader:
        before = [(connection.topic, stamp, bytes(data))
                  for connection, stamp, data in reader.messages()]
    with BagWriter(tmp_path / 'bag', TOPICS, max_bytes=60_000) as bag:
        for number, (name, stamp, data) in enumerate(before):
            bag.write(names[name], data, stamp, number + 1)
    assert bag.written.total() == len(before)
    assert_every_reader_accepts(tmp_path / 'bag')
    with AnyReader([tmp_path / 'bag']) as reader:
        after = [(connection.topic, stamp, bytes(data))
                 for connection, stamp, data in reader.messages()]
    assert after == before
    told = information(tmp_path / 'bag')
    count = len(told['files'])
    assert told['relative_file_paths'] == [f'bag_{k}.mcap' for k in range(count)] and count > 2
    assert sum(file['message_count'] for file in told['files']) == len(before)
    assert told['starting_time']['nanoseconds_since_epoch'] == before[0][1]
    assert told['duration']['nanoseconds'] == before[-1][1] - before[0][1]
    sizes = [(tmp_path / 'bag' / name).stat().st_size for name in told['relative_file_paths']]
    assert max(sizes[:-1]) < 60_000 + CHUNK_BYTES + 20_000  # the last chunk, and the summary


def test_definitions_and_quality_of_service_are_as_rosbag2_has_them(tmp_path):
    with BagWriter(tmp_path / 'bag', [topic('goal_image'), TEXT]) as bag:
        bag.write('scene', text(10), START)
    told = information(tmp_path / 'bag')['topics_with_message_count']
    assert [entry['message_count'] for entry in told] == [1]  # nothing of the other topic
    facts = told[0]['topic_metadata']
    quality, = facts['offered_qos_profiles']
    assert facts['type_description_hash'].startswith('RIHS01_')
    assert (quality['durability'], quality['reliability'], quality['depth']) == (
        'transient_local', 'reliable', 1)
    # A duration without end, as Jazzy has it (bags/ros2_bag_record was recorded by it).
    jazzy = information(BAGS / 'ros2_bag_record')['topics_with_message_count'][0]
    forever = jazzy['topic_metadata']['offered_qos_profiles'][0]['deadline']
    assert quality['deadline'] == quality['lifespan'] == forever
    assert quality['liveliness_lease_duration'] == forever
    with open(tmp_path / 'bag' / 'bag_0.mcap', 'rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
    channel, = summary.channels.values()
    schema, = summary.schemas.values()
    assert (channel.topic, channel.message_encoding) == ('/scene', 'cdr')
    assert (schema.name, schema.encoding) == ('std_msgs/msg/String', 'ros2msg')
    assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [quality]


def test_a_type_of_a_package_installed_here_is_written_with_all_it_is_made_of(
        tmp_path, monkeypatch):
    folder = tmp_path / 'prefix' / 'share' / 'bench_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Thing.msg').write_text('std_msgs/Header header\nPart[] parts  # of it\n')
    (folder / 'Part.msg').write_text('uint8 NONE=0\nfloat32[3] size\n')
    (folder / 'Bad.msg').write_text('float32[ size\n')
    with pytest.raises(UserError, match='installed'):
        definition('bench_msgs/msg/Thing')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'prefix'))
    text, digest = definition('bench_msgs/msg/Thing')
    assert 'MSG: bench_msgs/Part' in text and 'MSG: builtin_interfaces/Time' in text
    assert digest.startswith('RIHS01_')
    with pytest.raises(UserError, match='Bad'):
        definition('bench_msgs/msg/Bad')
    with pytest.raises(UserError, match='installed'):
        BagWriter(tmp_path / 'bag', [Topic('a', 'nobody_msgs/msg/A', '', '')])
    assert not (tmp_path / 'bag').exists()


def test_losses_are_counted_between_the_numbers_of_publishers():
    def lost(numbers, publishers=1):
        losses = Losses()
        return sum(losses.add(number, publishers) for number in numbers)
    assert lost(range(5, 100)) == 0, "what was before the first is nobody's loss"
    assert lost([1, 2, 5, 6, 10]) == 5
    assert lost([7, 8, 9, 1, 2, 3, 5]) == 1, 'a publisher that was started again'
    assert lost([7, 8, 1, 9, 2, 10, 3], 2) == 0
    assert lost([7, 8, 1, 9, 2, 10, 3], 1) == 0, 'before the graph shows the second publisher'
    assert lost([7, 8, 1, 9, 2, 12, 3], 2) == 2
    assert lost([1, 1, 2, 2, 3, 3], 2) == 0
