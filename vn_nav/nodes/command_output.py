"""The output thread of policy_node: it alone owns the command publisher and the watchdog."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration

from vn_msgs_py import motion
from vn_nav.nodes.qos import qos
from vn_nav.policy.navigator import Navigator, State

CROSSING = 0.03  # s of wall time, see _lock_step
AT_ONCE = (State.STOPPED, State.ARRIVED)  # their zero does not wait for the next period


class CommandOutput:
    """Odometry in, commands out.

    Args:
        node: that publishes `cmd_vel`.
        navigator: says the velocity.
        wake: guards the navigator and what this object keeps.
        is_running: false ends `run`.
        period: between two commands [s].
        lock_step: one command for every odometry message instead.
        stamped: TwistStamped instead of Twist.
        name: of the topic.
        patience: time without odometry after which lock-step sends a command unasked [s]; None:
            it never does.

    Attributes:
        publisher: of the commands.
        odometry: [3] x, y [m], yaw [rad] of the newest message; None before the first.
    """

    def __init__(self, node, navigator: Navigator, wake: threading.Condition,
                 is_running: Callable[[], bool], *, period: float, lock_step: bool,
                 stamped: bool, name: str = 'cmd_vel', patience: float | None = 0.5):
        self._node, self._navigator, self._wake = node, navigator, wake
        self._is_running, self._period, self._in_lock_step = is_running, period, lock_step
        self._stamped, self._patience = stamped, patience
        self.publisher = node.create_publisher(TwistStamped if stamped else Twist, name, qos(name))
        self.odometry: np.ndarray | None = None
        self._stamp = 0.0  # of the odometry
        self._rests = True  # says the odometry
        self._received = -math.inf
        self._count = 0
        self._robot_moves = False  # by the last command sent

    @property
    def silence(self) -> float:
        """Seconds since the newest odometry that was usable."""
        return time.monotonic() - self._received

    def take_odometry(self, message: Odometry) -> None:
        """Keep the newest odometry; stop on numbers that are not finite."""
        with self._wake:
            try:
                values = motion.odometry_to_array(message)
            except motion.MotionError as error:
                self._navigator.stop(f'bad odometry: {error}', time.monotonic())
                return
            if self._in_lock_step and values[6] < self._stamp:
                self._navigator.time_jumped()
            self.odometry, self._stamp = values[:3], values[6]
            self._rests = not values[3:6].any()
            self._received = time.monotonic()
            self._count += 1
            self._wake.notify_all()

    def run(self) -> None:
        """Publish commands until the node does not run any more."""
        if self._in_lock_step:
            self._lock_step()
        else:
            self._real_time()

    def _real_time(self) -> None:
        due = time.monotonic()
        while True:
            due = max(due + self._period, time.monotonic())
            with self._wake:
                self._wake.wait_for(
                    lambda: not self._is_running() or (self._navigator.state in AT_ONCE
                                                       and self._robot_moves),
                    timeout=max(0.0, due - time.monotonic()))
                if not self._is_running():
                    return
                now = time.monotonic()
                lost = self.odometry is not None and (
                    now - self._received > self._navigator.limits.frame_timeout)
                stamp = self._node.get_clock().now().nanoseconds * 1e-9
                velocity = self._navigator.step(now, self._period, self.odometry, stamp,
                                                odometry_lost=lost)
                self._robot_moves = velocity is not None and bool(velocity.any())
            if velocity is not None:
                self.send(velocity)

    def _lock_step(self) -> None:
        """One command for every odometry message; the first of a motion goes out at once.

        That first command may cross an odometry message that the bridge, still at rest, had just
        sent. Answering that one too would put every later command one tick ahead. It shows in its
        velocity of zero; so after a first command, odometry at rest gets no answer unless the
        next one stays away (the robot was blocked from the first tick on).
        """
        answered, moving, first = self._count, False, False
        while True:
            with self._wake:
                self._wait_for_odometry(answered, or_decision=not moving,
                                        timeout=self._patience)
                if first and self._rests and self._count > answered:
                    self._wait_for_odometry(self._count, or_decision=False, timeout=CROSSING)
                if not self._is_running():
                    return
                answered = self._count
                velocity = self._navigator.step(time.monotonic(), self._period, self.odometry,
                                                self._stamp)
                moved = velocity is not None and bool(velocity.any())
                moving, first = moved, moved and not moving
            if velocity is not None:
                self.send(velocity)

    def _wait_for_odometry(self, answered: int, *, or_decision: bool, timeout: float | None
                           ) -> None:
        self._wake.wait_for(
            lambda: not self._is_running() or self._count > answered
            or (or_decision and self._navigator.ready_to_move), timeout=timeout)

    def send(self, velocity: np.ndarray) -> None:
        """Publish a velocity [4]; only for the thread in `run`, or when it is gone."""
        if self._stamped:
            message = TwistStamped()
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.header.frame_id = 'base_link'
        else:
            message = Twist()
        self.publisher.publish(motion.fill_twist(message, velocity))

    def deliver_zero(self) -> None:
        """A last zero that has been delivered when this returns (200 ms at most)."""
        self.send(np.zeros(4))
        self.publisher.wait_for_all_acked(Duration(seconds=0.2))
