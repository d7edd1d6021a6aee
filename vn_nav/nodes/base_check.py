"""Tries whether a base stops by itself: it turns it a little, falls silent, and looks.

The only part of `vn_nav doctor` that publishes, and only when it is asked to. It ends with zero,
also after a signal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped

from vn_msgs_py.motion import MotionError, fill_twist, odometry_to_array
from vn_nav.doctor.seen import BaseStop, SeenTopic
from vn_nav.errors import UserError
from vn_nav.nodes.heard import Heard
from vn_nav.nodes.qos import qos
from vn_nav.nodes.signals import Ended

TURN_RAD_PER_S = 0.3
TURN_S = 1.0
SILENCE_S = 3.0  # in which a base has to stop
ZERO_S = 0.5  # at the end
PERIOD_S = 0.05
DISCOVERY_S = 1.0  # until the base has found the publisher
REST_RAD = 0.005  # a base within this of its last heading stands still
STILL_S = 0.5  # at the end of the silence, in which a base that has stopped does not turn


def try_base(node, command: SeenTopic, odometry: Heard,
             spin_for: Callable[[float], None]) -> BaseStop:
    """Turn the base to the left for a second, send nothing for three, then zero.

    Args:
        node: that publishes.
        command: topic of the commands.
        odometry: that is being heard.
        spin_for: serves the node for some seconds.

    Raises:
        UserError: somebody else publishes commands, nobody listens, or there is no odometry.
        KeyboardInterrupt: a signal came; the base has been sent zero.
    """
    rule = '--base-check moves the robot: it is done alone, with a base that listens and odometry'
    if command.publishers:
        raise UserError(rule, f'{command.publishers[0].node} publishes {command.name}',
                        'end it first')
    kinds = {'geometry_msgs/msg/Twist': Twist, 'geometry_msgs/msg/TwistStamped': TwistStamped}
    wanted = {end.type for end in command.subscribers}
    if len(wanted) != 1 or not wanted <= kinds.keys():
        raise UserError(rule, f'{command.name} is listened to as '
                        f'{", ".join(sorted(wanted)) or "nothing"}', 'correct that first')
    if odometry.last is None:
        raise UserError(rule, 'no odometry', 'start the base driver')
    kind = kinds[wanted.pop()]
    publisher = node.create_publisher(kind, command.name, qos('cmd_vel'))
    ended = Ended()

    def wait(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not ended.is_set():
            spin_for(PERIOD_S)

    def send(turn: float, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not (turn and ended.is_set()):
            message = fill_twist(kind(), np.array([0.0, 0.0, turn, 0.0]))
            if hasattr(message, 'header'):
                message.header.stamp = node.get_clock().now().to_msg()
                message.header.frame_id = 'base_link'
            publisher.publish(message)
            spin_for(PERIOD_S)

    try:
        wait(DISCOVERY_S)
        odometry.history.clear()
        send(TURN_RAD_PER_S, TURN_S)
        silent = time.monotonic() - PERIOD_S  # since the last command
        wait(SILENCE_S)
    finally:
        send(0.0, ZERO_S)
        node.destroy_publisher(publisher)
        ended.restore()
    if ended.is_set():
        raise KeyboardInterrupt
    return judge(_headings(odometry), silent, silent + SILENCE_S)


def _headings(odometry: Heard) -> np.ndarray:
    rows = []
    for at, message in odometry.history:
        try:
            rows.append((at, odometry_to_array(message)[2]))
        except MotionError:
            continue
    return np.array(rows).reshape(-1, 2)


def judge(headings: np.ndarray, silent: float, end: float) -> BaseStop:
    """What a base did.

    Args:
        headings: [N,2] time [s] and yaw [rad] by odometry, of turn, silence and zeros.
        silent, end: when the last command was sent, and when zero was [s].
    """
    before = headings[headings[:, 0] <= end]
    if len(before) < 2:
        return BaseStop(0.0, None)
    yaw = np.unwrap(before[:, 1])
    late = yaw[before[:, 0] >= end - STILL_S]
    turned = float(yaw[before[:, 0] <= silent + PERIOD_S][-1] - yaw[0]) if (
        before[0, 0] <= silent) else 0.0
    if not len(late) or np.ptp(late) > REST_RAD:
        return BaseStop(turned, None)
    moving = before[np.abs(yaw - yaw[-1]) > REST_RAD, 0]
    seconds = max(float(moving[-1]) - silent, 0.0) if len(moving) else 0.0
    return BaseStop(turned, seconds if math.isfinite(seconds) else None)
