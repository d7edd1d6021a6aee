"""The action `navigate_to_image`, where the package `vn_interfaces` is installed.

It does what the topic `goal_image` and the service `~/enable` do, and tells how that ends: one
goal at a time, the newest one counts. Nothing here waits: `tend` looks from time to time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from sensor_msgs.msg import CameraInfo, Image

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.images import fill_image
from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture
from vn_nav.nodes.goal_output import GoalOutput
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_record import ENDED, Code, GoalRecord, Status
from vn_nav.policy.navigator import Navigator

NAME = 'navigate_to_image'
PATIENCE_S = 5.0  # until motion can be enabled: frames have to be healthy for a second
FEEDBACK_PERIOD_S = 0.25


def action_type() -> Any:
    """The type of the action; None: `vn_interfaces` is not installed."""
    try:
        from vn_interfaces.action import NavigateToImage
    except ImportError:
        return None
    return NavigateToImage


class _Server(ActionServer):
    """Executes a goal when its end is known: a coroutine that waited would keep a core busy."""

    def notify_execute(self, goal_handle, execute_callback) -> None:
        """Called when a goal becomes active; `finish` calls back."""

    def finish(self, goal_handle, result) -> None:
        """Send the result of a goal: two tasks of the executor do that."""
        super().notify_execute(goal_handle, lambda _: result)


class NavigateAction:
    """Serves the action. Everything happens on the executor's thread.

    Args:
        node: that serves.
        kind: type of the action, see `action_type`.
        navigator: drives.
        wake: guards it; held by who calls `tend`.
        show: takes a goal picture, as a message on goal_image; what took it, as one on
            goal_camera_info (None: the robot's camera); decisions and seconds that there are (0:
            as many as by the parameters).
        refuse: of a picture that is unusable, the reason: as if it had come on goal_image.
        enable: allows motion, as `~/enable` does: whether it did, and why not.
        accepts: whether goals are taken at all.
        output: says what is estimated of the goal.
    """

    def __init__(self, node, kind: Any, navigator: Navigator, wake: threading.Condition,
                 show: Callable[[Image, CameraInfo | None, int, float], None],
                 refuse: Callable[[str], None], enable: Callable[[], tuple[bool, str]],
                 accepts: Callable[[], bool], output: GoalOutput):
        self._node, self._kind, self._navigator, self._output = node, kind, navigator, output
        self._wake, self._show, self._refuse = wake, show, refuse
        self._enable, self._accepts = enable, accepts
        self._handle: Any = None  # rclpy's, of the goal under way
        self._number = 0  # of the goal of that handle
        self._begun = self._told = 0.0  # steady times [s]
        self._asked: tuple[bool, str] = (False, '')  # the newest answer of `enable`
        self._server = _Server(
            node, kind, NAME, lambda _: kind.Result(), goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda _: CancelResponse.ACCEPT)

    def destroy(self) -> None:
        """Take it off the graph, after the two tasks that `finish` has left to the executor."""
        if (executor := self._node.executor) is None:
            self._server.destroy()
        else:
            executor.create_task(lambda: executor.create_task(self._server.destroy))

    def halt(self, reason: str) -> None:
        """End the goal under way, if any: the node stops acting."""
        goal = self._navigator.goal
        if self._handle is None:
            return
        if self._handle.is_cancel_requested:
            self._finish(Status.CANCELLED, Code.NONE, 'cancelled')
        elif goal.number == self._number and goal.status in ENDED:  # since `tend` looked
            self._finish(goal.status, goal.code, goal.message)
        else:
            self._finish(Status.FAILED, Code.STOPPED, reason)

    def _on_goal(self, request) -> GoalResponse:
        if not self._accepts():
            self._node.get_logger().error(f'{NAME} refused: the node is not active')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, handle) -> None:
        request, refusal = handle.request, ''
        try:
            message, camera = self._picture(request)  # which takes a while
        except UserError as error:
            refusal = str(error)
        with self._wake:
            if self._handle is not None:
                self._finish(Status.FAILED, Code.STOPPED, 'another goal came')
            handle.execute()
            self._handle, self._begun, self._asked = handle, time.monotonic(), (False, '')
            self._number = self._navigator.goal.number + 1
            if refusal:  # the goal before is over all the same, as by a picture on goal_image
                self._refuse(refusal)
                self._finish(Status.FAILED, Code.GOAL_REFUSED, refusal)
                return
            allowance = request.time_allowance
            self._show(message, camera, request.max_decisions,
                       allowance.sec + allowance.nanosec * 1e-9)

    def _picture(self, request) -> tuple[Image, CameraInfo | None]:
        """The goal picture with a new stamp, and its camera, where a file says what that was.

        Raises:
            UserError: neither a picture nor a file, both, or a file that holds none.
        """
        if bool(request.path) == bool(request.image.data):
            raise UserError('a goal is a picture or the path of one',
                            'both' if request.path else 'neither', 'give image or path')
        message, fov = request.image, None
        if request.path:
            picture, fov = read_goal_picture(Path(request.path))
            message = fill_image(Image(), picture, 'rgb8')
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message, None if fov is None else fill_camera_info(
            CameraInfo(header=message.header), message.width, message.height, fov)

    def tend(self) -> None:
        """Enable motion, tell, cancel, finish: whatever it is time for."""
        if self._handle is None:
            return
        goal, now = self._navigator.goal, time.monotonic()
        if self._handle.is_cancel_requested:
            self._navigator.disable()
            self._finish(Status.CANCELLED, Code.NONE, 'cancelled')
        elif goal.number > self._number:
            self._finish(Status.FAILED, Code.STOPPED, 'another goal came')
        elif goal.number == self._number and goal.status in ENDED:
            self._finish(goal.status, goal.code, goal.message)
        elif goal.number == self._number and goal.status is Status.WAITING:
            self._asked = self._enable()
            if not self._asked[0] and now - self._begun > PATIENCE_S:
                self._finish(Status.FAILED, Code.NOT_READY, self._asked[1])
        elif goal.number < self._number and now - self._begun > PATIENCE_S:
            self._finish(Status.FAILED, Code.NOT_READY, 'the goal picture was not taken in time')
        if self._handle is not None and now - self._told > FEEDBACK_PERIOD_S:
            self._told = now
            self._handle.publish_feedback(self._feedback(goal, now))

    def _feedback(self, goal: GoalRecord, now: float):
        message = self._kind.Feedback()
        message.distance_remaining, message.arrival = self._output.distance, self._output.arrival
        message.decisions, message.state = (
            self._navigator.decisions, self._navigator.state.value)
        message.navigation_time = _duration(goal.seconds(now))
        message.goal_estimate = self._output.estimate or PoseStamped()
        return message

    def _finish(self, status: Status, code: Code, message: str) -> None:
        """End the goal of the client."""
        handle, self._handle = self._handle, None
        cancelled = status is Status.CANCELLED and handle.is_cancel_requested  # by the client
        ours = self._navigator.goal.number == self._number
        result = self._kind.Result()
        if status is not Status.SUCCEEDED and code is Code.NONE and not cancelled:
            code = Code.STOPPED  # by a person: ~/enable, ~/stop, ~/reset
        result.error_code, result.error_msg = int(code), shorten(message)
        result.arrival = self._output.arrival
        if ours:
            result.decisions = self._navigator.decisions
            result.navigation_time = _duration(self._navigator.goal.seconds(time.monotonic()))
        if status is Status.SUCCEEDED:
            handle.succeed()
        elif cancelled:
            handle.canceled()
        else:
            handle.abort()
        self._server.finish(handle, result)


def _duration(seconds: float) -> Duration:
    whole = int(seconds)
    return Duration(sec=whole, nanosec=int((seconds - whole) * 1e9))
