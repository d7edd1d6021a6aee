"""NavigationEnv: seeds, partial resets, saved states."""

import numpy as np
import pytest
from small_env import alike, make, random_actions

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_sim_bridge.render.randomisation import load_randomisation

STANDARD = load_randomisation('standard')


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


def test_more_houses_than_environments_are_all_visited_and_resumed():
    options = dict(scenes=house_scenes((1, 2, 3, 4, 5), 2), num_envs=2, max_decisions=2, size=24,
                   privileged=('goal_pose', 'overlap'))
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
