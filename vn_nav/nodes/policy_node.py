"""`policy_node`: camera and goal picture in, Twist out. A lifecycle node.

Threads: the executor keeps the newest frame; one worker decodes and infers
(`vn_nav.nodes.decision_worker`); one output thread alone owns the command publisher, the watchdog
and the ramps (`vn_nav.nodes.command_output`).

Run: `ros2 run vn_nav policy_node --ros-args -p checkpoint:=models/house`.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time

import numpy as np
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from vn_nav.errors import UserError
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.diagnosis import Diagnosis
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import qos
from vn_nav.policy.navigator import ENABLED, Limits, Navigator, State
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec, load_robot

LOCK_STEP_LIMIT = 2.0  # s of wall time: the watchdog's limits in lock-step
SHADOW_LIMIT = 30.0  # s, the same in a shadow: nothing moves, and a busy machine may take its time


class PolicyNode(LifecycleNode):
    """See the module's docstring; what it does in which state is `vn_nav.policy.navigator`."""

    def __init__(self):
        super().__init__('policy_node')
        policy_parameters.declare(self)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._wake = threading.Condition()  # guards everything below, and wakes both threads
        self.navigator: Navigator | None = None
        self._running = False
        self._threads: list[threading.Thread] = []
        self._interfaces: list = []
        self.failure: UserError | None = None

    def _on_parameters(self, parameters) -> SetParametersResult:
        """Operation is fixed while active: a limit must not move under a moving robot."""
        for parameter in parameters:
            if parameter.name in policy_parameters.PARAMETERS and self._running:
                return SetParametersResult(successful=False, reason=(
                    f'{parameter.name} is fixed while the node is active; received '
                    f'{parameter.value!r}; deactivate first'))
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
        return TransitionCallbackReturn.SUCCESS

    def _fail(self, error: UserError) -> None:
        """Say why a transition failed: once. With autostart `main` says it and exits."""
        self.failure = error
        if not self.get_parameter('autostart').value:
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
                            inference_timeout=limit, settle_time=0.0)
        else:
            limits = Limits(**{name: value[name] for name in Limits.__dataclass_fields__})
        self.navigator = Navigator(robot, limits, continuous=value['mode'] != 'stop_and_go',
                                   exact=self.lock_step)
        self._output = CommandOutput(
            self, self.navigator, self._wake, lambda: self._running,
            period=1.0 / value['control_rate'], lock_step=self.lock_step,
            stamped=value['enable_stamped_cmd_vel'],
            # In a shadow nothing waits for commands: each answers odometry or a decision.
            **({'name': 'shadow/cmd_vel', 'patience': None} if shadow else {}))
        self._worker = DecisionWorker(self, self.navigator, runtime, self._wake,
                                      lambda: self._running, lock_step=self.lock_step,
                                      shadow=shadow)
        self._make_interfaces(value['image_transport'] == 'compressed', shadow)

    def _make_interfaces(self, compressed: bool, shadow: bool) -> None:
        self._diagnosis = Diagnosis(self, self._output.publisher, self.navigator.robot.name)
        self._image_topic = image = 'image_raw/compressed' if compressed else 'image_raw'
        told = [(self.destroy_subscription, self.create_subscription(
            String, 'executed_action', self._on_executed_action, qos('executed_action')))
        ] if shadow else []
        self._interfaces = [
            *told,
            (self.destroy_subscription, self.create_subscription(
                CompressedImage if compressed else Image, image, self._on_image, qos(image))),
            (self.destroy_subscription, self.create_subscription(
                CameraInfo, 'camera_info', self._on_camera_info, qos('camera_info'))),
            (self.destroy_subscription, self.create_subscription(
                Image, 'goal_image', self._on_goal, qos('goal_image'))),
            (self.destroy_subscription, self.create_subscription(
                Odometry, 'odom', self._output.take_odometry, qos('odom'))),
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
        self._running = True
        self._threads = [
            threading.Thread(target=self._guard, args=(name, loop), name=name, daemon=True)
            for name, loop in (('inference', self._worker.run), ('output', self._output.run))]
        for thread in self._threads:
            thread.start()
        self._say_what_it_waits_for()
        return super().on_activate(state)

    def _say_what_it_waits_for(self) -> None:
        """What somebody at a silent robot wants to know."""
        pictures, goal, odometry = map(self.resolve_topic_name, (
            self._image_topic, 'goal_image', 'odom'))
        enable = '' if self.auto_enable else (
            f', then for `ros2 service call {self.get_fully_qualified_name()}/enable '
            'std_srvs/srv/SetBool "{data: true}"`')
        self.get_logger().info(f'active: waits for pictures on {pictures}, a goal picture on '
                               f'{goal}, odometry on {odometry}{enable}')

    def on_deactivate(self, state) -> TransitionCallbackReturn:
        """Zero first, then silence."""
        self.halt('deactivated')
        with self._wake:
            self.navigator.reset()
            self._worker.tell_arrival()
        return super().on_deactivate(state)

    def on_cleanup(self, _state) -> TransitionCallbackReturn:
        """Let go of everything that on_configure made."""
        for destroy, interface in self._interfaces:
            destroy(interface)
        self._interfaces = []
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state) -> TransitionCallbackReturn:
        """As deactivation, from any state."""
        self.halt('shut down')
        return TransitionCallbackReturn.SUCCESS

    @property
    def is_running(self) -> bool:
        """Active: both threads are at work."""
        return self._running

    def destroy_node(self) -> None:
        """Zero first, then everything else."""
        self.halt('the process ends')
        super().destroy_node()

    def halt(self, reason: str) -> None:
        """End both threads with a zero command that has been delivered (200 ms at most)."""
        with self._wake:
            if not self._running:
                return
            self.navigator.stop(reason, time.monotonic())
            self._running = False
            self._wake.notify_all()
        for thread in self._threads:
            thread.join(timeout=1.0)
        self._output.deliver_zero()  # the output thread is gone: still only one owner

    def _guard(self, name: str, loop) -> None:
        """A failing thread stops the robot; it never dies silently."""
        try:
            loop()
        except Exception as error:  # whatever it was: zero first
            with self._wake:
                self.navigator.stop(f'{name} failed: {error!r}', time.monotonic())
            for _ in range(20):
                self._output.send(np.zeros(4))
                time.sleep(0.05)
            raise

    # Callbacks, on the executor's thread. They keep the newest message and return.

    def _on_image(self, message) -> None:
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        with self._wake:
            # In lock-step stamps are the simulator's ticks and nothing is late; elsewhere the
            # node's clock judges.
            clock = None if self.lock_step else self.get_clock().now().nanoseconds * 1e-9
            if self.navigator.admit(stamp, clock):
                self._worker.show_frame(message, stamp)

    def _on_goal(self, message: Image) -> None:
        identity = (message.header.stamp.sec, message.header.stamp.nanosec)
        with self._wake:
            if self.navigator.new_goal(identity):
                self._worker.show_goal(message)

    def _on_executed_action(self, message: String) -> None:
        try:
            told = json.loads(message.data)
            sec, nanosec = told['stamp']
            self._worker.tell(sec + nanosec * 1e-9, told['action'])
        except (ValueError, TypeError, KeyError) as error:
            self.get_logger().error(f'executed_action is JSON with stamp [sec, nanosec] and an '
                                    f"action's name or null; received {message.data!r}: {error!r}")

    def _on_camera_info(self, message: CameraInfo) -> None:
        side, focal = min(message.width, message.height), message.k[0]
        if side > 0 and math.isfinite(focal) and focal > 0:
            self._worker.camera_fov = 2 * math.atan(side / 2 / focal)

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
        if not self._running:
            blockers.append('the node is not active: activate it first')
        if self.lock_step and self._output.odometry is None:
            blockers.append('no odometry: lock_step answers each message on odom')
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
        response.success, response.message = True, 'ready: ~/enable to go on'
        return response

    def _on_timer(self) -> None:
        """Four times a second: intruders on the command topic, self-enabling, diagnostics."""
        with self._wake:
            if self._running:
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
        if self.navigator is None or not self._interfaces:
            return
        with self._wake:
            state, reason = self.navigator.state, self.navigator.reason
            fov = self._worker.camera_fov
            values = {'decisions': self.navigator.decisions,
                      'camera_fov_deg': round(math.degrees(fov), 1) if fov else 'unknown',
                      **{f'dropped: {why}': n for why, n in self.navigator.dropped.items()}}
        self._diagnosis.publish(state, reason, values)


def drive(node: PolicyNode, ended: Ended) -> None:
    """Bring the node up and serve it; a callback that fails takes it out of action."""
    if node.get_parameter('autostart').value:
        for transition in (node.trigger_configure, node.trigger_activate):
            if ended.is_set():
                return
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise node.failure or UserError(
                    f'{transition.__name__} succeeds', 'an error, see above', 'report it')
    else:
        name = node.get_fully_qualified_name()
        node.get_logger().info(f'not configured: waits for `ros2 lifecycle set {name} configure`, '
                               'then activate')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        try:
            executor.spin_once(timeout_sec=0.05)
        except ExternalShutdownException:
            raise
        except Exception as error:  # stand still, go inactive, say so
            node.get_logger().error(f'callback failed, going inactive: {error!r}')
            if node.is_running:
                node.trigger_deactivate()


def main(args=None) -> int:
    """Entry point: 0 after a signal, 2 and one line on standard error for bad input."""
    return run_node('policy_node', lambda _: PolicyNode(), drive, args, about=__doc__,
                    parameters=policy_parameters.PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
