"""`policy_node`: camera and goal picture in, Twist out. A lifecycle node.

Threads: the executor keeps the newest frame; one worker decodes and infers
(`vn_nav.nodes.decision_worker`); one output thread alone owns the command publisher, the watchdog
and the ramps (`vn_nav.nodes.command_output`).

Run: `ros2 run vn_nav policy_node --ros-args -p checkpoint:=models/house`.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from vn_nav.errors import UserError
from vn_nav.measured_ranges import RangeSource
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.camera_pictures import pictures_of
from vn_nav.nodes.command_output import LOCK_STEP_SILENCE_S, TOPIC, CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.policy_inputs import PolicyInputs
from vn_nav.nodes.policy_operation import Operation
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.range_input import RangeInput
from vn_nav.nodes.tilt_output import TiltOutput
from vn_nav.nodes.work_threads import WorkThreads
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_record import GoalLimits
from vn_nav.policy.navigator import Limits, Navigator
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec, load_robot

# The watchdog's limits in a shadow: nothing moves, and a busy machine may take its time.
SHADOW_LIMIT_S = 30.0
DECISION_END_TIMEOUT_S = 5.0  # for a decision under way when the node ends
LAST_TURNS = 50  # of the executor, to send what a goal ended with when the process ends


class PolicyNode(LifecycleNode):
    """See the module's docstring; what it does in which state is `vn_nav.policy.navigator`."""

    navigator: Navigator  # from on_configure on, as the interfaces are

    def __init__(self):
        super().__init__('policy_node')
        policy_parameters.declare(self)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._wake = threading.Condition()  # guards everything below, and wakes both threads
        self._threads: WorkThreads | None = None  # of the newest activation
        self._interfaces: list = []
        self.broken = ''  # why the node went inactive by itself
        self.failure: UserError | None = None
        self.starts = False  # `drive` brings it up, and says itself why that fails

    def _on_parameters(self, parameters) -> SetParametersResult:
        """Operation is read when the node is configured; what comes later would do nothing."""
        for parameter in parameters:
            if parameter.name in policy_parameters.PARAMETERS and self._interfaces:
                return SetParametersResult(successful=False, reason=(
                    f'{parameter.name} is fixed while the node is configured; received '
                    f'{shorten(repr(parameter.value))}; deactivate and clean up first'))
            try:
                if parameter.name in policy_parameters.PARAMETERS:
                    policy_parameters.check(parameter.name, parameter.value)
            except UserError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # Lifecycle.

    def on_configure(self, _state) -> TransitionCallbackReturn:
        """Load robot and checkpoint; nothing is published when that fails."""
        try:
            self._configure()
        except UserError as error:
            self._fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would turn it into an ERROR without a word
            self._let_go()
            self._fail(UserError('policy_node can be configured', shorten(repr(error)),
                                 'report it, with checkpoint and robot file'))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _fail(self, error: UserError) -> None:
        """Say why a transition failed: once. With autostart `main` says it and exits."""
        self.failure = error
        if not self.starts:
            self.get_logger().error(str(error))

    def _configure(self) -> None:
        value = policy_parameters.read(self)
        self.lock_step = value['time'] == 'lock_step'
        self.auto_enable = value['auto_enable']
        source = RangeSource(value['scan_topic'], value['depth_topic'],
                             (value['scan_x'], value['scan_y'], value['scan_yaw']))
        source.check()
        robot = load_robot(value['robot']) if value['robot'] else RobotSpec()
        threshold = value['stop_threshold']
        runtime = PolicyRuntime(value['checkpoint'] or share_file('models/house'),
                                seed=value['seed'], decoding=value['decoding'] or None,
                                stop_threshold=None if threshold < 0 else threshold,
                                verify=value['verify'], camera_pitch=robot.camera_pitch,
                                keep_map=value['keep_map'])
        robot = robot.with_actions(runtime.action_names, runtime.moves)
        runtime.forbid(robot.impossible)
        source.check_policy(searches=runtime.search is not None)
        shadow = value['mode'] == 'shadow'
        if self.lock_step:
            limit = SHADOW_LIMIT_S if shadow else policy_parameters.LOCK_STEP_LIMIT_S
            limits = Limits(frame_timeout=limit, frame_stop_timeout=limit,
                            inference_timeout=limit, odometry_timeout=limit, settle_time=0.0)
        else:
            limits = Limits(**{name: value[name] for name in Limits.__dataclass_fields__})
        self.navigator = Navigator(
            robot, limits, continuous=value['mode'] != 'stop_and_go', exact=self.lock_step,
            goal_limits=GoalLimits(
                value['goal_decisions'], value['goal_timeout'], value['progress_decisions'],
                value['progress_radius'], value['blocked_moves']))
        period = 1.0 / value['control_rate']
        self._tilt = TiltOutput(self, value['tilt_topic'], period, robot.camera_pitch) if (
            value['tilt_topic'] and not shadow) else None
        self._output = CommandOutput(
            self, self.navigator, self._wake, period=period, tilt=self._tilt,
            lock_step=self.lock_step, stamped=value['enable_stamped_cmd_vel'],
            # In a shadow nothing waits for commands: each answers odometry or a decision.
            name=f'shadow/{TOPIC}' if shadow else TOPIC,
            patience=None if shadow else LOCK_STEP_SILENCE_S)
        self._ranges = RangeInput(self, self.navigator, self._output, self._wake, source,
                                  robot) if source else None
        compressed = value['image_transport'] == 'compressed'
        self._worker = DecisionWorker(
            self, self.navigator, runtime, pictures_of(self, runtime, value), self._output,
            self._wake, lock_step=self.lock_step, shadow=shadow, ranges=self._ranges)
        self._require_odometry, self._shadow = value['require_odometry'], shadow
        self._inputs = PolicyInputs(self, self.navigator, self._worker, self._output, self._wake,
                                    compressed=compressed, lock_step=self.lock_step,
                                    shadow=shadow, ranges=self._ranges)
        self._make_interfaces()
        # Only now: a configuration that fails says one line, which is why.
        self.get_logger().info(f'computed by {runtime.engine}')
        if robot.impossible:
            names = ', '.join(robot.action_names[k] for k in robot.impossible)
            self.get_logger().info(f'{robot.name} is a differential base: never {names}')

    def _make_interfaces(self) -> None:
        self._operation = Operation(
            self, self.navigator, self._worker, self._output, self._inputs, self._wake,
            self._steady, lock_step=self.lock_step, auto_enable=self.auto_enable,
            require_odometry=self._require_odometry, takes_goals=not self._shadow)
        self._interfaces = [
            *((self.destroy_subscription, subscription)
              for subscription in (*self._inputs.subscriptions,
                                   *(self._ranges.subscriptions if self._ranges else ()))),
            *((self.destroy_publisher, publisher) for publisher in (
                self._output.publisher, *self._worker.publishers,
                *((self._tilt.publisher,) if self._tilt else ()))),
        ]

    def on_activate(self, state) -> TransitionCallbackReturn:
        """Start looking; motion needs ~/enable."""
        others = self._operation.other_publishers()
        if others:
            self._fail(UserError(
                'this node alone publishes its command topic', f'{others} more publisher(s) on '
                'cmd_vel', 'remap one of them (twist_mux combines them)'))
            return TransitionCallbackReturn.FAILURE
        if not self.has_clock():
            self._fail(UserError('with use_sim_time the node has a time', 'no message on /clock',
                                 'start the simulator, or set use_sim_time to false'))
            return TransitionCallbackReturn.FAILURE
        self.broken = ''
        self._threads = WorkThreads({'inference': self._worker.run, 'output': self._output.run},
                                    self._on_failed_thread)
        self._threads.start()
        self._say_what_it_waits_for()
        return super().on_activate(state)

    def _say_what_it_waits_for(self) -> None:
        """What somebody at a silent robot wants to know."""
        pictures, goal, odometry = self._inputs.awaited
        enable = '' if self.auto_enable else (
            f', then for `ros2 service call {self.get_fully_qualified_name()}/enable '
            'std_srvs/srv/SetBool "{data: true}"`')
        self.get_logger().info(f'active: waits for pictures on {pictures}, a goal picture on '
                               f'{goal}, odometry on {odometry}{enable}')

    def on_deactivate(self, state) -> TransitionCallbackReturn:
        """Zero first, then silence."""
        ended = self.halt('deactivated')
        with self._wake:
            self.navigator.reset()
            self._worker.publish_arrival()
        self._operation.diagnose()
        done = super().on_deactivate(state)
        return done if ended else TransitionCallbackReturn.ERROR

    def on_cleanup(self, _state) -> TransitionCallbackReturn:
        """Let go of everything that on_configure made."""
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state) -> TransitionCallbackReturn:
        """As deactivation and cleanup, from any state."""
        self.halt('shut down')
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, _state) -> TransitionCallbackReturn:
        """Back to unconfigured, with nothing left of what was configured."""
        self.halt('a transition failed')
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    def _let_go(self) -> None:
        interfaces, self._interfaces = self._interfaces, []
        if interfaces:
            self._operation.end()
        for destroy, interface in interfaces:
            destroy(interface)

    @property
    def is_running(self) -> bool:
        """Active: both threads are at work."""
        return self._threads is not None and self._threads.is_running()

    def has_clock(self) -> bool:
        """With use_sim_time: a /clock has come. In lock-step odometry is the clock."""
        return (self.lock_step or not self.get_parameter('use_sim_time').value
                or self.get_clock().now().nanoseconds > 0)

    def close(self) -> None:
        """Stand still."""
        self.halt('the process ends')

    def destroy_node(self) -> None:
        """Zero first, then everything else."""
        self.close()
        super().destroy_node()

    def halt(self, reason: str) -> bool:
        """End both threads. The zero comes first: a decision under way is not waited for.

        Returns:
            True; False when the decision under way did not end within `DECISION_END_TIMEOUT_S`.
        """
        with self._wake:
            threads = self._threads
            if threads is None or not threads.is_running():
                return True
            self.navigator.stop(reason, time.monotonic())
            threads.end()
            self._wake.notify_all()
        threads.join('output')  # it waits for nothing but `wake`
        self._output.deliver_zero()  # the output thread is gone: still only one owner
        self._worker.publish_last()
        with self._wake:
            self._operation.halt(reason)
        ended = threads.join('inference', DECISION_END_TIMEOUT_S)
        if not ended:
            self.get_logger().error(f'a decision did not end within {DECISION_END_TIMEOUT_S:g} s')
        return ended

    def _on_failed_thread(self, threads: WorkThreads, name: str, error: Exception) -> None:
        """A failing thread stops the robot; `tend` then takes the node out of action."""
        if threads is not self._threads or not threads.is_running():
            return  # of an activation that has ended, with its zero delivered
        with self._wake:
            self.broken = shorten(f'the {name} thread failed: {error!r}')
            self.navigator.stop(self.broken, time.monotonic())
            self._wake.notify_all()
        if name == 'output':  # else that thread repeats the zero
            self._output.deliver_zero()

    def tend(self) -> None:
        """A thread that failed takes the node out of action: for the loop that serves the node."""
        if self.broken and self.is_running:
            self.get_logger().error(f'{self.broken}; going inactive: activate it again')
            self.trigger_deactivate()


