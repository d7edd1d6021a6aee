"""The single environment: Gymnasium's checks, its specification, seeds and options."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from small_env import make

from vn_nav.errors import UserError
from vn_sim_bridge.navigation.gym_env import HouseNavigation, Navigation


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
