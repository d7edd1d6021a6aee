"""Tells a `route_node` where to drive: for `vn_nav goal`."""

from __future__ import annotations

import contextlib
import time
from typing import Any

from std_msgs.msg import String

from vn_nav.errors import UserError
from vn_nav.nodes.qos import qos
from vn_nav.nodes.said import read_said
from vn_nav.nodes.visit import visiting

SILENCE_S = 30.0  # without a word of route_node while it drives
LEAVE_S = 0.5  # for the middleware to deliver the last word


class RouteClient:
    """A node beside `route_node`. Use as a context manager.

    Args:
        namespace: of the robot.
        patience: for a route_node to be found [s].

    Raises:
        UserError: the middleware cannot start.
    """

    def __init__(self, namespace: str, patience: float):
        self._patience = patience
        self._heard: list[dict[str, Any]] = []
        self._visit = contextlib.ExitStack()
        self._node, self._executor = self._visit.enter_context(
            visiting('vn_nav_goal', namespace))
        self._goal = self._node.create_publisher(String, 'route_goal', qos('route_goal'))
        self._node.create_subscription(String, 'route_status', self._hear,
                                       qos('route_status', depth=50))

    def _hear(self, message: String) -> None:
        said = read_said(self._node, 'route_status', message, 'status', 'error_msg', 'place',
                         'places', 'pictures_shown')
        if said is not None:
            self._heard.append(said)

    def __enter__(self) -> RouteClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._visit.close()

    def status(self) -> dict[str, Any]:
        """What route_node said last.

        Raises:
            UserError: there is none.
        """
        until = time.monotonic() + self._patience
        # It has to hear what is said next.
        while not (self._heard and self._goal.get_subscription_count()):
            if time.monotonic() > until:
                raise UserError('a route_node is there', 'none answers',
                                'ros2 run vn_nav route_node --ros-args -p route:=FOLDER; check '
                                'ROS_DOMAIN_ID and --namespace')
            self._executor.spin_once(timeout_sec=0.1)
        return self._heard[-1]

    def drive_to(self, place: str) -> None:
        """Say where to."""
        self._heard.clear()
        self._goal.publish(String(data=place))
        self._linger()

    def stop(self) -> None:
        """The robot stands still."""
        self._goal.publish(String(data=''))
        self._linger()

    def next_status(self) -> dict[str, Any]:
        """The next word of route_node.

        Raises:
            UserError: it says nothing, and is gone.
        """
        until = time.monotonic() + SILENCE_S
        while not self._heard:
            self._executor.spin_once(timeout_sec=0.1)
            if self._goal.get_subscription_count():
                until = time.monotonic() + SILENCE_S
            elif time.monotonic() > until:
                raise UserError('route_node goes on', 'it is gone',
                                "stop the robot: policy_node's ~/stop")
        return self._heard.pop(0)

    def _linger(self) -> None:
        until = time.monotonic() + LEAVE_S
        while time.monotonic() < until:
            self._executor.spin_once(timeout_sec=0.05)
