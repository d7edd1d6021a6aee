"""`NavigationEnv`: many robots with a task in the places of a simulator, as a VectorEnv."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from vn_nav.errors import UserError
from vn_nav.labels import label_dtype
from vn_nav.reset_arguments import read_options
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.counter_random import Stream, key, uniform
from vn_sim_bridge.floor.places import have_floors, walled
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.base_motion import BaseMotion, Counters
from vn_sim_bridge.navigation.env_config import (
    EnvConfig,
    check_simulator,
    setup_for,
    tells,
    with_own_actions,
)
from vn_sim_bridge.navigation.episode_odometry import EpisodeOdometry
from vn_sim_bridge.navigation.episode_ranges import EpisodeRanges
from vn_sim_bridge.navigation.episodes import draw_motion_scale, draw_variant
from vn_sim_bridge.navigation.exploration import Exploration
from vn_sim_bridge.navigation.goal_distances import FloorDistances, SeparateDistances
from vn_sim_bridge.navigation.goal_views import GoalViews
from vn_sim_bridge.navigation.make_task import make_task
from vn_sim_bridge.navigation.seeds import Seeds, read_reset_mask
from vn_sim_bridge.navigation.tasks import ABSENT, BLANK, RIGHT, WRONG
from vn_sim_bridge.navigation.teachers import ExplorerTeacher, FloorTeacher
from vn_sim_bridge.simulator import Frames, Motion, Simulator
from vn_sim_bridge.simulators import open_simulator, robot_for


class NavigationEnv(gymnasium.vector.VectorEnv):
    """Visual navigation in the places of a simulator.

    Observations are a dict of arrays over the N environments: `image` [N,3,H,W] uint8,
    `goal_index` [N] int64 into `goals`, `last_action` [N] int64 (-1 at an episode's start) and
    `last_reward` [N] float32 (the sparse reward alone). The goal pictures stand once in `goals`
    [G,3,H,W] uint8; the last one, `blank_goal`, is plain grey.

    Autoreset is NEXT_STEP: the step after an episode's end ignores its action and returns the new
    episode's first observation with reward 0; `info['reset']` marks these rows: no frames.

    With `config.odometry` there is also `odometry` [N,3] float64: x, y [m], yaw [rad] as the
    robots' own odometry has them, in a frame of its own that begins at (0, 0, 0) with every
    episode: x ahead of where the robot starts, y to its left (see `EpisodeOdometry`).

    With `config.ranges` other than `picture` there is also `scan` [N,K] float32 m: ranges along
    the bearings of the attribute `scanner`, measured where the pictures are taken (see
    `EpisodeRanges`). They are for the map of a policy that has one; no network is shown them.

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
        robot: actions, camera and footprint; left out: the scenes' own, which is the standard
            robot wherever they do not say.
        threads: threads that draw.
        simulator: robots and places instead of the configuration's scenes: as many robots, and
            pictures as large, as the configuration says. It is closed with the environment.

    Raises:
        UserError: the simulator cannot do what the configuration asks for.
    """

    metadata = {'autoreset_mode': AutoresetMode.NEXT_STEP, 'render_modes': []}

    def __init__(self, config: EnvConfig | None = None, robot: RobotSpec | None = None, *,
                 threads: int = 1, simulator: Simulator | None = None):
        config = config or EnvConfig()
        if robot is None:
            robot = RobotSpec() if simulator else robot_for(config.scenes)
        self.config = config = with_own_actions(config, robot)
        self.robot = robot.with_actions(config.actions)
        self.num_envs = n = config.num_envs
        self.simulator: Simulator = simulator or open_simulator(
            config.scenes, setup_for(config, self.robot, threads))
        try:
            check_simulator(self.simulator, config, self.robot, given=simulator is not None)
        except UserError:
            if simulator is None:
                self.simulator.close()
            raise
        self.places = list(self.simulator.places)
        self._wanders = len(self.places) > n and not config.one_goal_per_env
        # Random numbers are functions of an environment's seed and number.
        self._seeds = Seeds(config.seed, n)
        self.task = make_task(config, self.simulator, self.label_names)
        self.world_version = self.simulator.version
        self.simulator_name = parse_scene(self.places[0].name).simulator
        self.action_names = self.robot.action_names
        self.declare_action = len(self.action_names) if config.stop == 'declared' else None
        self._base = BaseMotion(config, self.robot, exact_turns=self.simulator.exact_turns)
        self._odometry = None if config.odometry == 'none' else EpisodeOdometry(
            config.odometry, n, config.drift)
        self._ranges = None if config.ranges == 'picture' else EpisodeRanges(
            config.ranges, self.simulator, self.robot, config.size)
        self.scanner = None if self._ranges is None else self._ranges.scanner
        self._views = GoalViews(
            self.simulator, self.task.views, variants=config.pictures_per_goal, size=config.size,
            seed=config.seed,
            label_type=label_dtype(len(self.label_names)),
            with_points=bool({'overlap', 'explorer_action'} & set(config.privileged)))
        self.goals, self.goal_segmentation = self._views.pictures, self._views.segmentation
        self.goal_poses, self.goal_rooms = self._views.poses, self._views.names
        self.blank_goal = self._views.blank
        self.goal_features = self._views.features
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
        self._distances: FloorDistances | SeparateDistances = (
            FloorDistances(self.places, n) if have_floors(self.places) else SeparateDistances(n))
        self._exploration: Exploration | None = None
        if config.exploration_reward:
            assert isinstance(self._distances, FloorDistances)  # see `check_simulator`
            self._exploration = Exploration(self._distances, n)
        # Options that are off add nothing to the state.
        self._state = (*self._STATE, *(('_picture',) if set(config.privileged) & {
            'goal_pose', 'overlap', 'explorer_action'} else ()))
        self._explorer = (self._make_explorer_teacher() if 'explorer_action' in config.privileged
                          else None)
        # Made when they are asked for.
        self._floor_teacher: FloorTeacher | None = None
        self._control: ExplorerTeacher | None = None

    @property
    def place_index(self) -> np.ndarray:
        """[N] the place of each robot."""
        return self.simulator.place_index

    @property
    def label_names(self) -> Sequence[str]:
        """Behind the ids of segmentations; none where the simulator has no labels."""
        return self.simulator.label_names if self.simulator.capabilities.labels else ()

    def _make_explorer_teacher(self) -> ExplorerTeacher:
        if self.config.task != 'image':
            raise UserError('the explorer looks for the place of a picture (task image)',
                            self.config.task, 'leave out explorer_action')
        return ExplorerTeacher(list(map(walled, self.places)), self.num_envs,
                               fov=self.robot.camera_fov, action_names=self.action_names,
                               deltas=self._base.deltas)

    def _make_spaces(self) -> None:
        size, actions = self.config.size, len(self.action_names)
        features = {'features': spaces.Box(-np.inf, np.inf, (self.simulator.feature_size,),
                                           np.float32)} if self.simulator.feature_size else {}
        self.single_observation_space = spaces.Dict({
            'image': spaces.Box(0, 255, (3, size, size), np.uint8),
            'goal_index': spaces.Discrete(len(self.goals)),
            'last_action': spaces.Discrete(actions + 1, start=-1),
            'last_reward': spaces.Box(-np.inf, np.inf, (), np.float32),
            **features,
            **({} if self._odometry is None else {
                'odometry': spaces.Box(-np.inf, np.inf, (3,), np.float64)}),
            **({} if self.scanner is None else {
                'scan': spaces.Box(-np.inf, np.inf, (len(self.scanner.bearings),), np.float32)}),
        })
        self.single_action_space = spaces.Discrete(self._choices)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    @property
    def _choices(self) -> int:
        """Numbers that `step` takes."""
        return len(self.action_names) + (self.declare_action is not None)

    @property
    def distance_unit(self) -> str:
        """Of distances and of a path's length: 'm', 'steps' (decisions), or '': there are none."""
        can = self.simulator.capabilities
        return '' if can.own_actions else 'steps' if can.steps else 'm'

    @property
    def _judges_poses(self) -> bool:
        """Whether arriving at a pose is the task."""
        return self.config.task == 'image' and not self.simulator.capabilities.rewards

    @property
    def restorable(self) -> bool:
        """Whether `set_state` can put the robots back where they were."""
        return self.simulator.capabilities.teleport

    def close(self, **kwargs) -> None:
        """Let go of the simulator; a second time it does nothing."""
        if not self.closed:
            self.simulator.close()
        super().close(**kwargs)

    # The two switches that training and evaluation turn.

    def set_difficulty(self, tau: float) -> None:
        """Start later episodes within tau * the maximum distance of their goal, tau in (0, 1]."""
        if not 0 < tau <= 1:
            raise UserError('the difficulty tau lies in (0, 1]', tau, 'choose a value in range')
        self._tau = float(tau)

    def set_shown_goal(self, mode: str) -> None:
        """Which picture later episodes show.

        Args:
            mode: 'right'; 'wrong', another one of the place; 'absent', one of another place, for
                task image alone; or 'blank'.
        """
        if mode not in (RIGHT, WRONG, ABSENT, BLANK):
            raise UserError('the shown goal is right, wrong, absent or blank', mode,
                            'choose one of them')
        if mode == ABSENT and (self.config.task != 'image' or len(self.places) < 2):
            raise UserError('an absent goal needs the task image and at least two places',
                            f'task {self.config.task}, {", ".join(self.config.scenes)}',
                            'name more scenes')
        if mode == WRONG and min(count for _, count in self.task.ranges) < 2:
            raise UserError('a wrong goal needs a place with at least two goals',
                            ', '.join(self.config.scenes), 'use larger scenes')
        self._mode = mode

    _STATE = ('_episode', '_step', '_goal', '_goal_yaw', '_shown_goal', '_distance',
              '_start_distance', '_path_length', '_last_action', '_last_reward', '_done',
              '_motion_scale', '_last_image')

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that changes from step to step; with equal switches `set_state` goes on.

        Raises:
            UserError: the simulator cannot put robots back (`restorable`).
        """
        if not self.restorable:
            raise UserError('only robots that can be put anywhere have a state to go on from',
                            self.simulator_name, 'begin new episodes with `reset`')
        objects = self.simulator.objects
        more = {'house_index': self.place_index.copy()} if self._wanders else {}
        if isinstance(self._distances, FloorDistances):
            more['maps'] = self._distances.maps.copy()
        if self._explorer is not None:
            more |= {'explorer_seen': self._explorer.explorer.seen.copy(),
                     'explorer_found': self._explorer.explorer.found.copy()}
        if self._exploration is not None:
            more['visited'] = self._exploration.visited.copy()
        if self._odometry is not None:
            more['odometry'] = self._odometry.poses.copy()
        return {'poses': self.simulator.poses.copy(), **self._seeds.get_state(), **more,
                **{name.strip('_'): getattr(self, name).copy() for name in self._state},
                **{f'objects_{name}': part.copy() for name, part in objects._asdict().items()},
                **{f'task_{name}': part.copy() for name, part in self.task.state.items()}}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `get_state` was taken."""
        self._seeds.set_state(state)
        everyone = np.arange(self.num_envs)
        if self._wanders:
            self.simulator.enter(everyone, state['house_index'])
        self.simulator.place(everyone, state['poses'])
        for name in self._state:
            getattr(self, name)[:] = state[name.strip('_')]
        if isinstance(self._distances, FloorDistances):
            self._distances.maps[:] = state['maps']
        else:
            assert isinstance(self.task, tasks.ImageGoal)  # every other task has floors
            for n in range(self.num_envs):
                self._distances.set(n, self.task.goal_field(int(self._goal[n])).field)
        if self._explorer is not None:
            self._explorer.explorer.seen[:] = state['explorer_seen']
            self._explorer.explorer.found[:] = state['explorer_found']
        if self._exploration is not None:
            self._exploration.visited[:] = state['visited']
        if self._odometry is not None:
            self._odometry.poses[:] = state['odometry']
        for name, part in self.simulator.objects._asdict().items():
            part[:] = state[f'objects_{name}']
        for name, part in self.task.state.items():
            part[:] = state[f'task_{name}']
        seeds, numbers, episodes = self._counters(everyone)
        self.simulator.apply_appearance(everyone, seeds, Stream.APPEARANCE, numbers, episodes)

    def _counters(self, env_ids: np.ndarray) -> Counters:
        """What the random numbers of robots [K] are functions of."""
        return self._seeds.seeds[env_ids], self._seeds.numbers[env_ids], self._episode[env_ids]

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
        mask = read_reset_mask(read_options(options, ('reset_mask',)), self._episode >= 0)
        if seed is not None:
            self._episode[self._seeds.take(seed, mask)] = -1
        self._begin(np.nonzero(mask)[0])
        self._done[mask] = False
        none = np.zeros(self.num_envs, bool)
        return self._result(self._look(), reset=mask, success=none, collided=none)

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
        collided, motion = np.zeros(self.num_envs, bool), None
        before = self._distance.copy()
        if len(driving):
            motion = self._drive(actions[driving], driving)
            collided[driving] = motion.collided
        if reset.any():
            self._begin(np.nonzero(reset)[0])
        self._measure(acting)
        self._step[acting] += 1
        frames = self._look()
        objects = self.simulator.objects
        verdict = self.task.judge(tasks.Situation(
            ~reset, self._distance, self._heading_error(), self.simulator.poses, frames.labels,
            self.simulator.object_models(), objects.pose[:, :, :2],
            None if self.declare_action is None else declared))
        if self.simulator.capabilities.rewards:  # its own, in place of the task's
            verdict = _paid(motion, driving, verdict)
        ended = verdict.success if verdict.ended is None else verdict.ended
        objects.scene[verdict.removed] = -1
        reward = np.where(reset, 0, verdict.reward + tasks.shaping_reward(
            before, self._distance, collided, verdict.success,
            progress=self.config.progress_reward, collision=self.config.collision_reward,
            step=self.config.step_reward, goal=self.config.goal_bonus)).astype(np.float32)
        if self._exploration is not None:
            reward[acting] += self.config.exploration_reward * self._visit(acting)
        self._last_action[driving] = actions[driving]
        self._last_reward[acting] = verdict.reward[acting]
        terminated = ended | declared
        broken = self.simulator.broken_off()  # while an episode begins: it begins all the same
        truncated = ~terminated & ~reset & (broken | (self._step >= self.config.max_decisions))
        self._done = terminated | truncated
        observation, info = self._result(frames, reset, verdict.success, collided)
        return observation, reward, terminated, truncated, info

    def _drive(self, actions: np.ndarray, acting: np.ndarray) -> Motion:
        """Move some robots. On a grid nothing is noisy, slips or is worn."""
        if self.simulator.capabilities.own_actions:
            return self.simulator.act(actions, acting)
        counters, step = self._counters(acting), self._step[acting]
        delta = (self._base.driven(actions, counters, step, self._motion_scale[acting])
                 if self.simulator.capabilities.continuous else self._base.deltas[actions])
        motion = self.simulator.move(delta, acting)
        if self._odometry is not None:
            self._odometry.add(acting, self._base.deltas[actions], delta, motion.delta, counters,
                               step)
        self._path_length[acting] += (1.0 if self.simulator.capabilities.steps else np.hypot(
            motion.delta[:, 0], motion.delta[:, 1]))
        return motion

    def _begin(self, env_ids: np.ndarray) -> None:
        """Draw goal, start, light and base of new episodes."""
        self._episode[env_ids] += 1
        teleport = self.simulator.capabilities.teleport
        if self._wanders:
            own = (len(self.places) - 1 - env_ids) // self.num_envs + 1  # n, n + N, n + 2 N, ...
            seeds, numbers, episodes = self._counters(env_ids)
            turn = own * uniform(seeds, Stream.HOUSE, numbers, episodes)
            self.simulator.enter(env_ids, env_ids + turn.astype(np.int64) * self.num_envs)
        for n in env_ids:
            seed, number, index = self._counters(n)
            counter = int(seed), int(number), int(index)
            episode = self.task.begin(int(n), int(self.place_index[n]), counter, self._tau,
                                      self._mode)
            variant = draw_variant(self._views.variants, *counter)
            self._goal[n], self._goal_yaw[n] = episode.goal, episode.goal_yaw
            self._shown_goal[n] = (self.blank_goal if episode.shown < 0
                                   else episode.shown * self._views.variants + variant)
            true = episode.shown if self._mode == RIGHT else episode.goal
            self._picture[n] = true * self._views.variants + variant
            if teleport:
                self.simulator.place(np.array([n]), episode.start[None])
            self.simulator.set_objects(n, episode.objects)
            self._distances.set(n, episode.field)
        counters = self._counters(env_ids)
        if not teleport:
            self.simulator.spawn(env_ids, key(counters[0], Stream.START_CELL, *counters[1:]))
        self.simulator.apply_appearance(env_ids, counters[0], Stream.APPEARANCE, *counters[1:])
        self._motion_scale[env_ids] = draw_motion_scale(self.config.randomisation, *counters)
        self._step[env_ids] = 0
        self._path_length[env_ids] = 0.0
        self._last_action[env_ids] = -1
        self._last_reward[env_ids] = 0.0
        if self._odometry is not None:
            self._odometry.begin(env_ids)
        self._measure(env_ids)
        # Where nobody knows the ways no figure is made of the shortest one.
        can = self.simulator.capabilities
        known = can.geodesic and not can.rewards  # who pays itself has goals of its own
        self._start_distance[env_ids] = self._distance[env_ids] if known else np.nan
        if self._exploration is not None:
            self._exploration.begin(env_ids)
            self._visit(env_ids)

    def _visit(self, env_ids: np.ndarray) -> np.ndarray:
        """Which of robots [K] stand on floor that is new to their episodes, [K] bool."""
        assert self._exploration is not None
        return self._exploration.visit(env_ids, self.place_index[env_ids],
                                       self.simulator.poses[env_ids])

    def _measure(self, env_ids: np.ndarray) -> None:
        """Geodesic distance of robots to their goals; 0 where the task has none."""
        if self.config.task != 'collect':
            self._distance[env_ids] = self._distance_of(env_ids, self.simulator.poses[env_ids])

    def _distance_of(self, env_ids: np.ndarray, poses: np.ndarray) -> np.ndarray:
        return self._distances.at(env_ids, self.place_index[env_ids], poses)

    def _distance_from(self, env: int, xy: np.ndarray) -> np.ndarray:
        """Of positions [K,2] m in the place of one robot to its goal, [K] m."""
        return self._distance_of(np.full(len(xy), env), xy)

    def _heading_error(self) -> np.ndarray:
        return tasks.heading_error(self.simulator.poses[:, 2], self._goal_yaw)

    def _look(self) -> Frames:
        seeds, numbers = self._seeds.seeds, self._seeds.numbers
        return self.simulator.observe(keys=key(seeds, Stream.SENSOR, numbers, self._episode,
                                               self._step))

    def _result(self, frames: Frames, reset, success, collided):
        image = frames.rgb.copy()
        if self.config.randomisation.late_picture:
            late = (uniform(self._seeds.seeds, Stream.LATE_PICTURE, self._seeds.numbers,
                            self._episode, self._step)
                    < self.config.randomisation.late_picture) & (self._step > 0)
            image[late] = self._last_image[late]
            self._last_image[:] = image
        observation = {
            'image': image,
            'goal_index': self._shown_goal.copy(),
            'last_action': self._last_action.copy(),
            'last_reward': self._last_reward.copy(),
        }
        if self.simulator.feature_size:
            observation['features'] = self.simulator.features(self.place_index,
                                                              self.simulator.poses)
        if self._odometry is not None:
            observation['odometry'] = self._odometry.poses.copy()
        if self._ranges is not None:
            observation['scan'] = self._ranges.measure(
                frames, self._counters(np.arange(self.num_envs)), self._step)
        other, at_shown = self._views.other_shown(self._shown_goal, self._goal, self.place_index,
                                                  self.simulator.poses)
        self._seen_now = frames.depth, reset
        info = {
            'reset': reset,
            'success': success,
            'arrived': (tasks.arrived(self._distance, self._heading_error())
                        if self._judges_poses else success.copy()),
            'collided': collided,
            'distance': self._distance.astype(np.float32),
            'heading_error': self._heading_error().astype(np.float32),
            'start_distance': self._start_distance.astype(np.float32),
            'path_length': self._path_length.astype(np.float32),
            'decisions': self._step.copy(),
            'goal': self._goal.copy(),
            'shown_other': other,
            'at_shown': at_shown,
            'pose': self.simulator.poses.copy(),
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
            assert self.simulator.planner is not None  # see `check_simulator`
            info['oracle_regret'] = self.simulator.planner.regrets(self.simulator.poses,
                                                                   self.goal_poses[self._goal])
        if 'goal_pose' in self.config.privileged:
            info['goal_pose'] = self._views.relative_poses(self._picture)
        if {'overlap', 'explorer_action'} & set(self.config.privileged):
            info['overlap'] = self._views.co_visibility(self._picture, self._shown_goal,
                                                        frames.depth)
        if self._explorer is not None:
            info['explorer_action'] = self._explored(self._explorer, reset, info['overlap'])
        return observation, info

    def _explored(self, teacher: ExplorerTeacher, reset: np.ndarray, overlap: np.ndarray
                  ) -> np.ndarray:
        assert isinstance(self._distances, FloorDistances)  # where there are walls is a floor
        return teacher.actions(reset, self.simulator.poses, self.place_index, overlap,
                               self._distance, self._goal_yaw, self._distances.maps,
                               self._last_action)

    @property
    def explores(self) -> bool:
        """Whether there are `explorer_actions`."""
        return self.config.task == 'image' and 'explorer_action' in tells(self.simulator)

    def explorer_actions(self) -> np.ndarray:
        """The next action [N] of the explorer (see `explorer`), as a control.

        It looks when it is asked: ask at every observation of an episode. Having arrived, declare
        it where that ends an episode.
        """
        if self._control is None:
            self._control = self._make_explorer_teacher()
        depth, reset = self._seen_now
        overlap = self._views.co_visibility(self._picture, self._shown_goal, depth)
        return self._or_declared(self._explored(self._control, reset, overlap))

    def _or_declared(self, actions: np.ndarray) -> np.ndarray:
        """Actions [N], and the declared stop in place of those of robots that have arrived."""
        if self.declare_action is None:
            return actions
        arrived = tasks.arrived(self._distance, self._heading_error())
        return np.where(arrived, self.declare_action, actions)

    def oracle_actions(self) -> np.ndarray:
        """The next action [N] on a shortest path to the goal, from the simulator's geometry.

        See `oracle.FloorOracle`; a simulator with a planner of its own answers itself. Having
        arrived, declare it where that ends an episode.
        """
        if self.config.task == 'collect':
            raise UserError('the shortest-path action needs a task with a goal', 'collect',
                            'use another control')
        if not (self.simulator.capabilities.geodesic or self.simulator.planner):
            raise UserError('the shortest-path action needs a simulator that knows ways',
                            self.simulator_name, 'use another control')
        if self.simulator.planner is not None:
            actions = self.simulator.planner.actions(self.simulator.poses,
                                                     self.goal_poses[self._goal])
        else:
            near = (self._distance <= tasks.ARRIVAL_RADIUS) & (self.config.task == 'image')
            if self._floor_teacher is None:
                self._floor_teacher = FloorTeacher(self.action_names, self._base.deltas)
            actions = self._floor_teacher.actions(
                self.simulator.poses, self._goal_yaw, near, self.simulator.reach,
                self._distance_from)
        return self._or_declared(actions)


def _paid(motion: Motion | None, driving: np.ndarray, verdict: tasks.Judgement
          ) -> tasks.Judgement:
    """What a simulator with rewards of its own says of robots [K] that drove."""
    reward = np.zeros(len(verdict.success), np.float32)
    ended = np.zeros(len(verdict.success), bool)
    if motion is not None:
        reward[driving], ended[driving] = motion.reward, motion.ended
    return verdict._replace(reward=reward, ended=ended, success=ended & (reward > 0))
