"""NavigationEnv: what `info` tells beside the pictures."""

import numpy as np
import pytest
from small_env import make, random_actions

from vn_nav.scenes import house_scenes

LABELS = ('goal_pose', 'overlap')


def test_privileged_outputs_stand_beside_the_pictures():
    env = make(privileged=('depth', 'segmentation', 'goal_segmentation', 'oracle_action'))
    observation, info = env.reset(seed=0)
    assert info['depth'].shape == (4, 36, 36) and info['depth'].dtype == np.float32
    assert (info['depth'] > 0).all() and info['segmentation'].dtype == np.uint8
    assert info['goal_segmentation'].shape == (4, 36, 36)
    assert set(info['oracle_action']) <= set(range(4))
    assert set(observation) == {'image', 'goal_index', 'last_action', 'last_reward'}


def test_the_goal_pose_leads_to_the_goal():
    env = make(scenes=house_scenes((7, 8)), num_envs=8, privileged=LABELS, goal_variants=3)
    observation, info = env.reset(seed=0)
    act = random_actions(env)
    for _ in range(30):
        x, y, c, s = info['goal_pose'].T
        goal, pose = env.goal_poses[info['goal']], info['pose']
        straight = np.hypot(*(goal[:, :2] - pose[:, :2]).T)
        assert np.allclose(np.hypot(x, y), straight, atol=1e-4)
        bearing = np.arctan2(y, x) + pose[:, 2]
        assert np.allclose(pose[:, :2] + straight[:, None] * np.stack(
            [np.cos(bearing), np.sin(bearing)], axis=1), goal[:, :2], atol=1e-4)
        assert np.allclose(np.abs(np.arctan2(s, c)), info['heading_error'], atol=1e-4)
        assert (straight <= info['distance'] + 0.05).all()
        assert set(observation) == {'image', 'goal_index', 'last_action', 'last_reward'}
        observation, _, _, _, info = env.step(act())


def test_overlap_belongs_to_the_true_goal_and_a_grey_picture_has_none():
    env = make(num_envs=16, privileged=LABELS)
    env.set_difficulty(0.2)
    _, right = env.reset(seed=0)
    env.set_shown_goal('wrong')
    _, wrong = env.reset(seed=0)
    env.set_shown_goal('blank')
    _, blank = env.reset(seed=0)
    for name in LABELS:
        assert np.array_equal(right[name], wrong[name])
    assert np.array_equal(right['goal_pose'], blank['goal_pose'])
    assert (right['overlap'] > 0).any() and (blank['overlap'] == 0).all()


def test_a_robot_at_its_goal_sees_all_of_it_and_one_that_turns_away_nothing():
    env = make(num_envs=5, privileged=LABELS, stop='declared')
    _, info = env.reset(seed=0)
    env.simulator.place(np.arange(5), env.goal_poses[info['goal']])
    _, reward, terminated, _, info = env.step([env.declare_action] * 5)
    assert (info['overlap'] == 1).all() and np.allclose(info['goal_pose'], [0, 0, 1, 0], atol=1e-6)
    assert terminated.all() and info['success'].all() and (reward == 1).all()
    _, info = env.reset(seed=0)
    poses = env.goal_poses[info['goal']].copy()
    poses[:, 2] += np.pi
    env.simulator.place(np.arange(5), poses)
    _, reward, terminated, _, info = env.step([env.declare_action] * 5)
    assert (info['overlap'] == 0).all() and terminated.all()
    assert not info['success'].any() and not info['arrived'].any() and (reward == 0).all()


@pytest.mark.parametrize('task', ['object', 'room', 'collect'])
def test_labels_exist_in_every_task(task):
    env = make(task=task, privileged=LABELS)
    _, info = env.reset(seed=0)
    assert info['goal_pose'].shape == (4, 4) and info['overlap'].shape == (4,)
    for _ in range(5):
        _, _, _, _, info = env.step(np.zeros(4, int))
    if task == 'collect':
        assert (info['goal_pose'] == 0).all() and (info['overlap'] == 0).all()
    else:
        assert np.allclose(np.hypot(*info['goal_pose'][:, 2:].T), 1)
    assert np.array_equal(info['arrived'], info['success'])
