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
from vn_nav.nodes.tilt_output import TiltOutput
from vn_nav.policy.clock_watch import ClockWatch
from vn_nav.policy.navigator import Navigator
from vn_nav.policy.pose_track import PoseTrack

TOPIC = 'cmd_vel'
LOCK_STEP_SILENCE_S = 0.5  # without odometry, after which lock-step sends a command unasked
CROSSING_S = 0.03  # of wall time, see _lock_step
# Odometry that moves by this, and by more than the robot could have, was set anew.
JUMP_M, JUMP_RAD = 0.1, 0.3
# Times the robot's limits: they are conservative, and messages come in bursts.
PLAUSIBLE_SPEED_FACTOR = 3.0
POSE_AGE_S = 0.2  # that a pose may be older than a picture in motion
REORDERED_S = 1.0  # odometry from longer ago is from another time


class CommandOutput:
    """Odometry in, commands out.

    Args:
        node: that publishes `cmd_vel`.
        navigator: says the velocity.
        wake: guards the navigator and what this object keeps.
        period: between two commands [s].
        lock_step: one command for every odometry message instead.
        stamped: TwistStamped instead of Twist.
        name: of the topic.
        tilt: takes the camera's tilt out of the commands; None: they carry its rate.
        patience: time without odometry after which lock-step sends a command unasked [s]; None:
            it never does.

    Attributes:
        publisher: of the commands.
        odometry: [3] x, y [m], yaw [rad] of the newest message; None before the first.
        odometry_frame: name of the frame that they are in.
        track: its poses, for `pose_at`.
    """

    def __init__(self, node, navigator: Navigator, wake: threading.Condition, *, period: float,
                 lock_step: bool, stamped: bool, name: str = TOPIC,
                 tilt: TiltOutput | None = None,
                 patience: float | None = LOCK_STEP_SILENCE_S):
        self._node, self._navigator, self._wake = node, navigator, wake
        self._period, self._in_lock_step = period, lock_step
        self._is_running: Callable[[], bool] = lambda: False
        self._stamped, self._patience, self._tilt = stamped, patience, tilt
        self.publisher = node.create_publisher(TwistStamped if stamped else Twist, name, qos(name))
        self.odometry: np.ndarray | None = None
        self.odometry_frame = 'odom'
        self.track = PoseTrack()
        self._stamp = 0.0  # of the odometry
        self._rests = True  # says the odometry
        self._received = -math.inf
        self._count = 0
        self._robot_moves = False  # by the last command sent
        self._clock_watch = ClockWatch(
            simulated=bool(node.get_parameter('use_sim_time').value))

    @property
    def silence(self) -> float:
        """Seconds since the newest odometry that was usable."""
        return time.monotonic() - self._received

    @property
    def odometry_lost(self) -> bool:
        """There was odometry, and it fell silent."""
        return self.odometry is not None and (
            self.silence > self._navigator.limits.odometry_timeout)

    def take_odometry(self, message: Odometry) -> None:
        """Keep the newest odometry; stop on numbers that no odometry has."""
        with self._wake:
            try:
                values = motion.odometry_to_array(message)
            except motion.MotionError as error:
                self._navigator.stop(f'bad odometry: {error}', time.monotonic())
                self._wake.notify_all()
                return
            now = time.monotonic()
            back = self._stamp - values[6] if self.odometry is not None else 0.0
            if self._in_lock_step and back > 0.0:
                self._navigator.time_jumped(f'odometry stamps went back by {back:.4g} s')
                self.track.cut()
            elif 0.0 < back < REORDERED_S:
                return
            elif not self._in_lock_step and (jump := self._jump(values, now, back)):
                self._navigator.odometry_jumped(jump)
                self.track.cut()
            self.odometry, self._stamp = values[:3], values[6]
            self.odometry_frame = message.header.frame_id or self.odometry_frame
            self.track.add(values[6], values[:3])
            self._rests = not values[3:6].any()
            self._received = now
            self._count += 1
            self._wake.notify_all()

    def pose_at(self, stamp: float) -> np.ndarray | None:
        """The pose [3] of odometry that belongs to a picture; `wake` is held.

        Who looks at rest gets the newest one: since then the robot has not moved, however the
        stamps of camera and odometry lie to each other. In motion it is the one at the picture's
        stamp, or just before it.

        Args:
            stamp: of the picture [s].

        Returns:
            x, y [m], yaw [rad] in the frame of the odometry, which is another one where
            `track.breaks` has grown; None: there is no odometry, or it is silent.
        """
        if self.odometry_lost:
            return None
        return self.track.at(stamp if self._navigator.continuous else self._stamp, POSE_AGE_S)

    def _jump(self, values: np.ndarray, now: float, back: float) -> str:
        """A step in the pose that no driving explains, as a reason; empty: there is none."""
        if self.odometry is None:
            return ''
        if back > 0.0:
            return f'odometry stamps went back by {back:.4g} s'
        robot, passed = self._navigator.robot, now - self._received
        step = math.hypot(*(values[:2] - self.odometry[:2]))
        turn = abs((values[2] - self.odometry[2] + math.pi) % (2 * math.pi) - math.pi)
        if step > JUMP_M + PLAUSIBLE_SPEED_FACTOR * robot.max_linear * passed:
            return f'odometry jumped by {step:.4g} m'
        if turn > JUMP_RAD + PLAUSIBLE_SPEED_FACTOR * robot.max_angular * passed:
            return f'odometry jumped by {math.degrees(turn):.4g} deg'
        return ''

    def run(self, is_running: Callable[[], bool]) -> None:
        """Publish commands until `is_running` says that the node does not any more."""
        self._is_running = is_running
        self._robot_moves = False
        if self._in_lock_step:
            self._lock_step()
        else:
            self._real_time()

    def _real_time(self) -> None:
        due = last = time.monotonic()
        while True:
            due = max(due + self._period, time.monotonic())
            with self._wake:
                self._wait(due)
                if not self._is_running():
                    return
                now = time.monotonic()
                due = min(due, now)  # woken early: the next period begins here
                stamp = self._node.get_clock().now().nanoseconds * 1e-9
                if jumped := self._clock_watch.look(stamp, now):
                    self._navigator.time_jumped(jumped)
                # An action's profile is made for whole periods; a velocity that is held follows
                # its decisions whenever they come.
                passed = min(self._period, now - last) if self._navigator.continuous else (
                    self._period)
                velocity = self._navigator.step(now, passed, self.odometry, stamp,
                                                odometry_lost=self.odometry_lost)
                self._robot_moves = velocity is not None and bool(velocity.any())
                last = now
                # Still holding the lock: no motion goes out after a stop that was answered.
                if velocity is not None:
                    self.send(velocity)

    def _wait(self, due: float) -> None:
        """Until the next period, or for what does not wait for it.

        That is a zero where the last command moved the robot, a decision, and the moment at which
        the watchdog has to look.
        """
        while self._is_running():
            if self._navigator.ready_to_move or (
                    self._robot_moves and not self._navigator.velocity.any()):
                return
            until = min(due, self._deadline()) if self._robot_moves else due
            # A wait may end a moment early, and "later than" wants to be true.
            remaining = until + 0.001 - time.monotonic()
            if remaining <= 0.0:
                return
            self._wake.wait(remaining)

    def _deadline(self) -> float:
        odometry = math.inf if self.odometry is None else (
            self._received + self._navigator.limits.odometry_timeout)
        return min(self._navigator.deadline(), odometry)

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
                    self._wait_for_odometry(self._count, or_decision=False, timeout=CROSSING_S)
                if not self._is_running():
                    return
                if moving and self._count == answered and not self.odometry_lost:
                    continue  # nobody asked: a velocity unasked would move it a tick further
                answered = self._count
                velocity = self._navigator.step(time.monotonic(), self._period, self.odometry,
                                                self._stamp, odometry_lost=self.odometry_lost)
                moved = velocity is not None and bool(velocity.any())
                moving, first = moved, moved and not moving
                if velocity is not None:  # with the lock, as in real time
                    self.send(velocity)

    def _wait_for_odometry(self, answered: int, *, or_decision: bool, timeout: float | None
                           ) -> None:
        self._wake.wait_for(
            lambda: not self._is_running() or self._count > answered
            or (or_decision and self._navigator.ready_to_move), timeout=timeout)

    def send(self, velocity: np.ndarray) -> None:
        """Publish a velocity [4]; only for the thread in `run`, or when it is gone."""
        if self._tilt is not None:
            velocity = self._tilt.without_tilt(velocity)
        if self._stamped:
            message = TwistStamped()
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.header.frame_id = 'base_link'
        else:
            message = Twist()
        self.publisher.publish(motion.fill_twist(message, velocity))

    def deliver_zero(self) -> None:
        """A last zero that has been delivered when this returns (200 ms at most).

        Said three times: a listener that is best effort acknowledges nothing.
        """
        for _ in range(3):
            self.send(np.zeros(4))
        self.publisher.wait_for_all_acked(Duration(seconds=0.2))
