"""Robots on ROS topics as a vector environment: the interface is that of a simulator.

`vn_nav train --env ros`. What each robot does, and when it stands still, is
`vn_nav.nodes.ros_robot`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from vn_nav.bags.drive import RECORDED
from vn_nav.errors import EnvironmentLost, UserError
from vn_nav.labels import CLASSES, label_dtype
from vn_nav.nodes.process import Ended
from vn_nav.nodes.robot_senses import MAP_TOPICS, Seen
from vn_nav.nodes.ros_robot import RosRobot
from vn_nav.reset_arguments import read_options
from vn_nav.robot import RobotSpec
from vn_nav.scenes import HOUSE, house_scene

ROBOT = 'robot'  # in place of the name of a simulator
MAX_GOALS = 1024  # different goal pictures of a training


class RosEnv:
    """Visual navigation of real robots, or of simulated ones behind topics; used as a context.

    It observes and tells as `vn_sim_bridge`'s `NavigationEnv` does, as far as topics know:
    `odometry` is observed where all robots publish a pose on `odom`, as a pose seen from where the
    episode began.
    `info` has `reset`, `success`, `collided`, `arrived` and, where they are published and asked
    for, `depth` and `segmentation`. An episode ends as `episode_end` says; with a reward above 0,
    or `arrived`; where nobody publishes `episode_end` after `max_decisions`; with another
    goal picture; and when a motion was broken off. The next one begins with the next
    picture on `goal_image`, or after a truncation that nobody announced with the same one again.
    Between two steps, as while a learner learns, the robots stand still under zero commands.

    The last observation of an episode is the picture after its last decision; if the next goal
    has come by then (a simulator puts its robot elsewhere at once) it is the one before.

    Args:
        robot: with the actions of the policy.
        size: side of the pictures [pixels].
        namespaces: one for each robot.
        lock_step: the other side is `sim_bridge_node` with time:=lock_step.
        max_decisions: see above.
        collision_reward: for a decision that touched something, negative.
        record: folder of a new bag; of several robots: of their bags.
        ros_arguments: what may follow `--ros-args`: remappings and parameters of the nodes.

    Attributes:
        goals: [1024,3,S,S] the goal pictures seen so far, then empty ones.
        offers: keys of `info` beyond the first three that the topics can give.
        privileged: those that `info` shall have, once `listen` was called.
        steps, seconds: decisions, and the time spent on driving them.

    Raises:
        UserError: topics that are missing, or something on them that does not fit.
    """

    def __init__(self, robot: RobotSpec, size: int, *, namespaces: Sequence[str] = ('',),
                 lock_step: bool = False, max_decisions: int = 300,
                 collision_reward: float = 0.0, record: Path | None = None,
                 ros_arguments: Sequence[str] = ()):
        self.robot, self.num_envs = robot, len(namespaces)
        self.action_names = robot.action_names
        self.goals = np.zeros((MAX_GOALS, 3, size, size), np.uint8)
        self._numbers: dict[bytes, int] = {}  # of goals, by their bytes
        self.privileged: tuple[str, ...] = ()
        self._collision_reward = collision_reward
        self.steps, self.seconds = 0, 0.0
        n = self.num_envs
        self._done = np.zeros(n, bool)
        self._goal_index = np.zeros(n, np.int64)
        self._last_action = np.full(n, -1, np.int64)
        self._last_reward = np.zeros(n, np.float32)
        self._ended = Ended()
        self._closing = False
        self._context = Context()
        self._robots: list[RosRobot] = []
        self._thread: threading.Thread | None = None
        try:
            self._start(namespaces, ros_arguments, record, {
                'robot': robot, 'size': size, 'lock_step': lock_step,
                'max_decisions': max_decisions, 'ended': self._ended})
        except BaseException:
            self.close()
            raise
        present = set.intersection(*(one.offers() for one in self._robots))
        # In lock-step nobody sees the place of an arrival: the robot is put elsewhere at once.
        self.offers = tuple(sorted(present | (set() if lock_step else {'arrived'})))

    def _start(self, namespaces: Sequence[str], arguments: Sequence[str], record: Path | None,
               settings: dict) -> None:
        options = ['--ros-args', *arguments] if arguments else []
        try:
            # rclpy's own handlers would close the context before the last zero is out.
            rclpy.init(args=options, context=self._context,
                       signal_handler_options=SignalHandlerOptions.NO)
            self._executor = SingleThreadedExecutor(context=self._context)
            for name in namespaces:
                bag = record if record is None or len(namespaces) == 1 else record / name
                self._robots.append(RosRobot(self._context, name, bag=bag, **settings))
                self._executor.add_node(self._robots[-1])
        except (RuntimeError, ValueError, ParameterException) as error:  # refused options
            raise UserError(
                'namespaces and --ros-args follow the ROS syntax',
                ' '.join([*namespaces, *options]), str(error).splitlines()[0]) from error
        self._thread = threading.Thread(target=self._spin, name='executor', daemon=True)
        self._thread.start()
        for one in self._robots:
            one.connect()

    restorable = False  # a robot is not put back

    def __enter__(self) -> RosEnv:
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Zero first, delivered; then everything else."""
        for one in self._robots:
            one.halt()
        self._closing = True
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        for one in self._robots:
            one.destroy_node()
        self._robots = []
        rclpy.try_shutdown(context=self._context)
        self._ended.restore()

    @property
    def scene(self) -> dict:
        """What the first robot's simulator says of its scene; empty: there is none."""
        return self._robots[0].scene

    @property
    def simulator_name(self) -> str:
        """Of the simulator behind the topics, as `vn_nav.scenes` names it; ROBOT: there is none.

        Bridges of earlier versions simulated houses alone, and did not say so.
        """
        names = {one.scene.get('simulator', HOUSE if 'house' in one.scene else ROBOT)
                 for one in self._robots}
        return names.pop() if len(names) == 1 else ROBOT

    @property
    def label_names(self) -> tuple[str, ...]:
        """Behind the class ids of all robots' labels; empty: nobody says, or they differ."""
        said = {one.label_names for one in self._robots}
        return said.pop() if len(said) == 1 else ()

    @property
    def scene_names(self) -> list[str]:
        """Of the first robot's scene; empty: nobody says."""
        scene = self.scene
        if isinstance(scene.get('scene'), str):
            return [scene['scene']]
        return [house_scene(scene['house'], scene.get('rooms'))] if 'house' in scene else []

    @property
    def world_version(self) -> str:
        """Of the simulators; `RECORDED` for robots, or for several worlds."""
        worlds = {str(one.scene.get('world_version', RECORDED)) for one in self._robots}
        return worlds.pop() if len(worlds) == 1 else RECORDED

    @property
    def shown_goals(self) -> np.ndarray:
        """The goal pictures seen so far [G,3,S,S]: a training saves them."""
        return self.goals[:len(self._numbers)]

    def recall_goals(self, pictures: np.ndarray) -> None:
        """Number goals as an earlier training did; before `reset`."""
        self._numbers.clear()
        for picture in pictures:
            self._number(picture)

    def listen(self, privileged: Sequence[str]) -> None:
        """Have these of `offers` in `info`."""
        self.privileged = tuple(privileged)
        for one in self._robots:
            one.listen(tuple(key for key in privileged if key in MAP_TOPICS))

    def set_difficulty(self, tau: float) -> None:
        """Do nothing: where a robot starts is not for its policy's trainer to say."""

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin episodes where the robots stand; a seed has no meaning there.

        Raises:
            UserError: a `reset_mask`: robots begin together.
        """
        if 'reset_mask' in read_options(options, ('reset_mask',)):
            raise UserError('robots over ROS begin their episodes together', 'a reset_mask',
                            'reset without it')
        seen = [self._begin(n) for n in range(self.num_envs)]
        none = np.zeros(self.num_envs, bool)
        self._done[:] = False
        return self._observe(seen), self._info(seen, ~none, none, none, none)

    def step(self, actions):
        """One decision of every robot whose episode goes on; the others begin the next one."""
        begun, reset = time.monotonic(), self._done.copy()
        for one, action, resets in zip(self._robots, actions, reset, strict=True):
            if not resets:
                one.drive(int(action))
        n = self.num_envs
        reward = np.zeros(n, np.float32)
        success, collided, arrived, terminated, truncated = (np.zeros(n, bool) for _ in range(5))
        seen: list[Seen] = []
        for k, one in enumerate(self._robots):
            if reset[k]:
                seen.append(self._begin(k))
                continue
            outcome = one.finish()
            seen.append(outcome.seen)
            reward[k] = outcome.reward + self._collision_reward * outcome.collided
            self._last_action[k], self._last_reward[k] = actions[k], outcome.reward
            success[k], collided[k] = outcome.success, outcome.collided
            terminated[k], truncated[k] = outcome.terminated, outcome.truncated
            arrived[k] = outcome.success and not outcome.stale
        self._done = terminated | truncated
        self.steps += int((~reset).sum())
        self.seconds += time.monotonic() - begun
        return (self._observe(seen), reward, terminated, truncated,
                self._info(seen, reset, success, collided, arrived))

    def _begin(self, k: int) -> Seen:
        seen, goal = self._robots[k].begin(), self._robots[k].goal
        assert goal is not None  # no episode begins without
        self._goal_index[k] = self._number(goal)
        self._last_action[k], self._last_reward[k] = -1, 0.0
        return seen

    def _number(self, picture: np.ndarray) -> int:
        """Place of a goal picture in the table."""
        number = self._numbers.setdefault(picture.tobytes(), len(self._numbers))
        if number == MAX_GOALS:
            raise EnvironmentLost(f'a training has at most {MAX_GOALS} different goal pictures',
                                  'one more', 'go on with a new training: --init')
        self.goals[number] = picture
        return number

    def _observe(self, seen: list[Seen]) -> dict[str, np.ndarray]:
        poses = [one.odometry for one in seen if one.odometry is not None]
        odometry = {'odometry': np.stack(poses)} if len(poses) == len(seen) else {}
        return {'image': np.stack([one.picture for one in seen]),
                'goal_index': self._goal_index.copy(), 'last_action': self._last_action.copy(),
                'last_reward': self._last_reward.copy(), **odometry}

    def _info(self, seen: list[Seen], reset, success, collided, arrived) -> dict[str, np.ndarray]:
        maps = {key: np.stack([one.maps[key] for one in seen]) for key in self.privileged
                if key in MAP_TOPICS}
        if 'segmentation' in maps:
            maps['segmentation'] = self._as_classes(maps['segmentation'])
        return {'reset': reset, 'success': success, 'collided': collided, 'arrived': arrived,
                **maps}

    def _as_classes(self, labels: np.ndarray) -> np.ndarray:
        """Labels in the type that their classes need."""
        count = max(CLASSES, len(self.label_names))
        if labels.max(initial=0) >= count:
            raise EnvironmentLost(f'labels/image_raw shows classes below {count}: as many as '
                                  f'labels/names names, or {CLASSES}', int(labels.max()),
                                  'publish labels/names, or set segmentation=0 (--set NAME=VALUE)')
        return labels.astype(label_dtype(len(self.label_names)))

    def _spin(self) -> None:
        """Serve all robots; a callback that fails stops them."""
        try:
            while not self._closing:
                self._executor.spin_once(timeout_sec=0.1)
        except Exception as error:  # whatever it was: zero first
            for one in self._robots:
                one.fail(f'a callback failed: {error!r}')
