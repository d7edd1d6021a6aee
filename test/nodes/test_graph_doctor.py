"""`vn_nav doctor` on real graphs: a simulated robot is sound, and what is wrong is found."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import rclpy
from fake_robot import RELIABLE, FakeRobot
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from paths import ROOT
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import PATIENCE, child, wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo, Image

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry
from vn_nav.nodes.base_check import TURN_RAD_PER_S
from vn_nav.nodes.qos import qos

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
# Wide, for a busy machine: what is looked for here is not its load.
CALM = [f'--set={name}={value}' for name, value in (
    ('frame_timeout', 5.0), ('odometry_timeout', 5.0), ('max_frame_age', 5.0),
    ('max_frame_ahead', 5.0))]


def doctor(folder, *words):
    """Run the command in a process of its own: exit code, and what it found."""
    figures = folder / 'doctor.json'
    done = subprocess.run(
        [sys.executable, '-m', 'vn_nav.cli', 'doctor', '--json', str(figures), *words],
        capture_output=True, text=True, timeout=250, cwd=ROOT,
        env=os.environ | {'OMP_NUM_THREADS': '1'})
    assert figures.is_file(), done.stdout + done.stderr
    return done, json.loads(figures.read_text())


def has(found, check, severity, text):
    """A finding of a check that says this; all of them where it is missing."""
    rows = [f for f in found['findings'] if f['check'] == check and f['severity'] == severity
            and text in f'{f["topic"]} {f["seen"]}']
    assert rows, '\n'.join(f'{f["severity"]} {f["check"]} {f["topic"]} {f["seen"]}'
                           for f in found['findings'])
    return rows[0]


def test_a_simulated_robot_is_sound_and_its_base_stops_by_itself(tmp_path):
    log, page = tmp_path / 'log', tmp_path / 'page.html'
    with child('vn_sim_bridge.bridge_node', log, scene='house:7', noise=False):
        wait_until(lambda: 'ready:' in log.read_text(), lambda: threading.Event().wait(0.2))
        done, found = doctor(tmp_path, '--checkpoint', 'models/search', '--seconds', '8',
                             '--base-check', '--html', str(page), *CALM)
    assert done.returncode == 0, done.stdout
    errors = [f for f in found['findings'] if f['severity'] == 'error']
    assert not errors and done.stdout.splitlines()[-1].startswith('errors: 0')
    assert '/sim_bridge_node' in found['graph']['nodes']
    has(found, 'pictures', 'ok', 'rgb8 84 x 84')
    has(found, 'odometry', 'ok', 'odom to base_link')
    has(found, 'command', 'ok', '/sim_bridge_node listens')
    has(found, 'camera', 'ok', 'a square of 84 pixels is used')
    stop = found['graph']['base_stop']
    assert stop['turned'] > 0.1 and stop['seconds'] is not None
    assert 'base time-out' in page.read_text()


class Faulty:
    """A robot with drivers that do much wrong; a node of its own participant for each."""

    def __init__(self):
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._nodes = []
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        camera, base, teleop, logger = map(self._node, ('camera', 'base', 'teleop', 'logger'))
        self._image = camera.create_publisher(Image, 'image_raw', qos('image_raw'))
        self._info = camera.create_publisher(CameraInfo, 'camera_info', qos('camera_info'))
        self._odom = base.create_publisher(Odometry, 'odom', best_effort)
        teleop.create_publisher(Twist, 'cmd_vel', 5)
        logger.create_subscription(Odometry, 'odom', lambda _: None, QoSProfile(depth=5))
        base.create_subscription(Twist, 'cmd_vel', lambda _: None, latched)
        camera.create_timer(0.1, self._show)
        base.create_timer(0.05, self._move)
        self._camera, self._base = camera, base
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _node(self, name):
        node = rclpy.create_node(name, context=self._context)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def _show(self):
        message = fill_image(Image(), np.zeros((48, 64, 3), np.uint8), 'rgb8')
        message.encoding = '64FC9'
        message.header.stamp = (self._camera.get_clock().now()
                                - rclpy.duration.Duration(seconds=30)).to_msg()
        self._image.publish(message)
        info = CameraInfo(width=64, height=48)
        info.k[0] = 50.0  # 51 deg on the shorter side
        self._info.publish(info)

    def _move(self):
        message = fill_odometry(Odometry(), 0.0, 0.0, 0.0, np.zeros(4))
        message.header.stamp = self._base.get_clock().now().to_msg()
        message.header.frame_id = message.child_frame_id = 'odom'
        self._odom.publish(message)

    def close(self):
        self._executor.shutdown()
        self._thread.join(PATIENCE)
        for node in self._nodes:
            node.destroy_node()
        rclpy.shutdown(context=self._context)


def test_what_is_wrong_is_found_with_its_fix(tmp_path):
    with contextlib.closing(Faulty()):
        done, found = doctor(tmp_path, '--checkpoint', 'models/house', '--seconds', '5')
    assert done.returncode == 1
    assert 'rgb8' in has(found, 'pictures', 'error', '64FC9')['fix']
    assert 'twist_mux' in has(found, 'command', 'error', '/teleop publishes')['fix']
    has(found, 'clock', 'error', '/image_raw stamps lie 30')
    has(found, 'clock', 'error', 'differ by 30')
    has(found, 'qos', 'error', '/base asks for transient local and /teleop offers volatile')
    has(found, 'qos', 'warning', '/logger asks for reliable and /base offers best effort')
    has(found, 'odometry', 'error', 'from odom to itself')
    has(found, 'camera', 'error', 'at least the 90 deg')
    has(found, 'topics', 'warning', '/goal_image is not published')
    has(found, 'base time-out', 'warning', 'no parameter of a time-out')
    assert all(f['fix'] for f in found['findings'] if f['severity'] != 'ok')


def test_names_types_and_parameters_of_a_robot_in_its_own_words(tmp_path):
    """A base that wants TwistStamped, under other names, with a time-out of 0."""
    names = tmp_path / 'names.yaml'
    names.write_text('image: /front/rgb\nodometry: /wheels\ncommand: /drive/cmd\n'
                     'camera_info: null\n')
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node('drive_controller', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.declare_parameter('cmd_vel_timeout', 0.0)
    node.create_publisher(Image, '/front/rgb', qos('image_raw'))
    node.create_subscription(TwistStamped, '/drive/cmd', lambda _: None, 5)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        done, found = doctor(tmp_path, '--topics', str(names), '--seconds', '2')
        refused, _ = doctor(tmp_path, '--topics', str(names), '--seconds', '1', '--base-check')
    finally:
        executor.shutdown()
        thread.join(PATIENCE)
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert done.returncode == 1
    assert 'enable_stamped_cmd_vel:=true' in has(
        found, 'command', 'error', '/drive/cmd /drive_controller subscribes to')['fix']
    assert 'ros2 param set /drive_controller cmd_vel_timeout 0.5' in has(
        found, 'base time-out', 'error', 'cmd_vel_timeout = 0')['fix']
    has(found, 'topics', 'error', '/front/rgb has a publisher')
    has(found, 'topics', 'error', '/wheels is not published')
    assert not any(f['topic'].endswith('camera_info') for f in found['findings'])
    assert refused.returncode == 2 and 'no odometry' in refused.stderr


def test_a_policy_that_runs_is_asked_for_its_parameters(tmp_path):
    log = tmp_path / 'log'
    with child('vn_nav.nodes.policy_node', log, checkpoint=write_checkpoint(tmp_path / 'policy'),
               enable_stamped_cmd_vel=True, image_transport='compressed', max_frame_age=1.5):
        wait_until(lambda: 'active' in log.read_text(), lambda: threading.Event().wait(0.2))
        _, found = doctor(tmp_path, '--seconds', '2')
    operation = found['graph']['operation']
    assert operation['node'] == '/policy_node' and operation['use_sim_time'] is False
    assert operation['stamped'] and operation['compressed']
    assert operation['limits']['max_frame_age'] == 1.5
    has(found, 'topics', 'error', '/image_raw/compressed is not published')
    has(found, 'command', 'error', 'nobody subscribes')
    assert not any('commands too' in f['seen'] for f in found['findings']), 'it is our own'


def test_of_two_robots_it_looks_at_the_one_in_the_namespace(tmp_path):
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    executor = SingleThreadedExecutor(context=context)
    nodes = [rclpy.create_node('base', namespace=name, context=context) for name in ('one', 'two')]
    for node in nodes:
        executor.add_node(node)
        node.create_publisher(Odometry, 'odom', qos('odom'))
    nodes[0].create_subscription(TwistStamped, 'cmd_vel', lambda _: None, 5)
    nodes[1].create_subscription(Twist, 'cmd_vel', lambda _: None, 5)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        found = {name: doctor(tmp_path, '--namespace', name, '--seconds', '1')[1]
                 for name in ('one', 'two')}
    finally:
        executor.shutdown()
        thread.join(PATIENCE)
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown(context=context)
    for name, other in (('one', 'two'), ('two', 'one')):
        has(found[name], 'topics', 'error', f'/{name}/odom has a publisher')
        assert not any(f'/{other}/' in f['topic'] for f in found[name]['findings'])
    has(found['one'], 'command', 'error', '/one/cmd_vel /one/base subscribes to')
    assert not any(f['check'] == 'command' and f['severity'] == 'error'
                   and 'subscribes to' in f['seen'] for f in found['two']['findings'])


def test_a_signal_in_the_trial_of_a_base_ends_it_with_zero(tmp_path):
    rclpy.init()
    robot = FakeRobot(odometry=RELIABLE)
    words = ['doctor', '--seconds', '2', '--base-check', '--json', str(tmp_path / 'a.json')]
    try:
        with subprocess.Popen([sys.executable, '-m', 'vn_nav.cli', *words], cwd=ROOT,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
            try:
                wait_until(lambda: process.poll() is not None or any(
                    velocity.any() for _, velocity in robot.commands), robot.spin)
                process.send_signal(signal.SIGTERM)
                wait_until(lambda: process.poll() is not None, robot.spin)
            finally:
                process.kill()
        robot.spin_for(0.5)
        assert process.returncode == 130 and not (tmp_path / 'a.json').exists()
        turning = [velocity[2] for _, velocity in robot.commands if velocity.any()]
        assert 0 < len(turning) and set(turning) == {TURN_RAD_PER_S}
        assert not robot.commands[-1][1].any() and not robot.commands[-5][1].any()
    finally:
        robot.node.destroy_node()
        rclpy.shutdown()


def test_an_empty_graph_says_where_it_looked(tmp_path):
    done, found = doctor(tmp_path, '--seconds', '0.5')
    assert done.returncode == 1
    lost = has(found, 'graph', 'error', f'on domain {os.environ["ROS_DOMAIN_ID"]}')
    assert 'ROS_DOMAIN_ID' in lost['fix']
