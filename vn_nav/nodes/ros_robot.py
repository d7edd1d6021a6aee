"""One robot behind topics, driven a decision at a time: what training over ROS consists of.

Threads: the executor decodes what comes in; the output thread (`vn_nav.nodes.command_output`)
alone publishes commands, and zero whenever no decision is being driven; whoever trains waits in
`drive`, `finish` and `begin`. What stops the robot is `vn_nav.policy.navigator`'s matter, as in
policy_node; but nobody has to enable it again: it goes on by itself when the cause is gone.
"""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import Int8, String
from std_srvs.srv import Trigger

from vn_nav.errors import UserError
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.process import Ended
from vn_nav.nodes.qos import qos
from vn_nav.nodes.recorded_topics import RecordedTopics
from vn_nav.nodes.robot_readiness import Readiness
from vn_nav.nodes.robot_senses import Seen, Senses, Tally
from vn_nav.nodes.work_threads import WorkThreads
from vn_nav.observation import crop_fraction
from vn_nav.policy.navigator import ENABLED, Limits, Navigator
from vn_nav.robot import RobotSpec

NAME = 'training_node'
PARAMETERS = ('image_transport', 'enable_stamped_cmd_vel', 'control_rate', 'frame_timeout',
              'frame_stop_timeout', 'max_frame_age', 'max_frame_ahead', 'odometry_timeout',
              'settle_time')
PATIENCE_S = 120.0  # default of the parameter `patience`
JUDGE_TIMEOUT_S = 2.0  # that the end of a decision in lock-step waits for its judge
GRAPH_PERIOD_S = 0.25  # between looks for other publishers
TERMINATED, TRUNCATED = 1, 2  # on `episode_end`


class Outcome(NamedTuple):
    """What came of a decision."""

    seen: Seen
    reward: float  # of the task
    success: bool
    collided: bool
    terminated: bool
    truncated: bool
    # What is seen is from before the decision: the robot has been put elsewhere meanwhile.
    stale: bool


