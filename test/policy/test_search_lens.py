"""Lenses that the networks of `search` do not know: the squeezed place, and back to metres."""

import math

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.lens import bearings_through, squeezed_pose, squeezed_ranges, zoom_of
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.lens import in_metres
from vn_nav.policy.search.look import (
    BINS,
    COLUMNS,
    RANGE_CENTRES,
    Look,
    arrival_by_pose,
    column_bearings,
    median_ranges,
    range_classes,
)
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import RobotSpec

KNOWN = math.radians(90)
BEARINGS = column_bearings(KNOWN)
ZOOMS = [zoom_of(math.radians(fov), KNOWN) for fov in (55, 70, 110)]


def look_of(pose, ranges=None, sigma=0.2, heading_sigma=0.1, co_visible=4.0):
    """A look that says these poses [N,4] and log-probabilities of ranges."""
    pose = np.asarray(pose, np.float32)
    count = len(pose)
    if ranges is None:
        ranges = np.full((count, COLUMNS, BINS), -math.log(BINS), np.float32)
    sigma, heading_sigma, co_visible, arrived = (
        np.full(count, value, np.float32) for value in (sigma, heading_sigma, co_visible, 0))
    return Look(ranges, pose[:, :2], sigma, pose[:, 2:], heading_sigma, co_visible, arrived)


def sigmoid(logits):
    return 1 / (1 + np.exp(-logits))


def some_poses(count=50, seed=0):
    random = np.random.default_rng(seed)
    angle = random.uniform(-math.pi, math.pi, count)
    return np.column_stack([random.uniform(-4, 4, (count, 2)), np.cos(angle), np.sin(angle)])


def test_the_known_lens_changes_nothing():
    look = look_of(some_poses())
    assert in_metres(look, BEARINGS, 1.02) is look
    assert zoom_of(KNOWN, KNOWN) == 1.0 and zoom_of(math.radians(60), KNOWN) > 1.7
    assert np.allclose(bearings_through(BEARINGS, 1.0), BEARINGS)


@pytest.mark.parametrize('zoom', ZOOMS)
def test_a_pose_is_squeezed_and_comes_back(zoom):
    poses = some_poses()
    squeezed = squeezed_pose(poses, np.full(len(poses), zoom))
    # Both a point and a direction forward shrink by the zoom; what is across stays.
    assert np.allclose(squeezed[:, 0] * zoom, poses[:, 0], atol=1e-5)
    assert np.allclose(squeezed[:, 1], poses[:, 1], atol=1e-5)
    ahead = poses[:, :2] + poses[:, 2:]
    assert np.allclose(np.arctan2(ahead[:, 1] - poses[:, 1], (ahead[:, 0] - poses[:, 0]) / zoom),
                       np.arctan2(squeezed[:, 3], squeezed[:, 2]), atol=1e-5)
    back = in_metres(look_of(squeezed), BEARINGS, zoom)
    assert np.allclose(np.concatenate([back.position, back.heading], 1), poses, atol=1e-4)


@pytest.mark.parametrize('zoom', ZOOMS)
def test_the_spread_of_a_heading_is_that_of_the_angle(zoom):
    poses = some_poses()
    squeezed = squeezed_pose(poses, np.full(len(poses), zoom))
    angle = np.arctan2(squeezed[:, 3], squeezed[:, 2])
    step = 1e-2
    turned = np.concatenate([squeezed[:, :2], np.stack([np.cos(angle + step),
                                                        np.sin(angle + step)], 1)], 1)
    one, other = (in_metres(look_of(own, heading_sigma=step), BEARINGS, zoom)
                  for own in (squeezed, turned))
    moved = (one.heading[:, 0] * other.heading[:, 1] - one.heading[:, 1] * other.heading[:, 0])
    assert np.allclose(moved, one.heading_sigma, rtol=0.05)
    assert np.allclose(one.position_sigma, 0.2 * max(zoom, 1))


def test_arrival_through_another_lens_follows_from_the_pose():
    poses = np.array([[0.1, 0.0, 1.0, 0.0], [0.5, 0.0, 1.0, 0.0], [0.1, 0.0, 0.0, 1.0]])
    zoom = 1.7
    look = in_metres(look_of(squeezed_pose(poses, np.full(3, zoom)), sigma=0.05), BEARINGS, zoom)
    by_pose = arrival_by_pose(look.position, look.position_sigma, look.heading,
                              look.heading_sigma)
    assert np.allclose(sigmoid(look.arrived), by_pose * sigmoid(look.co_visible), atol=1e-4)
    assert sigmoid(look.arrived)[0] > 0.9 > 0.1 > sigmoid(look.arrived)[2]
    unseen = look_of(squeezed_pose(poses, np.full(3, zoom)), sigma=0.05, co_visible=-6.0)
    assert (sigmoid(in_metres(unseen, BEARINGS, zoom).arrived) < 0.01).all()


