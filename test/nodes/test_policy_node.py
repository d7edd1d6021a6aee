"""policy_node as a real process, driven over real ROS topics by a robot of this process."""

import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from fake_robot import FakeRobot
from geometry_msgs.msg import Twist
from ros_harness import child, wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import SetBool, Trigger

from vn_nav.errors import UserError
from vn_nav.nodes.qos import qos
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

pytestmark = pytest.mark.ros


@pytest.fixture
def robot():
    rclpy.init()
    robot = FakeRobot()
    yield robot
    robot.close()
    rclpy.shutdown()


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint')


def test_it_drives_within_limits_and_stops_when_the_camera_falls_silent(
        robot, checkpoint, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
        assert 'goal_image' in robot.refusal()
        assert not robot.commands, 'nothing is published before it is enabled'
        robot.drive()
        robot.spin_for(3.0)
        spec = RobotSpec()
        sent = np.array([velocity for _, velocity in robot.commands])
        assert np.abs(sent[:, 0]).max() <= spec.max_linear + 1e-9
        assert np.abs(sent[:, 2]).max() <= spec.max_angular + 1e-9
        assert (sent[:, [1, 3]] == 0).all()
        rise = np.diff(np.abs(sent), axis=0)
        assert rise[:, 0].max() <= spec.linear_acceleration / 20 + 1e-6
        assert rise[:, 2].max() <= spec.angular_acceleration / 20 + 1e-6
        wait_until(robot.moving, robot.spin)
        robot.sends.discard('image')
        silent = time.monotonic()
        # 0.25 s is the limit (test_soak.py measures it); a loaded machine wakes late.
        assert robot.wait_for_zero() - silent < 0.5
        heard = len(robot.commands)
        robot.spin_for(2.5)
        assert not np.array([v for _, v in robot.commands[heard:]]).any()
        robot.says('no camera frame', 'no usable camera frame')
        assert time.monotonic() - robot.commands[-1][0] > 0.3, 'silence after the latched stop'
        robot.sends.add('image')
        assert '~/reset' in robot.refusal()
        assert robot.call(Trigger, 'reset').success
        heard = len(robot.commands)
        robot.spin_for(1.5)
        assert len(robot.commands) == heard, 'reset never enables'
        robot.enable()
        wait_until(robot.moving, robot.spin)
        asked = time.monotonic()
        assert robot.call(Trigger, 'stop').success
        assert robot.wait_for_zero() - asked < 0.5


def test_what_the_policy_declares(tmp_path):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    picture = np.zeros((3, 84, 84), np.uint8)
    for threshold, in_force, arrived in ((None, 0.5, True), (0.95, 0.95, False), (1, 1, False)):
        runtime = PolicyRuntime(sure, stop_threshold=threshold)
        assert runtime.stop_threshold == in_force
        runtime.set_goal(picture)
        assert np.isnan(runtime.arrival) and not runtime.arrived
        runtime.act(picture)
        assert runtime.arrival == pytest.approx(0.93) and runtime.arrived == arrived
    silent = PolicyRuntime(write_checkpoint(tmp_path / 'silent', arrival=0.93))
    headless = PolicyRuntime(write_checkpoint(tmp_path / 'headless'))
    for runtime in (silent, headless):
        runtime.set_goal(picture)
        runtime.act(picture)
        assert runtime.stop_threshold is None and not runtime.arrived
    assert silent.arrival == pytest.approx(0.93) and np.isnan(headless.arrival)
    with pytest.raises(UserError, match='head arrival'):
        PolicyRuntime(tmp_path / 'headless', stop_threshold=0.5)
    with pytest.raises(UserError, match=r'\[0, 1\]'):
        PolicyRuntime(sure, stop_threshold=1.5)


@pytest.mark.parametrize('mode', ['stop_and_go', 'continuous'])
def test_a_declared_arrival_stands_still_and_says_so(robot, tmp_path, mode):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=sure, mode=mode):
        robot.show_goal(0)
        robot.enable()
        wait_until(lambda: robot.arrived and robot.arrived[-1], robot.spin)
        robot.says('arrived (p = 0.93)')
        statements = len(robot.arrived)
        robot.spin_for(1.0)
        assert len(robot.arrived) == statements, 'said once'
        robot.show_goal(1)  # another one: it takes it, looks, and says so again
        wait_until(lambda: robot.arrived[statements:] == [False, True], robot.spin)
        assert robot.call(SetBool, 'enable', data=True).success
        wait_until(lambda: robot.arrived[statements + 2:][-2:] == [False, True], robot.spin)
        assert robot.call(SetBool, 'enable', data=False).success
        wait_until(lambda: not robot.arrived[-1], robot.spin)
        assert robot.commands and not any(v.any() for _, v in robot.commands)


