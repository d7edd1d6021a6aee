"""Collected bags: what was seen is what is read, in episodes of one place, a frame a pose."""

import dataclasses
import json

import numpy as np
import pytest
from other_corridors import SHIFT, Lacking, ManyLabels, register
from rosbags.highlevel import AnyReader

from examples import corridor
from vn_nav.bags.dataset import Wanted, load_drives
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.roles import Topics
from vn_nav.bags.storage.stream import messages, summary
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.errors import UserError
from vn_nav.learning.hindsight import Drives
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.scenes import house_scenes as named
from vn_sim_bridge.datasets.collect import REACH, VIEWS, RandomViews, collect, legs, random_views
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.render.randomisation import Randomisation, load_randomisation
from vn_sim_bridge.simulator import Capabilities

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)


def record(folder, houses=(3, 4), pictures=90, randomisation=None, seed=0):
    """A bag of a few rooms."""
    scenes = random_views(named(houses, 2), 36, ROBOT, randomisation or Randomisation(), seed, 1)
    return collect(scenes, len(houses), pictures, ROBOT, lambda topics: BagWriter(folder, topics))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('collected') / 'bag'
    return folder, record(folder)


def read(folder, tmp_path):
    return load_drives(folder, Wanted(ROBOT, 36, Topics(), every=True), tmp_path / 'cache')