@pytest.mark.parametrize('zoom', ZOOMS)
def test_ranges_are_stretched_as_distributions(zoom):
    random = np.random.default_rng(1)
    # Between bins that stay inside after the shift, with some doubt.
    true = random.uniform(0.7, 3.0, (20, COLUMNS))
    squeezed = squeezed_ranges(true, BEARINGS, np.full(20, zoom))
    spread = np.log(RANGE_CENTRES / squeezed[..., None]) / 0.25
    said = torch.log_softmax(torch.from_numpy(-0.5 * spread**2).float(), -1).numpy()
    look = in_metres(look_of(some_poses(20), said), BEARINGS, zoom)
    assert np.allclose(np.exp(look.ranges).sum(-1), 1, atol=1e-4)
    assert look.ranges.dtype == look.position.dtype == look.arrived.dtype == np.float32
    assert (look.ranges <= 1e-6).all()
    stretch = zoom * np.cos(BEARINGS) / np.cos(bearings_through(BEARINGS, zoom))
    assert np.allclose(true / squeezed, np.broadcast_to(stretch, true.shape), rtol=1e-4)
    ratio = median_ranges(look.ranges) / median_ranges(said) / stretch
    assert np.abs(ratio - 1).max() < 0.03


def test_what_is_beyond_all_bins_stays_beyond():
    said = np.full((2, COLUMNS, BINS), 1e-7, np.float32)
    said[0, :, 0] = said[1, :, -1] = 1.0
    for zoom in ZOOMS:
        found = np.exp(in_metres(look_of(some_poses(2), np.log(said)), BEARINGS, zoom).ranges)
        # The last bin holds all that is far: drawn nearer, it still is about as far as bins say.
        assert (found[1, :, -1] > 0.99).all()
        assert (found[0].cumsum(-1)[:, 6] > 0.99).all()
        assert np.allclose(found.sum(-1), 1, atol=1e-4)


def test_the_squeezed_place_is_what_the_known_lens_would_show():
    """A wall of any direction: its picture through a long lens, and squeezed by the known one."""
    zoom = 1.8
    true = bearings_through(BEARINGS, zoom)
    normal, off = np.array([math.cos(0.4), math.sin(0.4)]), 2.5

    def wall(direction, scale):
        return off / (normal[0] * scale * np.cos(direction) + normal[1] * np.sin(direction))
    through_long = wall(true, 1.0)
    by_known = wall(BEARINGS, zoom)  # the wall with each x divided by zoom
    squeezed = squeezed_ranges(through_long[None], BEARINGS, np.array([zoom]))[0]
    assert np.allclose(squeezed, by_known, rtol=1e-5)
    assert (range_classes(squeezed) == range_classes(by_known)).mean() > 0.95


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    robot = RobotSpec().with_actions(('forward', 'rotate_left', 'rotate_right'))
    torch.manual_seed(0)
    network = build_policy(NetworkConfig(
        actions=robot.action_names, moves=robot.moves, size=48, architecture='search',
        channels=(8, 12, 8), features=24, blocks=1, view=KNOWN,
        footprint=robot.footprint_radius)).eval()
    folder = tmp_path_factory.mktemp('search') / 'model'
    save_checkpoint(folder, network, {
        'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0})
    return folder, network


def test_the_map_is_drawn_through_the_lens_of_the_robot(checkpoint):
    """The same picture through a longer lens: a narrower cone of floor, farther away."""
    folder, network = checkpoint
    picture = np.random.default_rng(0).integers(0, 255, (3, 48, 48), np.uint8)
    known = []
    for zoom in (1.0, 2.0):
        runtime = PolicyRuntime(folder)
        runtime.set_goal(picture)
        runtime.act(picture, zoom=zoom)
        searcher = runtime.search.searchers[0]
        assert np.allclose(searcher.bearings, bearings_through(BEARINGS, zoom))
        known.append(searcher.grid.known_area())
        batched = BatchedPolicy(network, 1, zoom=zoom)
        batched.act({'image': picture[None], 'goal_index': np.zeros(1, int),
                     'last_action': np.array([-1]), 'last_reward': np.zeros(1, np.float32)},
                    picture[None], np.array([True]))
        assert batched.search.searchers[0].grid.known_area() == known[-1]
        assert batched.arrival[0] == pytest.approx(runtime.arrival, abs=1e-6)
    assert known[0] != known[1]


def test_a_camera_is_prepared_for_the_policy_that_takes_it(checkpoint):
    runtime = PolicyRuntime(checkpoint[0])
    picture = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)
    short = 2 * math.atan(90 / 160 * math.tan(math.radians(30)))  # 60 deg across
    image, zoom = runtime.prepare(picture, short)
    assert image.shape == (3, 48, 48) and zoom == pytest.approx(math.sqrt(3))
    assert runtime.prepare(picture)[1] == 1.0  # nobody says what lens it is
    runtime.check_camera(short, 160 / 90)
    with pytest.raises(UserError, match='horizontally'):
        runtime.check_camera(math.radians(30), 1.0)
    goal, same = runtime.prepare(picture, math.radians(50), zoom)
    assert same == zoom and goal.shape == image.shape
