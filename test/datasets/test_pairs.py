"""PairSampler: the same pairs from the same numbers, and the labels that the environment gives."""

import dataclasses

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.tasks import arrived, heading_error
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.simulator import Goal
from vn_sim_bridge.simulators import house as house_module


@pytest.fixture(scope='module')
def sampler():
    return PairSampler(house_scenes((7, 8), 3), size=36,
                       randomisation=load_randomisation('standard'))


def test_draws_do_not_depend_on_how_they_are_batched_and_go_on(sampler):
    sampler.count = 0
    whole = sampler.draw(24)
    assert sampler.count == 24
    sampler.count = 0
    parts = [sampler.draw(k) for k in (5, 12, 7)]
    for name, values in whole.items():
        assert np.array_equal(values, np.concatenate([part[name] for part in parts])), name
    other = PairSampler(house_scenes((7, 8), 3), size=36, seed=1,
                        randomisation=load_randomisation('standard'))
    other.count = 17
    assert not np.array_equal(other.draw(7)['image'], parts[2]['image'])
    sampler.count = 17
    assert np.array_equal(sampler.draw(7)['image'], parts[2]['image'])


def test_shapes_and_mixture(sampler):
    sampler.count = 0
    pairs = sampler.draw(600)
    for name, shape, kind in (
            ('image', (3, 36, 36), np.uint8), ('goal', (3, 36, 36), np.uint8),
            ('goal_pose', (4,), np.float32), ('overlap', (), np.float32), ('arrived', (), bool),
            ('depth', (36, 36), np.float32), ('segmentation', (36, 36), np.uint8),
            ('goal_segmentation', (36, 36), np.uint8)):
        assert pairs[name].shape == (600, *shape) and pairs[name].dtype == kind, name
    distance = np.hypot(*pairs['goal_pose'][:, :2].T)
    turn = np.abs(np.arctan2(pairs['goal_pose'][:, 3], pairs['goal_pose'][:, 2]))
    assert 0.8 <= (distance <= 4.0).mean() <= 0.95 and turn.max() > 3.0
    far = distance > 1.5  # and some of the goal in view: what a robot sees that enters a room
    assert (far & (pairs['overlap'] >= 0.1)).mean() > 0.12
    assert 0.05 <= pairs['arrived'].mean() <= 0.3
    assert set(pairs['place']) == {0, 1}
    assert (pairs['overlap'][pairs['arrived']] > 0.05).mean() > 0.9
    assert (pairs['overlap'] >= 0).all() and (pairs['overlap'] <= 1).all()
    with pytest.raises(UserError, match='at least one pair'):
        sampler.draw(0)


def test_groups_hold_the_pairs_both_ways_round(sampler):
    sampler.count = 10
    pairs = sampler.draw(8)
    sampler.count = 10
    groups = sampler.draw_groups(8, robots=1)
    assert sampler.count == 18
    forth = groups['second'] % 2 == 0  # the goal is the first view of each group
    assert forth.sum() == 8 and len(forth) == 16
    for name in ('goal_pose', 'overlap'):
        assert np.array_equal(groups[name][forth], pairs[name]), name
    for name, own in (('image', 'image'), ('depth', 'depth'), ('segmentation', 'segmentation')):
        assert np.array_equal(groups[own][groups['first'][forth]], pairs[name]), name
    assert np.array_equal(groups['image'][groups['second'][forth]], pairs['goal'])
    # The way back: turned by the opposite angle, as far away.
    to, back = groups['goal_pose'][forth], groups['goal_pose'][~forth]
    assert np.allclose(np.hypot(*to[:, :2].T), np.hypot(*back[:, :2].T), atol=1e-5)
    assert np.allclose(to[:, 2], back[:, 2]) and np.allclose(to[:, 3], -back[:, 3])


def test_groups_share_a_goal_and_their_labels_are_those_of_the_environment(sampler):
    sampler.count = 0
    groups = sampler.draw_groups(5, robots=3)
    assert sampler.count == 15 and groups['image'].shape == (20, 3, 36, 36)
    assert len(groups['first']) == 5 * 4 * 3
    assert (groups['first'] // 4 == groups['second'] // 4).all()
    assert len(set(zip(groups['first'], groups['second'], strict=True))) == 60
    # Robot to robot is robot to goal and goal to robot, one after the other.
    at = {pair: k for k, pair in enumerate(zip(groups['first'], groups['second'], strict=True))}
    for group in range(5):
        goal, one, other = 4 * group, 4 * group + 1, 4 * group + 3
        first, second, whole = (groups['goal_pose'][at[pair]] for pair in (
            (one, goal), (goal, other), (one, other)))
        turned = complex(*first[2:]) * complex(*second[:2])
        assert np.allclose(first[:2] + [turned.real, turned.imag], whole[:2], atol=1e-4)
        assert np.isclose(complex(*first[2:]) * complex(*second[2:]), complex(*whole[2:]),
                          atol=1e-4)
    with pytest.raises(UserError, match='at least one group'):
        sampler.draw_groups(4, 0)


def test_robots_stand_where_robots_can_stand(sampler):
    house, poses, goal_poses = sampler.poses(np.arange(400))
    for index, built in enumerate(sampler.places):
        for pose in np.concatenate([poses[house == index], goal_poses[house == index]]):
            gap = np.maximum(np.maximum(built.obstacle_rects[:, :2] - pose[:2],
                                        pose[:2] - built.obstacle_rects[:, 2:]), 0)
            assert np.hypot(*gap.T).min() >= 0.18


def test_arrival_is_the_tasks_own(sampler):
    house, poses, goal_poses = sampler.poses(np.arange(1500))
    found = sampler.arrived(house, poses, goal_poses)
    expected = [
        arrived(sampler.places[h].geodesic(*goal[:2]).at(pose[None, :2])[0],
                heading_error(pose[2], goal[2]))
        for h, pose, goal in zip(house, poses, goal_poses, strict=True)]
    assert np.array_equal(found, expected) and found.sum() > 80


def test_labels_and_pictures_are_those_of_the_environment(monkeypatch):
    sampler = PairSampler(house_scenes((7,), 3), size=36)
    pairs = sampler.draw(24)
    goals = tuple(Goal(tuple(pose), 'kitchen') for pose in pairs['goal_place'])
    house = dataclasses.replace(generate_house(7, rooms=3), goals=goals)
    monkeypatch.setattr(house_module, 'generate_house', lambda *_, **__: house)
    env = NavigationEnv(EnvConfig(
        scenes=('house:7?rooms=3',), num_envs=24, size=36, one_goal_per_env=True, stop='declared',
        privileged=('goal_pose', 'overlap', 'depth', 'segmentation', 'goal_segmentation')))
    env.reset(seed=0)
    env.simulator.place(np.arange(24), pairs['pose'])
    observation, _, terminated, _, info = env.step(np.full(24, env.declare_action))
    assert terminated.all() and np.array_equal(info['success'], pairs['arrived'])
    assert np.array_equal(observation['image'], pairs['image'])
    assert np.array_equal(env.goals[observation['goal_index']], pairs['goal'])
    for name in ('goal_pose', 'overlap', 'depth', 'segmentation', 'goal_segmentation', 'arrived'):
        assert np.array_equal(info[name], pairs[name]), name
    assert 0 < pairs['arrived'].sum() < 24
