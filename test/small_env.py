"""A small `NavigationEnv` and what its tests need beside it."""

import numpy as np

from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def make(**options):
    """Four environments in one house, unless the options say otherwise."""
    return NavigationEnv(EnvConfig(**{
        'scenes': ('house:7',), 'num_envs': 4, 'size': 36} | options))


def random_actions(env, seed=0):
    """A function that draws one action for each environment."""
    rng = np.random.default_rng(seed)
    return lambda: rng.integers(0, len(env.action_names), env.num_envs)


def alike(one, two, rows, others):
    """Whether some rows of two observations are equal."""
    return all(np.array_equal(one[key][rows], two[key][others]) for key in one)
