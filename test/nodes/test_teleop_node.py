"""teleop_node drives while somebody holds a key or the dead-man button, and lets go."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time

import pytest
import rclpy
from geometry_msgs.msg import Twist
from paths import ROOT
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, child, wait_until
from sensor_msgs.msg import Joy

from vn_nav.nodes.qos import qos

pytestmark = [pytest.mark.ros, pytest.mark.slow]
NODE = 'vn_nav.nodes.teleop_node'


class Base:
    """Hears commands, and plays the joystick."""

    def __init__(self):
        self.node = rclpy.create_node('base')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.heard = []  # when, and the message
        self.node.create_subscription(
            Twist, 'cmd_vel', lambda twist: self.heard.append((time.monotonic(), twist)),
            qos('cmd_vel'))
        self.joy = self.node.create_publisher(Joy, 'joy', 1)

    def spin(self):
        self._executor.spin_once(timeout_sec=0.02)

    def spin_for(self, seconds):
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.spin()

    def moves(self):
        return bool(self.heard) and self.heard[-1][1].linear.x > 0

    def zeros(self):
        """How many of the newest commands in a row are zero."""
        return next((k for k, (_, twist) in enumerate(reversed(self.heard)) if twist != Twist()),
                    len(self.heard))

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def base():
    rclpy.init()
    robot = Base()
    try:
        yield robot
    finally:
        robot.close()
        rclpy.shutdown()


@contextlib.contextmanager
def in_terminal(log):
    """The node in a terminal of its own: (process, the terminal's other end)."""
    ours, theirs = pty.openpty()
    with open(log, 'w') as file:
        process = subprocess.Popen([sys.executable, '-m', NODE], stdin=theirs, stdout=file,
                                   stderr=file, cwd=ROOT, start_new_session=True)
    os.close(theirs)
    try:
        yield process, ours
    finally:
        process.kill()
        process.wait()
        with contextlib.suppress(OSError):
            os.close(ours)


def held(base, terminal, seconds):
    """Hold W, as a terminal repeats it."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        os.write(terminal, b'w')
        base.spin_for(0.03)


def test_a_key_drives_while_it_is_held(base, tmp_path):
    log = tmp_path / 'log'
    with in_terminal(log) as (process, terminal):
        wait_until(lambda: 'hold:' in log.read_text(), base.spin)
        wait_until(lambda: base.node.count_publishers('cmd_vel'), base.spin)
        base.spin_for(0.5)
        assert not base.heard, 'nobody has pressed anything'
        wait_until(base.moves, lambda: held(base, terminal, 0.1))
        held(base, terminal, 1.0)
        assert base.moves()
        wait_until(lambda: base.zeros() > 3, base.spin, 5)
        base.spin_for(1.5)
        count = len(base.heard)
        base.spin_for(0.5)
        assert len(base.heard) == count and base.zeros(), 'it has let go of the base'
        speeds = [twist.linear.x for _, twist in base.heard]
        assert max(speeds) == pytest.approx(0.3) and 0 < min(s for s in speeds if s) < 0.1
        os.write(terminal, b'x')
        wait_until(lambda: process.poll() is not None, base.spin)
        assert process.returncode == 0, log.read_text()


@pytest.mark.parametrize('end', [signal.SIGINT, signal.SIGTERM, 'the terminal'])
def test_whatever_ends_it_the_robot_stands(base, tmp_path, end):
    with in_terminal(tmp_path / 'log') as (process, terminal):
        wait_until(base.moves, lambda: held(base, terminal, 0.1))
        if end == 'the terminal':
            os.close(terminal)
        else:
            process.send_signal(end)
        wait_until(lambda: process.poll() is not None, base.spin)
        assert process.returncode == 0, (tmp_path / 'log').read_text()
        base.spin_for(0.3)
        assert base.zeros() >= 1


def test_a_joystick_drives_while_its_button_is_held(base, tmp_path):
    def say(button):
        base.joy.publish(Joy(axes=[0.0, 1.0, 0.0, 0.0], buttons=[0, 0, 0, 0, button]))
        base.spin_for(0.05)
    with child(NODE, tmp_path / 'log', source='joy') as process:
        wait_until(lambda: base.joy.get_subscription_count(), base.spin)
        for _ in range(10):
            say(0)
        assert not base.heard
        wait_until(base.moves, lambda: say(1))
        for _ in range(5):
            say(1)
        assert base.moves()
        wait_until(lambda: base.zeros() > 3, base.spin, 5)  # the joystick is silent
        wait_until(base.moves, lambda: say(1))
        wait_until(lambda: base.zeros(), lambda: say(0), 5)
        base.joy.publish(Joy(axes=[0.0], buttons=[]))
        wait_until(lambda: 'dead-man button is number 4' in (tmp_path / 'log').read_text(),
                   base.spin)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0


def test_without_a_terminal_there_is_no_keyboard():
    done = subprocess.run([sys.executable, '-m', NODE, '--ros-args', '-p', 'source:=keyboard'],
                          stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=100,
                          cwd=ROOT)
    assert done.returncode == 2 and 'source:=joy' in done.stderr.splitlines()[-1]
