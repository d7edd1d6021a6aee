"""NavigationEnv: Gymnasium's checks, and what training and evaluation rely on."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_nav.vector_env import MeasuredVectorEnv, NavigationVectorEnv
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.gym_env import HouseNavigation, Navigation
from vn_sim_bridge.navigation.tasks import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_sim_bridge.render.randomisation import load_randomisation

STANDARD = load_randomisation('standard')


def make(**options):
    return NavigationEnv(EnvConfig(**{
        'scenes': ('house:7',), 'num_envs': 4, 'size': 36} | options))


def random_actions(env, seed=0):
    rng = np.random.default_rng(seed)
    return lambda: rng.integers(0, len(env.action_names), env.num_envs)


@pytest.mark.filterwarnings('ignore::UserWarning')
def test_the_single_environment_passes_gymnasiums_checks():
    check_env(HouseNavigation(house=7, size=36))
    check_env(Navigation('examples.corridor:5', size=36))
    env = gymnasium.make('vn_nav/Navigation-v0', scene='house:3', size=36)
    same = gymnasium.make('vn_nav/House-v0', house=3, size=36)
    assert np.array_equal(env.reset(seed=1)[0]['image'], same.reset(seed=1)[0]['image'])
    env = gymnasium.make('vn_nav/House-v0', house=3, size=36, render_mode='rgb_array')
    observation, _ = env.reset(seed=1)
    assert np.array_equal(env.render(), observation['image'].transpose(1, 2, 0))


def test_the_specification_is_json_and_makes_the_same_environment():
    env = gymnasium.make('vn_nav/House-v0', house=3, size=36, randomisation='standard',
                         privileged=('depth',), actions=('forward', 'rotate_left'))
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    (one, told), (two, also) = (made.reset(seed=5) for made in (env, again))
    assert np.array_equal(one['image'], two['image']) and np.array_equal(one['goal'], two['goal'])
    assert again.action_space.n == 2 and np.array_equal(told['depth'], also['depth'])


def alike(one, two, rows, others):
    return all(np.array_equal(one[key][rows], two[key][others]) for key in one)


def test_a_list_of_seeds_gives_each_environment_its_own():
    env, single = make(num_envs=3, randomisation=STANDARD), make(num_envs=1,
                                                                 randomisation=STANDARD)
    seeds = [11, 5, 11]
    observation, info = env.reset(seed=seeds)
    assert info['reset'].all()
    state = env.get_state()
    act = random_actions(env)
    chosen = [act() for _ in range(12)]
    chosen = [np.array([a[0], a[1], a[0]]) for a in chosen]
    seen = [observation] + [env.step(actions)[0] for actions in chosen]
    for k in range(3):  # as a single environment with that seed
        alone = [single.reset(seed=seeds[k])[0]] + [single.step(a[k:k + 1])[0] for a in chosen]
        assert all(alike(one, two, k, 0) for one, two in zip(seen, alone, strict=True))
    env.reset(seed=1)
    env.set_state(state)
    assert all(alike(env.step(a)[0], later, slice(None), slice(None))
               for a, later in zip(chosen, seen[1:], strict=True))
    env.reset(seed=[None, 7, None])  # the others go on with their own
    env.reset(seed=np.array([1, 2, 3]))
    env.reset(seed=range(3))
    env.reset(seed=[np.int64(1), np.uint8(2), None])
    before = env.get_state()
    for wrong in ([1, 2], [1, 2, 3, 4], [1, 2, 'x'], [1, 2, 3.5], [1, 2, -3], [True, False, True],
                  np.array([True, False, True]), np.zeros((3, 1), int), [[1], 2, 3], [[1]] * 3,
                  [1, 2, 1 << 63], [], ()):
        with pytest.raises(UserError, match='seed is .*or 3 of them'):
            env.reset(seed=wrong)
    for wrong in (-1, 'x', 3.5, True, 1 << 63, np.array(-1), {1, 2, 3}, {}, np.float64(1)):
        with pytest.raises(UserError, match='a seed is a whole number'):
            env.reset(seed=wrong)
    after = env.get_state()  # nothing has begun
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_options_that_are_none_are_one_error():
    env, single = make(num_envs=2), HouseNavigation(house=7, size=36)
    env.reset(seed=0)
    for wrong in (5, 'reset_mask', [1], True, {'reset_maks': [True] * 2}, {'seed': 3},
                  {'reset_mask': [[1], 2]}, {5: 1}):
        with pytest.raises(UserError, match='option|reset_mask'):
            env.reset(options=wrong)
        with pytest.raises(UserError, match='no options'):
            single.reset(options=wrong)


def test_the_seed_of_a_single_environment():
    env = HouseNavigation(house=7, size=36)
    one, _ = env.reset(seed=np.int64(3), options={})
    two, _ = env.reset(seed=3)
    assert np.array_equal(one['image'], two['image'])
    for wrong in (-1, True, [3], 'x', 2.0, np.array(True)):
        with pytest.raises(UserError, match='a seed is a whole number'):
            env.reset(seed=wrong)


def test_a_reset_mask_leaves_the_others_where_they_are():
    env, other = (make(max_decisions=30, randomisation=STANDARD) for _ in range(2))
    env.reset(seed=3)
    other.reset(seed=3)
    act = random_actions(env)
    for _ in range(5):
        actions = act()
        before, *_, told = env.step(actions)
        other.step(actions)
    mask = np.array([False, True, False, True])
    after, info = env.reset(options={'reset_mask': mask})
    assert info['reset'].tolist() == mask.tolist()
    assert info['decisions'].tolist() == [5, 0, 5, 0]
    assert alike(before, after, ~mask, ~mask)
    assert np.array_equal(info['pose'][~mask], told['pose'][~mask])
    assert not np.array_equal(info['pose'][mask], told['pose'][mask])
    for _ in range(4):  # and they go on as if nothing had been
        actions = act()
        assert alike(env.step(actions)[0], other.step(actions)[0], ~mask, ~mask)
    first, _ = env.reset(seed=3, options={'reset_mask': mask})
    fresh, _ = other.reset(seed=3)
    assert alike(first, fresh, mask, mask)  # a seed of the masked alone
    for wrong in (np.zeros(4, bool), np.ones(3, bool), np.ones(4), [1, 0, 1, 0]):
        with pytest.raises(UserError, match='reset_mask'):
            env.reset(options={'reset_mask': wrong})
    with pytest.raises(UserError, match='without a mask'):
        make().reset(options={'reset_mask': mask})


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


LABELS = ('goal_pose', 'overlap')


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


def test_more_houses_than_environments_are_all_visited_and_resumed():
    options = dict(scenes=house_scenes((1, 2, 3, 4, 5), 2), num_envs=2, max_decisions=2, size=24,
                   privileged=LABELS)
    env, other = make(**options), make(**options)
    env.reset(seed=1)
    act = random_actions(env)
    seen = [set(), set()]
    for _ in range(90):
        _, _, _, _, info = env.step(act())
        for n in range(2):
            house = int(env.place_index[n])
            seen[n].add(house)
            field = env.places[house].geodesic(*env.goal_poses[info['goal'][n], :2])
            assert info['distance'][n] == pytest.approx(
                field.at(info['pose'][n:n + 1, :2])[0], abs=1e-5)
    assert seen == [{0, 2, 4}, {1, 3}]
    other.reset(seed=9)
    other.set_state(env.get_state())
    for _ in range(20):
        actions = act()
        one, two = env.step(actions), other.step(actions)
        for part in (0, 4):
            for name in one[part]:
                assert np.array_equal(one[part][name], two[part][name]), name
        assert np.array_equal(env.place_index, other.place_index)


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
