"""`EnvConfig.ranges`: what the robots' range sensors say, for the maps of their policies."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from small_env import make, random_actions

from examples.corridor import CorridorSimulator
from vn_nav.errors import UserError
from vn_sim_bridge.navigation.episode_ranges import SCAN_NOISE
from vn_sim_bridge.robot import lidar

SCENES = ('house:7?rooms=2', 'house:8?rooms=2')
small = functools.partial(make, scenes=SCENES, size=32)


def drive(env, steps=12):
    """Observations and poses of random actions."""
    act = random_actions(env)
    observation, info = env.reset(seed=3)
    found = [(observation, info['pose'])]
    for _ in range(steps):
        observation, *_, info = env.step(act())
        assert env.observation_space.contains(observation)
        found.append((observation, info['pose']))
    return found


def test_a_scan_is_what_would_stop_the_robot_all_around_with_noise():
    env, errors = small(ranges='scan'), []
    assert np.ptp(env.scanner.bearings) > math.radians(358)
    for observation, poses in drive(env):
        for n, pose in enumerate(poses):
            true = lidar.scan(env.places[env.place_index[n]].obstacle_rects, pose)
            known = np.isfinite(true)
            errors.append((observation['scan'][n] - true)[known])
    errors = np.concatenate(errors)
    errors = errors[np.isfinite(errors)]
    assert len(errors) > 10_000
    assert np.std(errors) == pytest.approx(SCAN_NOISE, rel=0.05) and abs(np.mean(errors)) < 1e-3


def test_depth_gives_the_ranges_of_the_camera_s_view():
    env, close = small(ranges='depth', size=64), []
    assert np.degrees(np.ptp(env.scanner.bearings)) == pytest.approx(90, abs=2)
    for observation, poses in drive(env):
        for n, pose in enumerate(poses):
            true = np.interp(env.scanner.bearings, lidar.scan_angles(), lidar.scan(
                env.places[env.place_index[n]].obstacle_rects, pose))
            known = np.isfinite(observation['scan'][n])
            close.append(np.abs(observation['scan'][n] - true)[known] < 0.1 + 0.1 * true[known])
    # Furniture stops a robot as a whole, and is seen as it is.
    assert np.mean(np.concatenate(close)) > 0.75


@pytest.mark.parametrize('kind', ['scan', 'depth'])
def test_noise_depends_on_seed_and_episode_not_on_the_number_of_environments(kind):
    few, many = drive(small(ranges=kind, num_envs=2, noise=False), 0), drive(
        small(ranges=kind, num_envs=4, noise=False), 0)
    assert np.array_equal(few[0][0]['scan'], many[0][0]['scan'][:2], equal_nan=True)
    env = small(ranges=kind, num_envs=2, noise=False)
    env.reset(seed=3)
    turned = env.step(np.array([2, 2]))[0]['scan']
    again = env.step(np.array([3, 3]))[0]['scan']
    assert not np.array_equal(turned, again)
    assert not np.array_equal(few[0][0]['scan'], again, equal_nan=True)  # the same view


def test_the_rest_of_an_episode_is_as_without_and_no_network_sees_ranges():
    plain, with_scan = drive(small()), drive(small(ranges='scan'))
    for (one, _), (two, _) in zip(plain, with_scan, strict=True):
        assert set(two) - set(one) == {'scan'}
        assert all(np.array_equal(one[key], two[key]) for key in one)


def test_what_cannot_measure_is_refused(monkeypatch):
    with pytest.raises(UserError, match='ranges are one of'):
        small(ranges='sonar')
    monkeypatch.setattr(CorridorSimulator, 'capabilities', dataclasses.replace(
        CorridorSimulator.capabilities, walls=False, depth=False))
    for kind, words in (('scan', 'knows walls'), ('depth', 'depth pictures')):
        with pytest.raises(UserError, match=words):
            make(scenes=('examples.corridor:8',), ranges=kind)
