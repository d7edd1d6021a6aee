"""policy_node as a real process, driven over real ROS topics by a camera of this process."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from rclpy.executors import SingleThreadedExecutor
from ros_harness import child, wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import twist_to_array
from vn_nav.errors import UserError
from vn_nav.nodes.qos import qos
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.robot import RobotSpec

pytestmark = pytest.mark.ros


class Camera:
    """Publishes pictures at 30 Hz, and hears the commands."""

    def __init__(self):
        self.node = rclpy.create_node('camera')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.image = self.node.create_publisher(Image, 'image_raw', qos('image_raw'))
        self.info = self.node.create_publisher(CameraInfo, 'camera_info', qos('camera_info'))
        self.goal = self.node.create_publisher(Image, 'goal_image', qos('goal_image'))
        self.commands, self.reasons, self.arrived = [], [], []
        self.node.create_subscription(Bool, 'arrived', self._hear_arrived, qos('arrived'))
        self.node.create_subscription(Twist, 'cmd_vel', self._hear, qos('cmd_vel', depth=100))
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnose,
                                      qos('/diagnostics'))
        self.sending, self.due, self.fov_focal = True, 0.0, 42.0
        self.rng = np.random.default_rng(0)

    def _hear(self, message):
        self.commands.append((time.monotonic(), twist_to_array(message)))

    def _hear_arrived(self, message):
        self.arrived.append(message.data)

    def _diagnose(self, message):
        self.reasons.append(message.status[0].message)

    def picture(self):
        message = fill_image(Image(), self.rng.integers(0, 255, (84, 84, 3), np.uint8), 'rgb8')
        message.header.stamp = self.node.get_clock().now().to_msg()
        return message

    def show_goal(self):
        self.goal.publish(self.picture())

    def spin(self):
        now = time.monotonic()
        if self.sending and now >= self.due:
            self.due = now + 1 / 30
            info = CameraInfo(width=84, height=84)
            info.k[0] = self.fov_focal
            self.info.publish(info)
            self.image.publish(self.picture())
        self.executor.spin_once(timeout_sec=0.005)

    def call(self, kind, name, **fields):
        """Call a service of the policy while the camera goes on."""
        client = self.node.create_client(kind, f'/policy_node/{name}')
        wait_until(client.service_is_ready, self.spin)
        future = client.call_async(kind.Request(**fields))
        wait_until(future.done, self.spin)
        self.node.destroy_client(client)
        return future.result()

    def enable(self):
        """Enable as soon as the node agrees."""
        self.show_goal()
        answers = []

        def enabled():
            answers.append(self.call(SetBool, 'enable', data=True))
            return answers[-1].success
        wait_until(enabled, self.spin)

    def moving(self):
        return bool(self.commands) and self.commands[-1][1].any()


@pytest.fixture
def camera():
    rclpy.init()
    camera = Camera()
    yield camera
    camera.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint')


def test_it_drives_within_limits_and_stops_when_the_camera_falls_silent(
        camera, checkpoint, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
        answer = camera.call(SetBool, 'enable', data=True)
        assert not answer.success and 'goal_image' in answer.message
        assert not camera.commands, 'nothing is published before it is enabled'
        camera.enable()
        wait_until(camera.moving, camera.spin)
        end = time.monotonic() + 3
        wait_until(lambda: time.monotonic() > end, camera.spin)
        robot = RobotSpec()
        sent = np.array([velocity for _, velocity in camera.commands])
        assert np.abs(sent[:, 0]).max() <= robot.max_linear + 1e-9
        assert np.abs(sent[:, 2]).max() <= robot.max_angular + 1e-9
        assert (sent[:, [1, 3]] == 0).all()
        rise = np.diff(np.abs(sent), axis=0)
        assert rise[:, 0].max() <= robot.linear_acceleration / 20 + 1e-6
        assert rise[:, 2].max() <= robot.angular_acceleration / 20 + 1e-6
        wait_until(camera.moving, camera.spin)
        camera.sending, silent = False, time.monotonic()
        wait_until(lambda: not camera.moving(), camera.spin, 2)
        assert camera.commands[-1][0] - silent < 0.35  # the last frame came up to 33 ms earlier
        heard = len(camera.commands)
        end = time.monotonic() + 2.5
        wait_until(lambda: time.monotonic() > end, camera.spin)
        assert not np.array([v for _, v in camera.commands[heard:]]).any()
        assert any('no camera frame' in reason for reason in camera.reasons)
        assert time.monotonic() - camera.commands[-1][0] > 0.3, 'silence after the latched stop'
        camera.sending = True
        answer = camera.call(SetBool, 'enable', data=True)
        assert not answer.success and '~/reset' in answer.message
        assert camera.call(Trigger, 'reset').success
        heard = len(camera.commands)
        end = time.monotonic() + 1.5
        wait_until(lambda: time.monotonic() > end, camera.spin)
        assert len(camera.commands) == heard, 'reset never enables'
        camera.enable()
        wait_until(camera.moving, camera.spin)
        assert camera.call(Trigger, 'stop').success
        wait_until(lambda: not camera.moving(), camera.spin, 0.3)


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
def test_a_declared_arrival_stands_still_and_says_so(camera, tmp_path, mode):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=sure, mode=mode):
        camera.enable()
        wait_until(lambda: camera.arrived and camera.arrived[-1], camera.spin)
        wait_until(lambda: any(r.startswith('arrived (p = 0.93)') for r in camera.reasons),
                   camera.spin, 3)
        statements = len(camera.arrived)
        end = time.monotonic() + 1
        wait_until(lambda: time.monotonic() > end, camera.spin)
        assert len(camera.arrived) == statements, 'said once'
        camera.show_goal()  # another one: it takes it, looks, and says so again
        wait_until(lambda: camera.arrived[statements:] == [False, True], camera.spin, 5)
        assert camera.call(SetBool, 'enable', data=True).success
        wait_until(lambda: camera.arrived[statements + 2:] == [False, True], camera.spin, 5)
        assert camera.call(SetBool, 'enable', data=False).success
        wait_until(lambda: not camera.arrived[-1], camera.spin, 3)
        assert camera.commands and not any(v.any() for _, v in camera.commands)


def test_the_parameter_is_stronger_than_the_checkpoint(camera, tmp_path):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=sure,
               stop_threshold=0.95):
        camera.enable()
        wait_until(camera.moving, camera.spin)
        assert camera.arrived and not any(camera.arrived)


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP,
                                    signal.SIGQUIT])
def test_signals_deliver_zero(camera, checkpoint, tmp_path, number):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint) as process:
        camera.enable()
        wait_until(camera.moving, camera.spin)
        os.kill(process.pid, number)
        sent = time.monotonic()
        wait_until(lambda: not camera.moving(), camera.spin, 2)
        assert camera.commands[-1][0] - sent < 0.25
        wait_until(lambda: process.poll() is not None, camera.spin, 10)
        assert process.returncode == 0, (tmp_path / 'log').read_text()
        assert not camera.commands[-1][1].any()


def test_a_second_publisher_and_a_narrow_camera_are_refused(camera, checkpoint, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint):
        camera.fov_focal = 84.0  # 53 degrees where the policy needs 90
        camera.show_goal()

        def refused_as_narrow():
            camera.spin()
            answer = camera.call(SetBool, 'enable', data=True)
            assert not answer.success
            return 'deg' in answer.message  # and not for what is not there yet
        wait_until(refused_as_narrow, camera.spin)
        camera.fov_focal = 42.0
        end = time.monotonic() + 0.5
        wait_until(lambda: time.monotonic() > end, camera.spin)
        camera.enable()
        wait_until(camera.moving, camera.spin)
        intruder = camera.node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
        wait_until(lambda: any('other publisher' in r for r in camera.reasons), camera.spin)
        assert not camera.moving()
        camera.node.destroy_publisher(intruder)


@pytest.mark.parametrize('parameters, word', [
    (['-p', 'checkpoint:=/nowhere'], 'checkpoint'),
    (['-p', 'robot:=/nowhere.yaml'], 'robot file'),
    (['-p', 'mode:=sideways'], 'mode'),
    (['-p', 'stop_threshold:=-0.5'], 'stop_threshold'),
])
def test_bad_input_is_one_line_and_exit_code_2(parameters, word):
    done = subprocess.run([sys.executable, '-m', 'vn_nav.nodes.policy_node', '--ros-args',
                           *parameters], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert word in done.stderr and 'received' in done.stderr
