"""`teleop_node`: drive by keyboard or joystick, to record a place or to take a robot out of one.

Run: `ros2 run vn_nav teleop_node` in a terminal, or with `--ros-args -p source:=joy` beside
`ros2 run joy joy_node`. It publishes `cmd_vel` while a key, or the dead-man button, is held; then
zeros for a second, and then nothing. A policy_node on the same topic stops for a second publisher:
remap to `cmd_vel_joy` and put twist_mux in front of the base (docs/graph.md).
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections.abc import Iterator

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Joy

from vn_msgs_py import motion
from vn_nav.errors import UserError
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import qos
from vn_nav.policy.motion import ramp
from vn_nav.resources import share_file
from vn_nav.robot import load_robot
from vn_nav.teleop import Axes, Joystick, Keyboard, limits_of

AUTO, KEYBOARD, JOY = SOURCES = 'auto', 'keyboard', 'joy'
LET_GO_S = 1.0  # of zeros, after which somebody else may drive
_BUTTONS = Axes()
PARAMETERS = {
    'robot': ('', 'YAML file of the robot; empty: the standard robot'),
    'source': (AUTO, 'keyboard; joy: messages on the topic joy; auto: keyboard in a terminal',
               SOURCES),
    'speed': (1.0, "share of the robot's greatest speeds", (0.05, 1.0)),
    'rate': (20.0, 'commands per second [Hz]', (5.0, 100.0)),
    'joy_timeout': (0.5, 'time without a message after which the robot stands still [s]',
                    (0.05, 5.0)),
    'dead_man': (_BUTTONS.dead_man, 'button that is held while driving', (0, 63)),
    'axis_forward': (_BUTTONS.forward, 'number of the axis; -1: none', (-1, 63)),
    'axis_left': (_BUTTONS.left, 'the same, sideways', (-1, 63)),
    'axis_turn': (_BUTTONS.turn, 'the same, of turns', (-1, 63)),
    'axis_tilt': (_BUTTONS.tilt, "the same, of the camera's tilt", (-1, 63)),
    'dead_zone': (_BUTTONS.dead_zone, 'share of an axis about its middle that counts as nothing',
                  (0.0, 0.9)),
    'enable_stamped_cmd_vel': (False, 'publish TwistStamped instead of Twist'),
}
HELP = 'hold: w s drive  a d turn (or arrows){}; any other key stops, x leaves'


class TeleopNode(Node):
    """Publishes what a hand says.

    Attributes:
        source: KEYBOARD or JOY.
        hand: what it says.
        period: s between commands.
    """

    def __init__(self):
        super().__init__('teleop_node')
        value = parameters.declare(self, PARAMETERS, read_only=True,
                                   others=policy_parameters.PARAMETERS)
        self._robot = load_robot(value['robot'] or share_file('config/robots/standard.yaml'))
        self.source = value['source']
        if self.source == AUTO:
            self.source = KEYBOARD if sys.stdin.isatty() else JOY
        if self.source == KEYBOARD and not sys.stdin.isatty():
            raise UserError('the keyboard is that of a terminal', 'standard input is none',
                            'run it in a terminal, or with -p source:=joy')
        limits = value['speed'] * limits_of(self._robot)
        self.period = 1 / value['rate']
        self._stamped = value['enable_stamped_cmd_vel']
        self._publisher = self.create_publisher(TwistStamped if self._stamped else Twist,
                                                'cmd_vel', qos('cmd_vel'))
        self._velocity, self._moved_at, self._said = np.zeros(4), -LET_GO_S, ''
        self.hand: Keyboard | Joystick
        if self.source == KEYBOARD:
            self.hand = Keyboard(limits)
            self.get_logger().info(HELP.format(
                ('  q e sideways' if limits[1] else '') + ('  r f tilt' if limits[3] else '')))
            return
        self.hand = Joystick(limits, Axes(*(value[name] for name in (
            'axis_forward', 'axis_left', 'axis_turn', 'axis_tilt', 'dead_man', 'dead_zone'))),
            value['joy_timeout'])
        self.create_subscription(Joy, 'joy', self._on_joy, 1)
        self.get_logger().info(
            f'waits for {self.resolve_topic_name("joy")}; drives while button '
            f'{value["dead_man"]} is held')

    def _on_joy(self, message: Joy) -> None:
        assert isinstance(self.hand, Joystick)
        wrong = self.hand.take(message.axes, message.buttons, time.monotonic())
        if wrong and wrong != self._said:
            self.get_logger().error(wrong)
        self._said = wrong

    def command(self) -> None:
        """Publish the command of this period, if there is any."""
        now = time.monotonic()
        wanted = self.hand.velocity(now)
        if wanted is None:
            # Let go, or in doubt: at once.
            self._velocity = np.zeros(4)
            if now - self._moved_at > LET_GO_S:
                return
        else:
            self._velocity = ramp(self._velocity, wanted, self._robot, self.period)
            self._moved_at = now
        self._send()

    def _send(self) -> None:
        message = TwistStamped() if self._stamped else Twist()
        if self._stamped:
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = 'base_link'
        self._publisher.publish(motion.fill_twist(message, self._velocity))

    def close(self) -> None:
        """Say zero, delivered (200 ms at most), if anything was said."""
        if self._moved_at > 0:
            self._velocity = np.zeros(4)
            for _ in range(3):
                self._send()
            self._publisher.wait_for_all_acked(Duration(seconds=0.2))

    def destroy_node(self) -> None:
        """Stand still first."""
        self.close()
        super().destroy_node()


def drive(node: TeleopNode, ended: Ended) -> None:
    """Drive until a signal, the key to leave, or the end of the terminal."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    hand = node.hand
    with _keys() if isinstance(hand, Keyboard) else contextlib.nullcontext():
        due = time.monotonic()
        while not ended.is_set():
            due = max(due + node.period, time.monotonic())
            while (remaining := due - time.monotonic()) > 0:
                if not isinstance(hand, Keyboard):
                    executor.spin_once(timeout_sec=remaining)
                elif select.select([sys.stdin], [], [], remaining)[0]:
                    try:
                        text = os.read(sys.stdin.fileno(), 1024)
                    except OSError:  # the terminal is gone
                        return
                    if not text:
                        return
                    hand.press(text.decode(errors='replace'), time.monotonic())
            if isinstance(hand, Keyboard):
                executor.spin_once(timeout_sec=0)
                if hand.left:
                    return
            node.command()


@contextlib.contextmanager
def _keys() -> Iterator[None]:
    """Keys come at once, and are not shown."""
    import termios
    import tty
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def main(args=None) -> int:
    """Entry point: until a signal; exit code 2 and one line for bad parameters."""
    return run_node('teleop_node', lambda _: TeleopNode(), drive, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