class RosRobot(Node):
    """A robot that a training drives.

    Args:
        context: of rclpy.
        namespace: of the topics; empty: none.
        robot: with the actions of the policy, in its order.
        size: side of the pictures [pixels].
        lock_step: answer every odometry message (`vn_sim_bridge` with time:=lock_step).
        max_decisions: of an episode, where nobody publishes `episode_end`.
        ended: a signal has come.
        bag: folder to record into; None: nowhere.
    """

    def __init__(self, context: Context, namespace: str, robot: RobotSpec, size: int, *,
                 lock_step: bool, max_decisions: int, ended: Ended, bag: Path | None):
        super().__init__(NAME, namespace=namespace or None, context=context)
        policy_parameters.declare(self, PARAMETERS, others=None)
        patience = self.declare_parameter('patience', PATIENCE_S, ParameterDescriptor(
            description='without a picture, a goal or leave to move a training ends after [s]',
            floating_point_range=[FloatingPointRange(from_value=1.0, to_value=1e6)])).value
        value = policy_parameters.read(self, PARAMETERS)
        self.robot, self.size, self.lock_step = robot, size, lock_step
        self.max_decisions = max_decisions
        self.wake = threading.Condition()  # guards everything below, and wakes all threads
        limit = policy_parameters.LOCK_STEP_LIMIT_S
        limits = (Limits(limit, limit, odometry_timeout=limit, settle_time=0.0) if lock_step else
                  Limits(**{name: value[name] for name in Limits.__dataclass_fields__
                            if name in value}))
        self.navigator = Navigator(robot, limits, exact=lock_step)
        self.output = CommandOutput(
            self, self.navigator, self.wake, period=1.0 / value['control_rate'],
            lock_step=lock_step, stamped=value['enable_stamped_cmd_vel'])
        self._topics = RecordedTopics(self, bag)
        self._senses = Senses(
            self, self._topics, self.navigator, self.output, self.wake, robot, size,
            lock_step=lock_step, compressed=value['image_transport'] == 'compressed')
        self._threads: WorkThreads | None = None
        self._shown: Seen | None = None
        self._episode_goal = 0  # number of the goal that the episode began with
        self._awaits_goal = False
        self._decisions = self._cut_before = 0
        self._readiness = Readiness(self, self.navigator, self.output, self.wake, ended, patience,
                                    lambda: self._running)
        self._make_interfaces()

    def _make_interfaces(self) -> None:
        self._action, names = (self.create_publisher(kind, name, qos(name)) for kind, name in (
            (Int8, 'action'), (String, 'action_names')))
        self._topics.publish(names, 'action_names',
                             String(data=json.dumps(self.robot.action_names)))
        self._topics.record_own(self.output.publisher, 'cmd_vel')
        self.create_service(Trigger, '~/stop', self._on_stop)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_timer(GRAPH_PERIOD_S, self._watch,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def listen(self, keys: tuple[str, ...]) -> None:
        """Have the maps of these keys of `MAP_TOPICS` with every picture."""
        self._senses.listen(keys)

    def offers(self) -> set[str]:
        """The keys of `MAP_TOPICS` that somebody publishes."""
        return self._senses.offers()

    @property
    def goal(self) -> np.ndarray | None:
        """The goal picture in force [3,S,S]."""
        return self._senses.goal

    @property
    def scene(self) -> dict:
        """What a simulator says of itself; empty: nobody does."""
        return self._senses.scene

    @property
    def label_names(self) -> tuple[str, ...]:
        """Behind the class ids of labels; empty: nobody says."""
        return self._senses.label_names

    def _on_stop(self, _request, response):
        with self.wake:
            self._readiness.held = True
            self.navigator.stop('~/stop was called', time.monotonic())
            self.wake.notify_all()
        response.success, response.message = True, 'stopped: ~/reset to go on'
        return response

    def _on_reset(self, _request, response):
        with self.wake:
            self._readiness.held = False
        response.success, response.message = True, 'the training goes on'
        return response

    def _watch(self) -> None:
        """Four times a second: intruders on the command topic."""
        if others := self._readiness.other_publishers():
            with self.wake:
                if self.navigator.state in ENABLED:
                    self.navigator.stop(f'{others} other publisher(s) on cmd_vel',
                                        time.monotonic())
                    self.wake.notify_all()

    # What is asked of it, in turn: begin, then drive and finish until the episode ends.

    def connect(self) -> None:
        """Wait for camera, odometry, goal and base, then publish commands: zero, for now.

        Raises:
            UserError: one of them is missing, another node publishes commands, or the camera sees
                less than the robot's.
        """
        if others := self._readiness.other_publishers():
            raise UserError('this node alone publishes its command topic', f'{others} more '
                            f'publisher(s) on {self.output.publisher.topic_name}',
                            'end the other node, or remap one of them')
        self._readiness.wait_until(lambda: not self._missing(),
                                   lambda: f'waits for {", ".join(self._missing())}')
        if self._senses.camera is not None:
            crop_fraction(self._senses.camera.fov, self.robot.camera_fov)
        self._threads = WorkThreads({'output': self.output.run}, self._on_failed_thread).start()

    def _missing(self) -> list[str]:
        found = (('image_raw', self._senses.frame is not None),
                 ('odom', self.output.odometry is not None),
                 ('goal_image', self.goal is not None),
                 (f'somebody {self._readiness.listener_kind()}', self._readiness.listeners()),
                 ('scene', self.scene or not self.count_publishers('scene')),
                 ('labels/names', self.label_names or not self.count_publishers('labels/names')))
        return [name for name, there in found if not there]

    def begin(self) -> Seen:
        """Begin an episode: what the robot sees, once there is a goal and it may move."""
        def lacks_goal() -> bool:
            return self._awaits_goal and self._senses.goals == self._episode_goal
        self._readiness.wait_until(
            lambda: not lacks_goal() and self._senses.sees(),
            lambda: 'waits for the next picture on goal_image' if lacks_goal() else '')
        with self.wake:
            self._senses.tally = Tally()
            self._episode_goal, self._awaits_goal, self._decisions = self._senses.goals, False, 0
            self._shown = self._senses.look(begins=True)
        return self._shown

    def drive(self, action: int) -> None:
        """Begin an action as soon as the robot may move."""
        def taken() -> bool:
            now = time.monotonic()
            if self._senses.frame is None or (
                    ticket := self.navigator.request(self._senses.frame[0], now)) is None:
                return False
            self.navigator.decided(ticket, action, now)
            self._cut_before = self.navigator.cut_off
            return True
        self._readiness.wait_until(taken)
        with self.wake:
            self.wake.notify_all()
        self._decisions += 1
        self._topics.publish(self._action, 'action', Int8(data=action))

    def finish(self) -> Outcome:
        """Wait until the motion is over and seen: what came of it."""
        at_rest = None

        def over() -> bool:
            nonlocal at_rest
            if not self._senses.sees():
                return False
            at_rest = at_rest or time.monotonic()
            # In lock-step a judge speaks before the picture; one that lost its word is not
            # waited for.
            return (not self.lock_step or self._senses.tally.judged
                    or time.monotonic() - at_rest > JUDGE_TIMEOUT_S)
        self._readiness.wait_until(over)
        with self.wake:
            tally, self._senses.tally = self._senses.tally, Tally()
            elsewhere = self._senses.goals != self._episode_goal
            cut = self.navigator.cut_off != self._cut_before
            seen = self._shown if elsewhere else self._senses.look()
        assert seen is not None  # the decision was made at a picture
        success = tally.reward > 0 or tally.arrived
        terminated = success or tally.end == TERMINATED
        limit = self._decisions >= self.max_decisions and not self.count_publishers('episode_end')
        truncated = not terminated and (tally.end == TRUNCATED or elsewhere or cut or limit)
        self._awaits_goal = terminated or tally.end == TRUNCATED
        self._shown = seen
        return Outcome(seen, tally.reward or float(tally.arrived), success, tally.collided,
                       terminated, truncated, stale=elsewhere)

    def halt(self) -> None:
        """End the output thread with a zero command that has been delivered; end the bag."""
        with self.wake:
            threads = self._threads if self._running else None
            if threads is not None:
                threads.end()
            self.navigator.stop('the training ends', time.monotonic())
            self.wake.notify_all()
        if threads is not None:
            threads.join('output')  # it waits for nothing but `wake`
            self.output.deliver_zero()  # the output thread is gone: still only one owner
        self._topics.close()

    def fail(self, reason: str) -> None:
        """Something broke that nobody expected: zero, and no more training."""
        self._readiness.fail(reason)

    @property
    def _running(self) -> bool:
        return self._threads is not None and self._threads.is_running()

    def _on_failed_thread(self, _threads: WorkThreads, name: str, error: Exception) -> None:
        self.fail(f'the {name} thread failed: {error!r}')
        self.output.deliver_zero()
