"""`bench/photo_sequence.py`: a sequence written out of a house is read back as it was."""

import importlib.util
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from vn_nav.co_visibility import co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.simulator import cameras_at

BENCH = Path(__file__).parents[2] / 'bench' / 'photo_sequence.py'
SIDE = 160  # pixels
CROPPED = slice(20, 140)  # rows of a photograph: 4:3


@pytest.fixture(scope='module')
def bench():
    spec = importlib.util.spec_from_file_location('photo_sequence', BENCH)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def house():
    with_camera = PairSampler(house_scenes((7,), 2), size=SIDE)
    yield with_camera
    with_camera.simulator.close()


def shown(house, poses):
    return house.simulator.view(np.zeros(len(poses), np.int64), poses)


@pytest.fixture(scope='module')
def poses(house):
    _, robots, goals = house.poses(np.arange(5))
    found = np.stack([robots, goals], 1).reshape(-1, 4)
    found[:, 3] = np.radians([0, 25, 10, -8, 30, 20, 5, 15, 0, 22])
    return found


@pytest.fixture(scope='module')
def folder(house, poses, tmp_path_factory):
    """The house's pictures, rolled by nothing, in the format of a head-set's sequence."""
    folder = tmp_path_factory.mktemp('sequence')
    for name in ('images', 'depth'):
        (folder / name).mkdir()
    frames = shown(house, poses)
    rows = []
    for k, (x, y, yaw, pitch) in enumerate(poses):
        picture = frames.rgb[k].transpose(1, 2, 0)[CROPPED]
        cv2.imwrite(str(folder / 'images' / f'{k:05}.jpg'), picture[..., ::-1],
                    [cv2.IMWRITE_JPEG_QUALITY, 95])
        depth = np.minimum(frames.depth[k][CROPPED][::2, ::2] * 1000, 65_535)
        cv2.imwrite(str(folder / 'depth' / f'{k:05}.png'), depth.astype(np.uint16))
        ahead = np.array([math.cos(yaw) * math.cos(pitch), -math.sin(pitch),
                          -math.sin(yaw) * math.cos(pitch)])  # y up
        right = np.array([math.sin(yaw), 0, math.cos(yaw)])
        turn = np.stack([right, np.cross(ahead, right), ahead], 1)
        rows.append([*np.column_stack([turn, [x, house.robot.camera_height, -y]]).ravel(),
                     0, 0, 0, 1])
    np.savetxt(folder / 'poses.txt', rows)
    focal = SIDE / 2 / math.tan(house.robot.camera_fov / 2)
    np.savetxt(folder / 'K.txt', [[focal, 0, SIDE / 2 - 0.5], [0, focal, 59.5], [0, 0, 1]])
    return folder


def test_poses_lens_and_overlaps_are_those_of_the_house(bench, house, poses, folder):
    sequence = bench.Sequence(folder)
    assert np.allclose(sequence.poses[:, :2], poses[:, :2], atol=1e-4)
    assert np.allclose(np.exp(1j * sequence.poses[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-4)
    assert np.allclose(sequence.poses[:, 3], poses[:, 3], atol=1e-4)
    assert math.degrees(sequence.fov) == pytest.approx(90) and sequence.upright_fov < sequence.fov
    one, other = np.array([0, 2]), np.array([1, 3])
    assert np.allclose(sequence.relative(one, other), relative_pose(poses[one], poses[other]),
                       atol=1e-4)
    frames = shown(house, poses)
    frames.depth[:, :20] = frames.depth[:, 140:] = 0
    cameras = cameras_at(poses, house.robot)
    points = lift(frames.depth, *cameras)
    wanted = np.stack([co_visible(points, frames.depth[[k] * 10], cameras[0][[k] * 10],
                                  cameras[1][[k] * 10]) for k in range(10)])
    found = sequence.overlaps(np.arange(10))
    assert (wanted > 0.1).sum() > 12  # beyond each with itself
    assert np.abs(found - wanted).mean() < 0.03 and np.corrcoef(
        found.ravel(), wanted.ravel())[0, 1] > 0.97


def test_a_level_camera_of_another_lens_sees_what_it_would(bench, house, poses, folder):
    sequence = bench.Sequence(folder)
    level = poses.copy()
    level[:, 3] = 0.0
    rendered = shown(house, level).rgb
    camera = bench.Camera(house.robot.camera_fov, pitch=0.0)
    found = sequence.pictures(camera, 80, np.arange(10))
    small = np.stack([cv2.resize(own.transpose(1, 2, 0), (80, 80), interpolation=cv2.INTER_AREA)
                      for own in rendered]).transpose(0, 3, 1, 2)
    known = (np.abs(found.astype(int) - OUTSIDE_GREY).max(1) > 2)[:, None].repeat(3, 1)
    assert 0.3 < known.mean() < 0.95
    gap = np.abs(found.astype(int) - small)[known]
    assert np.median(gap) <= 4
    # Turned the wrong way, or not at all, they would not agree.
    asis = sequence.pictures(bench.Camera(house.robot.camera_fov), 80, np.arange(10))
    assert np.median(np.abs(asis.astype(int) - small)[known]) > 2 * np.median(gap)


def test_no_sequence_is_one_line(bench, tmp_path):
    with pytest.raises(UserError, match='K.txt'):
        bench.Sequence(tmp_path)
