"""NavigationEnv: what training and evaluation rely on."""

import math

import numpy as np
import pytest
from small_env import make, random_actions

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_nav.vector_env import ExploringEnv, MeasuredVectorEnv, NavigationVectorEnv
from vn_sim_bridge.navigation.tasks import ARRIVAL_HEADING, ARRIVAL_RADIUS


def test_observations_lie_in_their_space():
    env = make(actions=('forward', 'left', 'rotate_left', 'look_up', 'look_down'))
    observation, _ = env.reset(seed=0)
    act = random_actions(env)
    for _ in range(20):
        assert env.observation_space.contains(
            {key: value for key, value in observation.items()})
        observation, *_ = env.step(act())


def test_it_is_what_trainer_and_evaluator_use():
    env = make()
    assert isinstance(env, MeasuredVectorEnv) and isinstance(env, NavigationVectorEnv)
    assert isinstance(env, ExploringEnv) and env.explores
    _, info = env.reset(seed=0)
    assert {'reset', 'success', 'collided', 'arrived', 'distance', 'heading_error',
            'start_distance', 'path_length', 'decisions', 'goal', 'pose'} <= info.keys()


def test_sixteen_environments_hold_sixteen_scene_goal_pairs():
    env = make(scenes=house_scenes((1, 2, 3, 4), 4), num_envs=16, one_goal_per_env=True)
    observation, info = env.reset(seed=0)
    assert len(np.unique(info['goal'])) == 16
    pictures = env.goals[observation['goal_index']]
    assert len(np.unique(pictures.reshape(16, -1), axis=0)) == 16
    assert len(np.unique(env.place_index[:4])) == 4


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


def test_an_absent_goal_is_a_picture_of_another_place():
    env = make(num_envs=12, scenes=('house:3', 'house:4', 'house:5'))
    right, info = env.reset(seed=0)
    assert not info['shown_other'].any() and not info['at_shown'].any()
    env.set_shown_goal('absent')
    absent, absent_info = env.reset(seed=0)
    assert np.array_equal(info['goal'], absent_info['goal'])
    assert np.array_equal(info['pose'], absent_info['pose'])
    places = np.array([view.place for view in env.task.views])
    assert (places[absent['goal_index']] != env.place_index).all()
    assert (places[right['goal_index']] == env.place_index).all()
    assert len(set(absent['goal_index'].tolist())) > 4 and absent_info['shown_other'].all()
    # Where it would be in its own place is nowhere here.
    env.simulator.place(np.arange(12), env.goal_poses[absent['goal_index']])
    with np.errstate(invalid='ignore'):  # from outside there is no way
        assert not env.step(np.full(12, 1))[4]['at_shown'].any()
    with pytest.raises(UserError, match='two places'):
        make(num_envs=2).set_shown_goal('absent')


def test_standing_at_the_wrong_picture_is_told():
    env = make(num_envs=16, noise=False)
    env.set_shown_goal('wrong')
    observation, info = env.reset(seed=0)
    assert info['shown_other'].all()
    beside = env.goal_poses[observation['goal_index']].copy()
    beside[8:, 2] += math.radians(90)  # half of them look elsewhere
    env.simulator.place(np.arange(16), beside)
    told = env.step(np.full(16, env.action_names.index('forward')))[4]['at_shown']
    assert told[:8].all() and not told[8:].any()


@pytest.mark.parametrize('options, moves, turns', [
    ({}, True, True), ({'turn_noise': False}, True, False), ({'noise': 0.0}, False, False)])
def test_motion_noise_is_of_moves_and_turns_of_moves_alone_or_none(options, moves, turns):
    """The thesis has noise along the movement alone in its 5.6."""
    env = make(num_envs=32, **options)
    for action, noisy in (('forward', moves), ('rotate_left', turns)):
        env.reset(seed=0)
        before = env.simulator.poses.copy()
        info = env.step(np.full(32, env.action_names.index(action)))[4]
        moved = np.hypot(*(env.simulator.poses - before)[:, :2].T) if action == 'forward' else (
            np.angle(np.exp(1j * (env.simulator.poses - before)[:, 2])))
        free = moved[~info['collided']]
        assert len(free) >= 8 and (free.std() > 1e-3) == noisy


def test_a_robot_that_sees_its_goal_pose_sees_the_goal_picture():
    env = make(size=84, num_envs=2)
    observation, info = env.reset(seed=0)
    env.simulator.place(np.arange(2), env.goal_poses[info['goal']])
    seen = env.simulator.observe().rgb
    assert np.array_equal(seen, env.goals[observation['goal_index']])


@pytest.mark.parametrize('options', [
    {'scenes': ()}, {'scenes': ('house:1', 'bag:1')}, {'scenes': ('7',)},
    {'scenes': ('house:x',)}, {'scenes': ('house:1?doors=2',)}, {'num_envs': 0},
    {'max_decisions': 0}, {'size': 4},
    {'privileged': ('pose',)}, {'actions': ('fly',)}, {'stop': 'never'},
    {'stop': 'declared', 'task': 'room'}, {'goal_variants': 0}, {'goal_seed': -1},
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


def test_new_floor_pays_and_is_never_shown():
    options = dict(num_envs=8, max_decisions=25)
    plain, paid = make(**options), make(exploration_reward=0.5, **options)
    _, info = plain.reset(seed=2)
    paid.reset(seed=2)
    other = make(exploration_reward=0.5, **options)
    act = random_actions(plain)
    squares = [set() for _ in range(8)]
    origin = np.array(plain.places[0].floor.origin)
    total, reward, shaped = 0.0, np.zeros(8), np.zeros(8)
    for step in range(60):
        for n in range(8):
            square = tuple(np.floor(info['pose'][n, :2] - origin).astype(int))
            new, known = square not in squares[n], bool(squares[n])
            if info['reset'][n]:
                squares[n], known = set(), False
            squares[n].add(square)
            gain = shaped[n] - reward[n]
            assert gain == pytest.approx(0.5 * (new and known)), (step, n)
            total += gain
        actions = np.where(act() == 1, 1, 0)
        if step == 30:
            other.set_state(paid.get_state())
        one, reward, _, _, info = plain.step(actions)
        two, shaped, *_ = paid.step(actions)
        if step >= 30:
            assert np.array_equal(other.step(actions)[1], shaped)
        for name in one:
            assert np.array_equal(one[name], two[name]), name
    assert total > 5


def test_other_goals_in_the_same_house():
    own, unseen, again = make(), make(goal_seed=1), make(goal_seed=1)
    assert np.array_equal(own.places[0].scene.vertices, unseen.places[0].scene.vertices)
    assert own.goal_rooms == unseen.goal_rooms
    assert (own.goal_poses[:, :2] != unseen.goal_poses[:, :2]).any(axis=1).all()
    assert np.array_equal(unseen.goal_poses, again.goal_poses)
    assert len(make(goal_variants=2).goals) == 2 * (len(own.goals) - 1) + 1
