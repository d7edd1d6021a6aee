"""What policy_node hears: its subscriptions, and what is wrong with what comes on them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
import time

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String

from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.decision_worker import WINDOW_S, DecisionWorker
from vn_nav.nodes.qos import other_types, qos, subscribe
from vn_nav.nodes.range_input import NamedRanges, RangeInput
from vn_nav.nodes.window import Window
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_watch import GoalWatch
from vn_nav.policy.navigator import ENABLED, Navigator


class PolicyInputs:
    """Hands what comes to the worker and the output; callbacks keep the newest and return.

    Args:
        node: that subscribes.
        navigator: judges stamps.
        worker: takes pictures and goals.
        output: takes odometry.
        wake: guards the navigator.
        compressed: pictures come on image_raw/compressed.
        lock_step: stamps are the simulator's ticks, and nothing is late.
        shadow: somebody else drives, and publishes what was done.
        ranges: measured ranges, for the diagnostics; None: there are none.

    Attributes:
        subscriptions: what was made.
        camera_fault: why nothing is known of the camera though it has a camera_info; else empty.
        odometry_topic: its resolved name.
    """

    def __init__(self, node, navigator: Navigator, worker: DecisionWorker, output: CommandOutput,
                 wake: threading.Condition, *, compressed: bool, lock_step: bool, shadow: bool,
                 ranges: RangeInput | None = None):
        self._node, self._navigator, self._worker, self._output = node, navigator, worker, output
        self._wake, self._lock_step, self._ranges = wake, lock_step, ranges
        self._goals = GoalWatch(trust_stamps=lock_step)
        self._frames, self._odometry = Window(WINDOW_S), Window(WINDOW_S)  # frames: their ages [s]
        self._types: dict[str, type] = {}  # by resolved name
        self.subscriptions: list = []
        image, kind = (('image_raw/compressed', CompressedImage) if compressed else
                       ('image_raw', Image))
        self._subscribe(image, kind, self._on_image)
        self.camera_fault = ''
        self._subscribe('camera_info', CameraInfo, self._on_camera_info)
        self._subscribe('goal_image', Image, self._on_goal)
        # In lock-step no message may be missed, and the simulator is reliable.
        self.odometry_topic = self._subscribe('odom', Odometry, self._on_odometry, exact=lock_step)
        self._subscribe('goal_camera_info', CameraInfo, self._on_goal_camera_info)
        if shadow:
            self._subscribe('executed_action', String, self._on_executed_action, exact=True)

    def _subscribe(self, name: str, kind: type, callback, *, exact: bool = False) -> str:
        """Subscribe, as the contract says or from any publisher; the resolved name."""
        self.subscriptions += (
            [self._node.create_subscription(kind, name, callback, qos(name))] if exact
            else subscribe(self._node, kind, name, callback))
        resolved = self.subscriptions[-1].topic_name
        self._types[resolved] = kind
        return resolved

    @property
    def awaited(self) -> tuple[str, str, str]:
        """Resolved names of the topics without which nothing moves: pictures, goal, odometry."""
        image, _, goal, odometry = list(self._types)[:4]
        return image, goal, odometry

    # Callbacks, on the executor's thread.

    def _on_image(self, message) -> None:
        received = time.monotonic()
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        with self._wake:
            # In lock-step stamps are the simulator's ticks and nothing is late; elsewhere the
            # node's clock judges.
            clock = None if self._lock_step else self._node.get_clock().now().nanoseconds * 1e-9
            self._frames.add(received, 0.0 if clock is None else clock - stamp)
            if self._navigator.admit(stamp, clock, received):
                self._worker.show_frame(message, stamp, received)
            else:
                self._wake.notify_all()

    def _on_goal(self, message: Image) -> None:
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        picture = (message.height, message.width, message.encoding,
                   hashlib.blake2b(message.data, digest_size=16).digest())
        with self._wake:
            if self._goals.is_new(stamp, picture, time.monotonic()):
                self._navigator.new_goal()
                self._worker.show_goal(message)

    def take_goal(self, message: Image, camera: CameraInfo | None, max_decisions: int,
                  seconds: float) -> None:
        """A goal that did not come on the topic, with limits of its own; 0: the usual one."""
        with self._wake:
            if camera is not None:
                self._on_goal_camera_info(camera)
            usual = self._navigator.usual_limits
            self._navigator.new_goal(dataclasses.replace(
                usual, max_decisions=max_decisions or usual.max_decisions,
                time_allowance=seconds or usual.time_allowance))
            self._worker.show_goal(message)

    def refuse_goal(self, why: str) -> None:
        """A goal that did not come on the topic, and cannot be used: the one before is over."""
        with self._wake:
            self._navigator.new_goal()
            self._worker.drop_goal()
            self._navigator.refuse_goal(why)
            self._wake.notify_all()

    def _on_odometry(self, message: Odometry) -> None:
        self._odometry.add(time.monotonic())
        self._output.take_odometry(message)

    def _on_executed_action(self, message: String) -> None:
        try:
            executed = json.loads(message.data)
            sec, nanosec = executed['stamp']
            pose = executed.get('odometry')
            self._worker.note_executed(
                sec + nanosec * 1e-9, executed['action'],
                None if pose is None else _pose(pose), says_pose='odometry' in executed,
                ranges=_named(executed.get('ranges')), says_ranges='ranges' in executed)
        except Exception as error:  # whatever somebody writes there
            self._node.get_logger().error(
                "executed_action is JSON with stamp [sec, nanosec], an action's name or null and, "
                'if anything, odometry [x, y, yaw] or null, and ranges, null or with stamp and '
                'odometry of their own; '
                f'received {shorten(message.data)!r}: {shorten(repr(error))}')

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            camera = self._worker.pictures.read_camera(message)
            if camera is not None:
                self._worker.set_camera(camera)
            self.camera_fault = ''
        except Exception as error:  # whatever somebody publishes there
            if self._worker.pictures.camera is None:
                self.camera_fault = shorten(str(error) or repr(error))
            self._node.get_logger().error(shorten(str(error) or repr(error)),
                                          throttle_duration_sec=10.0)

    def _on_goal_camera_info(self, message: CameraInfo) -> None:
        stamp = message.header.stamp
        try:
            camera = self._worker.pictures.read_goal_camera(message)
            if camera is not None:
                self._worker.set_goal_camera((stamp.sec, stamp.nanosec), camera)
        except Exception as error:  # as above
            self._node.get_logger().error(
                f'goal_camera_info refused: {shorten(str(error) or repr(error))}',
                throttle_duration_sec=10.0)

    # What is missing or wrong with them.

    def unreceived(self) -> list[str]:
        """Topics that are published and not received: another type, or no odometry."""
        found = [f'{node} publishes {name} as {other}, and this node subscribes to '
                 f'{kind.__name__}: remap it, or republish it'
                 for name, kind in self._types.items()
                 for node, other in other_types(self._node, name, kind)]
        if self._output.odometry is None and not found and (
                self._node.count_publishers(self.odometry_topic)):
            found.append(f'{self.odometry_topic} has a publisher, and nothing of it has come: '
                         'check the driver and the middleware')
        return found

    def warnings(self) -> list[str]:
        """What is wrong with the inputs though the robot may drive."""
        warnings = self.unreceived() + [self.camera_fault] * bool(self.camera_fault)
        if goals := self._goals.warning(time.monotonic()):
            warnings.append(goals)
        if (self._output.odometry is None and not self._lock_step and not warnings
                and self._navigator.state in ENABLED):
            warnings.append(f'no odometry on {self.odometry_topic}: actions run on time alone')
        return warnings + (self._ranges.warnings() if self._ranges else [])

    def values(self) -> dict[str, str]:
        """Rates and latencies of the last seconds, for the diagnostics."""
        now = time.monotonic()
        inferences = self._worker.inferences
        return {'frame_rate_hz': f'{self._frames.rate(now):.1f}',
                'frame_age_ms': _milliseconds(self._frames.median(now)),
                'inference_ms': _milliseconds(inferences.median(now)),
                'inference_ms_max': _milliseconds(inferences.largest(now)),
                'odometry_rate_hz': f'{self._odometry.rate(now):.1f}',
                **({key: str(value) for key, value in self._ranges.values().items()}
                   if self._ranges else {})}


def _pose(values: object) -> np.ndarray:
    pose = np.array(values, float)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError('a pose is x, y and yaw')
    return pose


def _named(ranges: dict | None) -> NamedRanges | None:
    if ranges is None:
        return None
    (sec, nanosec), pose = ranges['stamp'], ranges['odometry']
    return NamedRanges(sec + nanosec * 1e-9, None if pose is None else _pose(pose))


def _milliseconds(seconds: float | None) -> str:
    return 'unknown' if seconds is None else f'{1e3 * seconds:.1f}'
