"""DriveSets: what a bag's steps hold, the cache, and what ends in an error."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
from paths import ROOT
from small_bags import IMAGE, INFO, START, camera_info, drive, picture, write

from vn_msgs_py.images import decode_rgb
from vn_nav.bags import drive_cache
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.roles import Topics
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.bags.storage.reader import read_bag
from vn_nav.errors import UserError
from vn_nav.observation import preprocess, preprocess_map
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

BAG = ROOT / 'bags' / 'house_drive'
WANTED = Wanted(RobotSpec().with_actions(DRIVE_ACTIONS))


@pytest.fixture(scope='module')
def drives(tmp_path_factory):
    return load_drives(BAG, WANTED, tmp_path_factory.mktemp('cache'))


def test_the_actions_of_a_recorded_policy_are_found_in_its_odometry(drives):
    names = json.loads(next(iter(read_bag(BAG, ('action_names',)))).message.data)
    recorded = [names[r.message.data] for r in read_bag(BAG, ('action',))]
    cut = [DRIVE_ACTIONS[a] for a in drives.action if a != NO_ACTION]
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
    monkeypatch.setattr(drive_cache, 'decode_bag', lambda *_: decoded.append(1))
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
    assert (every.action == NO_ACTION).all()


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


@pytest.mark.parametrize('every', [True, False])
def test_depth_in_an_encoding_that_cannot_be_read_is_left_out_and_it_says_so(tmp_path, every):
    sent = drive(2.0)
    beside = []
    for k, (_, _, time, _) in enumerate([m for m in sent if m[0] == '/image_raw']):
        depth = picture(time - 5_000_000, np.ones((32, 32), np.uint16),
                        'mono12' if every or k < 7 else '16UC1')
        depth.step = 64
        beside.append(('/depth/image_raw', IMAGE, time + 1, depth))
    goal = ('/goal_image', IMAGE, START, picture(START, np.ones((8, 8), np.uint8), 'magic8'))
    bag = write(tmp_path / 'a.mcap', sorted([*sent, *beside, goal], key=lambda m: m[2]))
    drives = load_drives(bag, dataclasses.replace(WANTED, every=True), tmp_path / 'cache')
    assert len(drives) == 20 and drives.depth is None and drives.facts['undecodable'] == 0
    words, about_goal = drives.facts['notes']
    assert words.startswith(f'depth left out: {20 if every else 7} of 20 cannot be read')
    assert 'mono12' in words and about_goal == '1 goal picture cannot be decoded'


def test_a_simulator_that_was_reset_while_recording_gives_two_episodes_and_every_picture(tmp_path):
    """On its own clock, recorded by the wall's, or by its own too: what a bag can hold of it."""
    for shift in (0, 5 * 10**9):
        again = [(topic, kind, time + shift, message)
                 for topic, kind, time, message in drive(4.0, seed=1)]
        bag = write(tmp_path / f'{shift}.mcap', drive(4.0) + again)
        drives = load_drives(bag, dataclasses.replace(WANTED, every=True), tmp_path / 'cache')
        assert len(drives) == 80 and [len(drives.time[k]) for k in drives.episodes()] == [40, 40]
        assert drives.facts['set_back'] == 1 and drives.facts['unordered'] == 0
        assert np.allclose(drives.pose[:40], drives.pose[40:], atol=1e-6)
        split = write(tmp_path / f'{shift}b.mcap', drive(4.0) + again, chunked=False)
        whole = load_drives(split, dataclasses.replace(WANTED, every=True), tmp_path / 'cache')
        assert np.array_equal(whole.image, drives.image)


@pytest.mark.parametrize('after', [False, True])
def test_a_goal_of_another_camera_is_cut_by_that_one(tmp_path, after):
    """Whatever the order in which the two were recorded; a narrower one shows too little."""
    shades = np.arange(80, dtype=np.uint8)[:, None, None] * np.ones((1, 120, 3), np.uint8)
    goals = []
    for second, degrees in ((0, 100), (2, 70), (3, None)):
        time = START + second * 10**9
        shown = ('/goal_image', IMAGE, time + 1, picture(time, shades + second))
        goals.append(shown)
        if degrees:
            lens = camera_info(time, focal=40 / math.tan(math.radians(degrees / 2)), side=80,
                               width=120)
            goals.append(('/goal_camera_info', INFO, time + (500_000_000 if after else 0), lens))
    sent = [*drive(4.0), *goals, ('/camera_info', INFO, START, camera_info(START, focal=16.0))]
    bag = write(tmp_path / 'bag.mcap', sorted(sent, key=lambda m: m[2]))
    drives = load_drives(bag, dataclasses.replace(WANTED, every=True), tmp_path / 'cache')
    target = WANTED.robot.camera_fov
    expected = [preprocess(shades, 84, fov=math.radians(100), target_fov=target),
                preprocess(shades + 3, 84, fov=math.radians(90), target_fov=target)]
    assert np.array_equal(drives.goals, expected)
    assert set(drives.goal) == {0, -1, 1}
    assert drives.facts['notes'] == [
        '1 goal picture left out: of a camera that sees less than 90 deg']
