"""Gymnasium environments, `gym:MiniWorld-Hallway-v0`: pictures, discrete actions, native rewards.

Any environment of one agent whose observations are pictures (or have one among them, or that
draws itself) and whose actions are discrete. Nothing is known of places, ways and goals: figures
that need them are dashes, and the goal picture is grey. What an environment pays and when its
episodes end is taken over as it is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from vn_nav.errors import UserError
from vn_nav.observation import preprocess
from vn_nav.robot import NamedAction, RobotSpec
from vn_nav.scenes import SceneName, options_of
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Goal,
    Motion,
    Setup,
)

# Packages whose import registers environments, by how the names of these begin; and the command
# that installs them.
FAMILIES = {
    'MiniWorld-': ('miniworld', "pip install 'vn_nav[miniworld]' (and, without a display, "
                   'apt install libegl1 libgl1 libglu1-mesa)'),
    'Vizdoom': ('vizdoom.gymnasium_wrapper', "pip install 'vn_nav[vizdoom]'"),
}
GREY = 128  # of the goal picture: there is no goal
LOOK = 'see docs/simulators/gym.md for environments that fit'


class GymPlace:
    """An environment as a place: nobody knows where anything is in it."""

    def __init__(self, name: str):
        self.name = name
        self.goals = (Goal((0.0, 0.0, 0.0, 0.0), 'no goal'),)

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """The one place that has a name: nowhere."""
        return np.zeros((1, 2)), np.zeros(1)

    def distance_to(self, goal: Goal) -> None:
        """Nobody knows."""

    def plan(self) -> None:
        """There is no map."""


class OneEnvironment:
    """One Gymnasium environment, its picture kept until the next step.

    Args:
        scene: its name.

    Raises:
        UserError: there is none of that name, it does not start, or it is of another kind.
    """

    def __init__(self, scene: SceneName):
        options_of(scene, ())
        self.name = str(scene)
        self._env = _make(scene, None)
        self._picture_of = _picture_in(self._env.observation_space)
        if self._picture_of is None:  # it has none: it may draw one
            self._env.close()
            self._env = _make(scene, 'rgb_array')
        actions = self._env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.n < 2:
            self.close()
            raise UserError('an environment of gym has at least two discrete actions',
                            f'{actions} of {scene}', LOOK)
        self.first = int(actions.start)
        self.action_names = _action_names(self._env, int(actions.n))
        self.picture = np.zeros((0, 0, 3), np.uint8)
        try:
            self.reset(0)
        except UserError:
            self.close()
            raise
        except Exception as error:  # whatever its engine raises
            self.close()
            raise UserError(f'{scene} starts', _one_line(error), LOOK) from error

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        observation, _ = self._env.reset(seed=seed)
        self._look(observation)

    def step(self, action: int) -> tuple[float, bool, bool]:
        """One step: its reward, and whether the episode is over or was cut off."""
        observation, reward, ended, truncated, _ = self._env.step(self.first + action)
        self._look(observation)
        return float(reward), bool(ended), bool(truncated)

    def _look(self, observation: Any) -> None:
        picture = (np.asarray(self._env.render()) if self._picture_of is None
                   else self._picture_of(observation))
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise UserError('an environment of gym has a picture, uint8 [H,W,3], among its '
                            'observations, or draws one (rgb_array)',
                            f'{picture.dtype} {picture.shape} of {self.name}', LOOK)
        self.picture = picture

    def close(self) -> None:
        """Let go of it."""
        self._env.close()


def _make(scene: SceneName, render_mode: str | None) -> gymnasium.Env:
    """The environment of a scene."""
    if not os.environ.get('DISPLAY'):
        os.environ.setdefault('PYGLET_HEADLESS', 'true')  # MiniWorld then draws by EGL
    for start, (module, install) in FAMILIES.items():
        if scene.place.startswith(start):
            try:
                importlib.import_module(module)
            except Exception as error:  # a missing library of the system is no ImportError
                raise UserError(f'{scene} needs {module}', _one_line(error), install) from error
    options: dict[str, Any] = {} if render_mode is None else {'render_mode': render_mode}
    try:
        return gymnasium.make(scene.place, **options)
    except Exception as error:  # gymnasium's own, or whatever the environment raises
        raise UserError('a scene of gym is an environment that Gymnasium makes by its name',
                        f'{scene}: {_one_line(error)}',
                        'correct the name, or put its module in front: gym:my_package:MyEnv-v0'
                        ) from error


def _one_line(error: Exception) -> str:
    return ' '.join(f'{type(error).__name__}: {error}'.split())[:200]


def _is_picture(space: spaces.Space) -> bool:
    return (isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3
            and space.shape[2] == 3)


def _picture_in(space: spaces.Space) -> Callable[[Any], np.ndarray] | None:
    """What takes the picture out of an observation; None: there is none."""
    if _is_picture(space):
        return lambda observation: observation
    if isinstance(space, spaces.Dict):
        for name, part in space.items():
            if _is_picture(part):
                return lambda observation: observation[name]
    return None


def _action_names(env: gymnasium.Env, count: int) -> tuple[str, ...]:
    """Names of its actions, in their order; action_0, action_1, ... where it gives none."""
    base: Any = env.unwrapped
    names: Sequence[str] = ()
    if hasattr(base, 'get_action_meanings'):
        names = list(base.get_action_meanings())
    elif hasattr(base, 'button_map') and hasattr(base, 'game'):  # ViZDoom: buttons held down
        buttons = [str(button).rpartition('.')[2] for button in base.game.get_available_buttons()]
        names = ['+'.join(button for button, held in zip(buttons, held_down, strict=True) if held)
                 or 'nothing' for held_down in base.button_map]
    elif isinstance(getattr(base, 'actions', None), type):  # MiniWorld and MiniGrid: an enum
        names = [action.name for action in base.actions]
    names = [str(name).lower() for name in names][:count]
    if len(set(names)) != count:
        return tuple(f'action_{k}' for k in range(count))
    return tuple(names)


class GymSimulator(BaseSimulator):
    """N environments in this process, one after another."""

    capabilities = Capabilities(continuous=False, depth=False, labels=False, geodesic=False,
                                tilt=False, teleport=False, rewards=True, own_actions=True)

    def __init__(self, scenes: Sequence[SceneName], setup: Setup):
        super().__init__([GymPlace(str(scene)) for scene in scenes], setup)
        self._envs: list[OneEnvironment] = []
        size, names = setup.size, setup.robot.action_names
        self._rgb = np.zeros((setup.num_envs, 3, size, size), np.uint8)
        self._numbers = np.zeros((len(scenes), len(names)), np.int64)  # of the robot's actions
        self._cut_off = np.zeros(setup.num_envs, bool)  # since `broken_off` was last asked
        try:
            for n in range(setup.num_envs):
                self._envs.append(OneEnvironment(scenes[n % len(scenes)]))
                self._look(n)
            for k, env in enumerate(self._envs[:len(scenes)]):
                lacking = [name for name in names if name not in env.action_names]
                if lacking:
                    raise UserError(f'the actions of {env.name} are '
                                    f'{", ".join(env.action_names)}', ', '.join(lacking),
                                    'leave out --robot, and name some of these with --actions')
                self._numbers[k] = [env.action_names.index(name) for name in names]
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> GymSimulator:
        """See `BaseSimulator.open`."""
        if len(scenes) > setup.num_envs:
            raise UserError('there are as many robots as environments of gym, or more',
                            f'{setup.num_envs} for {len(scenes)}', 'raise --envs')
        return cls(scenes, setup)

    @classmethod
    def own_robot(cls, scenes: Sequence[SceneName], robot: RobotSpec) -> RobotSpec:
        """A robot with the actions of the first environment, none of which is a motion."""
        with contextlib.closing(OneEnvironment(scenes[0])) as env:
            return dataclasses.replace(robot, name='gym',
                                       actions=tuple(map(NamedAction, env.action_names)))

    def _look(self, env_id: int) -> None:
        self._rgb[env_id] = preprocess(self._envs[env_id].picture, self.setup.size)

    def spawn(self, env_ids: np.ndarray, keys: np.ndarray) -> None:
        """Begin episodes by random numbers [K] uint64, the seeds of the environments."""
        for n, key in zip(env_ids, keys, strict=True):
            self._envs[n].reset(int(key % np.uint64(2**31)))
            self._look(n)

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Nobody can."""
        raise UserError('robots in an environment of gym are where it puts them', 'a pose',
                        'use `spawn`')

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Nothing moves by metres: see `act`."""
        raise UserError('an environment of gym has actions of its own', 'a displacement',
                        'use `act`')

    def act(self, actions: np.ndarray, env_ids: np.ndarray) -> Motion:
        """Step environments [K]."""
        count = len(env_ids)
        reward, ended, truncated = np.zeros(count, np.float32), *np.zeros((2, count), bool)
        for k, (n, action) in enumerate(zip(env_ids, actions, strict=True)):
            number = int(self._numbers[self.place_index[n], action])
            reward[k], ended[k], truncated[k] = self._envs[n].step(number)
            if not math.isfinite(reward[k]):
                raise UserError('rewards are finite', f'{reward[k]} of {self._envs[n].name}',
                                'correct the environment')
            self._look(n)
        self._cut_off[env_ids] |= truncated & ~ended
        return Motion(np.zeros((count, 4)), np.zeros(count, bool), reward, ended)

    def broken_off(self) -> np.ndarray:
        """See `Simulator`: an environment's own limit of steps."""
        cut_off, self._cut_off = self._cut_off, np.zeros(self.num_envs, bool)
        return cut_off

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """The pictures of the environments."""
        return self._frames(self._rgb if env_ids is None else self._rgb[env_ids])

    def draw(self, place_index: np.ndarray, poses: np.ndarray) -> Frames:
        """Grey pictures: there are no goals to show."""
        return self._frames(np.full((len(poses), *self._rgb.shape[1:]), GREY, np.uint8))

    def _frames(self, rgb: np.ndarray) -> Frames:
        blank = np.zeros((len(rgb), *rgb.shape[2:]), np.uint8)
        return Frames(rgb, blank.astype(np.float32), blank, blank.astype(np.uint16))

    def close(self) -> None:
        """Let go of the environments; a second time it does nothing."""
        while self._envs:
            self._envs.pop().close()


SIMULATOR = GymSimulator
