"""Remembered routes for real: a recorded drive, then `vn_nav goal kitchen`, on ROS."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from browser import CHROMIUM, Browser
from dashboard_client import dashboard, live, post
from joystick_drive import drive, write_bag
from nav_msgs.msg import Odometry
from paths import ROOT
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, child, wait_until, write_checkpoint
from sensor_msgs.msg import Image
from std_msgs.msg import String

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import odometry_to_array
from vn_nav.arrival import wrap_angle
from vn_nav.nodes.qos import qos

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(500)]
HOUSE, ROOMS = 12_001, 2  # no training saw it
NODE = 'vn_nav.nodes.route_node'
SAID = {'stamp': [2, 0], 'status': 'waiting', 'error_code': 0, 'error_msg': '', 'decisions': 0}
ARRIVED_M, ARRIVED_RAD = 0.9, math.radians(40)  # the recorded picture is of a moving camera


def command(*words, **options):
    """`vn_nav` as a process."""
    return subprocess.Popen([sys.executable, '-m', 'vn_nav.cli', *map(str, words)],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


@pytest.fixture(scope='module')
def way(tmp_path_factory):
    """A route by `vn_nav route`, and the poses of its pictures."""
    folder = tmp_path_factory.mktemp('drive')
    poses, pictures = drive(45.0, rooms=ROOMS, house=HOUSE, size=84)
    bag = write_bag(folder / 'bag', poses, pictures)
    done = command('route', bag, '--out', folder / 'way')
    assert done.wait(PATIENCE) == 0, done.stderr.read()
    from vn_nav.bags.roles import Topics
    from vn_nav.routes.from_bag import pictures_along
    rows = [round(own.time / 0.2) for own in pictures_along(bag, Topics())]
    return folder / 'way', poses[rows]


class Watch:
    """Hears what route_node says, and where the robot really is."""

    def __init__(self):
        rclpy.init()
        self.node = rclpy.create_node('watch')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.pose, self.said = None, []
        self.node.create_subscription(Odometry, 'ground_truth/odom', self._hear,
                                      qos('ground_truth/odom'))
        self.node.create_subscription(
            String, 'route_status', lambda message: self.said.append(json.loads(message.data)),
            qos('route_status', depth=100))

    def _hear(self, message):
        self.pose = odometry_to_array(message)[:3]

    def spin(self):
        self.executor.spin_once(timeout_sec=0.05)

    def until(self, status):
        wait_until(lambda: self.said and self.said[-1]['status'] == status, self.spin,
                   what=f'{status}: {self.said[-3:]}')
        return self.said[-1]

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown()


@contextlib.contextmanager
def watching():
    watch = Watch()
    try:
        yield watch
    finally:
        watch.close()


def finish(process, watch, seconds=300):
    """Wait for a command while the watch hears; code and what it printed."""
    until = time.monotonic() + seconds
    while process.poll() is None:
        assert time.monotonic() < until, watch.said[-3:]
        watch.spin()
    return process.returncode, process.stdout.read(), process.stderr.read()


def test_it_drives_to_places_by_their_names(way, tmp_path):
    folder, poses = way
    last = len(poses) - 1
    named = command('route', folder, '--name', f'kitchen={last}', '--name', 'desk=0')
    assert named.wait(PATIENCE) == 0
    search = ROOT / 'models' / 'search'
    with watching() as watch, \
            child('vn_sim_bridge.bridge_node', tmp_path / 'bridge', house=HOUSE, rooms=ROOMS,
                  time='lock_step', free_driving=True, noise=False), \
            child('vn_nav.nodes.policy_node', tmp_path / 'policy', checkpoint=search,
                  time='lock_step', use_sim_time=True, keep_map=True), \
            child(NODE, tmp_path / 'route', route=folder, checkpoint=search,
                  use_sim_time=True, max_decisions=250) as node:
        wait_until(lambda: watch.said, watch.spin)
        code, said, _ = finish(command('goal'), watch)
        assert code == 0 and said == 'places: kitchen, desk\n'
        outcomes = []
        for place, number in (('kitchen', last), ('desk', 0), ('kitchen', last)):
            code, said, errors = finish(command('goal', place), watch)
            way = [one for one in watch.said if one['place'] == place]
            gap = np.hypot(*(watch.pose[:2] - poses[number, :2]))
            turn = abs(wrap_angle(watch.pose[2] - poses[number, 2]))
            outcomes.append((place, code, gap, math.degrees(turn), way[-1], said, errors))
            if code == 0:
                assert f'arrived at {place}' in said and way[-1]['shown'] == number, outcomes
            else:
                assert code == 1 and 'are used up' in said, outcomes
        # It recognises nine of ten places; what it says of one of them may be wrong.
        right = [code == 0 and gap < ARRIVED_M and turn < math.degrees(ARRIVED_RAD)
                 for _, code, gap, turn, *_ in outcomes]
        assert sum(right) >= 2, outcomes
        # It went along the route, not straight for the goal alone.
        assert max(one['pictures_shown'] for one in watch.said) > 1
        code, said, _ = finish(command('goal', 'the moon'), watch)
        assert code == 1 and 'kitchen' in said
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0
    for name in ('bridge', 'policy', 'route'):
        assert 'Traceback' not in (tmp_path / name).read_text()


def test_a_person_stops_it(way, tmp_path):
    folder, _ = way
    with watching() as watch, \
            child('vn_sim_bridge.bridge_node', tmp_path / 'bridge', house=HOUSE, rooms=ROOMS,
                  time='lock_step', free_driving=True), \
            child('vn_nav.nodes.policy_node', tmp_path / 'policy', time='lock_step',
                  checkpoint=ROOT / 'models' / 'search', use_sim_time=True, stop_threshold=1.0), \
            child(NODE, tmp_path / 'route', route=folder, place="'0'", use_sim_time=True) as node:
        watch.until('active')
        # Another command takes it over; Ctrl-C there stops the robot.
        driver = command('goal', len(way[1]) - 2)
        wait_until(lambda: watch.said[-1]['place'] == str(len(way[1]) - 2)
                   and watch.said[-1]['status'] == 'active', watch.spin)
        driver.send_signal(signal.SIGINT)
        code, said, _ = finish(driver, watch)
        assert code == 130 and 'stopped' in said
        watch.until('cancelled')
        before = watch.pose.copy()
        for _ in range(20):
            watch.spin()
        assert np.abs(watch.pose - before).max() < 0.3
        # So does the end of route_node.
        finish(command('goal', '0', '--no-wait'), watch)
        watch.until('active')
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0
        assert watch.until('cancelled')['error_msg'] == 'route_node ended'


def test_a_page_in_the_browser_drives_along_it(way, tmp_path):
    folder, _ = way
    named = command('route', folder, '--name', 'kitchen=2', '--name', 'desk=first')
    assert named.wait(PATIENCE) == 0
    with child('vn_sim_bridge.bridge_node', tmp_path / 'bridge', house=HOUSE, rooms=ROOMS,
               time='lock_step', free_driving=True), \
            child('vn_nav.nodes.policy_node', tmp_path / 'policy', time='lock_step',
                  checkpoint=ROOT / 'models' / 'search', use_sim_time=True, stop_threshold=1.0), \
            dashboard(tmp_path / 'log') as (address, _):
        def until(condition):
            return live(address, lambda message: isinstance(message, dict) and condition(
                message['route']))[-1]['route']
        until(lambda route: route is None)
        code, said = post(f'{address}place', b'kitchen')
        assert code == 200 and not said['done'] and 'route_node' in said['message']
        with child(NODE, tmp_path / 'route', route=folder, use_sim_time=True) as node:
            until(lambda route: route and 'kitchen' in route['places'])
            for wrong in (b'bath', b'\xff'):
                assert not post(f'{address}place', wrong)[1]['done']
            assert post(f'{address}place', b'kitchen', Origin='http://evil.example')[0] == 403
            assert post(f'{address}place', b'kitchen')[1]['done']
            live(address, lambda message: isinstance(message, dict) and (
                message['goal']['status'], message['route']['place']) == ('active', 'kitchen'))
            assert post(f'{address}stop')[1]['done']
            until(lambda route: route['status'] == 'cancelled')
            # What a person has stopped only a person sets going.
            assert post(f'{address}place', b'desk')[1]['done']
            ended = until(lambda route: route['status'] == 'failed')
            assert ended['place'] == 'desk' and 'reset' in ended['error_msg']
            assert post(f'{address}reset')[1]['done']
            if CHROMIUM is not None:
                drive_by_page(address, tmp_path)
            node.send_signal(signal.SIGINT)
            assert node.wait(PATIENCE) == 0
            until(lambda route: route is None)


def drive_by_page(address, tmp_path):
    """Click on a place, and on Stop."""
    with Browser(tmp_path / 'profile', address) as page:
        page.wait_for('document.querySelectorAll("#places button").length == 2')
        page.click('#places button:first-child')
        page.wait_for('document.getElementById("route_status").textContent.startsWith('
                      '"drives to kitchen; shows picture ")')
        assert page.value('document.querySelector("#places .chosen").textContent') == 'kitchen'
        page.click('#stop')
        page.wait_for('document.getElementById("route_status").textContent.startsWith('
                      '"to kitchen cancelled")')
        assert not page.errors, page.errors


def test_what_fails_is_said(way, tmp_path):
    """Without camera and policy, and with somebody else's goal."""
    folder, _ = way
    with watching() as watch:
        with child(NODE, tmp_path / 'log', route=folder, place="'3'"):
            assert 'no goal_status' in watch.until('failed')['error_msg']
            for said in (1, 2):  # whoever asks again gets an answer again
                code, _, errors = finish(command('goal', 'bath', '--no-wait'), watch)
                assert code == 0, errors
                wait_until(lambda said=said: sum(
                    'bath' in one['error_msg'] for one in watch.said) == said, watch.spin)
        goal, status = (watch.node.create_publisher(String, name, qos(name))
                        for name in ('route_goal', 'goal_status'))
        watch.said.clear()
        with child(NODE, tmp_path / 'other', route=folder):
            wait_until(lambda: goal.get_subscription_count() and watch.said, watch.spin)
            # What somebody else writes there is nothing.
            for name in ('goal_status', 'goal_feedback'):
                foreign = watch.node.create_publisher(String, name, qos(name))
                wait_until(foreign.get_subscription_count, watch.spin)
                for text in ('hello', '[]', '{}', '3'):
                    foreign.publish(String(data=text))
                watch.node.destroy_publisher(foreign)
            # A policy without a camera, then one that does not answer.
            status.publish(String(data=json.dumps({'goal': 4} | SAID | {'stamp': [1, 0]})))
            goal.publish(String(data='2'))
            wait_until(lambda: 'no picture' in watch.said[-1]['error_msg'], watch.spin)
            camera = watch.node.create_publisher(Image, 'image_raw', qos('image_raw'))
            picture = fill_image(Image(), np.full((84, 84, 3), 90, np.uint8), 'rgb8')
            goal.publish(String(data='2'))

            def show():
                camera.publish(picture)
                watch.spin()
            wait_until(lambda: 'does not answer' in watch.said[-1]['error_msg'], show)
            # Somebody else shows a goal; a place that is none ends the way, too.
            for number, end in ((6, 'another goal came'), (3, 'began anew')):
                goal.publish(String(data='2'))
                wait_until(lambda: watch.said[-1]['status'] == 'active', show)
                status.publish(String(data=json.dumps({'goal': number} | SAID)))
                wait_until(lambda end=end: end in watch.said[-1]['error_msg'], show)
            # Asked again and again for what it drives to, it shows the picture once.
            shown = []
            watch.node.create_subscription(Image, 'goal_image', shown.append, qos('goal_image'))
            wait_until(lambda: shown, show)  # the last one
            shown.clear()
            for asked in range(3):
                goal.publish(String(data='2'))
                wait_until(lambda: shown and watch.said and (
                    watch.said[-1]['status'] == 'active'), show)
                watch.said.clear()
                stamp = shown[-1].header.stamp
                status.publish(String(data=json.dumps({
                    'goal': 7, 'stamp': [stamp.sec, stamp.nanosec], 'status': 'active',
                    'error_code': 0, 'error_msg': '', 'decisions': asked})))
                for _ in range(10):
                    show()
            assert len(shown) == 1
            goal.publish(String(data='bath'))
            wait_until(lambda: watch.said and 'bath' in watch.said[-1]['error_msg'], show)
            # A policy that is gone.
            goal.publish(String(data='2'))
            wait_until(lambda: len(shown) == 2, show)
            stamp = shown[-1].header.stamp
            status.publish(String(data=json.dumps({
                'goal': 8, 'stamp': [stamp.sec, stamp.nanosec], 'status': 'active',
                'error_code': 0, 'error_msg': '', 'decisions': 0})))
            for _ in range(10):
                show()
            watch.node.destroy_publisher(status)
            wait_until(lambda: 'gone' in watch.said[-1]['error_msg'], show)


def test_without_a_route_node_the_command_says_what_to_start():
    done = command('goal', 'kitchen', '--patience', '1', env=os.environ | {'ROS_DOMAIN_ID': '101'})
    assert done.wait(PATIENCE) == 2
    said = done.stderr.read().strip().splitlines()
    assert len(said) == 1 and 'ros2 run vn_nav route_node' in said[0]


@pytest.mark.parametrize('words, says', [
    ({'route': '/nowhere'}, '/nowhere'), ({}, 'route:=FOLDER'), ({'place': 'bath'}, 'bath'),
    ({'checkpoint': 'OTHER'}, 'searches')])
def test_what_it_cannot_drive_is_one_line(way, tmp_path, words, says):
    given = {'route': way[0]} | words if words else {}
    if 'checkpoint' in words:
        given['checkpoint'] = write_checkpoint(tmp_path / 'other')
    with child(NODE, tmp_path / 'log', **given) as process:
        assert process.wait(PATIENCE) == 2
    lines = (tmp_path / 'log').read_text().strip().splitlines()
    assert says in lines[-1] and 'Traceback' not in str(lines)
