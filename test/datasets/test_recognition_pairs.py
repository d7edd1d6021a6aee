"""Pairs to recognise a goal by: the mixture, arrivals in groups, ranges along bearings."""

import dataclasses
import math

import numpy as np
import pytest

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.policy.search.look import COLUMNS, column_bearings
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.datasets.view_ranges import ranges_of_depth
from vn_sim_bridge.floor.rays import ray_cast
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.simulator import cameras_at

BEARINGS = column_bearings(math.radians(90))
SCENES = house_scenes((7, 8), 3)


@pytest.fixture(scope='module')
def sampler():
    return PairSampler(SCENES, size=36, randomisation=load_randomisation('standard'),
                       mix='recognition')


def test_the_usual_pairs_are_as_they_were():
    _, poses, goal_poses = PairSampler(SCENES, size=36).poses(np.arange(400))
    assert np.allclose(poses.sum(0), [1547.1328, 1452.3406, 12.1089, 0], atol=1e-3)
    assert np.allclose(goal_poses.sum(0), [1500.4, 1437.3, -92.2907, 0], atol=1e-3)


def test_there_in_sight_nearly_there_and_elsewhere(sampler):
    place, poses, goal_poses = sampler.poses(np.arange(6000))
    distance = np.hypot(*(poses - goal_poses)[:, :2].T)
    turn = np.degrees(np.abs(wrap_angle(poses[:, 2] - goal_poses[:, 2])))
    beside = (distance >= 0.6) & (distance <= 1.5) & (turn <= 45)
    askew = (distance <= 0.6) & (turn >= 30) & (turn <= 60)
    # The other kinds add to the ring what happens to fall there.
    assert 0.20 < (beside | askew).mean() < 0.35
    assert 0.09 < askew.mean() < 0.16 and 0.10 < beside.mean() < 0.22
    assert 0.08 < sampler.arrived(place, poses, goal_poses).mean() < 0.20
    assert 0.2 < (turn > 60).mean() < 0.42 and (distance > 4).mean() > 0.03
    for index, built in enumerate(sampler.places):
        own = poses[place == index]
        gap = np.maximum(np.maximum(built.obstacle_rects[None, :, :2] - own[:, None, :2],
                                    own[:, None, :2] - built.obstacle_rects[None, :, 2:]), 0)
        assert np.hypot(*gap.transpose(2, 0, 1)).min() >= sampler.robot.footprint_radius - 1e-9
    with pytest.raises(UserError, match='mix of pairs'):
        PairSampler(SCENES, size=36, mix='other')


def test_the_goal_is_seen_from_any_side(sampler):
    sampler.count = 0
    pairs = sampler.draw_groups(400, 1)
    turn = np.degrees(np.abs(np.arctan2(pairs['goal_pose'][:, 3], pairs['goal_pose'][:, 2])))
    away = np.hypot(*pairs['goal_pose'][:, :2].T)
    seen = pairs['overlap'] >= 0.25
    assert (seen & (turn > 60)).mean() > 0.08 and (seen & (turn > 90)).mean() > 0.03
    assert (seen & (away > 1.5)).mean() > 0.12


def test_groups_say_who_has_arrived_and_how_far_it_is(sampler):
    sampler.count = 100
    groups = sampler.draw_groups(60, 1, bearings=BEARINGS)
    sampler.count = 100
    assert 'ranges' not in sampler.draw_groups(2, 1)
    sampler.count = 100
    pairs = sampler.draw(60)
    forth = groups['second'] % 2 == 0
    assert np.array_equal(groups['arrived'][forth], pairs['arrived']) and pairs['arrived'].any()
    assert groups['ranges'].shape == (120, COLUMNS) and groups['ranges'].dtype == np.float32
    # By dense steps along the bearing until one is inside of an obstacle.
    steps = np.arange(0, 12, 0.01)
    for view in range(0, 40, 3):
        kind = 'goal_place' if view % 2 == 0 else 'pose'
        x, y, yaw, _ = pairs[kind][view // 2]
        rects = sampler.places[pairs['place'][view // 2]].obstacle_rects
        for column in (0, 13, 31):
            angle = yaw + BEARINGS[column]
            along = np.stack([x + steps * math.cos(angle), y + steps * math.sin(angle)], 1)
            inside = ((along[:, None] >= rects[:, :2]) & (along[:, None] <= rects[:, 2:])
                      ).all(2).any(1)
            assert abs(groups['ranges'][view, column] - steps[inside.argmax()]) < 0.03


def test_ranges_between_known_walls():
    rects = np.array([[2.0, -9, 2.2, 9], [-9, 1.0, 9, 1.1], [0, 0, 1, 1]])
    poses = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, math.pi / 2, 0.0]])
    ahead_and_left = np.array([0.0, math.pi / 4, math.pi / 2, math.pi])
    bearings = np.stack([ahead_and_left, ahead_and_left])
    found = ray_cast(poses, np.array([0, 0]), bearings, rects, np.array([0, 2, 3]))
    assert np.allclose(found[0], [2.0, math.sqrt(2), 1.0, np.inf], atol=1e-6)
    assert np.allclose(found[1], [1.0, math.sqrt(2), np.inf, np.inf], atol=1e-6)


@pytest.mark.parametrize('pitch', [0.0, 0.3])
def test_depth_gives_the_ranges_that_walls_give(pitch):
    """For places without known walls; here with, so that both can be compared."""
    plain = PairSampler(SCENES, size=64)
    robot = dataclasses.replace(plain.robot, camera_pitch=pitch)
    plain = PairSampler(SCENES, size=64, robot=robot)
    groups = plain.draw_groups(40, 1, bearings=BEARINGS)
    plain.count = 0
    pairs = plain.draw(40)
    poses = np.stack([pairs['goal_place'], pairs['pose']], 1).reshape(-1, 4)
    lens = (*cameras_at(poses, robot), poses[:, 2], np.tile(BEARINGS, (len(poses), 1)))
    found = ranges_of_depth(groups['depth'], *lens)
    known = np.isfinite(found)
    assert known.mean() > 0.98
    # A table stands over what is behind its edge, a door is edged: most columns agree.
    assert (np.abs(found - groups['ranges'])[known] < 0.1 * groups['ranges'][known] + 0.05
            ).mean() > 0.8
    blind = ranges_of_depth(0 * groups['depth'], *lens)
    assert np.isnan(blind).all()


def test_places_without_walls_take_the_ranges_of_depth(monkeypatch):
    sampler, walled = PairSampler(SCENES, size=64), PairSampler(SCENES, size=64)
    known = sampler.draw_groups(20, 1, bearings=BEARINGS)['ranges']
    cells, first, rects, _, *rest = sampler._floors
    sampler._floors = (cells, first, rects, np.zeros(3, int), *rest)
    sampler.count = 0
    monkeypatch.setattr(sampler, 'poses', walled.poses)  # the same views
    found = sampler.draw_groups(20, 1, bearings=BEARINGS)['ranges']
    assert np.isfinite(found).mean() > 0.98 and not np.array_equal(found, known)
    assert (np.abs(found - known) < 0.1 * known + 0.05).mean() > 0.75
