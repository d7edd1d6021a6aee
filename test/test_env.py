"""NavigationEnv: Gymnasium's checks, and what training and evaluation rely on."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from vn_nav.errors import UserError
from vn_sim_bridge.env import EnvConfig, HouseNavigation, NavigationEnv
from vn_sim_bridge.tasks import ARRIVAL_HEADING, ARRIVAL_RADIUS


def make(**options):
    return NavigationEnv(EnvConfig(**{'houses': (7,), 'num_envs': 4, 'size': 36} | options))


def random_actions(env, seed=0):
    rng = np.random.default_rng(seed)
    return lambda: rng.integers(0, len(env.action_names), env.num_envs)


@pytest.mark.filterwarnings('ignore::UserWarning')
def test_the_single_environment_passes_gymnasiums_checks():
    check_env(HouseNavigation(house=7, size=36))
    env = gymnasium.make('vn_nav/House-v0', house=3, size=36, render_mode='rgb_array')
    observation, _ = env.reset(seed=1)
    assert np.array_equal(env.render(), observation['image'].transpose(1, 2, 0))


def test_observations_lie_in_their_space():
    env = make(actions=('forward', 'left', 'rotate_left', 'look_up', 'look_down'))
    observation, _ = env.reset(seed=0)
    act = random_actions(env)
    for _ in range(20):
        assert env.observation_space.contains(
            {key: value for key, value in observation.items()})
        observation, *_ = env.step(act())


def test_sixteen_environments_hold_sixteen_scene_goal_pairs():
    env = make(houses=(1, 2, 3, 4), num_envs=16, rooms=4, one_goal_per_env=True)
    observation, info = env.reset(seed=0)
    assert len(np.unique(info['goal'])) == 16
    pictures = env.goals[observation['goal_index']]
    assert len(np.unique(pictures.reshape(16, -1), axis=0)) == 16
    assert len(np.unique(env.house_index[:4])) == 4


def test_results_do_not_depend_on_the_number_of_environments():
    small, large = make(num_envs=2), make(num_envs=5)
    one, _ = small.reset(seed=3)
    many, _ = large.reset(seed=3)
    act = random_actions(large)
    for _ in range(40):
        for key in one:
            assert np.array_equal(one[key], many[key][:2]), key
        actions = act()
        one, reward, *_ = small.step(actions[:2])
        many, rewards, *_ = large.step(actions)
        assert np.array_equal(reward, rewards[:2])


def test_equal_seeds_repeat_and_resets_without_seed_go_on():
    env = make()
    first, info = env.reset(seed=5)
    later, other = env.reset()
    assert not np.array_equal(info['pose'], other['pose'])
    again, _ = env.reset(seed=5)
    assert np.array_equal(first['image'], again['image'])


def test_a_saved_state_goes_on_as_if_nothing_had_happened():
    env, other = make(max_decisions=15), make(max_decisions=15)
    env.reset(seed=4)
    act = random_actions(env)
    for _ in range(20):
        env.step(act())
    other.reset(seed=9)
    other.set_state(env.get_state())
    for _ in range(30):
        actions = act()
        one, two = env.step(actions), other.step(actions)
        assert np.array_equal(one[0]['image'], two[0]['image'])
        for part in (1, 2, 3):
            assert np.array_equal(one[part], two[part])


def test_next_step_autoreset():
    env = make(max_decisions=3)
    env.reset(seed=0)
    act = random_actions(env)
    for _ in range(2):
        _, _, terminated, truncated, _ = env.step(act())
        assert not truncated.any()
    last, _, terminated, truncated, info = env.step(act())
    assert (truncated | terminated).all() and (info['decisions'] == 3).all()
    assert (last['last_action'] >= 0).all()  # the true last observation
    begun, reward, terminated, truncated, info = env.step(act())
    assert info['reset'].all() and (reward == 0).all() and not (terminated | truncated).any()
    assert (begun['last_action'] == -1).all() and (info['decisions'] == 0).all()


def test_time_outs_truncate_and_arrivals_terminate():
    env = make(num_envs=8, max_decisions=60)
    env.reset(seed=0)
    ends = []
    for _ in range(200):
        _, reward, terminated, truncated, info = env.step(env.oracle_actions())
        assert not (terminated & truncated).any()
        assert np.array_equal(terminated, info['success'])
        assert np.array_equal(reward, terminated.astype(np.float32))
        arrived = (info['distance'] <= ARRIVAL_RADIUS) & (info['heading_error'] <= ARRIVAL_HEADING)
        assert (info['success'] <= arrived).all()
        ends += [bool(x) for x in terminated[terminated | truncated]]
    assert len(ends) > 20 and np.mean(ends) > 0.95  # the shortest-path control


def test_shaping_never_reaches_the_observation():
    plain = make(num_envs=8)
    shaped = make(num_envs=8, progress_reward=3.0, collision_reward=-1.0)
    one, _ = plain.reset(seed=2)
    two, _ = shaped.reset(seed=2)
    differs = False
    for _ in range(60):
        actions = plain.oracle_actions()
        one, reward, *_ = plain.step(actions)
        two, shaped_reward, *_ = shaped.step(actions)
        for key in one:
            assert np.array_equal(one[key], two[key]), key
        differs |= not np.array_equal(reward, shaped_reward)
    assert differs


def test_progress_rewards_add_up_to_the_distance_covered():
    env = make(progress_reward=2.0, max_decisions=50, num_envs=1)
    _, info = env.reset(seed=1)
    start, total = info['distance'][0], 0.0
    for _ in range(10):
        _, reward, terminated, _, info = env.step(env.oracle_actions())
        total += reward[0]
        assert not terminated[0]
    assert total == pytest.approx(2.0 * (start - info['distance'][0]), abs=1e-4)


def test_starts_follow_the_curriculum():
    env = make(num_envs=64)
    env.set_difficulty(0.3)
    _, info = env.reset(seed=0)
    easy = info['start_distance']
    env.set_difficulty(1.0)
    _, info = env.reset(seed=0)
    assert easy.min() >= 1.0 and easy.max() <= 0.3 * 20 + 0.2
    assert info['start_distance'].mean() >= 4.0 > easy.mean()
    with pytest.raises(UserError, match='tau'):
        env.set_difficulty(0.0)


def test_wrong_and_blank_goals_change_the_picture_not_the_task():
    env = make(num_envs=16)
    right, info = env.reset(seed=0)
    env.set_shown_goal('wrong')
    wrong, wrong_info = env.reset(seed=0)
    assert np.array_equal(info['goal'], wrong_info['goal'])
    assert np.array_equal(info['pose'], wrong_info['pose'])
    assert (right['goal_index'] != wrong['goal_index']).all()
    env.set_shown_goal('blank')
    blank, _ = env.reset(seed=0)
    assert (blank['goal_index'] == env.blank_goal).all()
    assert len(np.unique(env.goals[env.blank_goal])) == 1


def test_privileged_outputs_stand_beside_the_pictures():
    env = make(privileged=('depth', 'segmentation', 'goal_segmentation', 'oracle_action'))
    observation, info = env.reset(seed=0)
    assert info['depth'].shape == (4, 36, 36) and info['depth'].dtype == np.float32
    assert (info['depth'] > 0).all() and info['segmentation'].dtype == np.uint8
    assert info['goal_segmentation'].shape == (4, 36, 36)
    assert set(info['oracle_action']) <= set(range(4))
    assert set(observation) == {'image', 'goal_index', 'last_action', 'last_reward'}


def test_a_robot_that_sees_its_goal_pose_sees_the_goal_picture():
    env = make(size=84, num_envs=2)
    observation, info = env.reset(seed=0)
    env.backend.place(np.arange(2), env.goal_poses[info['goal']])
    seen = env.backend.observe().rgb
    assert np.array_equal(seen, env.goals[observation['goal_index']])


@pytest.mark.parametrize('options', [
    {'houses': ()}, {'num_envs': 0}, {'max_decisions': 0}, {'size': 4},
    {'privileged': ('pose',)}, {'actions': ('fly',)},
])
def test_bad_configurations_are_refused(options):
    with pytest.raises(UserError, match='received'):
        make(**options)


def test_bad_actions_are_refused():
    env = make()
    env.reset(seed=0)
    for actions in ([0, 1, 2, 9], [0, 1], [-1, 0, 0, 0]):
        with pytest.raises(UserError, match='actions are'):
            env.step(actions)
