"""`EnvConfig.odometry`: what the robots observe of their own motion."""

import functools
import math

import numpy as np
import pytest
from small_env import alike, make, random_actions

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.navigation.gym_env import Navigation
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.robot.odometry import (
    advance,
    advance_all,
    drift_errors,
    drift_errors_of_all,
)
from vn_sim_bridge.robot.simulated_robot import TICK, SimulatedRobot

ROUGH = Randomisation(motion_scale=(0.9, 1.1), slip=0.2)
small = functools.partial(make, scenes=('house:7?rooms=2',), size=16)


def from_start(pose, start):
    """Poses [N,>=3] seen from other ones."""
    (dx, dy), yaw = (pose[:, :2] - start[:, :2]).T, start[:, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(pose[:, 2] - yaw)], 1)


def off(odometry, pose):
    """By how much they differ, [N,3]."""
    gap = odometry - pose
    gap[:, 2] = wrap_angle(gap[:, 2])
    return gap


def drive(env, steps, seed=0):
    """Random actions: the odometry, the pose seen from its episode's start, who touched."""
    act = random_actions(env, seed)
    observation, info = env.reset(seed=3)
    start, found = info['pose'].copy(), []
    assert not observation['odometry'].any()
    for _ in range(steps):
        observation, *_, info = env.step(act())
        start[info['reset']] = info['pose'][info['reset']]
        assert not observation['odometry'][info['reset']].any()
        assert observation['odometry'].dtype == np.float64
        assert env.observation_space.contains(observation)
        found.append((observation['odometry'], from_start(info['pose'], start),
                      info['collided'], info['reset']))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize('randomisation', [Randomisation(), ROUGH])
def test_true_odometry_is_the_pose_seen_from_the_start(randomisation):
    env = small(odometry='true', max_decisions=30, randomisation=randomisation)
    said, true, collided, reset = drive(env, 100)
    assert collided.any() and reset.sum() >= 8
    assert np.abs(off(said.reshape(-1, 3), true.reshape(-1, 3))).max() < 1e-9


def test_drift_is_the_true_motion_with_the_models_errors():
    env = small(odometry='drift', num_envs=200, actions=('forward', 'rotate_left'),
                stop='declared')  # no episode ends
    _, info = env.reset(seed=1)
    start, way, turned = info['pose'].copy(), 0.0, 0.0
    for k in range(24):
        before = info['pose'].copy()
        observation, _, _, _, info = env.step(np.full(200, k % 4 == 3, int))
        step = np.hypot(*(info['pose'] - before)[:, :2].T)
        way, turned = way + step, turned + (k % 4 == 3) * math.radians(30)
    gaps = off(observation['odometry'], from_start(info['pose'], start))
    wanted = np.sqrt(5e-5 * way + 1e-5 * turned)  # rad, of each
    assert np.sqrt(np.mean((gaps[:, 2] / wanted) ** 2)) == pytest.approx(1.0, rel=0.2)
    assert abs(np.mean(gaps[:, 2] / wanted)) < 0.25
    assert 0.005 < np.sqrt(np.mean(gaps[:, :2] ** 2)) < 0.1
    # No number serves twice: turns alone, whose errors would add up faster than their variances.
    _, info = env.reset(seed=2)
    start = info['pose'].copy()
    for _ in range(24):
        observation, _, _, _, info = env.step(np.ones(200, int))
    gaps = off(observation['odometry'], from_start(info['pose'], start))
    assert np.sqrt(np.mean(gaps[:, 2] ** 2)) == pytest.approx(
        math.sqrt(1e-5 * 24 * math.radians(30)), rel=0.2)


def test_drift_depends_on_seed_and_episode_not_on_the_number_of_environments():
    said = {}
    for n in (2, 5):
        env = small(odometry='drift', num_envs=n, max_decisions=8)
        env.reset(seed=3)
        said[n] = []
        for k in range(20):
            observation, *_ = env.step(np.full(n, (0, 2, 0)[k % 3]))
            said[n].append(observation['odometry'][:2])
    assert np.array_equal(*map(np.array, said.values()))
    other = small(odometry='drift', num_envs=2)
    _, info = other.reset(seed=4)
    before, start = info['pose'].copy(), info['pose'].copy()
    seen, _, _, _, info = other.step(np.full(2, 2))
    errors = off(seen['odometry'], from_start(info['pose'], start))
    assert (errors[:, 2] != 0).all() and errors[0, 2] != errors[1, 2]
    assert np.array_equal(before[:, :2], info['pose'][:, :2])  # the truth does not drift


