"""NavigationEnv: stops that the robot declares."""

import numpy as np
from small_env import make

from vn_sim_bridge.navigation.tasks import ARRIVAL_HEADING, ARRIVAL_RADIUS


def test_declared_stops_end_an_episode_and_arrivals_do_not():
    env = make(num_envs=8, stop='declared', max_decisions=60)
    assert env.declare_action == 4 and env.single_action_space.n == 5
    assert env.action_names == make().action_names and make().declare_action is None
    env.set_difficulty(0.2)
    env.reset(seed=0)
    passed = 0
    for _ in range(60):
        actions = np.minimum(env.oracle_actions(), 3)  # never declares
        observation, reward, terminated, truncated, info = env.step(actions)
        assert not terminated.any() and (reward == 0).all() and not info['success'].any()
        assert np.array_equal(info['arrived'], (info['distance'] <= ARRIVAL_RADIUS) & (
            info['heading_error'] <= ARRIVAL_HEADING))
        passed += info['arrived'].sum()
    assert passed > 8 and truncated.all()


def test_a_declaration_is_judged_where_the_robot_stands():
    env = make(num_envs=8, stop='declared', max_decisions=60)
    env.set_difficulty(0.3)
    observation, before = env.reset(seed=0)
    actions = np.zeros(8, int)
    actions[:4] = env.declare_action
    last = observation['last_action'].copy()
    observation, reward, terminated, truncated, info = env.step(actions)
    assert np.array_equal(terminated, np.arange(8) < 4) and not truncated.any()
    assert (reward == 0).all() and not info['success'].any() and (info['decisions'] == 1).all()
    assert np.array_equal(info['pose'][:4], before['pose'][:4])
    assert np.array_equal(observation['last_action'][:4], last[:4])
    assert env.observation_space.contains(observation)
    _, _, terminated, _, info = env.step(actions)  # the ended ones begin anew, whatever is asked
    assert info['reset'][:4].all() and not terminated[:4].any()
    ends = []
    for _ in range(200):
        observation, reward, terminated, truncated, info = env.step(env.oracle_actions())
        assert env.observation_space.contains(observation)
        assert np.array_equal(info['success'], reward == 1)
        assert (info['success'] <= info['arrived']).all() and (info['success'] <= terminated).all()
        ends += info['success'][terminated | truncated].tolist()
    assert len(ends) > 20 and np.mean(ends) > 0.95