def drive(node: PolicyNode, ended: Ended) -> None:
    """Bring the node up and serve it; a callback or thread that fails takes it out of action."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    if node.get_parameter('autostart').value:
        _transit(node, node.trigger_configure)
        if not node.has_clock():
            node.get_logger().info('waits for /clock (use_sim_time is set)')
        while not node.has_clock() and not ended.is_set():
            executor.spin_once(timeout_sec=0.05)
        if not ended.is_set():
            _transit(node, node.trigger_activate)
    else:
        name = node.get_fully_qualified_name()
        node.get_logger().info(f'not configured: waits for `ros2 lifecycle set {name} configure`, '
                               'then activate')
    while not ended.is_set():
        try:
            executor.spin_once(timeout_sec=0.05)
            node.tend()
        except ExternalShutdownException:
            raise
        except Exception as error:  # stand still, go inactive, say so
            node.broken = shorten(f'a callback failed: {error!r}')
            node.get_logger().error(f'{node.broken}; going inactive: activate it again')
            if node.is_running:
                node.trigger_deactivate()
    node.close()
    for _ in range(LAST_TURNS):
        with contextlib.suppress(Exception):  # nothing that fails now is of use to anyone
            executor.spin_once(timeout_sec=0.0)


def _transit(node: PolicyNode, transition) -> None:
    node.starts = True
    done = transition()
    node.starts = False
    if done != TransitionCallbackReturn.SUCCESS:
        raise node.failure or UserError(f'{transition.__name__} succeeds', 'an error, see above',
                                        'report it')


def main(args=None) -> int:
    """Entry point: 0 after a signal, 2 and one line on standard error for bad input."""
    return run_node('policy_node', lambda _: PolicyNode(), drive, args, about=__doc__,
                    parameters=policy_parameters.PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
