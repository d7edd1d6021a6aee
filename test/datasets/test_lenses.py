"""Pairs through other lenses, of other formats and heights; pictures cut to a format."""

import math

import numpy as np
import pytest

from vn_nav.lens import squeezed_pose, zoom_of
from vn_nav.observation import OUTSIDE_GREY
from vn_nav.policy.search.look import column_bearings
from vn_nav.robot import RobotSpec
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.lenses import Lenses, cut
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.datasets.view_ranges import ranges_of_depth
from vn_sim_bridge.simulator import Frames, cameras_at

KNOWN = math.radians(90)
BEARINGS = column_bearings(KNOWN)
SCENES = house_scenes((7, 8), 3)
LENS_DEG = math.degrees(2 * math.atan(1 / 1.5))  # magnifies 1.5 times
USUAL = {'share': 0.0, 'wide_share': 0.0, 'mast_share': 0.0, 'pitched_share': 0.0}
NARROW = Lenses(**USUAL | {'share': 1.0}, fov_deg=(LENS_DEG, LENS_DEG))


def sampler(lenses):
    return PairSampler(SCENES, size=64, seed=3, mix='recognition', lenses=lenses)


def test_what_is_drawn_lies_in_its_bounds_and_in_its_shares():
    robot, lenses = RobotSpec(), Lenses()
    fovs, aspects, masts = lenses.draw(1, np.arange(4000), robot)
    other = ~np.isclose(fovs, robot.camera_fov)
    assert abs(other.mean() - lenses.share) < 0.03
    assert np.degrees(fovs[other]).min() > 55 and np.degrees(fovs[other]).max() < 100
    assert abs((aspects < 1).mean() - lenses.wide_share) < 0.03
    assert aspects.min() >= lenses.least_aspect and aspects.max() == 1
    moved = ~np.isclose(masts, robot.camera_height)
    assert abs(moved.mean() - lenses.mast_share) < 0.03
    assert masts.min() >= lenses.mast[0] and masts[moved].max() <= lenses.mast[1]
    again = lenses.draw(1, np.arange(4000)[::-1], robot)
    assert all(np.array_equal(a, b[::-1]) for a, b in zip((fovs, aspects, masts), again,
                                                          strict=True))
    assert not np.array_equal(lenses.draw(2, np.arange(4000), robot)[0], fovs)


@pytest.mark.parametrize('aspect', [0.5, 0.75, 1.0])
def test_a_cut_picture_is_grey_above_and_below(aspect):
    random = np.random.default_rng(0)
    frames = Frames(random.integers(0, 100, (2, 3, 40, 40), dtype=np.uint8),
                    np.ones((2, 40, 40), np.float32), np.ones((2, 40, 40), np.uint8),
                    np.ones((2, 40, 40), np.uint16))
    before = frames.rgb.copy()
    cut(frames, np.array([aspect, 1.0]))
    edge = round(40 * (1 - aspect) / 2)
    outside = np.ones(40, bool)
    outside[edge:40 - edge] = False
    assert (frames.rgb[0][:, outside] == OUTSIDE_GREY).all()
    assert (frames.depth[0][outside] == 0).all() and (frames.labels[0][outside] == 0).all()
    assert np.array_equal(frames.rgb[0][:, ~outside], before[0][:, ~outside])
    assert (frames.depth[0][~outside] == 1).all() and np.array_equal(frames.rgb[1], before[1])


def test_labels_through_a_long_lens_are_those_of_the_squeezed_place():
    through, plain = sampler(NARROW), sampler(None)
    groups = through.draw_groups(40, 1, bearings=BEARINGS)
    usual = plain.draw_groups(40, 1, bearings=BEARINGS)
    zoom = groups['zoom']
    assert np.allclose(zoom, 1.5, atol=1e-5) and np.allclose(usual['zoom'], 1)
    assert np.allclose(groups['goal_pose'], squeezed_pose(usual['goal_pose'], zoom), atol=1e-5)
    assert np.array_equal(groups['arrived'], usual['arrived'])
    assert groups['overlap'].mean() < usual['overlap'].mean()  # it shows less
    # The known lens at the squeezed place would see every pixel's depth divided by the zoom.
    plain.count = 0
    pairs = plain.draw(40)
    poses = np.stack([pairs['goal_place'], pairs['pose']], 1).reshape(-1, 4)
    cameras, fov = cameras_at(poses, through.robot)
    found = ranges_of_depth(groups['depth'] / 1.5, cameras, fov, poses[:, 2],
                            np.tile(BEARINGS, (80, 1)))
    assert zoom_of(2 * math.atan(1 / 1.5), float(fov[0])) == pytest.approx(1.5)
    known = np.isfinite(found)
    assert known.mean() > 0.95
    near = np.abs(found - groups['ranges']) < 0.1 * groups['ranges'] + 0.05
    assert near[known].mean() > 0.8
    off = np.abs(found - usual['ranges']) < 0.1 * usual['ranges'] + 0.05
    assert off[known].mean() < 0.3  # unsqueezed they do not agree


def test_formats_and_heights_change_pictures_and_leave_poses():
    plain = sampler(None).draw_groups(12, 1, bearings=BEARINGS)
    for kind in ('wide_share', 'mast_share', 'pitched_share'):
        groups = sampler(Lenses(**USUAL | {kind: 1.0})).draw_groups(12, 1, bearings=BEARINGS)
        assert (groups['zoom'] == 1).all()
        assert np.array_equal(groups['goal_pose'], plain['goal_pose'])
        assert np.allclose(groups['ranges'], plain['ranges'])
        assert not np.array_equal(groups['image'], plain['image'])


def test_cameras_look_down_together_or_swayed():
    lenses = Lenses()
    groups, views = np.repeat(np.arange(3000), 2), np.tile(np.arange(2), 3000)
    pitches = np.degrees(lenses.pitches(1, groups, views)).reshape(-1, 2)
    pitched = (pitches != 0).any(1)
    assert abs(pitched.mean() - lenses.pitched_share) < 0.03
    apart = np.abs(np.diff(pitches[pitched], axis=1))[:, 0]
    assert abs((apart > 0).mean() - lenses.swayed_share) < 0.04
    assert apart.max() <= 2 * lenses.sway_deg and apart.max() > 1.5 * lenses.sway_deg
    low, high = lenses.pitch_deg
    assert pitches.min() >= low - lenses.sway_deg and pitches.max() <= high + lenses.sway_deg
    assert pitches[pitched].mean() == pytest.approx((low + high) / 2, abs=1.5)


def test_a_camera_that_looks_down_shows_more_floor():
    level, down = (sampler(Lenses(**USUAL | {'pitched_share': share}, pitch_deg=(30.0, 30.0),
                                  swayed_share=0.0)).draw_groups(12, 1) for share in (0.0, 1.0))
    nearest = [np.where(own['depth'] > 0, own['depth'], np.inf)[:, -8:].mean()
               for own in (level, down)]
    # The lowest rows of a level 90 deg picture meet the floor 1 m ahead; 75 deg down much nearer.
    assert nearest[1] < 0.8 * nearest[0]
