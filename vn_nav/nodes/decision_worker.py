"""The worker thread of policy_node: decodes pictures, and decides when a decision is wanted."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import Bool, Int8, String

from vn_nav.bags.stamped import header_stamp
from vn_nav.nodes.camera_pictures import CameraPictures, Prepared
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.goal_output import GoalOutput
from vn_nav.nodes.prepared import prepared
from vn_nav.nodes.qos import qos
from vn_nav.nodes.range_input import NamedRanges, RangeInput
from vn_nav.nodes.window import Window
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_record import Code, ProgressWatch
from vn_nav.policy.navigator import Navigator
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.rectification import Camera

WINDOW_S = 5.0  # that rates and latencies are measured over
# That a picture waits for the ranges measured with it: scanners turn 10 times a second. In
# lock-step only topics are not in order.
RANGES_PATIENCE_S, LOCK_STEP_RANGES_PATIENCE_S = 0.15, 1.0
NAMED_RANGES_PATIENCE_S = 10.0  # for those that a recording says belong to the picture


class Executed(NamedTuple):
    """What a robot that somebody else drives has done before a picture."""

    stamp: float  # s, of the picture
    action: int  # -1: none of the policy's
    pose: np.ndarray | None  # [3] of odometry at the picture
    says_pose: bool  # else the topic of the odometry does
    ranges: NamedRanges | None = None  # that belong to the picture; None: none do
    says_ranges: bool = False  # else their topic does


class DecisionWorker:
    """Pictures and goals in, decisions and the statement `arrived` out.

    Args:
        node: that publishes `action`, `action_names` and `arrived`.
        navigator: wants the decisions.
        runtime: makes them; only the thread in `run` uses it.
        pictures: what camera and goals show the policy.
        output: knows the odometry.
        wake: guards the navigator and what this object keeps.
        lock_step: frames stamped up to the goal's stamp belong to the episode before.
        shadow: decide only after `note_executed`, for a robot that somebody else drives.
        ranges: measured ranges for the map; None: it takes those that are seen in the pictures.

    Attributes:
        pictures: as given.
        inferences: seconds that the decisions of the last while took.
        publishers: what `create_publisher` made.
        goal_output: says where the goal stands.
    """

    def __init__(self, node, navigator: Navigator, runtime: PolicyRuntime,
                 pictures: CameraPictures, output: CommandOutput, wake: threading.Condition, *,
                 lock_step: bool, shadow: bool = False, ranges: RangeInput | None = None):
        self._node, self._navigator, self._runtime = node, navigator, runtime
        self.pictures, self._output = pictures, output
        self._wake, self._lock_step = wake, lock_step
        self._breaks = output.track.breaks  # of the odometry, that the runtime knows of
        self._shadow, self._ranges = shadow, ranges
        self._waits_from: float | None = None  # steady time [s]: pictures wait for ranges
        self._map = None
        if runtime.search is not None:
            from vn_nav.nodes.map_output import PERIOD_S, MapOutput  # with Numba
            # Along a recording there is a map for each decision: it is awaited, and recorded.
            self._map = MapOutput(node, 0.0 if shadow and lock_step else PERIOD_S)
        self._executed: Executed | None = None
        self._shown: tuple | None = None  # the newest frame, also when the worker has taken it
        # Of goal pictures that another camera took: the newest, and its stamp.
        self._goal_camera: tuple[tuple[int, int], Camera] | None = None
        self._frame: tuple | None = None  # the newest message, its stamp, when it came
        self._goal: Image | None = None  # to be taken
        self._goal_in_force: Image | None = None
        self._accepted: Image | None = None  # the newest goal that the navigator has accepted
        self._epoch = navigator.epoch
        self.inferences = Window(WINDOW_S)
        self._published: bool | None = None  # on `arrived`
        self._action, names, self._arrived = self.publishers = [
            node.create_publisher(kind, name, qos(name)) for kind, name in (
                (Int8, 'action'), (String, 'action_names'), (Bool, 'arrived'))]
        names.publish(String(data=json.dumps(list(runtime.action_names))))
        self.publishers += [] if self._map is None else self._map.publishers
        self.goal_output = GoalOutput(node, navigator)
        self.publishers += self.goal_output.publishers
        self._progress = ProgressWatch(navigator.goal_limits, navigator.robot)
        self._watched: tuple | None = None  # which run at which goal the watch is of
        self.publish_arrival()

    def show_frame(self, message, stamp: float, received: float) -> None:
        """The newest admitted picture; one before it that still waits is dropped.

        Args:
            message: the picture.
            stamp: its [s].
            received: steady time at which it came [s].
        """
        with self._wake:
            self._frame = self._shown = (message, stamp, received)
            self._wake.notify_all()

    def show_goal(self, message: Image) -> None:
        """The newest goal picture."""
        with self._wake:
            self._goal = message
            self._wake.notify_all()

    def drop_goal(self) -> None:
        """No picture is the goal any more, also not one that is being prepared."""
        with self._wake:
            self._goal = self._goal_in_force = None

    def note_executed(self, stamp: float, action: str | None, pose: np.ndarray | None = None, *,
                      says_pose: bool = False, ranges: NamedRanges | None = None,
                      says_ranges: bool = False) -> None:
        """What the robot really did before the picture of a stamp, where a decision is wanted.

        Args:
            stamp: of the picture; a later one will do [s].
            action: None: none of the policy's.
            pose: [3] x, y [m], yaw [rad] of odometry at the picture; None: unknown.
            says_pose: it is to be taken; else that of the topic is.
            ranges: those that belong to the picture; None: none do.
            says_ranges: it is to be waited for; else the nearest of the topic counts.

        Raises:
            ValueError: the policy does not know the action.
        """
        number = -1 if action is None else self._runtime.action_names.index(action)
        with self._wake:
            self._executed = Executed(stamp, number, pose, says_pose, ranges, says_ranges)
            if self._frame is None and self._shown is not None and self._shown[1] >= stamp:
                self._frame = self._shown  # topics are not in order: the picture came first
            self._wake.notify_all()

    def set_camera(self, camera: Camera) -> None:
        """What the camera says of itself. The goal was cut for what it said before."""
        with self._wake:
            self.pictures.camera = camera
            self._take_goal_again()

    def set_goal_camera(self, stamp: tuple[int, int], camera: Camera) -> None:
        """The camera that took the goal picture of a stamp, where it is not the robot's."""
        with self._wake:
            self._goal_camera = stamp, camera
            # Topics are not in order: the picture may have come first.
            if self._goal_in_force is not None and header_stamp(self._goal_in_force) == stamp:
                self._take_goal_again()

    def _take_goal_again(self) -> None:
        if self._goal is None and self._goal_in_force is not None:
            self._goal = self._goal_in_force
            self._wake.notify_all()

    def filter_values(self) -> dict[str, str | int]:
        """What diagnostics say of the action filter: its name, and its counts until now."""
        counts = self._runtime.filter_counts
        return {'action_filter': self._runtime.action_filter} | (
            {} if self._runtime.action_filter == NONE else {
                'filter_decisions': counts.decisions, 'filter_acted': counts.acted,
                'filter_changed': counts.changed})

    def publish_arrival(self, *, again: bool = False) -> None:
        """Publish whether the robot stands where the policy has arrived, when that changed.

        Args:
            again: also when it did not: a new goal is answered with a statement.
        """
        with self._wake:
            arrived = self._navigator.arrival is not None
            self.goal_output.publish()
            if again or arrived != self._published:
                self._published = arrived
                self._arrived.publish(Bool(data=arrived))

    def publish_last(self) -> None:
        """Publish how the goal has ended, delivered when this returns (200 ms at most)."""
        self.publish_arrival()
        self.goal_output.deliver()

    def run(self, is_running: Callable[[], bool]) -> None:
        """Decode every admitted frame, until `is_running` says that the node does not any more."""
        while True:
            with self._wake:
                self._wake.wait_for(lambda: not is_running() or self._frame or self._goal)
                if not is_running():
                    return
                goal, self._goal = self._goal, None
                frame, self._frame = self._frame, None
            if goal is not None:
                self._take_goal(goal)
            if frame is not None:
                self._take_frame(*frame)

    def _take_goal(self, message: Image) -> None:
        with self._wake:
            self._goal_in_force = message
            budget = self._navigator.goal_limits.max_decisions
        self._runtime.set_budget(budget or None)
        found = prepared(self._prepare_goal, message, self._wake,
                         lambda why: self._refuse_goal(message, why))
        if found is None:
            return
        picture, _, view = found
        self._runtime.set_goal(picture, view)
        with self._wake:
            if self._is_newest(message):
                self.goal_output.stamp = sec, nanosec = header_stamp(message)
                again, self._accepted = message is self._accepted, message
                self._navigator.accept_goal(sec + nanosec * 1e-9 if self._lock_step
                                            else -math.inf, again)
                self.publish_arrival(again=True)

    def _refuse_goal(self, message: Image, why: str) -> None:
        if not self._is_newest(message):
            return
        self.goal_output.stamp = header_stamp(message)
        self._node.get_logger().error(f'goal_image refused: {shorten(why)}')
        self._navigator.refuse_goal(why)
        self.goal_output.publish()

    def _is_newest(self, message: Image) -> bool:
        """Nothing newer is waiting, and nobody has dropped it."""
        return self._goal is None and self._goal_in_force is message

    def _take_frame(self, message, stamp: float, received: float) -> None:
        found = prepared(self.pictures.of, message, self._wake,
                         lambda why: self._navigator.bad_frame(why, time.monotonic()))
        if found is None:
            return
        picture, zoom, view = found
        with self._wake:
            now = time.monotonic()
            self._navigator.good_frame(received)
            if self._epoch != self._navigator.epoch:
                self._epoch = self._navigator.epoch
                self._runtime.reset()
            executed = self._executed if self._shadow else None
            if self._shadow and (executed is None or stamp < executed.stamp):
                return
            if executed is not None and executed.says_ranges:
                self._wait_for(executed.ranges)
            elif not self._has_ranges(stamp):
                return
            now = time.monotonic()
            ticket = self._navigator.request(stamp, now)
            if ticket is None:
                return
            pose, breaks = self._output.pose_at(stamp), self._output.track.breaks
            if executed is not None:
                self._runtime.correct(executed.action)
                self._executed = None
                pose = executed.pose if executed.says_pose else pose
        if breaks != self._breaks:
            self._breaks = breaks
            self._runtime.reset_odometry()
        scan = None
        if self._ranges is not None and executed is not None and executed.says_ranges:
            scan = self._ranges.scan_of(executed.ranges, stamp, pose)
        elif self._ranges is not None:
            scan = self._ranges.scan_at(stamp)
        try:
            action = self._runtime.act(picture, pose, scan, zoom, view)
        except FloatingPointError as error:
            with self._wake:
                self._navigator.stop(str(error), time.monotonic())
                self._wake.notify_all()
            return
        with self._wake:
            begun, now = now, time.monotonic()
            self.inferences.add(now, now - begun)
            if self._runtime.arrived:
                self._navigator.declared(ticket, self._runtime.arrival, now)
            elif ended := self._gets_nowhere(action, pose):
                self._navigator.give_up(*ended)
            else:
                # Still holding the lock: a receiver of it finds it decided, and no command for it
                # is out yet.
                if self._navigator.decided(ticket, action, now):
                    self._action.publish(Int8(data=action))
            self.publish_arrival()
            self.goal_output.decided(self._runtime.arrival, self._runtime.goal_estimate, pose,
                                     self._output.odometry_frame, message.header.stamp)
            self._wake.notify_all()
        if self._map is not None and self._runtime.search is not None:
            self._map.publish(self._runtime.search.searchers[0], pose,
                              self._output.odometry_frame, message.header.stamp)

    def _gets_nowhere(self, action: int, pose: np.ndarray | None) -> tuple[Code, str] | None:
        """Why to give the goal up instead of doing an action; None: there is no reason."""
        goal = self._navigator.goal
        if (goal.number, goal.begun) != self._watched:
            self._watched = goal.number, goal.begun
            self._progress.reset()
        return self._progress.decided(action, pose)

    def _wait_for(self, ranges: NamedRanges | None) -> None:
        """Wait for the ranges that a recording says belong to a picture; topics have no order."""
        if self._ranges is not None and ranges is not None:
            own, stamp = self._ranges, ranges.stamp
            self._wake.wait_for(lambda: own.has_exactly(stamp), timeout=NAMED_RANGES_PATIENCE_S)

    def _has_ranges(self, stamp: float) -> bool:
        """Wait a moment for the ranges measured with a picture that a decision needs.

        Returns:
            False: a newer picture has come meanwhile, which may wait for the rest of that moment.
        """
        ranges = self._ranges
        if ranges is None or not ranges.is_alive or not self._navigator.wants(stamp):
            self._waits_from = None
            return True
        now = time.monotonic()
        self._waits_from = self._waits_from or now
        patience = LOCK_STEP_RANGES_PATIENCE_S if self._lock_step else RANGES_PATIENCE_S
        self._wake.wait_for(
            lambda: (ranges.has(stamp) or self._frame is not None or self._goal is not None
                     or not self._navigator.wants(stamp)),
            timeout=max(self._waits_from + patience - now, 0.0))
        if self._frame is not None and not ranges.has(stamp) and (
                time.monotonic() < self._waits_from + patience):
            return False
        self._waits_from = None
        return True

    def _prepare_goal(self, message: Image) -> Prepared:
        stamp, camera = self._goal_camera or (None, None)
        return self.pictures.goal(message, camera if stamp == header_stamp(message) else None)
