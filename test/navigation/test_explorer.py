"""The teacher: it finds what it looks for, and knows nothing that it has not seen."""

import math

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.learning.batches import own_frames
from vn_nav.learning.presets import preset
from vn_nav.learning.rollout import Collector
from vn_nav.policy.network import Policy
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.explorer import NEAR, SIDE, Explorer

HOUSES = (10_000, 10_001, 10_002, 10_003)  # of the validation split


def make_env(**options):
    return NavigationEnv(EnvConfig(**{
        'scenes': house_scenes(HOUSES), 'num_envs': 16, 'size': 36,
        'privileged': ('explorer_action', 'overlap')} | options))


def make_explorer(env):
    return Explorer(env.places, env.num_envs, fov=env.robot.camera_fov, turn=math.radians(30),
                    length=0.5, radius=0.6)


def test_it_arrives_in_houses_of_which_it_knows_nothing():
    env = make_env()
    _, info = env.reset(seed=1)
    ended, success, decisions = np.zeros(16, bool), np.zeros(16, bool), np.zeros(16, int)
    for _ in range(200):
        _, _, terminated, truncated, info = env.step(info['explorer_action'])
        first = (terminated | truncated) & ~ended
        success[first], decisions[first] = info['success'][first], info['decisions'][first]
        ended |= first
    assert success.mean() >= 0.8  # random actions: 0.07 in 300 decisions
    assert decisions[success].mean() < 70


def test_until_the_goal_was_seen_the_goal_changes_nothing():
    env = make_env(scenes=house_scenes(HOUSES[:1]), num_envs=1)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    one, other = make_explorer(env), make_explorer(env)
    shape = env._distances.maps.shape
    for step in range(40):
        poses, house = env.simulator.poses, env.place_index
        common = {'turned': np.zeros(1)}
        mine = one.turns(poses, house, np.zeros(1), np.array([5.0]), np.array([1.0]),
                         env._distances.maps,
                         **common)
        blind = other.turns(poses, house, np.zeros(1), np.array([0.1]), np.array([-2.0]),
                            rng.uniform(0, 9, shape).astype(np.float32), **common)
        assert mine == blind, step
        env.step(rng.integers(0, 4, 1))
    assert not one.found[0]
    # Once it was seen, the way to it is what counts.
    seen = one.turns(env.simulator.poses, env.place_index, np.ones(1), np.array([0.1]),
                     env.simulator.poses[:, 2] + 1.0, env._distances.maps, np.zeros(1))
    assert one.found[0] and seen[0] == pytest.approx(1.0)


def test_it_sees_in_front_and_around_itself_but_not_through_walls():
    env = make_env(scenes=house_scenes(HOUSES[:1]), num_envs=1)
    env.reset(seed=4)
    explorer = make_explorer(env)
    explorer.turns(env.simulator.poses, env.place_index, np.zeros(1), np.array([5.0]),
                   np.array([0.0]), env._distances.maps, np.zeros(1))
    x, y, yaw, _ = env.simulator.poses[0]
    x, y = np.array([x, y]) - env.places[0].floor.origin
    rows, columns = np.nonzero(explorer.seen[0])
    ahead = (np.array([columns, rows]).T + 0.5) * SIDE - (x, y)
    distance = np.hypot(*ahead.T)
    bearing = np.abs((np.arctan2(ahead[:, 1], ahead[:, 0]) - yaw + math.pi) % (2 * math.pi)
                     - math.pi)
    far = distance > NEAR + SIDE
    assert far.any() and distance.max() <= 4.0 + SIDE
    assert (bearing[far] <= env.robot.camera_fov / 2 + SIDE / NEAR).all()
    walls = explorer._wall[0] & explorer.seen[0]
    assert walls.any()  # the first wall is seen
    assert not explorer.seen[0].all()
    explorer.begin(np.array([0]))
    assert not explorer.seen.any()


def test_what_it_saw_is_part_of_the_saved_state():
    env = make_env()
    _, info = env.reset(seed=2)
    for _ in range(20):
        _, _, _, _, info = env.step(info['explorer_action'])
    state, action = env.get_state(), info['explorer_action']
    one = [env.step(action)[4]['explorer_action'] for _ in range(5)]
    again = make_env()
    again.reset(seed=9)
    again.set_state(state)
    two = [again.step(action)[4]['explorer_action'] for _ in range(5)]
    assert np.array_equal(one, two)


def test_only_the_task_of_pictures_and_a_robot_that_turns_have_a_teacher():
    with pytest.raises(UserError, match='explorer'):
        make_env(task='room')
    with pytest.raises(UserError, match='rotations'):
        make_env(actions=('forward', 'backward'))


@pytest.mark.parametrize('share', [0.0, 0.5, 1.0])
def test_episodes_driven_by_the_teacher(share):
    torch.manual_seed(0)
    env = make_env(privileged=('explorer_action', 'overlap', 'goal_pose'), max_decisions=12)
    config = preset('fast', imitation=1.0)
    network = Policy(config.network(env.action_names, 36))
    collector = Collector(env, network, torch.Generator().manual_seed(0), config.privileged)
    collector.begin(0)
    rollout, episodes = collector.collect(40, 'explorer_action', share)
    driven = rollout.driven
    assert torch.equal(rollout.action[driven], rollout.privileged['explorer_action'][:-1][driven])
    assert driven.float().mean() == pytest.approx(share, abs=0.25)
    # Whole episodes have one driver.
    changes = driven[1:] != driven[:-1]
    assert not (changes & ~rollout.starts[1:-1]).any()
    assert torch.equal(own_frames(rollout), rollout.valid & ~driven)
    ended = (rollout.terminated | rollout.truncated) & ~driven
    assert len(episodes) == int(ended.sum()) and (len(episodes) > 0) == (share < 1)


def test_a_teacher_needs_the_task_that_follows_it():
    with pytest.raises(UserError, match='imitation'):
        preset('fast', teacher_share=0.5)
    assert preset('fast', imitation=1.0, teacher='oracle').privileged[-1] == 'oracle_action'
    assert preset('fast').privileged == ('goal_pose', 'overlap', 'arrived', 'distance')
