"""`NavigationEnv`: many robots with a task, in houses or other places, as a VectorEnv."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from vn_nav.co_visibility import GRID, co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.reset_arguments import are_several, read_options, read_seed, read_seeds
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.counter_random import Stream, key, normal, uniform
from vn_sim_bridge.floor.contacts import motion_noise
from vn_sim_bridge.houses.house import CELL, interpolate
from vn_sim_bridge.houses.objects import GOAL_OBJECTS
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.explorer import Explorer
from vn_sim_bridge.navigation.oracle import FloorOracle, turning_table
from vn_sim_bridge.navigation.tasks import BLANK, RIGHT, WRONG
from vn_sim_bridge.render.randomisation import Randomisation, load_randomisation
from vn_sim_bridge.simulator import Frames, Simulator
from vn_sim_bridge.simulators.house import HouseBackend

TASKS = ('image', 'object', 'room', 'collect')
PRIVILEGED = ('depth', 'segmentation', 'goal_segmentation', 'oracle_action', 'goal_pose',
              'overlap', 'explorer_action', 'oracle_regret')
STOPS = ('arrival', 'declared')
SQUARE = 1.0  # m, side of the squares of floor that exploration counts
BATCH = 256  # goal pictures drawn at a time: few need little memory


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What a `NavigationEnv` simulates.

    Environment i lives in house i modulo their number. With more houses than environments it draws
    one of the houses i, i + N, i + 2 N, ... for every episode.
    """

    houses: tuple[int, ...] = (0,)  # seeds
    rooms: int = 5  # of each house
    num_envs: int = 64
    size: int = 84  # pixels
    actions: tuple[str, ...] = DRIVE_ACTIONS
    max_decisions: int = 300
    noise: bool = True
    progress_reward: float = 0.0  # per metre of geodesic progress
    collision_reward: float = 0.0  # per decision that touched something; a penalty is negative
    step_reward: float = 0.0  # per decision that does not reach the goal; a penalty is negative
    goal_bonus: float = 0.0  # at the goal, beside the sparse reward
    min_start_distance: float = 1.0  # m, geodesic
    one_goal_per_env: bool = False  # environment i keeps pair i; else drawn each episode
    seed: int = 0
    goals_per_room: int = 1
    task: str = 'image'  # of TASKS
    objects: int = 1  # in the house at a time (object, collect)
    room_must_see: bool = False  # the room rule of House3D's code, see tasks.RoomGoal
    randomisation: Randomisation = Randomisation()
    privileged: tuple[str, ...] = ()  # of PRIVILEGED
    stop: str = 'arrival'  # of STOPS: an episode ends on arrival, or when the robot says so
    goal_variants: int | None = None  # pictures of each goal; default: the randomisation's
    goal_seed: int = 0  # 0: the houses' own goals, else other ones in the same houses
    exploration_reward: float = 0.0  # per square of floor that is new to the episode, see SQUARE

    def __post_init__(self):
        rules = (
            (len(self.houses) >= 1, 'there is at least one house', self.houses),
            (self.num_envs >= 1, 'there is at least one environment', self.num_envs),
            (self.max_decisions >= 1, 'an episode has at least one decision', self.max_decisions),
            (8 <= self.size <= 2048, 'pictures have 8 to 2048 pixels a side', self.size),
            (self.task in TASKS, f'the task is one of {", ".join(TASKS)}', self.task),
            (1 <= self.objects <= 16, 'there are 1 to 16 objects', self.objects),
            (set(self.privileged) <= set(PRIVILEGED),
             f'privileged outputs are some of {", ".join(PRIVILEGED)}', self.privileged),
            (self.stop in STOPS, f'the stop is one of {", ".join(STOPS)}', self.stop),
            (self.stop == 'arrival' or self.task == 'image',
             'only the image task ends when the robot declares that it has arrived', self.task),
            (self.goal_variants is None or 1 <= self.goal_variants <= 256,
             'a goal has 1 to 256 pictures', self.goal_variants),
            (self.goal_seed >= 0, 'the seed of goals is not negative', self.goal_seed),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the environment configuration')

    @property
    def pictures_per_goal(self) -> int:
        """Differently lit pictures kept of each goal."""
        return self.goal_variants or self.randomisation.pictures_per_goal


class NavigationEnv(gymnasium.vector.VectorEnv):
    """Visual navigation in embedded houses, or where another simulator puts the robots.

    Observations are a dict of arrays over the N environments: `image` [N,3,H,W] uint8,
    `goal_index` [N] int64 into `goals`, `last_action` [N] int64 (-1 at an episode's start) and
    `last_reward` [N] float32 (the sparse reward alone). The goal pictures stand once in `goals`
    [G,3,H,W] uint8; the last one, `blank_goal`, is plain grey.

    Autoreset is NEXT_STEP: the step after an episode's end ignores its action and returns the new
    episode's first observation with reward 0; `info['reset']` marks these rows: no frames.

    With `stop='declared'` arriving ends no episode. `step` then takes one more number,
    `declare_action`, which says "I have arrived": the robot stays where it is and the episode
    ends, a success if it is true. It counts as a decision; `last_action` never shows it.
    `info['arrived']` tells at the end of every decision whether it would be true.

    `config.privileged` adds to `info`, beside pictures and the shortest path's action:
    `goal_pose` [N,4] float32, the true goal's camera as the robot sees it (see
    `co_visibility.relative_pose`), and `overlap` [N] float32, the share of what the true goal's
    picture shows that the robot's picture shows too (see `co_visibility.co_visible`; 0 for a blank
    goal). Without a view to go to both are zeros. `explorer_action` [N] int64 is what a robot
    would do that knows only what it has seen (see `explorer`).

    Args:
        config: what to simulate.
        robot: actions, camera and footprint; the standard robot if left out.
        threads: threads that draw.
        backend: robots and places instead of the configuration's houses: as many robots, and
            pictures as large, as the configuration says.
    """

    metadata = {'autoreset_mode': AutoresetMode.NEXT_STEP, 'render_modes': []}

    def __init__(self, config: EnvConfig | None = None, robot: RobotSpec | None = None, *,
                 threads: int = 1, backend: Simulator | None = None):
        self.config = config = config or EnvConfig()
        self.robot = (robot or RobotSpec()).with_actions(config.actions)
        self.num_envs = n = config.num_envs
        if backend is None:
            self.houses = [generate_house(seed, rooms=config.rooms,
                                          goals_per_room=config.goals_per_room,
                                          goal_seed=config.goal_seed)
                           for seed in config.houses]
        else:
            self._check_backend(backend)
            self.houses = list(backend.houses)
        self._wanders = len(self.houses) > n and not config.one_goal_per_env
        # Random numbers are functions of an environment's seed and number.
        self._seeds, self._numbers = np.full(n, config.seed, np.int64), np.arange(n)
        self.task = self._make_task()
        self.backend: Simulator = backend or HouseBackend(
            self.houses, np.arange(n) % len(self.houses), robot=self.robot, size=config.size,
            threads=threads, randomisation=config.randomisation, models=self.task.models,
            objects=self.task.objects)
        self.world_version = self.backend.world_version
        self.action_names = self.robot.action_names
        self.declare_action = len(self.action_names) if config.stop == 'declared' else None
        self._deltas = np.array([[a.dx, a.dy, a.dyaw, a.dpitch] for a in self.robot.actions])
        self._sizes = np.array([abs(action.size) for action in self.robot.actions])
        self._make_goals()
        self._make_spaces()
        self._tau = 1.0
        self._mode = RIGHT
        self._episode = np.full(n, -1, np.int64)
        self._step = np.zeros(n, np.int64)
        self._goal = np.zeros(n, np.int64)  # index of the view that names the true goal
        self._goal_yaw = np.zeros(n)
        self._shown_goal = np.zeros(n, np.int64)
        self._picture = np.zeros(n, np.int64)  # of the true goal
        self._distance = np.zeros(n)
        self._start_distance = np.zeros(n)
        self._path_length = np.zeros(n)
        self._last_action = np.full(n, -1, np.int64)
        self._last_reward = np.zeros(n, np.float32)
        self._done = np.ones(n, bool)
        self._motion_scale = np.ones(n)
        self._last_image = np.zeros((n, 3, config.size, config.size), np.uint8)
        # Every environment's distances to its goal, side by side: one look-up for all.
        shapes = [house.floor.free.shape for house in self.houses]
        self._maps = np.full((n, max(s[0] for s in shapes), max(s[1] for s in shapes)), np.inf,
                             np.float32)
        self._origins = np.array([house.floor.origin for house in self.houses])
        rows, columns = (math.ceil(side * CELL / SQUARE) for side in self._maps.shape[1:])
        self._visited = np.zeros((n, rows, columns), bool)
        # Options that are off add nothing to the state.
        used = {'_visited': config.exploration_reward,
                '_picture': set(config.privileged) & {'goal_pose', 'overlap', 'explorer_action'}}
        self._state = (*self._STATE, *(name for name in used if used[name]))
        self._explorer = self._make_explorer() if 'explorer_action' in config.privileged else None
        self._oracle: FloorOracle | None = None  # made when it is asked for

    def _check_backend(self, backend: Simulator) -> None:
        """Whether a simulator can do what the configuration asks for."""
        config, can, told = self.config, backend.capabilities, set(self.config.privileged)
        tilts = any(action.dpitch for action in self.robot.actions)
        rules = (
            (backend.num_envs == config.num_envs, 'a backend has as many robots as the '
             f'configuration: {config.num_envs}', backend.num_envs),
            (can.scene or config.task == 'image', 'the backend knows a floor and no rooms or '
             'objects: its task is image', config.task),
            (can.scene or 'explorer_action' not in told, 'the backend knows no walls, which the '
             'explorer needs', 'explorer_action'),
            (backend.routes is not None or 'oracle_regret' not in told,
             'the backend knows what each action costs on the ways there (as an image graph does)',
             'oracle_regret'),
            (can.depth or 'depth' not in told, 'the backend has depth pictures', 'none'),
            (can.labels or not told & {'segmentation', 'goal_segmentation'},
             'the backend has labels', 'none'),
            (can.tilt or not tilts, 'the camera of the backend is fixed',
             self.robot.action_names),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the environment configuration')

    @property
    def house_index(self) -> np.ndarray:
        """[N] the house of each robot."""
        return self.backend.house_index

    def _make_explorer(self) -> Explorer:
        if self.config.task != 'image':
            raise UserError('the explorer looks for the place of a picture (task image)',
                            self.config.task, 'leave out explorer_action')
        table = turning_table(self.action_names)
        return Explorer(
            self.houses, self.num_envs, fov=self.robot.camera_fov,
            turn=self._deltas[table['rotate_left'], 2], length=self._deltas[table['forward'], 0],
            radius=tasks.ARRIVAL_RADIUS)

    def _make_task(self) -> tasks.Task:
        config, common = self.config, (self.houses, self.config.num_envs)
        distance = config.min_start_distance
        if config.task == 'image':
            return tasks.ImageGoal(*common, min_distance=distance,
                                   fixed_goals=config.one_goal_per_env)
        if config.task == 'object':
            return tasks.ObjectGoal(
                *common, models=GOAL_OBJECTS, objects=config.objects,
                pictures=max(4, config.pictures_per_goal), min_distance=distance,
                seed=config.seed)
        if config.task == 'room':
            return tasks.RoomGoal(*common, must_see=config.room_must_see, min_distance=distance)
        return tasks.Collect(*common, objects=config.objects)

    def _make_goals(self) -> None:
        """The pictures of all views, each in some lights of its own."""
        views = self.task.views
        self.goal_poses = np.array([view.pose for view in views]).reshape(-1, 4)
        self.goal_rooms = (*(view.name for view in views), 'nothing')
        self._variants = self.config.pictures_per_goal
        size, count = self.config.size, len(views) * self._variants
        self.goals = np.full((count + 1, 3, size, size), 128, np.uint8)
        self.goal_segmentation = np.zeros((count + 1, size, size), np.uint8)
        self.blank_goal = count
        wanted = self.backend.capabilities.depth and bool(
            {'overlap', 'explorer_action'} & set(self.config.privileged))
        self._goal_points = np.full((count + 1 if wanted else 0, GRID * GRID, 3), np.nan,
                                    np.float32)
        for first in range(0, count, BATCH):
            part = slice(first, min(first + BATCH, count))
            view, variant = np.divmod(np.arange(part.start, part.stop), self._variants)
            poses = self.goal_poses[view]
            appearance = self.backend.appearance(self.config.seed, Stream.GOAL_APPEARANCE, view,
                                                 variant)
            frames = self.backend.view(
                np.array([views[k].house for k in view]), poses, None, appearance,
                key(self.config.seed, Stream.GOAL_APPEARANCE, view, variant, 99),
                [views[k].objects for k in view])
            self.goals[part], self.goal_segmentation[part] = frames.rgb, frames.labels
            if wanted:
                self._goal_points[part] = lift(frames.depth,
                                               *self.backend.cameras(poses, appearance))

    def _make_spaces(self) -> None:
        size, actions = self.config.size, len(self.action_names)
        self.single_observation_space = spaces.Dict({
            'image': spaces.Box(0, 255, (3, size, size), np.uint8),
            'goal_index': spaces.Discrete(len(self.goals)),
            'last_action': spaces.Discrete(actions + 1, start=-1),
            'last_reward': spaces.Box(-np.inf, np.inf, (), np.float32),
        })
        self.single_action_space = spaces.Discrete(self._choices)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    @property
    def _choices(self) -> int:
        """Numbers that `step` takes."""
        return len(self.action_names) + (self.declare_action is not None)

    # The two switches that training and evaluation turn.

    def set_difficulty(self, tau: float) -> None:
        """Start later episodes within tau * the maximum distance of their goal, tau in (0, 1]."""
        if not 0 < tau <= 1:
            raise UserError('the difficulty tau lies in (0, 1]', tau, 'choose a value in range')
        self._tau = float(tau)

    def set_shown_goal(self, mode: str) -> None:
        """Which picture later episodes show: 'right', 'wrong' (same house) or 'blank'."""
        if mode not in (RIGHT, WRONG, BLANK):
            raise UserError('the shown goal is right, wrong or blank', mode, 'choose one of them')
        if mode == WRONG and min(count for _, count in self.task.ranges) < 2:
            raise UserError('a wrong goal needs a house with at least two goals',
                            self.config.rooms, 'use more rooms')
        self._mode = mode

    _STATE = ('_episode', '_step', '_goal', '_goal_yaw', '_shown_goal', '_distance',
              '_start_distance', '_path_length', '_last_action', '_last_reward', '_done',
              '_motion_scale', '_last_image', '_maps')

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that changes from step to step; with equal switches `set_state` goes on."""
        objects = self.backend.objects
        more = {'house_index': self.house_index.copy()} if self._wanders else {}
        if self._explorer is not None:
            more |= {'explorer_seen': self._explorer.seen.copy(),
                     'explorer_found': self._explorer.found.copy()}
        # One seed for all, as a training has it, is kept as one number.
        alike = (self._seeds == self._seeds[0]).all() and (
            self._numbers == np.arange(self.num_envs)).all()
        more |= {} if alike else {'numbers': self._numbers.copy()}
        seed = self._seeds[0] if alike else self._seeds.copy()
        return {'poses': self.backend.poses.copy(), 'seed': np.array(seed), **more,
                **{name.strip('_'): getattr(self, name).copy() for name in self._state},
                **{f'objects_{name}': part.copy() for name, part in objects._asdict().items()},
                **{f'task_{name}': part.copy() for name, part in self.task.state.items()}}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `get_state` was taken."""
        self._seeds[:] = state['seed']
        self._numbers[:] = state.get('numbers', np.arange(self.num_envs))
        everyone = np.arange(self.num_envs)
        if self._wanders:
            self.backend.enter(everyone, state['house_index'])
        self.backend.place(everyone, state['poses'])
        for name in self._state:
            getattr(self, name)[:] = state[name.strip('_')]
        if self._explorer is not None:
            self._explorer.seen[:] = state['explorer_seen']
            self._explorer.found[:] = state['explorer_found']
        for name, part in self.backend.objects._asdict().items():
            part[:] = state[f'objects_{name}']
        for name, part in self.task.state.items():
            part[:] = state[f'task_{name}']
        self.backend.dress(everyone, self._seeds, Stream.APPEARANCE, self._numbers,
                           self._episode)

    def reset(self, *, seed: int | Sequence[int | None] | None = None,
              options: dict | None = None):
        """Start new episodes; a seed also restarts the count of episodes.

        Args:
            seed: of all environments, which differ by their number; or one for each (None: as it
                was): environment i then does what environment 0 does with that seed.
            options: `reset_mask`, [N] bool: which environments begin; the others stay as they are.

        Raises:
            UserError: another number of seeds, or another mask, or an option that is none.
        """
        mask = self._reset_mask(read_options(options, ('reset_mask',)))
        if seed is not None:
            self._take_seeds(seed, mask)
        self._begin(np.nonzero(mask)[0])
        self._done[mask] = False
        none = np.zeros(self.num_envs, bool)
        return self._result(self._look(), reset=mask, success=none, collided=none)

    def _reset_mask(self, options: Mapping) -> np.ndarray:
        """Which environments begin a new episode, [N] bool."""
        if 'reset_mask' not in options:
            return np.ones(self.num_envs, bool)
        try:
            mask = np.asarray(options['reset_mask'])
        except ValueError:  # rows of several lengths
            mask = np.zeros(0, bool)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise UserError(f'a reset_mask is {self.num_envs} booleans, one of them true',
                            options['reset_mask'], 'pass such an array')
        if (self._episode[~mask] < 0).any():
            raise UserError('every environment has begun before some of them begin again',
                            'a reset_mask at the first reset', 'reset once without a mask')
        return mask.copy()

    def _take_seeds(self, seed: int | Sequence[int | None], mask: np.ndarray) -> None:
        """Give seeds to the environments of the mask [N]."""
        own = np.arange(self.num_envs)
        if are_several(seed):
            given, own = read_seeds(seed, self.num_envs), np.zeros_like(own)
        else:
            given = [read_seed(seed)] * self.num_envs
        for n in np.nonzero(mask)[0]:
            if given[n] is not None:
                self._seeds[n], self._numbers[n] = given[n], own[n]
                self._episode[n] = -1

    def step(self, actions):
        """One decision in every environment that is not being reset."""
        actions = np.asarray(actions, np.int64)
        if actions.shape != (self.num_envs,) or actions.min() < 0 or (
                actions.max() >= self._choices):
            raise UserError(f'actions are {self.num_envs} integers from 0 to '
                            f'{self._choices - 1}', actions.tolist(),
                            'pass such an array')
        reset = self._done.copy()
        declared = ~reset & (actions == len(self.action_names))
        acting, driving = np.nonzero(~reset)[0], np.nonzero(~reset & ~declared)[0]
        collided = np.zeros(self.num_envs, bool)
        before = self._distance.copy()
        if len(driving):
            collided[driving] = self._drive(actions[driving], driving)
        if reset.any():
            self._begin(np.nonzero(reset)[0])
        self._measure(acting)
        self._step[acting] += 1
        frames = self._look()
        objects = self.backend.objects
        verdict = self.task.judge(tasks.Situation(
            ~reset, self._distance, self._heading_error(), self.backend.poses, frames.labels,
            self.backend.object_models(), objects.pose[:, :, :2],
            None if self.declare_action is None else declared))
        objects.scene[verdict.removed] = -1
        reward = np.where(reset, 0, verdict.reward + tasks.shaping_reward(
            before, self._distance, collided, verdict.success,
            progress=self.config.progress_reward, collision=self.config.collision_reward,
            step=self.config.step_reward, goal=self.config.goal_bonus)).astype(np.float32)
        if self.config.exploration_reward:
            reward[acting] += self.config.exploration_reward * self._explore(acting)
        self._last_action[driving] = actions[driving]
        self._last_reward[acting] = verdict.reward[acting]
        terminated = verdict.success | declared
        truncated = ~terminated & ~reset & (self._step >= self.config.max_decisions)
        self._done = terminated | truncated
        observation, info = self._result(frames, reset, verdict.success, collided)
        return observation, reward, terminated, truncated, info

    def _drive(self, actions: np.ndarray, acting: np.ndarray) -> np.ndarray:
        """Move some robots; whether they touched something."""
        delta = self._deltas[actions]
        if self.config.noise:
            delta = motion_noise(delta, self._sizes[actions], normal(
                self._seeds[acting], Stream.MOTION_NOISE, self._numbers[acting],
                self._episode[acting], self._step[acting]))
        motion = self.backend.move(self._as_driven(delta, acting), acting)
        self._path_length[acting] += np.hypot(motion.delta[:, 0], motion.delta[:, 1])
        return motion.collided

    def _as_driven(self, delta: np.ndarray, env_ids: np.ndarray) -> np.ndarray:
        """What a base with worn wheels on a smooth floor makes of displacements [K,4]."""
        config = self.config.randomisation
        share = self._motion_scale[env_ids]
        if config.slip:
            counter = (self._seeds[env_ids], Stream.SLIP, self._numbers[env_ids],
                       self._episode[env_ids], self._step[env_ids])
            part = key(*counter) % np.uint64(1000) / 1000.0
            share = np.where(uniform(*counter) < config.slip, part, 1.0) * share
        delta = delta.copy()
        delta[:, :3] *= share[:, None]
        return delta

    def _begin(self, env_ids: np.ndarray) -> None:
        """Draw goal, start, light and base of new episodes."""
        self._episode[env_ids] += 1
        if self._wanders:
            own = (len(self.houses) - 1 - env_ids) // self.num_envs + 1  # n, n + N, n + 2 N, ...
            turn = own * uniform(self._seeds[env_ids], Stream.HOUSE, self._numbers[env_ids],
                                 self._episode[env_ids])
            self.backend.enter(env_ids, env_ids + turn.astype(np.int64) * self.num_envs)
        for n in env_ids:
            counter = (int(self._seeds[n]), int(self._numbers[n]), int(self._episode[n]))
            episode = self.task.begin(int(n), int(self.house_index[n]), counter, self._tau,
                                      self._mode)
            variant = tasks.draw_index(self._variants, counter[0], Stream.GOAL_VARIANT,
                                       *counter[1:])
            self._goal[n], self._goal_yaw[n] = episode.goal, episode.goal_yaw
            self._shown_goal[n] = (self.blank_goal if episode.shown < 0
                                   else episode.shown * self._variants + variant)
            true = episode.shown if self._mode == RIGHT else episode.goal
            self._picture[n] = true * self._variants + variant
            self.backend.place(np.array([n]), episode.start[None])
            self.backend.set_objects(n, episode.objects)
            self._maps[n] = np.inf
            if episode.field is not None:
                rows, columns = episode.field.values.shape
                self._maps[n, :rows, :columns] = episode.field.values
        self.backend.dress(env_ids, self._seeds[env_ids], Stream.APPEARANCE,
                           self._numbers[env_ids], self._episode[env_ids])
        low, high = self.config.randomisation.motion_scale
        self._motion_scale[env_ids] = low + (high - low) * uniform(
            self._seeds[env_ids], Stream.BASE, self._numbers[env_ids], self._episode[env_ids])
        self._step[env_ids] = 0
        self._path_length[env_ids] = 0.0
        self._last_action[env_ids] = -1
        self._last_reward[env_ids] = 0.0
        self._measure(env_ids)
        self._start_distance[env_ids] = self._distance[env_ids]
        if self.config.exploration_reward:
            self._visited[env_ids] = False
            self._explore(env_ids)

    def _explore(self, env_ids: np.ndarray) -> np.ndarray:
        """Which robots stand on a square of floor that is new to their episodes, [K] bool."""
        at = (self.backend.poses[env_ids, :2] - self._origins[self.house_index[env_ids]]) / SQUARE
        column, row = at.astype(np.int64).T
        new = ~self._visited[env_ids, row, column]
        self._visited[env_ids, row, column] = True
        return new

    def _measure(self, env_ids: np.ndarray) -> None:
        """Geodesic distance of robots to their goals; 0 where the task has none."""
        if self.config.task != 'collect':
            self._distance[env_ids] = self._distance_of(env_ids, self.backend.poses[env_ids, :2])

    def _distance_of(self, env_ids: np.ndarray, xy: np.ndarray) -> np.ndarray:
        cells = (xy - self._origins[self.house_index[env_ids]]) / CELL - 0.5
        return interpolate(self._maps, np.asarray(env_ids), cells[:, 0], cells[:, 1])

    def _heading_error(self) -> np.ndarray:
        return tasks.heading_error(self.backend.poses[:, 2], self._goal_yaw)

    def _look(self) -> Frames:
        return self.backend.observe(keys=key(self._seeds, Stream.SENSOR, self._numbers,
                                             self._episode, self._step))

    def _result(self, frames: Frames, reset, success, collided):
        image = frames.rgb.copy()
        if self.config.randomisation.late_picture:
            late = (uniform(self._seeds, Stream.LATE_PICTURE, self._numbers, self._episode,
                            self._step)
                    < self.config.randomisation.late_picture) & (self._step > 0)
            image[late] = self._last_image[late]
            self._last_image[:] = image
        observation = {
            'image': image,
            'goal_index': self._shown_goal.copy(),
            'last_action': self._last_action.copy(),
            'last_reward': self._last_reward.copy(),
        }
        info = {
            'reset': reset,
            'success': success,
            'arrived': (tasks.arrived(self._distance, self._heading_error())
                        if self.config.task == 'image' else success.copy()),
            'collided': collided,
            'distance': self._distance.astype(np.float32),
            'heading_error': self._heading_error().astype(np.float32),
            'start_distance': self._start_distance.astype(np.float32),
            'path_length': self._path_length.astype(np.float32),
            'decisions': self._step.copy(),
            'goal': self._goal.copy(),
            'pose': self.backend.poses.copy(),
        }
        if 'depth' in self.config.privileged:
            info['depth'] = frames.depth.copy()
        if 'segmentation' in self.config.privileged:
            info['segmentation'] = frames.labels.copy()
        if 'goal_segmentation' in self.config.privileged:
            info['goal_segmentation'] = self.goal_segmentation[self._shown_goal]
        if 'oracle_action' in self.config.privileged:
            info['oracle_action'] = self.oracle_actions()
        if 'oracle_regret' in self.config.privileged:
            info['oracle_regret'] = self.backend.routes.regrets(self.backend.poses,
                                                                self.goal_poses[self._goal])
        if 'goal_pose' in self.config.privileged:
            info['goal_pose'] = self._goal_pose()
        if {'overlap', 'explorer_action'} & set(self.config.privileged):
            info['overlap'] = self._overlap(frames.depth)
        if self._explorer is not None:
            info['explorer_action'] = self._explore_action(reset, info['overlap'])
        return observation, info

    def _explore_action(self, reset: np.ndarray, overlap: np.ndarray) -> np.ndarray:
        """What the `Explorer` would do, [N] int64; it looks from here."""
        self._explorer.begin(np.nonzero(reset)[0])
        turned = np.where(self._last_action < 0, 0, np.sign(self._deltas[self._last_action, 2]))
        turns = self._explorer.turns(self.backend.poses, self.house_index, overlap,
                                     self._distance, self._goal_yaw, self._maps, turned)
        table = turning_table(self.action_names)
        return np.where(turns == 0, table['forward'], np.where(
            turns > 0, table['rotate_left'], table['rotate_right']))

    def _goal_pose(self) -> np.ndarray:
        if not self.task.views:
            return np.zeros((self.num_envs, 4), np.float32)
        # As the picture shows it, which was taken a little beside the robot in some backends.
        return relative_pose(self.backend.seen_from,
                             self.goal_poses[self._picture // self._variants])

    def _overlap(self, depth: np.ndarray) -> np.ndarray:
        if not self.task.views:
            return np.zeros(self.num_envs, np.float32)
        if not self.backend.capabilities.depth:
            shown = self.backend.overlap(self.goal_poses[self._picture // self._variants])
            return np.where(self._shown_goal == self.blank_goal, np.float32(0), shown)
        # The grey picture has no points.
        picture = np.where(self._shown_goal == self.blank_goal, self.blank_goal, self._picture)
        return co_visible(self._goal_points[picture], depth, *self.backend.cameras())

    def oracle_actions(self) -> np.ndarray:
        """The next action [N] on a shortest path to the goal, from the simulator's geometry.

        See `oracle.FloorOracle`; a backend with routes of its own answers itself. Having arrived,
        declare it where that ends an episode.
        """
        if self.config.task == 'collect':
            raise UserError('the shortest-path action needs a task with a goal', 'collect',
                            'use another control')
        there = tasks.arrived(self._distance, self._heading_error())
        if self.backend.routes is not None:
            actions = self.backend.routes.actions(self.backend.poses, self.goal_poses[self._goal])
        else:
            actions = self._floor_actions()
        return actions if self.declare_action is None else np.where(
            there, self.declare_action, actions)

    def _floor_actions(self) -> np.ndarray:
        if self._oracle is None:
            self._oracle = FloorOracle(self.action_names, self._deltas)
        near = (self._distance <= tasks.ARRIVAL_RADIUS) & (self.config.task == 'image')
        return np.array([self._oracle.action(
            self.backend.poses[n], self._goal_yaw[n] if near[n] else None,
            functools.partial(self.backend.reach, n),
            lambda ends, n=n: self._distance_of(np.full(len(ends), n), ends))
            for n in range(self.num_envs)], np.int64)


class HouseNavigation(gymnasium.Env):
    """One robot in one house, for tools that want a single `gymnasium.Env`.

    Observations: `image` and `goal`, both [3,H,W] uint8. Registered as `vn_nav/House-v0`.

    Args:
        house: seed of the house; rooms: its number of rooms.
        options: further fields of `EnvConfig`; the randomisation may be given by name or file, so
            that `spec.to_json()` can write it.
    """

    metadata = {'render_modes': ['rgb_array'], 'render_fps': 10}

    def __init__(self, house: int = 0, rooms: int = 5, render_mode: str | None = None, **options):
        self.render_mode = render_mode
        # JSON has no tuples.
        options = {name: tuple(value) if isinstance(value, list) else value
                   for name, value in options.items()}
        if isinstance(options.get('randomisation'), str):
            options['randomisation'] = load_randomisation(options['randomisation'])
        self._batch = NavigationEnv(EnvConfig(houses=(house,), rooms=rooms, num_envs=1, **options))
        size = self._batch.config.size
        picture = spaces.Box(0, 255, (3, size, size), np.uint8)
        self.observation_space = spaces.Dict({'image': picture, 'goal': picture})
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
                'goal': self._batch.goals[observation['goal_index'][0]].copy()}


# By name: a callable cannot be written as JSON.
gymnasium.register('vn_nav/House-v0', entry_point='vn_sim_bridge.navigation.env:HouseNavigation')