def test_commanded_odometry_misses_noise_alone():
    """Without noise it is the truth, cut off at contacts as well; with noise the nominal move."""
    said, true, collided, _ = drive(small(odometry='commanded', noise=False), 60)
    assert collided.any()
    assert np.abs(off(said.reshape(-1, 3), true.reshape(-1, 3))).max() < 1e-9
    env = small(odometry='commanded', num_envs=32, randomisation=ROUGH)
    _, info = env.reset(seed=3)
    start = info['pose'].copy()
    observation, _, _, _, info = env.step(np.zeros(32, int))
    free, gap = ~info['collided'], off(observation['odometry'], from_start(info['pose'], start))
    assert free.sum() > 10
    assert np.allclose(observation['odometry'][free], [0.5, 0.0, 0.0], atol=1e-12)
    assert (np.abs(gap[free, 0]) > 1e-6).all() and np.abs(gap[free]).max() < 0.5
    touched = observation['odometry'][~free, 0]
    assert len(touched) and (touched < 0.5).all()


def test_commanded_odometry_is_what_the_bridge_says():
    """The same actions, whole and in ticks, contacts too; noise off, as its numbers differ."""
    robot = SimulatedRobot('house:7?rooms=2', robot=RobotSpec(), size=16, noise=False, seed=3)
    env = small(odometry='commanded', noise=False, num_envs=1)
    _, info = env.reset(seed=3)
    robot.begin_episode(0)
    assert np.array_equal(robot.pose, info['pose'][0])
    act, collided = random_actions(env, 1), False
    for _ in range(40):
        action = act()
        observation, *_, info = env.step(action)
        wanted = env._base.deltas[action[0]]
        for _ in range(4):
            robot.tick(wanted / TICK / 4)
        collided |= info['collided'][0]
        robot.end_decision()
        assert np.abs(off(observation['odometry'], robot.odometry[None])).max() < 2e-3
        robot.simulator.place(np.array([0]), info['pose'])  # contacts are found to 0.1 mm
    assert collided
    robot.close()


@pytest.mark.parametrize('kind', ['true', 'drift', 'commanded'])
def test_a_saved_state_resumes_bit_for_bit(kind):
    env, other = (small(odometry=kind, max_decisions=12) for _ in range(2))
    act = random_actions(env)
    env.reset(seed=5)
    other.reset(seed=6)
    for _ in range(7):
        env.step(act())
    state = env.get_state()
    assert state['odometry'].any()
    other.set_state(state)
    for _ in range(20):
        actions = act()
        one, two = env.step(actions)[0], other.step(actions)[0]
        assert alike(one, two, slice(None), slice(None))


def test_odometry_changes_nothing_else():
    plain, more = small(), small(odometry='drift')
    one, _ = plain.reset(seed=2)
    two, _ = more.reset(seed=2)
    act = random_actions(plain)
    assert two.keys() - one.keys() == {'odometry'}
    assert 'odometry' not in plain.get_state()
    for _ in range(20):
        actions = act()
        one, two = plain.step(actions)[0], more.step(actions)[0]
        assert alike(one, two, slice(None), slice(None))


def test_a_single_robot_has_it_as_well():
    env = Navigation('house:7?rooms=2', size=16, odometry='commanded', noise=False)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation) and not observation['odometry'].any()
    turn = env._batch.action_names.index('rotate_left')
    observation, *_ = env.step(turn)
    assert observation['odometry'] == pytest.approx([0.0, 0.0, math.radians(30)])
    env = Navigation('house:7?rooms=2', size=16, ranges='scan')
    observation = env.reset(seed=0)[0]
    assert observation['scan'].shape == (360,) and env.observation_space.contains(observation)
    assert 'odometry' not in Navigation('house:7?rooms=2', size=16).reset(seed=0)[0]


def test_it_is_refused_where_nothing_moves_in_metres():
    with pytest.raises(UserError, match='odometry is one of none, true, drift, commanded'):
        small(odometry='wheels')
    with pytest.raises(UserError, match='move in metres'):
        make(scenes=('gym:CartPole-v1',), odometry='true')


def test_all_robots_at_once_are_each_alone():
    rng = np.random.default_rng(0)
    poses, motions, normals = rng.normal(size=(3, 50, 3))
    motions[::5, :2] = 0.0
    motions[1::5, 2] = 0.0
    errors = drift_errors_of_all(motions, 1.5, normals)
    alone = np.array([drift_errors(*each) for each in zip(motions, [1.5] * 50, normals,
                                                          strict=True)])
    assert errors == pytest.approx(alone, abs=1e-15)
    assert advance_all(poses, motions, errors) == pytest.approx(
        np.array(list(map(advance, poses, motions, errors))), abs=1e-12)
    assert advance_all(poses, motions) == pytest.approx(
        np.array(list(map(advance, poses, motions))), abs=1e-12)
