"""`policy_node`: camera and goal picture in, Twist out. A lifecycle node.

Threads: the executor keeps the newest frame; one worker decodes and infers
(`vn_nav.nodes.decision_worker`); one output thread alone owns the command publisher, the watchdog
and the ramps (`vn_nav.nodes.command_output`).

Run: `ros2 run vn_nav policy_node --ros-args -p checkpoint:=models/house`.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from std_srvs.srv import SetBool, Trigger

from vn_nav.errors import UserError
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.command_output import PATIENCE, TOPIC, CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.diagnosis import Diagnosis
from vn_nav.nodes.policy_inputs import PolicyInputs
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.work_threads import WorkThreads
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.navigator import ENABLED, Limits, Navigator, State
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec, load_robot

LOCK_STEP_LIMIT = 2.0  # s of wall time: the watchdog's limits in lock-step
SHADOW_LIMIT = 30.0  # s, the same in a shadow: nothing moves, and a busy machine may take its time
WARNINGS_PERIOD = 0.9  # s: to look at the graph takes a while
WORKER_PATIENCE = 5.0  # s that a decision under way is waited for when the node ends


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
        robot = load_robot(value['robot']) if value['robot'] else RobotSpec()
        threshold = value['stop_threshold']
        runtime = PolicyRuntime(value['checkpoint'] or share_file('models/house'),
                                seed=value['seed'], decoding=value['decoding'] or None,
                                stop_threshold=None if threshold < 0 else threshold)
        robot = robot.with_actions(runtime.action_names, runtime.moves)
        shadow = value['mode'] == 'shadow'
        if self.lock_step:
            limit = SHADOW_LIMIT if shadow else LOCK_STEP_LIMIT
            limits = Limits(frame_timeout=limit, frame_stop_timeout=limit,
                            inference_timeout=limit, odometry_timeout=limit, settle_time=0.0)
        else:
            limits = Limits(**{name: value[name] for name in Limits.__dataclass_fields__})
        self.navigator = Navigator(robot, limits, continuous=value['mode'] != 'stop_and_go',
                                   exact=self.lock_step)
        self._output = CommandOutput(
            self, self.navigator, self._wake, period=1.0 / value['control_rate'],
            lock_step=self.lock_step, stamped=value['enable_stamped_cmd_vel'],
            # In a shadow nothing waits for commands: each answers odometry or a decision.
            name=f'shadow/{TOPIC}' if shadow else TOPIC, patience=None if shadow else PATIENCE)
        self._worker = DecisionWorker(self, self.navigator, runtime, self._wake,
                                      lock_step=self.lock_step, shadow=shadow)
        self._require_odometry = value['require_odometry']
        self._warnings: list[str] = []
        self._warned_at = 0.0  # steady time [s]
        self._inputs = PolicyInputs(self, self.navigator, self._worker, self._output, self._wake,
                                    compressed=value['image_transport'] == 'compressed',
                                    lock_step=self.lock_step, shadow=shadow)
        self._make_interfaces()

    def _make_interfaces(self) -> None:
        self._diagnosis = Diagnosis(self, self._output.publisher, self.navigator.robot.name)
        self._interfaces = [
            *((self.destroy_subscription, subscription)
              for subscription in self._inputs.subscriptions),
            (self.destroy_service, self.create_service(SetBool, '~/enable', self._on_enable)),
            (self.destroy_service, self.create_service(Trigger, '~/stop', self._on_stop)),
            (self.destroy_service, self.create_service(Trigger, '~/reset', self._on_reset)),
            (self.destroy_timer, self.create_timer(0.25, self._on_timer, clock=self._steady)),
            *((self.destroy_publisher, publisher) for publisher in (
                self._output.publisher, *self._worker.publishers, self._diagnosis.publisher)),
        ]

    def on_activate(self, state) -> TransitionCallbackReturn:
        """Start looking; motion needs ~/enable."""
        others = self._other_publishers()
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
            self._worker.tell_arrival()
        self._diagnose()
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

    def destroy_node(self) -> None:
        """Zero first, then everything else."""
        self.halt('the process ends')
        super().destroy_node()

    def halt(self, reason: str) -> bool:
        """End both threads. The zero comes first: a decision under way is not waited for.

        Returns:
            True; False when the decision under way did not end within `WORKER_PATIENCE`.
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
        ended = threads.join('inference', WORKER_PATIENCE)
        if not ended:
            self.get_logger().error(f'a decision did not end within {WORKER_PATIENCE:g} s')
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

    # Services.

    def _on_enable(self, request, response):
        with self._wake:
            if request.data:
                response.success, response.message = self._enable()
            else:
                self.navigator.disable()
                response.success, response.message = True, 'disabled'
            self._worker.tell_arrival()
            self._wake.notify_all()
        self._diagnose()
        return response

    def _enable(self) -> tuple[bool, str]:
        blockers = []
        if not self.is_running:
            blockers.append('the node is not active: activate it first'
                            + (f' (it went inactive: {self.broken})' if self.broken else ''))
        if not self.has_clock():
            blockers.append('use_sim_time is set and nothing has come on /clock: start the '
                            'simulator, or set use_sim_time to false')
        blockers += self._inputs.unheard()
        if self._output.odometry is None:
            if self.lock_step:
                blockers.append('no odometry: lock_step answers each message on odom')
            elif self._require_odometry:
                blockers.append(f'no odometry has come on {self._inputs.odometry_topic} '
                                '(require_odometry is set)')
        elif self._output.odometry_lost:
            blockers.append(f'odometry is silent: check {self._inputs.odometry_topic}')
        if others := self._other_publishers():
            blockers.append(f'{others} other publisher(s) on cmd_vel: remap one')
        try:
            self._worker.check_fov()
        except UserError as error:
            blockers.append(str(error))
        return self.navigator.enable(time.monotonic(), tuple(blockers))

    def _on_stop(self, _request, response):
        with self._wake:
            self.navigator.stop('~/stop was called', time.monotonic())
            self._worker.tell_arrival()
            self._wake.notify_all()
        response.success, response.message = True, 'stopped: ~/reset, then ~/enable to go on'
        return response

    def _on_reset(self, _request, response):
        with self._wake:
            self.navigator.reset()
            self._worker.tell_arrival()
            self._wake.notify_all()
        response.success, response.message = True, 'ready: ~/enable to go on'
        return response

    def _on_timer(self) -> None:
        """Four times a second: intruders on the command topic, self-enabling, diagnostics."""
        with self._wake:
            if self.is_running:
                others = self._other_publishers()
                if others and self.navigator.state in ENABLED:
                    self.navigator.stop(f'{others} other publisher(s) on cmd_vel',
                                        time.monotonic())
                elif self.auto_enable and self.navigator.state is State.IDLE:
                    self._enable()
                self._worker.tell_arrival()
                self._wake.notify_all()
        self._diagnose()

    def _other_publishers(self) -> int:
        return max(0, self.count_publishers(self._output.publisher.topic_name) - 1)

    def _diagnose(self) -> None:
        """Publish the state once a second, and at once when it changes."""
        if not self._interfaces:
            return
        if time.monotonic() - self._warned_at > WARNINGS_PERIOD:
            self._warned_at = time.monotonic()
            self._warnings = self._inputs.warnings()
            if self.get_parameter('use_sim_time').value and (
                    self.count_publishers(self.resolve_topic_name('/clock')) > 1):
                self._warnings.append('/clock has several publishers: time will jump; keep one')
        with self._wake:
            state, reason = self.navigator.state, self.navigator.reason
            if state is State.IDLE and not self.is_running:
                reason = 'the node is not active'
            fov, gate = self._worker.camera_fov, self.navigator.gate
            values = {'decisions': self.navigator.decisions, **self._worker.filter_values(),
                      **self._inputs.values(),
                      'camera_fov_deg': round(math.degrees(fov), 1) if fov else 'unknown',
                      **{f'dropped: {kind}': n for kind, n in gate.dropped.items()},
                      **({'last_dropped': gate.last} if gate.last else {}),
                      **({'broken': self.broken} if self.broken else {})}
        self._diagnosis.publish(state, reason, values, self._warnings,
                                fault=f'inactive: {self.broken}' if self.broken else '')


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


def _transit(node: PolicyNode, transition) -> None:
    node.starts = True
    done = transition()
    node.starts = False
    if done != TransitionCallbackReturn.SUCCESS:
        raise node.failure or UserError(f'{transition.__name__} succeeds', 'an error, see above',
                                        'report it')


def main(args=None) -> int:
    """Entry point: 0 after a signal, 2 and one line on standard error for bad input."""
    status = run_node('policy_node', lambda _: PolicyNode(), drive, args, about=__doc__,
                      parameters=policy_parameters.PARAMETERS)
    if any(thread.name == 'inference' for thread in threading.enumerate()):
        # It sits in a decision that does not end. The zero is delivered, everything is closed;
        # to leave in the ordinary way would abort the process.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


if __name__ == '__main__':
    sys.exit(main())
