"""Measured ranges over ROS: a scan, or depth, reaches the map of a policy that searches."""

import json
import math
import threading
import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import SingleThreadedExecutor
from ros_harness import child, wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo, Image, LaserScan
from std_msgs.msg import String

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry
from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.measured_ranges import RangeSource
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.map_output import MapOutput
from vn_nav.nodes.qos import qos
from vn_nav.nodes.range_input import RangeInput
from vn_nav.policy.navigator import Limits, Navigator
from vn_nav.policy.search.grid import CELL
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec
from vn_sim_bridge.bridge_messages import fill_scan
from vn_sim_bridge.houses.procedural import generate_house

pytestmark = pytest.mark.ros
BRIDGE, NODE = 'vn_sim_bridge.bridge_node', 'vn_nav.nodes.policy_node'


class Watcher:
    """Hears what the policy node says of its map, and where the robot really is."""

    def __init__(self):
        self.node = rclpy.create_node('watcher')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.heard = {}
        for name, kind in (('policy_node/map', OccupancyGrid), ('policy_node/hypotheses',
                           PoseArray), ('ground_truth/odom', Odometry), ('odom', Odometry),
                           ('episode', String), ('/diagnostics', DiagnosticArray)):
            self.heard[name] = []
            self.node.create_subscription(kind, name, self.heard[name].append, qos(name, depth=20))

    def spin(self):
        self.executor.spin_once(timeout_sec=0.01)

    def values(self):
        """What the newest diagnostics of the policy say."""
        statuses = [message.status[0] for message in self.heard['/diagnostics']
                    if message.status[0].name.endswith('policy_node')]
        return {pair.key: pair.value for pair in statuses[-1].values} if statuses else {}


@pytest.fixture
def watcher():
    rclpy.init()
    watcher = Watcher()
    yield watcher
    watcher.node.destroy_node()
    rclpy.shutdown()


def cells_of(message, chosen, start):
    """Places [K,2] m in the house of chosen cells of a map in a frame that begins at `start`."""
    origin = message.info.origin
    yaw = 2 * math.atan2(origin.orientation.z, origin.orientation.w)
    rows, columns = np.nonzero(chosen)
    x, y = (CELL * (part + 0.5) for part in (columns, rows))
    in_frame = [origin.position.x + math.cos(yaw) * x - math.sin(yaw) * y,
                origin.position.y + math.sin(yaw) * x + math.cos(yaw) * y]
    c, s = math.cos(start[2]), math.sin(start[2])
    return np.stack([start[0] + c * in_frame[0] - s * in_frame[1],
                     start[1] + s * in_frame[0] + c * in_frame[1]], 1)


@pytest.mark.parametrize('sensor', ['scan', 'depth'])
def test_measured_ranges_reach_the_map(watcher, tmp_path, sensor):
    topic = {'scan_topic': 'scan'} if sensor == 'scan' else {'depth_topic': 'depth/image_raw'}
    with (child(BRIDGE, tmp_path / 'bridge', house=7, size=64, noise=False, time='lock_step',
                stop='declared'),
          child(NODE, tmp_path / 'policy', checkpoint=share_file('models/search'),
                time='lock_step', auto_enable=True, stop_threshold=1.0, **topic)):
        # Never declared: a second episode would begin another map.
        wait_until(lambda: len(watcher.heard['policy_node/map']) >= 2
                   and int(watcher.values().get('ranges_used', 0)) >= 4, watcher.spin,
                   what=(tmp_path / 'policy').read_text())
        values = watcher.values()
        assert values['ranges_missed'] == '0'
        assert len(watcher.heard['policy_node/map']) < 20  # once a second at most
        start = json.loads(watcher.heard['episode'][0].data)['start']
        message = watcher.heard['policy_node/map'][-1]
        assert message.header.frame_id == watcher.heard['odom'][-1].header.frame_id == 'odom'
        assert watcher.heard['policy_node/hypotheses']
        cells = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
        assert set(np.unique(cells)) <= set(range(-1, 101))
        # What is taken for an obstacle is one: within a cell's diagonal of its edge.
        rects = generate_house(7, rooms=5).obstacle_rects
        walls = cells_of(message, cells > 80, start)
        gap = np.hypot(*(np.maximum(np.maximum(rects[None, :, i] - walls[:, None, i],
                                               walls[:, None, i] - rects[None, :, i + 2]), 0)
                         for i in (0, 1))).min(1)
        near = 0.12 if sensor == 'scan' else 0.35
        assert len(walls) > 30 and np.mean(gap < near) > 0.9
        free = cells_of(message, (cells >= 0) & (cells < 40), start)
        inside = ((free[:, None] > rects[None, :, :2] + 0.1)
                  & (free[:, None] < rects[None, :, 2:] - 0.1)).all(2).any(1)
        # A camera clears nothing nearer than 0.85 m, and it begins before a table.
        assert len(free) > (100 if sensor == 'scan' else 10) and np.mean(inside) < 0.02


