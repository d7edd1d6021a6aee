"""DriveSets: what a bag's steps hold, the cache, and what ends in an error."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from vn_msgs_py.images import decode_rgb
from vn_nav.bags import dataset
from vn_nav.bags.dataset import Wanted, load_drives
from vn_nav.bags.drive import MISFIT
from vn_nav.bags.reader import read_bag
from vn_nav.bags.roles import Topics
from vn_nav.errors import UserError
from vn_nav.observation import preprocess, preprocess_map
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

BAG = Path(__file__).parent.parent / 'bags' / 'house_drive'
WANTED = Wanted(RobotSpec().with_actions(DRIVE_ACTIONS))


@pytest.fixture(scope='module')
def drives(tmp_path_factory):
    return load_drives(BAG, WANTED, tmp_path_factory.mktemp('cache'))


def test_the_actions_of_a_recorded_policy_are_found_in_its_odometry(drives):
    names = json.loads(next(iter(read_bag(BAG, ('action_names',)))).message.data)
    recorded = [names[r.message.data] for r in read_bag(BAG, ('action',))]
    cut = [DRIVE_ACTIONS[a] for a in drives.action if a != MISFIT]
    # Where the last action leads to is not always recorded any more.
    assert cut == recorded[:len(cut)] and len(recorded) - 1 <= len(cut) >= 5
    assert drives.facts['misfits'] == 0
    assert len(drives) == len(cut) + len(drives.episodes())
    assert sum(drives.facts['actions'].values()) == len(cut)


def test_pictures_are_those_of_the_bag_and_poses_those_of_the_odometry(drives):
    pictures = {r.message.header.stamp.sec + r.message.header.stamp.nanosec * 1e-9: r.message
                for r in read_bag(BAG, ('image_raw',))}
    for k in range(len(drives)):
        message = pictures[min(pictures, key=lambda stamp: abs(stamp - drives.time[k]))]
        assert np.array_equal(drives.image[k], preprocess(decode_rgb(message), 84))
    moved = np.hypot(*np.diff(drives.pose[:, :2], axis=0).T)
    for action, (dx, dy, _) in enumerate(WANTED.robot.moves):
        own = drives.action[:-1] == action
        assert (np.abs(moved[own] - math.hypot(dx, dy)) < 0.1).all()
    assert drives.depth.shape == drives.labels.shape == (len(drives), 84, 84)
    assert 0 < np.median(drives.depth) < 255 and len(np.unique(drives.labels)) > 3
    assert len(drives.goals) >= 1 and (drives.goal >= 0).any()


def test_the_second_time_it_comes_from_the_cache_and_a_changed_bag_does_not(
        tmp_path, monkeypatch):
    bag = tmp_path / 'bag'
    shutil.copytree(BAG, bag)
    first = load_drives(bag, WANTED, tmp_path / 'cache')
    decoded = []
    monkeypatch.setattr(dataset, '_decode', lambda *_: decoded.append(1))
    again = load_drives(bag, WANTED, tmp_path / 'cache')
    assert not decoded and isinstance(again.image, np.memmap)
    for field in ('image', 'pose', 'time', 'action', 'episode', 'goal', 'goals', 'depth'):
        assert np.array_equal(getattr(first, field), getattr(again, field)), field
    monkeypatch.undo()
    (file,) = bag.glob('*.mcap')
    file.touch()
    load_drives(bag, WANTED, tmp_path / 'cache')
    load_drives(bag, dataclasses.replace(WANTED, size=64), tmp_path / 'cache')
    assert len(list((tmp_path / 'cache').iterdir())) == 3
    assert not list((tmp_path / 'cache').glob('.*'))  # nothing half done


def test_every_picture_can_be_had_too(tmp_path, drives):
    every = load_drives(BAG, dataclasses.replace(WANTED, every=True), tmp_path)
    assert len(every) == every.facts['pictures'] - every.facts['without_pose'] > len(drives)
    assert (every.action == MISFIT).all()


def test_a_bag_that_cannot_be_learned_from_is_refused(tmp_path):
    with pytest.raises(UserError, match='no such file or folder'):
        load_drives(tmp_path / 'nowhere', WANTED, tmp_path)
    with pytest.raises(UserError, match='--topics'):
        load_drives(BAG, dataclasses.replace(WANTED, topics=Topics(image='camera')), tmp_path)
    wide = dataclasses.replace(WANTED.robot, camera_fov=math.radians(120))
    with pytest.raises(UserError, match='wider lens'):
        load_drives(BAG, dataclasses.replace(WANTED, robot=wide), tmp_path)
    (tmp_path / 'file').touch()
    with pytest.raises(UserError, match='cache'):
        load_drives(BAG, WANTED, tmp_path / 'file' / 'cache')
    assert not [p for p in tmp_path.rglob('*') if p.name != 'file']  # nothing is left behind


def test_labels_are_cropped_as_pictures_are_and_never_mixed():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 60, (12, 16)).astype(np.uint8).repeat(40, 0).repeat(40, 1)
    lens = {'fov': math.radians(100), 'target_fov': math.radians(90)}
    small = preprocess_map(labels, 84, **lens)
    picture = preprocess(np.repeat(labels[..., None], 3, 2), 84, **lens)[0]
    assert small.shape == (84, 84) and set(np.unique(small)) <= set(np.unique(labels))
    assert (np.abs(small.astype(int) - picture) <= 1).mean() > 0.55  # but at their edges
    assert np.array_equal(preprocess_map(small, 84), small)