def test_the_parameter_is_stronger_than_the_checkpoint(robot, tmp_path):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=sure,
               stop_threshold=0.95):
        robot.drive()
        assert robot.arrived and not any(robot.arrived)


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP,
                                    signal.SIGQUIT])
def test_signals_deliver_zero(robot, checkpoint, tmp_path, number):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint) as process:
        robot.drive()
        os.kill(process.pid, number)
        sent = time.monotonic()
        assert robot.wait_for_zero() - sent < 0.5
        wait_until(lambda: process.poll() is not None, robot.spin)
        assert process.returncode == 0, (tmp_path / 'log').read_text()
        assert not robot.moving()


def test_a_second_publisher_and_a_narrow_camera_are_refused(robot, checkpoint, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
        robot.focal = 84.0  # 53 degrees where the policy needs 90
        robot.show_goal()
        # Not for what is not there yet.
        robot.refuses('deg')
        robot.focal = 42.0
        robot.enable()
        wait_until(robot.moving, robot.spin)
        intruder = robot.node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
        robot.says('other publisher')
        robot.wait_for_zero()
        robot.node.destroy_publisher(intruder)


def test_a_policy_that_searches_drives_by_a_narrow_wide_format_camera(tmp_path):
    spec = RobotSpec().with_actions(DRIVE_ACTIONS)
    checkpoint = write_checkpoint(
        tmp_path / 'search', 48, architecture='search', channels=(8, 12, 8), blocks=1,
        moves=spec.moves, view=spec.camera_fov, footprint=spec.footprint_radius)
    rclpy.init()
    robot = FakeRobot((160, 90))
    try:
        with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
            robot.focal = 80 / math.tan(math.radians(20))  # 40 deg across
            robot.show_goal()
            robot.refuses('horizontally')
            robot.focal = 80 / math.tan(math.radians(30))
            robot.enable()
            wait_until(robot.moving, robot.spin)
            *_, values = robot.statuses[-1]
            assert float(values['camera_fov_deg']) == pytest.approx(36.0, abs=0.1)  # upright
    finally:
        robot.close()
        rclpy.shutdown()


@pytest.mark.parametrize('parameters, word', [
    (['-p', 'checkpoint:=/nowhere'], 'checkpoint'),
    (['-p', 'robot:=/nowhere.yaml'], 'robot file'),
    (['-p', 'mode:=sideways'], 'mode'),
    (['-p', 'stop_threshold:=-0.5'], 'stop_threshold'),
    (['-p', 'mode:=continuous', '-p', 'blocked_moves:=3'], 'blocked_moves'),
])
def test_bad_input_is_one_line_and_exit_code_2(parameters, word):
    done = subprocess.run([sys.executable, '-m', 'vn_nav.nodes.policy_node', '--ros-args',
                           *parameters], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert word in done.stderr and 'received' in done.stderr


def test_a_fisheye_camera_drives_and_an_uncalibrated_one_does_not(checkpoint, tmp_path):
    rclpy.init()
    robot = FakeRobot((160, 120))
    lens = CameraInfo(width=160, height=120, distortion_model='equidistant',
                      d=[-0.02, 0.004, -0.002, 0.0003],
                      k=[51.0, 0.0, 80.0, 0.0, 51.0, 59.0, 0.0, 0.0, 1.0])
    try:
        with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
            robot.focal = 0.0
            robot.show_goal()
            robot.refuses('not calibrated')
            robot.info.publish(lens)
            robot.enable()
            wait_until(robot.moving, robot.spin)
            *_, values = robot.says('equidistant, rectified')
            assert float(values['camera_fov_deg']) == pytest.approx(120.0, abs=0.5)
            robot.size = (160, 160)  # pictures of another format than the camera's
            robot._pictures = 16 * [np.zeros((160, 160, 3), np.uint8)]
            robot.wait_for_zero()
            robot.says("camera_info has the pictures' format")
    finally:
        robot.close()
        rclpy.shutdown()
