"""`NavigationEnv`: many robots that look for the places of pictures, as a Gymnasium VectorEnv."""

from __future__ import annotations

import dataclasses
import math

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge import tasks
from vn_sim_bridge.backends.house import HouseBackend
from vn_sim_bridge.counter_random import Stream, normal
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.world import motion_noise

PRIVILEGED = ('depth', 'segmentation', 'goal_segmentation', 'oracle_action')
TURN_COST = 0.05  # m, what the shortest-path action charges for one rotation
BLOCKED_COST = 1.0  # per metre that a contact cuts off a forward move
RIGHT, WRONG, BLANK = 'right', 'wrong', 'blank'


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What a `NavigationEnv` simulates. Environment i lives in house i modulo their number."""

    houses: tuple[int, ...] = (0,)  # seeds
    rooms: int = 5  # of each house
    num_envs: int = 64
    size: int = 84  # pixels
    actions: tuple[str, ...] = DRIVE_ACTIONS
    max_decisions: int = 300
    noise: bool = True
    progress_reward: float = 0.0  # per metre of geodesic progress
    collision_reward: float = 0.0  # per decision that touched something; a penalty is negative
    min_start_distance: float = 1.0  # m, geodesic
    one_goal_per_env: bool = False  # environment i keeps pair i; else drawn each episode
    seed: int = 0
    privileged: tuple[str, ...] = ()  # of PRIVILEGED

    def __post_init__(self):
        rules = (
            (len(self.houses) >= 1, 'there is at least one house', self.houses),
            (self.num_envs >= 1, 'there is at least one environment', self.num_envs),
            (self.max_decisions >= 1, 'an episode has at least one decision', self.max_decisions),
            (8 <= self.size <= 2048, 'pictures have 8 to 2048 pixels a side', self.size),
            (set(self.privileged) <= set(PRIVILEGED),
             f'privileged outputs are some of {", ".join(PRIVILEGED)}', self.privileged),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the environment configuration')


class NavigationEnv(gymnasium.vector.VectorEnv):
    """Image-goal navigation in embedded houses.

    Observations are a dict of arrays over the N environments: `image` [N,3,H,W] uint8,
    `goal_index` [N] int64 into `goals`, `last_action` [N] int64 (-1 at an episode's start) and
    `last_reward` [N] float32 (the sparse reward alone). The goal pictures stand once in `goals`
    [G,3,H,W] uint8; the last one, `blank_goal`, is plain grey.

    Autoreset is NEXT_STEP: the step after an episode's end ignores its action and returns the new
    episode's first observation with reward 0; `info['reset']` marks these rows: no frames.

    Args:
        config: what to simulate.
        robot: actions, camera and footprint; the standard robot if left out.
        threads: threads that draw.
    """

    metadata = {'autoreset_mode': AutoresetMode.NEXT_STEP, 'render_modes': []}

    def __init__(self, config: EnvConfig | None = None, robot: RobotSpec | None = None, *,
                 threads: int = 1):
        self.config = config = config or EnvConfig()
        self.robot = (robot or RobotSpec()).with_actions(config.actions)
        self.num_envs = n = config.num_envs
        self.houses = [generate_house(seed, rooms=config.rooms) for seed in config.houses]
        self.house_index = np.arange(n) % len(self.houses)
        self.backend = HouseBackend(self.houses, self.house_index, robot=self.robot,
                                    size=config.size, threads=threads)
        self.world_version = self.backend.world_version
        self.action_names = self.robot.action_names
        self._deltas = np.array([[a.dx, a.dy, a.dyaw, a.dpitch] for a in self.robot.actions])
        self._sizes = np.array([abs(action.size) for action in self.robot.actions])
        self._make_goals()
        self._make_spaces()
        self._seed = config.seed
        self._tau = 1.0
        self._shown = RIGHT
        self._episode = np.full(n, -1, np.int64)
        self._step = np.zeros(n, np.int64)
        self._goal = np.zeros(n, np.int64)  # index of the true goal in the pool
        self._shown_goal = np.zeros(n, np.int64)
        self._distance = np.zeros(n)
        self._start_distance = np.zeros(n)
        self._path_length = np.zeros(n)
        self._last_action = np.full(n, -1, np.int64)
        self._last_reward = np.zeros(n, np.float32)
        self._done = np.ones(n, bool)

    def _make_goals(self) -> None:
        """The pool of goals over all houses, and their pictures."""
        pool, owner = [], []
        self._goal_range = []
        for index, house in enumerate(self.houses):
            self._goal_range.append((len(pool), len(house.goals)))
            pool += [tasks.GoalField(house, goal, self.config.min_start_distance)
                     for goal in house.goals]
            owner += [index] * len(house.goals)
        self.goal_fields = pool
        self.goal_poses = np.array([entry.goal.pose for entry in pool])
        self.goal_rooms = tuple(entry.goal.room for entry in pool)
        frames = self.backend.view(np.array(owner), self.goal_poses)
        size = self.config.size
        grey = np.full((1, 3, size, size), 128, np.uint8)
        self.goals = np.concatenate([frames.rgb, grey])
        self.goal_segmentation = np.concatenate([frames.labels, np.zeros((1, size, size),
                                                                         np.uint8)])
        self.blank_goal = len(pool)

    def _make_spaces(self) -> None:
        size, actions = self.config.size, len(self.action_names)
        self.single_observation_space = spaces.Dict({
            'image': spaces.Box(0, 255, (3, size, size), np.uint8),
            'goal_index': spaces.Discrete(len(self.goals)),
            'last_action': spaces.Discrete(actions + 1, start=-1),
            'last_reward': spaces.Box(-1.0, 1.0, (), np.float32),
        })
        self.single_action_space = spaces.Discrete(actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    # The three switches that training and evaluation turn.

    def set_difficulty(self, tau: float) -> None:
        """Start later episodes within tau * the maximum distance of their goal, tau in (0, 1]."""
        if not 0 < tau <= 1:
            raise UserError('the difficulty tau lies in (0, 1]', tau, 'choose a value in range')
        self._tau = float(tau)

    def set_shown_goal(self, mode: str) -> None:
        """Which picture later episodes show: 'right', 'wrong' (same house) or 'blank'."""
        if mode not in (RIGHT, WRONG, BLANK):
            raise UserError('the shown goal is right, wrong or blank', mode, 'choose one of them')
        if mode == WRONG and min(count for _, count in self._goal_range) < 2:
            raise UserError('a wrong goal needs a house with at least two goals',
                            self.config.rooms, 'use more rooms')
        self._shown = mode

    _STATE = ('_episode', '_step', '_goal', '_shown_goal', '_distance', '_start_distance',
              '_path_length', '_last_action', '_last_reward', '_done')

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that changes from step to step; with equal switches `set_state` goes on."""
        return {'poses': self.backend.poses.copy(), 'seed': np.array(self._seed),
                **{name.strip('_'): getattr(self, name).copy() for name in self._STATE}}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `get_state` was taken."""
        self._seed = int(state['seed'])
        self.backend.place(np.arange(self.num_envs), state['poses'])
        for name in self._STATE:
            getattr(self, name)[:] = state[name.strip('_')]

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start a new episode everywhere; a seed also restarts the count of episodes."""
        if seed is not None:
            self._seed = int(seed)
            self._episode[:] = -1
        self._begin(np.arange(self.num_envs))
        self._done[:] = False
        none = np.zeros(self.num_envs, bool)
        return self._observe(reset=np.ones(self.num_envs, bool), success=none, collided=none)

    def step(self, actions):
        """One decision in every environment that is not being reset."""
        actions = np.asarray(actions, np.int64)
        if actions.shape != (self.num_envs,) or actions.min() < 0 or (
                actions.max() >= len(self.action_names)):
            raise UserError(f'actions are {self.num_envs} integers from 0 to '
                            f'{len(self.action_names) - 1}', actions.tolist(),
                            'pass such an array')
        reset = self._done.copy()
        acting = np.nonzero(~reset)[0]
        collided = np.zeros(self.num_envs, bool)
        reward = np.zeros(self.num_envs, np.float32)
        success = np.zeros(self.num_envs, bool)
        if len(acting):
            delta = self._deltas[actions[acting]]
            if self.config.noise:
                delta = motion_noise(delta, self._sizes[actions[acting]], normal(
                    self._seed, Stream.MOTION_NOISE, acting, self._episode[acting],
                    self._step[acting]))
            motion = self.backend.move(delta, acting)
            collided[acting] = motion.collided
            self._path_length[acting] += np.hypot(motion.delta[:, 0], motion.delta[:, 1])
            before = self._distance.copy()
            self._measure()
            success = tasks.arrived(self._distance, self._heading_error()) & ~reset
            sparse = tasks.sparse_reward(success)
            reward = np.where(reset, 0, sparse + tasks.shaping_reward(
                before, self._distance, collided, progress=self.config.progress_reward,
                collision=self.config.collision_reward)).astype(np.float32)
            self._last_action[acting] = actions[acting]
            self._last_reward[acting] = sparse[acting]
            self._step[acting] += 1
        if reset.any():
            self._begin(np.nonzero(reset)[0])
        terminated = success
        truncated = ~terminated & ~reset & (self._step >= self.config.max_decisions)
        self._done = terminated | truncated
        observation, info = self._observe(reset, success, collided)
        return observation, reward, terminated, truncated, info

    def _begin(self, env_ids: np.ndarray) -> None:
        """Draw goal and start of a new episode."""
        self._episode[env_ids] += 1
        for n in env_ids:
            first, count = self._goal_range[self.house_index[n]]
            counter = (self._seed, int(n), int(self._episode[n]))
            if self.config.one_goal_per_env:
                local = (n // len(self.houses)) % count
            else:
                local = tasks.draw_goal(count, *counter)
            shown = local
            if self._shown == WRONG:
                shown = tasks.draw_wrong_goal(count, local, *counter)
            self._goal[n] = first + local
            self._shown_goal[n] = self.blank_goal if self._shown == BLANK else first + shown
            start = self.goal_fields[first + local].start(self._tau, *counter)
            self.backend.place(np.array([n]), start[None])
        self._step[env_ids] = 0
        self._path_length[env_ids] = 0.0
        self._last_action[env_ids] = -1
        self._last_reward[env_ids] = 0.0
        self._measure()
        self._start_distance[env_ids] = self._distance[env_ids]

    def _measure(self) -> None:
        """Geodesic distance of every robot to its goal."""
        for goal in np.unique(self._goal):
            rows = self._goal == goal
            self._distance[rows] = self.goal_fields[goal].field.distance(
                self.backend.poses[rows, :2])

    def _heading_error(self) -> np.ndarray:
        return tasks.heading_error(self.backend.poses[:, 2], self.goal_poses[self._goal, 2])

    def _observe(self, reset, success, collided):
        frames = self.backend.observe()
        observation = {
            'image': frames.rgb.copy(),
            'goal_index': self._shown_goal.copy(),
            'last_action': self._last_action.copy(),
            'last_reward': self._last_reward.copy(),
        }
        info = {
            'reset': reset,
            'success': success,
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
        return observation, info

    def oracle_actions(self) -> np.ndarray:
        """The next action [N] on a shortest path to the goal pose, from the simulator's geometry.

        Far from the goal: the heading, among those that rotations reach, whose forward move comes
        closest to the goal, charging `TURN_COST` a rotation and `BLOCKED_COST` for contacts.
        At the goal: turn to its yaw.
        """
        table = {name: index for index, name in enumerate(self.action_names)}
        for name in ('forward', 'rotate_left', 'rotate_right'):
            if name not in table:
                raise UserError('the shortest-path action needs forward and both rotations',
                                self.action_names, 'add them to the actions')
        turn = self._deltas[table['rotate_left'], 2]
        length = self._deltas[table['forward'], 0]
        half = math.ceil(math.pi / turn)
        turns = np.arange(-half + 1, half + 1)
        actions = np.empty(self.num_envs, np.int64)
        for n in range(self.num_envs):
            yaw = self.backend.poses[n, 2]
            if self._distance[n] <= tasks.ARRIVAL_RADIUS:
                wanted = tasks.wrap_angle(self.goal_poses[self._goal[n], 2] - yaw)
            else:
                ends = self.backend.world.reach(n, yaw + turns * turn, length)
                cut = length - np.hypot(*(ends - self.backend.poses[n, :2]).T)
                cost = (self.goal_fields[self._goal[n]].field.distance(ends)
                        + TURN_COST * np.abs(turns) + BLOCKED_COST * cut)
                wanted = turns[np.argmin(cost)] * turn
            if abs(wanted) < turn / 2:
                actions[n] = table['forward']
            else:
                actions[n] = table['rotate_left' if wanted > 0 else 'rotate_right']
        return actions


class HouseNavigation(gymnasium.Env):
    """One robot in one house, for tools that want a single `gymnasium.Env`.

    Observations: `image` and `goal`, both [3,H,W] uint8. Registered as `vn_nav/House-v0`.

    Args:
        house: seed of the house; rooms: its number of rooms.
        options: further fields of `EnvConfig`.
    """

    metadata = {'render_modes': ['rgb_array'], 'render_fps': 10}

    def __init__(self, house: int = 0, rooms: int = 5, render_mode: str | None = None, **options):
        self.render_mode = render_mode
        self._batch = NavigationEnv(EnvConfig(houses=(house,), rooms=rooms, num_envs=1, **options))
        size = self._batch.config.size
        picture = spaces.Box(0, 255, (3, size, size), np.uint8)
        self.observation_space = spaces.Dict({'image': picture, 'goal': picture})
        self.action_space = self._batch.single_action_space
        self._image = np.zeros((3, size, size), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin an episode; without a seed the next one of the sequence."""
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


gymnasium.register('vn_nav/House-v0', entry_point=HouseNavigation)