@pytest.mark.parametrize(('options', 'words'), [
    ({'scan_topic': 'scan'}, 'search with a map'),
    ({'scan_topic': 'scan', 'depth_topic': 'depth/image_raw'}, 'one topic')])
def test_who_has_no_map_takes_no_ranges(options, words, tmp_path):
    checkpoint = write_checkpoint(tmp_path / 'checkpoint', size=36)
    with child(NODE, tmp_path / 'log', checkpoint=checkpoint, **options) as process:
        assert process.wait(timeout=100) == 2
    lines = (tmp_path / 'log').read_text().strip().splitlines()
    assert len(lines) == 1 and words in lines[0]


class Inside:
    """A `RangeInput` without a node around it; messages are given to it by hand."""

    def __init__(self, depth=False, continuous=False):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('policy_node', context=self.context)
        self.wake, self.robot = threading.Condition(), RobotSpec()
        self.navigator = Navigator(self.robot, Limits(), continuous=continuous)
        self.output = CommandOutput(self.node, self.navigator, self.wake, period=0.05,
                                    lock_step=False, stamped=False)
        self.ranges = RangeInput(
            self.node, self.navigator, self.output, self.wake,
            RangeSource('' if depth else 'scan', 'depth/image_raw' if depth else '',
                        (0.1, 0.0, math.pi)), self.robot)

    def scan(self, stamp, ranges=(1.0,) * 360, **changes):
        message = fill_scan(LaserScan(), np.zeros((0, 4)), np.zeros(3), 0.1)
        message.ranges = list(ranges)
        for name, value in changes.items():
            setattr(message, name, value)
        self.give(message, stamp)

    def give(self, message, stamp):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        self.ranges._on_message(message)

    def measure(self, stamp, *pose):
        message = fill_odometry(Odometry(), *pose, np.zeros(4))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        self.output.take_odometry(message)

    def close(self):
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def inside(request):
    parts = Inside(**getattr(request, 'param', {}))
    yield parts
    parts.close()


def test_a_scan_belongs_to_a_picture_of_its_rest_alone(inside):
    assert inside.ranges.scan_at(10.0) is None and not inside.ranges.is_alive
    inside.scan(10.0)
    assert inside.ranges.is_alive and inside.ranges.has(10.2) and not inside.ranges.has(10.3)
    scan = inside.ranges.scan_at(10.1)
    assert scan.scanner.mount == (0.1, 0.0, math.pi) and (scan.ranges == 1.0).all()
    inside.navigator._look_after = 10.05  # the robot has moved until then
    assert inside.ranges.scan_at(10.2) is None
    inside.scan(10.15, ranges=[2.0] * 360)
    inside.scan(10.4, ranges=[3.0] * 360)
    assert (inside.ranges.scan_at(10.2).ranges == 2.0).all()
    assert (inside.ranges.used, inside.ranges.missed) == (2, 2)


@pytest.mark.parametrize('changes', [
    {'ranges': [1.0]}, {'ranges': []}, {'ranges': [math.nan] * 360}, {'range_max': 0.0},
    {'angle_increment': 0.0}, {'angle_increment': math.nan}, {'angle_increment': 0.1},
    {'angle_min': math.inf}, {'range_min': -1.0}])
def test_what_is_no_scan_is_not_used(inside, changes):
    inside.scan(10.0, **changes)
    assert inside.ranges.scan_at(10.0) is None
    said = any('refused' in line for line in inside.ranges.warnings())
    assert said == (changes.get('ranges', [0.0])[:1] != [math.nan])
    inside.scan(10.1)
    assert inside.ranges.scan_at(10.1) is not None
    assert not any('refused' in line for line in inside.ranges.warnings())


