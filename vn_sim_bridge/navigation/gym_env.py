"""One robot as a single `gymnasium.Env`."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces

from vn_nav.reset_arguments import read_options, read_seed
from vn_nav.scenes import ROOMS, house_scene
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation


class Navigation(gymnasium.Env):
    """One robot in one scene, for tools that want a single `gymnasium.Env`.

    Observations: `image` and `goal`, both [3,H,W] uint8; with the option `odometry` also that,
    [3] float64, with `ranges` also `scan`, [K] float32, see `NavigationEnv`. Registered as
    `vn_nav/Navigation-v0`; `vn_nav/House-v0` is short for that with the scene of a house, by its
    seed and rooms.

    Args:
        scene: its name.
        options: further fields of `EnvConfig`; the randomisation may be given by name or file, so
            that `spec.to_json()` can write it.
    """

    metadata = {'render_modes': ['rgb_array'], 'render_fps': 10}

    def __init__(self, scene: str = 'house:0', render_mode: str | None = None, **options):
        self.render_mode = render_mode
        # JSON has no tuples.
        options = {name: tuple(value) if isinstance(value, list) else value
                   for name, value in options.items()}
        if isinstance(options.get('randomisation'), str):
            options['randomisation'] = load_randomisation(options['randomisation'])
        self._batch = NavigationEnv(EnvConfig(scenes=(scene,), num_envs=1, **options))
        size = self._batch.config.size
        picture = spaces.Box(0, 255, (3, size, size), np.uint8)
        batch = self._batch.single_observation_space
        assert isinstance(batch, spaces.Dict)  # as `NavigationEnv` makes it
        self._more = [name for name in ('odometry', 'scan') if name in batch.spaces]
        self.observation_space = spaces.Dict({
            'image': picture, 'goal': picture, **{name: batch[name] for name in self._more}})
        self.action_space = self._batch.single_action_space
        self._image = np.zeros((3, size, size), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin an episode; without a seed the next one of the sequence.

        Raises:
            UserError: a seed that is none, or options, which it does not have.
        """
        seed = read_seed(seed)
        read_options(options)
        super().reset(seed=seed)
        observation, info = self._batch.reset(seed=seed)
        return self._single(observation), {key: value[0] for key, value in info.items()}

    def close(self):
        """Let go of the simulator."""
        self._batch.close()

    def step(self, action):
        """One decision."""
        observation, reward, terminated, truncated, info = self._batch.step([int(action)])
        return (self._single(observation), float(reward[0]), bool(terminated[0]),
                bool(truncated[0]), {key: value[0] for key, value in info.items()})

    def render(self):
        """The robot's view, [H,W,3] uint8."""
        return np.ascontiguousarray(self._image.transpose(1, 2, 0))

    def _single(self, observation) -> dict:
        self._image = observation['image'][0]
        return {'image': self._image.copy(),
                'goal': self._batch.goals[observation['goal_index'][0]].copy(),
                **{name: observation[name][0] for name in self._more}}


class HouseNavigation(Navigation):
    """`Navigation` in the house of a seed, with a number of rooms."""

    def __init__(self, house: int = 0, rooms: int = ROOMS, render_mode: str | None = None,
                 **options):
        super().__init__(house_scene(house, rooms), render_mode, **options)


# By name: a callable cannot be written as JSON.
gymnasium.register('vn_nav/Navigation-v0',
                   entry_point='vn_sim_bridge.navigation.gym_env:Navigation')
gymnasium.register('vn_nav/House-v0',
                   entry_point='vn_sim_bridge.navigation.gym_env:HouseNavigation')