def seen(pictures, house, number=0):
    """What the scene of a house shows, by itself."""
    scene = RandomViews(*named((house,), 2), 36, ROBOT, Randomisation())
    return scene.look(number, -(-pictures // VIEWS))


def test_every_picture_is_read_with_its_pose_depth_and_labels(bag, tmp_path):
    folder, done = bag
    drives = read(folder, tmp_path)
    assert len(drives) == done.pictures == 90 and done.scenes == 2
    facts = drives.facts
    assert facts['without_pose'] == facts['jumps'] == facts['unordered'] == 0
    assert facts['episodes'] == done.episodes == len(drives.episodes())
    poses, frames = seen(45, 3)
    # The bag has them in another order: each is looked for by its pose.
    for k in range(45):
        view, = np.nonzero((np.abs(poses[:, :2] - drives.pose[k, :2]) < 1e-9).all(axis=1) & (
            np.abs(np.sin(poses[:, 2] - drives.pose[k, 2])) < 1e-9))[0]
        assert np.array_equal(drives.image[k], frames.rgb[view])
        assert np.array_equal(drives.labels[k], frames.labels[view])
        metres = drives.depth[k] / 25.5
        near = frames.depth[view] < 10
        assert np.abs(metres - frames.depth[view])[near].max() < 0.05
    assert not (drives.action >= 0).any()


def test_most_pictures_have_another_of_their_place_in_their_episode(bag, tmp_path):
    drives = read(bag[0], tmp_path)
    alone = sum(steps.stop - steps.start for steps in drives.episodes()
                if steps.stop - steps.start == 1)
    assert alone <= 0.1 * len(drives)
    for steps in drives.episodes():
        assert steps.stop - steps.start <= VIEWS
        hops = np.hypot(*np.diff(drives.pose[steps, :2], axis=0).T)
        assert (hops <= REACH + 1e-9).all()
    pairs = Drives([drives], ROBOT)
    rows, goals = np.array([(i, j) for first, stop in pairs.episodes for i in range(first, stop)
                            for j in range(first, stop) if i != j]).T
    assert (pairs.co_visibility(rows, goals) >= 0.1).mean() > 0.25


def test_labels_of_pairs_are_those_of_the_sampler(tmp_path):
    record(tmp_path / 'bag', houses=(3,), pictures=6 * VIEWS)
    pairs = Drives([read(tmp_path / 'bag', tmp_path)], ROBOT)
    sampler = PairSampler(named((3,), 2), size=36, robot=ROBOT)
    groups = sampler.draw_groups(6, VIEWS - 1)
    at = {tuple(np.round(pose, 6)): k for k, pose in enumerate(
        np.column_stack([pairs.pose[:, :2], np.cos(pairs.pose[:, 2])]))}
    poses = seen(6 * VIEWS, 3)[0]
    row = np.array([at[tuple(np.round([x, y, np.cos(yaw)], 6))] for x, y, yaw, _ in poses])
    first, second = row[groups['first']], row[groups['second']]
    assert np.allclose(pairs.label(first, second).goal_pose, groups['goal_pose'], atol=1e-4)
    errors = np.abs(pairs.co_visibility(first, second) - groups['overlap'])
    assert errors.mean() < 0.01 and (errors < 0.15).mean() > 0.99  # depth in steps of 4 cm


def test_the_bag_says_what_it_is_to_other_readers_too(bag):
    with AnyReader([bag[0]]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts['/image_raw'] == counts['/odom'] == counts['/camera_info'] == 90
        kept = {c.topic: reader.deserialize(data, c.msgtype)
                for c, _, data in reader.messages()}
    assert json.loads(kept['/labels/names'].data) == list(LABELS)
    scene = json.loads(kept['/scene'].data)
    assert scene['house'] == 4 and scene['poses'] == 'random' and scene['world_version']
    assert kept['/camera_info'].k[0] == pytest.approx(18.0)
    assert counts['/scene'] == 2 and summary(bag[0])['/episode_end'].count == bag[1].episodes


def test_a_seed_repeats_a_bag_and_houses_are_alone(tmp_path):
    def contents(name, **options):
        record(tmp_path / name, pictures=20, randomisation=load_randomisation('standard'),
               **options)
        return [bytes(m.message.data) for m in messages(tmp_path / name, ('image_raw',))]
    one = contents('one')
    assert one == contents('two') and one != contents('three', seed=1)
    # The pictures of the first house do not depend on the second.
    assert contents('four', houses=(3, 5))[:10] == one[:10]


def test_legs_visit_every_place_once_and_never_leap():
    places = np.random.default_rng(0).uniform(0, 9, (40, 2))
    found = legs(places)
    assert sorted(k for leg in found for k in leg) == list(range(40)) and found[0][0] == 0
    for leg in found:
        assert (np.hypot(*np.diff(places[leg], axis=0).T) <= REACH).all()
    assert legs(np.array([[0.0, 0.0], [100.0, 0.0]])) == [[0], [1]]


class Blind:
    """A scene of a simulator that has pictures alone."""

    label_names, facts = (), {}

    def __init__(self, scene):
        self.simulator = type('Backend', (), {'capabilities': Capabilities(
            continuous=False, depth=False, labels=False, geodesic=False, tilt=False)})
        self.look = scene.look


def test_what_a_simulator_does_not_have_is_no_topic(tmp_path):
    scene = Blind(RandomViews('house:3?rooms=2', 36, ROBOT, Randomisation()))
    collect([scene], 1, 8, ROBOT, lambda topics: BagWriter(tmp_path / 'bag', topics))
    assert set(summary(tmp_path / 'bag')) == {'/image_raw', '/camera_info', '/odom',
                                              '/episode_end', '/scene'}


def test_too_little_to_collect_is_refused_before_anything_is_written(tmp_path):
    for houses, pictures in (((), 10), ((3, 4), 3)):
        with pytest.raises(UserError, match='two pictures'):
            record(tmp_path / 'bag', houses, pictures)
    with pytest.raises(UserError, match='rooms'):
        collect(random_views(named((3,), 99), 36, ROBOT, Randomisation(), 0, 1), 1, 8, ROBOT,
                lambda topics: BagWriter(tmp_path / 'bag', topics))
    assert not (tmp_path / 'bag').exists()


def test_the_doctor_finds_nothing_wrong_with_it(bag):
    assert diagnose(bag[0]).findings == []


class Gridded(corridor.CorridorSimulator):
    """Robots stand at a few places, along the corridor or across."""

    capabilities = dataclasses.replace(corridor.CorridorSimulator.capabilities, continuous=False)

    @classmethod
    def open(cls, scenes, setup):
        made = super().open(scenes, setup)
        for place in made.places:
            x, yaw = np.meshgrid(np.arange(0.5, place.length, 0.5), np.arange(4) * np.pi / 2)
            place.starts = lambda x=x, yaw=yaw: (
                np.column_stack([x.ravel(), 0 * x.ravel()]), yaw.ravel())
        return made


@pytest.mark.slow
@pytest.mark.parametrize('kind', [corridor.CorridorSimulator, Gridded, ManyLabels, Lacking])
def test_any_simulator_is_collected_from(tmp_path, monkeypatch, kind):
    register(monkeypatch, 'kind', kind)
    scenes = random_views(['kind:8', 'kind:5'], 36, ROBOT, Randomisation(), 0, 1)
    done = collect(scenes, 2, 80, ROBOT, lambda topics: BagWriter(tmp_path / 'bag', topics))
    drives = read(tmp_path / 'bag', tmp_path)
    assert len(drives) == done.pictures == 80
    # On a grid the same few pictures come again and again, and the doctor wonders.
    assert diagnose(tmp_path / 'bag').findings == [] or kind is Gridded
    poses = drives.pose
    assert (poses[:, 0] > 0).all() and (poses[:, 0] < 8).all() and np.ptp(poses[:, 0]) > 4
    assert (np.abs(poses[:, 1]) < 1).all()
    if kind is Gridded:  # nobody stands in between
        assert not poses[:, 1].any() and np.allclose(poses[:, 0] % 0.5, 0)
        assert np.allclose(np.sin(2 * poses[:, 2]), 0, atol=1e-6)
    else:
        assert len(np.unique(poses[:, 0].round(3))) > 40
    can = kind.capabilities
    assert (drives.depth is not None) == can.depth and (drives.labels is not None) == can.labels
    if can.labels:
        ids = SHIFT if kind is ManyLabels else 0
        assert set(np.unique(drives.labels)) == {ids, ids + 1, ids + 2}
        assert Drives([drives], ROBOT).label_names == tuple(kind.label_names)
        assert Drives([drives], ROBOT).classes == len(kind.label_names)
    else:
        assert drives.facts.get('label_names', []) == []


def test_pairs_of_a_simulator_without_walls(monkeypatch):
    sampler = PairSampler(('examples.corridor:8',), 36, ROBOT)
    pairs = sampler.draw(60)
    assert 0.3 < (pairs['overlap'] >= 0.1).mean() and pairs['arrived'].any()
    assert np.isfinite(pairs['goal_pose']).all() and pairs['segmentation'].max() == 2
    register(monkeypatch, 'lacking', Lacking)
    with pytest.raises(UserError, match='need a simulator with depth'):
        PairSampler(('lacking:8',), 36, ROBOT).draw_groups(2)
