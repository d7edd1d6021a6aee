"""`policy_node`: camera and goal picture in, Twist out. A lifecycle node.

Threads: the executor keeps the newest frame; one worker decodes and infers; one output thread on
the steady clock alone owns the command publisher, the watchdog and the ramps.

Run: `ros2 run vn_nav policy_node --ros-args -p checkpoint:=models/house`.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Int8, String
from std_srvs.srv import SetBool, Trigger

from vn_msgs_py import images, motion
from vn_nav.errors import UserError
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.diagnosis import Diagnosis
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import qos
from vn_nav.observation import crop_fraction, preprocess
from vn_nav.policy.navigator import Limits, Navigator, State
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec, load_robot

LOCK_STEP_LIMIT = 2.0  # s of wall time: the watchdog's limits in lock-step
CROSSING = 0.03  # s of wall time, see _output_lock_step


def _seconds(stamp) -> float:
    return stamp.sec + stamp.nanosec * 1e-9


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
        self._new_frame = self._new_goal = None
        self._camera_fov: float | None = None
        self._odometry: np.ndarray | None = None
        self._odometry_stamp = 0.0
        self._odometry_rests = True
        self._robot_moves = False  # by the last command sent
        self._odometry_received = -math.inf
        self._odometry_count = 0
        self.failure: UserError | None = None

    def _on_parameters(self, parameters) -> SetParametersResult:
        """Operation is fixed while active: a limit must not move under a moving robot."""
        for parameter in parameters:
            if parameter.name in policy_parameters.PARAMETERS and self._running:
                return SetParametersResult(successful=False, reason=(
                    f'{parameter.name} is fixed while the node is active; received '
                    f'{parameter.value!r}; deactivate first'))
            if isinstance(parameter.value, float) and not math.isfinite(parameter.value):
                return SetParametersResult(successful=False, reason=(
                    f'{parameter.name} is finite; received {parameter.value}'))
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
        self.runtime = PolicyRuntime(value['checkpoint'] or share_file('models/house'),
                                     seed=value['seed'], decoding=value['decoding'] or None)
        robot = robot.with_actions(self.runtime.action_names)
        if self.lock_step:
            limits = Limits(frame_timeout=LOCK_STEP_LIMIT, frame_stop_timeout=LOCK_STEP_LIMIT,
                            inference_timeout=LOCK_STEP_LIMIT, settle_time=0.0)
        else:
            limits = Limits(**{name: value[name] for name in Limits.__dataclass_fields__})
        self.period = 1.0 / value['control_rate']
        self.navigator = Navigator(robot, limits, continuous=value['mode'] == 'continuous',
                                   exact=self.lock_step)
        self.stamped = value['enable_stamped_cmd_vel']
        self._make_interfaces(value['image_transport'] == 'compressed')

    def _make_interfaces(self, compressed: bool) -> None:
        kind = TwistStamped if self.stamped else Twist
        self._command = self.create_publisher(kind, 'cmd_vel', qos('cmd_vel'))
        self._action = self.create_publisher(Int8, 'action', qos('action'))
        self._action_names = self.create_publisher(String, 'action_names', qos('action_names'))
        self._diagnosis = Diagnosis(self, self._command, self.navigator.robot.name)
        image = 'image_raw/compressed' if compressed else 'image_raw'
        self._interfaces = [
            (self.destroy_subscription, self.create_subscription(
                CompressedImage if compressed else Image, image, self._on_image, qos(image))),
            (self.destroy_subscription, self.create_subscription(
                CameraInfo, 'camera_info', self._on_camera_info, qos('camera_info'))),
            (self.destroy_subscription, self.create_subscription(
                Image, 'goal_image', self._on_goal, qos('goal_image'))),
            (self.destroy_subscription, self.create_subscription(
                Odometry, 'odom', self._on_odometry, qos('odom'))),
            (self.destroy_service, self.create_service(SetBool, '~/enable', self._on_enable)),
            (self.destroy_service, self.create_service(Trigger, '~/stop', self._on_stop)),
            (self.destroy_service, self.create_service(Trigger, '~/reset', self._on_reset)),
            (self.destroy_timer, self.create_timer(0.25, self._on_timer, clock=self._steady)),
            *((self.destroy_publisher, publisher) for publisher in (
                self._command, self._action, self._action_names, self._diagnosis.publisher)),
        ]
        self._action_names.publish(String(data=json.dumps(list(self.runtime.action_names))))

    def on_activate(self, state) -> TransitionCallbackReturn:
        """Start looking; motion needs ~/enable."""
        others = self._other_publishers()
        if others:
            self._fail(UserError(
                'this node alone publishes its command topic', f'{others} more publisher(s) on '
                'cmd_vel', 'remap one of them (twist_mux combines them)'))
            return TransitionCallbackReturn.FAILURE
        self._running = True
        self._threads = [threading.Thread(target=self._guard, args=(loop,), name=loop.__name__,
                                          daemon=True) for loop in (self._infer, self._output)]
        for thread in self._threads:
            thread.start()
        return super().on_activate(state)

    def on_deactivate(self, state) -> TransitionCallbackReturn:
        """Zero first, then silence."""
        self.halt('deactivated')
        with self._wake:
            self.navigator.reset()
        return super().on_deactivate(state)

    def on_cleanup(self, _state) -> TransitionCallbackReturn:
        """Let go of everything that on_configure made."""
        for destroy, interface in self._interfaces:
            destroy(interface)
        self._interfaces = []
        self._new_frame = self._new_goal = self._odometry = None
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
        self._send(np.zeros(4))  # the output thread is gone: still only one owner
        self._command.wait_for_all_acked(Duration(seconds=0.2))

    def _guard(self, loop) -> None:
        """A failing thread stops the robot; it never dies silently."""
        try:
            loop()
        except Exception as error:  # whatever it was: zero first
            with self._wake:
                self.navigator.stop(f'{loop.__name__.strip("_")} failed: {error!r}',
                                    time.monotonic())
            for _ in range(20):
                self._send(np.zeros(4))
                time.sleep(0.05)
            raise

    # Callbacks, on the executor's thread. They keep the newest message and return.

    def _on_image(self, message) -> None:
        stamp = _seconds(message.header.stamp)
        with self._wake:
            # In lock-step stamps are the simulator's ticks and nothing is late; elsewhere the
            # node's clock judges.
            clock = None if self.lock_step else self.get_clock().now().nanoseconds * 1e-9
            if self.navigator.admit(stamp, clock):
                self._new_frame = (message, stamp)
                self._wake.notify_all()

    def _on_goal(self, message: Image) -> None:
        identity = (message.header.stamp.sec, message.header.stamp.nanosec)
        with self._wake:
            if self.navigator.new_goal(identity):
                self._new_goal = message
                self._wake.notify_all()

    def _on_camera_info(self, message: CameraInfo) -> None:
        side, focal = min(message.width, message.height), message.k[0]
        if side > 0 and math.isfinite(focal) and focal > 0:
            self._camera_fov = 2 * math.atan(side / 2 / focal)

    def _on_odometry(self, message: Odometry) -> None:
        with self._wake:
            try:
                values = motion.odometry_to_array(message)
            except motion.MotionError as error:
                self.navigator.stop(f'bad odometry: {error}', time.monotonic())
                return
            if self.lock_step and values[6] < self._odometry_stamp:
                self.navigator.time_jumped()
            self._odometry, self._odometry_stamp = values[:3], values[6]
            self._odometry_rests = not values[3:6].any()
            self._odometry_received = time.monotonic()
            self._odometry_count += 1
            self._wake.notify_all()

    def _on_enable(self, request, response):
        with self._wake:
            if request.data:
                response.success, response.message = self._enable()
            else:
                self.navigator.disable()
                response.success, response.message = True, 'disabled'
            self._wake.notify_all()
        self._diagnose()
        return response

    def _enable(self) -> tuple[bool, str]:
        blockers = []
        if not self._running:
            blockers.append('the node is not active: activate it first')
        if self.lock_step and self._odometry is None:
            blockers.append('no odometry: lock_step answers each message on odom')
        if others := self._other_publishers():
            blockers.append(f'{others} other publisher(s) on cmd_vel: remap one')
        try:
            self._fov_check()
        except UserError as error:
            blockers.append(str(error))
        return self.navigator.enable(time.monotonic(), tuple(blockers))

    def _fov_check(self) -> None:
        if self._camera_fov is not None:
            crop_fraction(self._camera_fov, self.runtime.camera_fov)

    def _on_stop(self, _request, response):
        with self._wake:
            self.navigator.stop('~/stop was called', time.monotonic())
            self._wake.notify_all()
        response.success, response.message = True, 'stopped: ~/reset, then ~/enable to go on'
        return response

    def _on_reset(self, _request, response):
        with self._wake:
            self.navigator.reset()
        response.success, response.message = True, 'ready: ~/enable to go on'
        return response

    def _on_timer(self) -> None:
        """Four times a second: intruders on the command topic, self-enabling, diagnostics."""
        with self._wake:
            if self._running:
                others = self._other_publishers()
                if others and self.navigator.state in (State.RUNNING, State.HOLD):
                    self.navigator.stop(f'{others} other publisher(s) on cmd_vel',
                                        time.monotonic())
                elif self.auto_enable and self.navigator.state is State.IDLE:
                    self._enable()
                self._wake.notify_all()
        self._diagnose()

    def _other_publishers(self) -> int:
        return max(0, self.count_publishers(self._command.topic_name) - 1)

    def _diagnose(self) -> None:
        """Publish the state once a second, and at once when it changes."""
        if self.navigator is None or not self._interfaces:
            return
        with self._wake:
            state, reason = self.navigator.state, self.navigator.reason
            values = {'decisions': self.navigator.decisions,
                      'camera_fov_deg': round(math.degrees(self._camera_fov), 1)
                      if self._camera_fov else 'unknown',
                      **{f'dropped: {why}': n for why, n in self.navigator.dropped.items()}}
        self._diagnosis.publish(state, reason, values)

    # The worker: decodes every admitted frame, and infers when a decision is wanted.

    def _infer(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: not self._running or self._new_frame or self._new_goal)
                if not self._running:
                    return
                goal, self._new_goal = self._new_goal, None
                frame, self._new_frame = self._new_frame, None
            if goal is not None:
                self._take_goal(goal)
            if frame is not None:
                self._take_frame(*frame)

    def _take_goal(self, message: Image) -> None:
        try:
            # A goal picture comes from a camera like this one; it is cropped the same way.
            picture = self._prepare(message)
        except (images.ImageError, UserError) as error:
            self.get_logger().error(f'goal_image refused: {error}')
            with self._wake:
                self.navigator.refuse_goal()
            return
        self.runtime.set_goal(picture)
        with self._wake:
            if self._new_goal is None:  # else a newer one is waiting
                stamp = _seconds(message.header.stamp) if self.lock_step else -math.inf
                self.navigator.accept_goal(stamp)

    def _take_frame(self, message, stamp: float) -> None:
        try:
            picture = self._prepare(message)
        except (images.ImageError, UserError) as error:
            with self._wake:
                self.navigator.bad_frame(str(error), time.monotonic())
            return
        with self._wake:
            now = time.monotonic()
            self.navigator.good_frame(now)
            ticket = self.navigator.request(stamp, now)
        if ticket is None:
            return
        try:
            action = self.runtime.act(picture)
        except FloatingPointError as error:
            with self._wake:
                self.navigator.stop(str(error), time.monotonic())
                self._wake.notify_all()
            return
        self._action.publish(Int8(data=action))
        with self._wake:
            self.navigator.decided(ticket, action, time.monotonic())
            self._wake.notify_all()

    def _prepare(self, message) -> np.ndarray:
        fov = {} if self._camera_fov is None else {
            'fov': self._camera_fov, 'target_fov': self.runtime.camera_fov}
        return preprocess(images.decode_rgb(message), self.runtime.size, **fov)

    # The output thread: the only one that publishes commands.

    def _output(self) -> None:
        if self.lock_step:
            self._output_lock_step()
        else:
            self._output_real_time()

    def _output_real_time(self) -> None:
        due = time.monotonic()
        while True:
            due = max(due + self.period, time.monotonic())
            with self._wake:
                # A stop does not wait for the next period.
                self._wake.wait_for(
                    lambda: not self._running or (self.navigator.state is State.STOPPED
                                                  and self._robot_moves),
                    timeout=max(0.0, due - time.monotonic()))
                if not self._running:
                    return
                now = time.monotonic()
                lost = self._odometry is not None and (
                    now - self._odometry_received > self.navigator.limits.frame_timeout)
                stamp = self.get_clock().now().nanoseconds * 1e-9
                velocity = self.navigator.step(now, self.period, self._odometry, stamp,
                                               odometry_lost=lost)
                self._robot_moves = velocity is not None and bool(velocity.any())
            if velocity is not None:
                self._send(velocity)

    def _output_lock_step(self) -> None:
        """One command for every odometry message; the first of a motion goes out at once.

        That first command may cross an odometry message that the bridge, still at rest, had just
        sent. Answering that one too would put every later command one tick ahead. It shows in its
        velocity of zero; so after a first command, odometry at rest gets no answer unless the
        next one stays away (the robot was blocked from the first tick on).
        """
        answered, moving, first = self._odometry_count, False, False
        while True:
            with self._wake:
                self._wait_for_odometry(answered, or_decision=not moving, timeout=0.5)
                if first and self._odometry_rests and self._odometry_count > answered:
                    self._wait_for_odometry(self._odometry_count, or_decision=False,
                                            timeout=CROSSING)
                if not self._running:
                    return
                answered = self._odometry_count
                velocity = self.navigator.step(time.monotonic(), self.period, self._odometry,
                                               self._odometry_stamp)
                moved = velocity is not None and bool(velocity.any())
                moving, first = moved, moved and not moving
            if velocity is not None:
                self._send(velocity)

    def _wait_for_odometry(self, answered: int, *, or_decision: bool, timeout: float) -> None:
        self._wake.wait_for(
            lambda: not self._running or self._odometry_count > answered
            or (or_decision and self.navigator.ready_to_move), timeout=timeout)

    def _send(self, velocity: np.ndarray) -> None:
        if self.stamped:
            message = TwistStamped()
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = 'base_link'
        else:
            message = Twist()
        self._command.publish(motion.fill_twist(message, velocity))


def drive(node: PolicyNode, ended: Ended) -> None:
    """Bring the node up and serve it; a callback that fails takes it out of action."""
    if node.get_parameter('autostart').value:
        for transition in (node.trigger_configure, node.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise node.failure
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        try:
            executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            raise
        except Exception as error:  # stand still, go inactive, say so
            node.get_logger().error(f'callback failed, going inactive: {error!r}')
            if node.is_running:
                node.trigger_deactivate()


def main(args=None) -> int:
    """Entry point: 0 after a signal, 2 and one line on standard error for bad input."""
    return run_node('policy_node', PolicyNode, drive, args)


if __name__ == '__main__':
    sys.exit(main())
