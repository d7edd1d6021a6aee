"""Bags: the fixture that this repository recorded, read by three independent readers."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from vn_nav.bags.reader import read_bag
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import drives_from_bag

FIXTURE = Path(__file__).resolve().parent.parent / 'bags' / 'house_drive'


def test_the_fixture_is_small_and_every_reader_counts_the_same():
    assert sum(path.stat().st_size for path in FIXTURE.iterdir()) < 1_000_000
    metadata = yaml.safe_load((FIXTURE / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    assert metadata['version'] == 9 and metadata['storage_identifier'] == 'mcap'
    ours = sum(1 for _ in read_bag(FIXTURE))
    with AnyReader([FIXTURE]) as reader:
        assert reader.message_count == ours == metadata['message_count']
    with open(FIXTURE / metadata['relative_file_paths'][0], 'rb') as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == ours


def test_an_episode_comes_out_of_it():
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
    data = (FIXTURE / 'house_drive.mcap').read_bytes()
    (broken / 'house_drive.mcap').write_bytes(data[:len(data) // 2])
    with pytest.raises(UserError, match='readable'):
        list(read_bag(broken))
