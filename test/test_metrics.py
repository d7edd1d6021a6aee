"""What every figure means."""

import pytest

from vn_nav.evaluation.evaluator import evaluate, random_actor, run_episodes
from vn_nav.evaluation.metrics import Episode, bootstrap_interval, path_efficiency, summarise
from vn_nav.policy.network import NetworkConfig, Policy
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.env import EnvConfig, NavigationEnv


def episode(**fields):
    return Episode(**{'success': True, 'start_distance': 4.6, 'path_length': 8.0, 'decisions': 20,
                      'collisions': 2, 'seconds': 30.0, 'stop_distance': 0.3, 'stop_heading': 0.1,
                      'reward': 1.0} | fields)


def test_path_efficiency_is_shortest_over_driven():
    assert path_efficiency(episode()) == pytest.approx(0.5)
    assert path_efficiency(episode(path_length=3.0)) == 1.0
    assert path_efficiency(episode(success=False)) == 0.0
    assert path_efficiency(episode(start_distance=0.5, path_length=0.0)) == 1.0


def test_summary():
    figures = summarise([episode(), episode(success=False, collisions=0, decisions=60, reward=0)])
    assert figures['success'] == 0.5 and figures['spl'] == pytest.approx(0.25)
    assert figures['collisions'] == 2 / 80 and figures['contact_free_success'] == 0.0
    assert figures['decisions'] == 40 and figures['return'] == 0.5
    low, high = figures['success_interval']
    assert low <= 0.5 <= high
    with pytest.raises(ValueError, match='at least one'):
        summarise([])


def test_bootstrap_interval_narrows_with_episodes():
    few, many = (bootstrap_interval([0, 1] * n) for n in (10, 400))
    assert few[1] - few[0] > 3 * (many[1] - many[0])


def test_every_environment_gives_the_same_number_of_episodes():
    env = NavigationEnv(EnvConfig(houses=(7,), num_envs=6, size=36, max_decisions=40))
    episodes = run_episodes(env, random_actor(env, 0), 12, seed=1, robot=RobotSpec())
    again = run_episodes(env, random_actor(env, 0), 12, seed=1, robot=RobotSpec())
    assert len(episodes) == 12 and episodes == again
    for one in episodes:
        assert one.start_distance >= 1.0 and 1 <= one.decisions <= 40
        assert one.collisions <= one.decisions and one.reward == float(one.success)
        assert one.seconds > 0.5 * one.decisions


def test_evaluation_has_every_control_and_equal_starts():
    env = NavigationEnv(EnvConfig(houses=(7,), num_envs=10, size=36, max_decisions=60))
    network = Policy(NetworkConfig(actions=DRIVE_ACTIONS, size=36, channels=(4, 4, 4),
                                   features=16, hidden=16))
    results = evaluate(env, network, decoding='sample', episodes=10)
    assert set(results) == {'right goal, sample', 'right goal, greedy', 'wrong goal',
                            'blank goal', 'random actions', 'shortest path'}
    assert results['shortest path']['success'] >= 0.9
    starts = {round(figures['start_distance'], 4) for figures in results.values()}
    assert len(starts) == 1