@pytest.mark.parametrize('inside', [{'continuous': True}], indirect=True)
def test_in_motion_a_scan_is_seen_from_where_the_picture_was_taken(inside):
    inside.scan(10.0)
    assert inside.ranges.scan_at(10.2) is None  # nobody knows how it has moved since
    assert inside.ranges.scan_at(10.03) is not None
    inside.measure(10.0, 1.0, 0.0, math.pi / 2)
    inside.measure(10.2, 1.0, 0.04, math.pi / 2)
    mount = inside.ranges.scan_at(10.2).scanner.mount
    assert mount[:2] == pytest.approx((0.1 - 0.04, 0.0), abs=1e-9)
    assert wrap_angle(mount[2] - math.pi) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize('inside', [{'depth': True}], indirect=True)
def test_depth_needs_the_camera_info_beside_it(inside):
    def picture(stamp, size=64):
        inside.give(fill_image(Image(), np.full((48, size), 2.0, np.float32), '32FC1'), stamp)

    def refused():
        return ' '.join(inside.ranges.warnings())
    picture(10.0)
    assert inside.ranges.scan_at(10.0) is None and 'camera_info' in refused()
    info = fill_camera_info(CameraInfo(), 64, 48, math.radians(60))
    inside.ranges._on_info(info)
    scan = inside.ranges.scan_at(10.0)
    assert scan is not None and 'refused' not in refused()
    # A wall across the way, 2 m ahead.
    known = np.isfinite(scan.ranges)
    assert known.all() and np.allclose(scan.ranges * np.cos(scan.scanner.bearings), 2.0, atol=1e-3)
    picture(10.1, size=32)
    assert inside.ranges.scan_at(10.1) is None and 'size' in refused()
    picture(10.2)
    info.k[0] = 0.0
    assert inside.ranges.scan_at(10.2) is None and 'focal' in refused()
    info.k[0] = info.k[4]
    assert inside.ranges.scan_at(10.2) is not None and 'refused' not in refused()
    inside.give(fill_image(Image(), np.zeros((48, 64, 3), np.uint8)), 10.3)
    assert inside.ranges.scan_at(10.3) is None and 'encoding' in refused()


def test_one_topic_for_a_policy_with_a_map():
    mount = (0.0, 0.0, 0.0)
    for names in (('', ''), ('scan', ''), ('', 'depth')):
        RangeSource(*names, mount).check()
        RangeSource(*names, mount).check_policy(searches=True)
    RangeSource('', '', mount).check_policy(searches=False)
    with pytest.raises(UserError, match='search with a map'):
        RangeSource('', 'depth', mount).check_policy(searches=False)
    with pytest.raises(UserError, match='one topic'):
        RangeSource('scan', 'depth', mount).check()


def test_without_odometry_the_map_is_as_the_robot_sees_it(watcher):
    """And nothing is published that nobody listens to, or too often."""
    from vn_nav.policy.search.look import RANGE_EDGES, column_bearings
    from vn_nav.policy.search.searcher import Searcher
    searcher = Searcher(((0.5, 0, 0), (0, 0, 0.5), (0, 0, -0.5)), column_bearings(1.5),
                        RANGE_EDGES, 0.18)
    searcher.pose = np.array([1.0, 2.0, math.pi / 2])
    searcher.grid.add_contact(searcher.pose, math.pi / 2)  # 0.23 m ahead
    node = rclpy.create_node('policy_node')
    output = MapOutput(node)
    wait_until(lambda: all(p.get_subscription_count() for p in output.publishers), watcher.spin)
    for _ in range(3):
        output.publish(searcher, None, 'odom', Odometry().header.stamp)
    wait_until(lambda: watcher.heard['policy_node/map'] and watcher.heard[
        'policy_node/hypotheses'], watcher.spin)
    end = time.monotonic() + 0.5
    wait_until(lambda: time.monotonic() > end, watcher.spin)
    message, = watcher.heard['policy_node/map']
    assert message.header.frame_id == 'base_link'
    cells = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    place = cells_of(message, cells == 100, np.zeros(3)).mean(0)
    assert place == pytest.approx([0.23, 0.0], abs=CELL)
    node.destroy_node()
