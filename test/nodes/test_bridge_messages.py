"""Numbers of the bridge's messages: camera, scan, frames, goals, covariances, the first stamp."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, LaserScan

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.motion import yaw_to_quaternion
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge import bridge_messages
from vn_sim_bridge.bridge_messages import Frames
from vn_sim_bridge.bridge_parameters import DAY, first_stamp
from vn_sim_bridge.robot import lidar
from vn_sim_bridge.robot.odometry import Uncertainty, advance
from vn_sim_bridge.robot.simulated_robot import TICK, SimulatedRobot

pytestmark = pytest.mark.ros
FRAMES = Frames.with_prefix('')


@pytest.fixture(scope='module')
def robot():
    robot = SimulatedRobot('house:7', robot=RobotSpec(), noise=False, seed=5)
    robot.begin_episode(0)
    return robot


def matrix(transform):
    """The 4 x 4 matrix of a TransformStamped."""
    x, y, z, w = (getattr(transform.transform.rotation, axis) for axis in 'xyzw')
    out = np.eye(4)
    out[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                   [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                   [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    out[:3, 3] = [getattr(transform.transform.translation, axis) for axis in 'xyz']
    return out


def tree(frames, robot, **options):
    """All transforms by child; each frame has one parent."""
    found = [*bridge_messages.static_transforms(frames), *bridge_messages.moving_transforms(
        frames, robot.odometry, camera_height=robot.robot.camera_height,
        pitch=robot.pose[3] + robot.robot.camera_pitch, **options)]
    messages = [bridge_messages.fill_transform(TransformStamped(), t) for t in found]
    assert len({m.child_frame_id for m in messages}) == len(messages)
    return {m.child_frame_id: m for m in messages}


def to_root(child, transforms):
    """The matrix from a frame to the root of the tree, and the root's name."""
    out = np.eye(4)
    while child in transforms:
        out = matrix(transforms[child]) @ out
        child = transforms[child].header.frame_id
    return out, child


def test_depth_camera_info_and_frames_put_walls_where_they_are(robot):
    """A cloud out of the depth picture, with k and the frames, lies on the house's walls.

    Half a pixel in the principal point would put it 3 cm aside at 3 m.
    """
    robot.drive(np.array([0.3, 0, 0.5, 0]))  # odom and the map differ
    info = fill_camera_info(CameraInfo(), 84, 84, robot.robot.camera_fov)
    assert info.k[2] == info.k[5] == 41.5 and info.k[0] == pytest.approx(42.0)
    focal, cx, cy = info.k[0], info.k[2], info.k[5]
    rects = robot.place.obstacle_rects
    walls = rects[[o.label == 'wall' for o in robot.place.obstacles]]
    gaps = []
    for yaw in np.arange(0, 2 * math.pi, 0.7):
        robot.simulator.place(np.array([0]), np.array([[*robot.pose[:2], yaw, 0.0]]))
        seen = robot.observe()
        v, u = np.nonzero(seen.labels[0] == _label('wall'))
        z = seen.depth[0][v, u].astype(float)
        points = np.stack([(u - cx) / focal * z, (v - cy) / focal * z, z, np.ones_like(z)])
        transforms = tree(FRAMES, robot, true=robot.pose)
        to_map, root = to_root('camera_optical_frame', transforms)
        assert root == 'map'
        x, y, height, _ = to_map @ points
        assert (height > -0.01).all() and height.max() > 1.5
        gaps.append(np.abs(_outside(walls, x, y)).min(axis=0))
    gaps = np.concatenate(gaps)
    assert len(gaps) > 3000 and np.quantile(gaps, 0.95) < 2e-3


def _label(name):
    from vn_sim_bridge.houses.labels import LABELS
    return LABELS.index(name)


def _outside(rects, x, y):
    """Signed distance [M,K] of points to the outlines of rectangles."""
    dx = np.maximum(rects[:, :1] - x, x - rects[:, 2:3])
    dy = np.maximum(rects[:, 1:2] - y, y - rects[:, 3:])
    return np.where((dx <= 0) & (dy <= 0), np.maximum(dx, dy),
                    np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)))


def test_a_scan_ends_where_the_robot_would(robot):
    scan = bridge_messages.fill_scan(LaserScan(), robot.place.obstacle_rects, robot.pose, 0.1)
    assert len(scan.ranges) == lidar.RAYS and scan.scan_time == pytest.approx(0.1)
    assert scan.angle_min + scan.angle_increment * (lidar.RAYS - 1) == pytest.approx(
        scan.angle_max)
    ranges = np.array(scan.ranges)
    angles = scan.angle_min + scan.angle_increment * np.arange(lidar.RAYS)
    assert np.isfinite(ranges).all() and ranges.min() >= RobotSpec().footprint_radius - 1e-4
    heading = robot.pose[2] + angles
    x = robot.pose[0] + ranges * np.cos(heading)
    y = robot.pose[1] + ranges * np.sin(heading)
    assert np.abs(_outside(robot.place.obstacle_rects, x, y).min(axis=0)).max() < 1e-4
    for part in (0.3, 0.7, 0.999):  # and nothing before that
        ahead = _outside(robot.place.obstacle_rects,
                         robot.pose[0] + part * ranges * np.cos(heading),
                         robot.pose[1] + part * ranges * np.sin(heading))
        assert ahead.min() > 0


def test_a_scan_of_boxes():
    boxes = np.array([[2.0, -1.0, 3.0, 1.0], [-0.02, 1.0, 0.02, 20.0], [-20.0, -9, -19, 9]])
    pose = np.array([0.0, 0.0, 0.0])
    ranges = dict(zip(np.round(np.degrees(lidar.scan_angles())), lidar.scan(boxes, pose),
                      strict=True))
    assert ranges[0] == 2.0 and ranges[90] == 1.0
    assert ranges[-180] == np.inf  # farther than it measures
    assert ranges[-90] == np.inf
    assert ranges[-26] == pytest.approx(2 / math.cos(math.radians(26)))
    assert ranges[-27] == np.inf  # past the corner
    turned = lidar.scan(boxes, np.array([0.0, 0.0, math.pi / 2]))
    assert turned[lidar.RAYS // 2] == 1.0  # straight ahead is now the second box
    assert lidar.scan(boxes, np.array([1.99, 0.0, 0.0]))[lidar.RAYS // 2] == -np.inf
    assert np.isinf(lidar.scan(np.zeros((0, 4)), pose)).all()


def test_frames_have_a_prefix_of_their_own_and_share_the_map(robot):
    frames = Frames.with_prefix('robot2/')
    transforms = tree(frames, robot, true=robot.pose)
    assert set(transforms) == {'robot2/odom', 'robot2/base_link', 'robot2/camera_link',
                               'robot2/camera_optical_frame', 'robot2/base_scan'}
    assert to_root(frames.lidar, transforms)[1] == 'map'
    assert to_root(frames.optical, tree(frames, robot))[1] == 'robot2/odom'


def test_the_optical_frame_looks_ahead_and_down(robot):
    robot.simulator.place(np.array([0]), np.array([[*robot.pose[:2], 0.0, 0.5]]))
    transforms = tree(FRAMES, robot)
    in_base, _ = to_root('camera_optical_frame', {k: transforms[k] for k in (
        'camera_optical_frame', 'camera_link')})
    ahead = in_base[:3, 2]
    assert ahead == pytest.approx([math.cos(0.5), 0, -math.sin(0.5)])
    assert in_base[:3, 0] == pytest.approx([0, -1, 0])  # the picture's columns run to the right
    assert in_base[:3, 3] == pytest.approx([0, 0, RobotSpec().camera_height])


def test_the_odom_frame_lies_where_true_pose_and_odometry_say():
    rng = np.random.default_rng(0)
    for _ in range(20):
        true, said = rng.uniform(-3, 3, (2, 3))
        x, y, yaw = bridge_messages.odom_in_map(true, said)
        # Drive in odom from its origin as odometry says: that ends at the true pose.
        there = advance(np.array([x, y, yaw]), (0, 0, 0))
        c, s = math.cos(yaw), math.sin(yaw)
        end = [there[0] + c * said[0] - s * said[1], there[1] + s * said[0] + c * said[1]]
        assert end == pytest.approx(true[:2])
        assert math.cos(yaw + said[2] - true[2]) == pytest.approx(1.0)


def goal(frame, x, y, yaw, scale=1.0):
    message = PoseStamped()
    message.header.frame_id = frame
    message.pose.position.x, message.pose.position.y = x, y
    q = message.pose.orientation
    q.x, q.y, q.z, q.w = (scale * part for part in yaw_to_quaternion(yaw))
    return message


def test_a_goals_frame_is_honoured():
    true, said = np.array([3.0, 1.0, math.pi / 2]), np.array([1.0, 0.0, 0.0])

    def taken(message, frames=FRAMES):
        return bridge_messages.goal_in_map(message, frames, true, said)
    for frame in ('map', '', '/map'):
        assert taken(goal(frame, 2.0, 3.0, 0.4)) == pytest.approx((2.0, 3.0, 0.4))
    # One metre ahead of the robot, and to its left, by its odometry.
    assert taken(goal('odom', 2.0, 0.0, 0.0)) == pytest.approx((3.0, 2.0, math.pi / 2))
    assert taken(goal('odom', 1.0, 1.0, math.pi / 2)) == pytest.approx((2.0, 1.0, -math.pi))
    theirs = Frames.with_prefix('robot2/')
    assert taken(goal('robot2/odom', 2.0, 0.0, 0.0), theirs)[0] == pytest.approx(3.0)
    for message, word in ((goal('base_link', 1, 1, 0), 'map or odom'),
                          (goal('map', 1, 1, 0, scale=0.0), 'orientation'),
                          (goal('map', 1, 1, 0, scale=3.0), 'orientation'),
                          (goal('map', math.nan, 1, 0), 'finite'),
                          (goal('odom', math.inf, 1, 0), 'finite')):
        with pytest.raises(UserError, match=word):
            taken(message)
    with pytest.raises(UserError, match='robot2/odom'):
        taken(goal('odom', 1, 1, 0), theirs)


def test_covariances_are_written_where_they_belong():
    uncertainty = Uncertainty(1.0, TICK)
    for _ in range(20):
        uncertainty.add(0.3, (0.02, 0.0, 0.03), noise=0.04)
    message = bridge_messages.fill_covariances(Odometry(), uncertainty)
    for part, values in ((message.pose, uncertainty.pose), (message.twist, uncertainty.twist)):
        whole = np.array(part.covariance).reshape(6, 6)
        assert np.array_equal(whole[np.ix_((0, 1, 5), (0, 1, 5))], values)
        assert (np.linalg.eigvalsh(whole) > 0).all()  # a filter inverts it
        assert np.abs(values).max() > 100 * bridge_messages.FLAT


def test_a_bridge_that_starts_again_has_another_first_stamp():
    noon = 20_000 * DAY + DAY / 2
    for lock_step in (False, True):
        stamps = [first_stamp(0.0, lock_step=lock_step, wall=noon + k) for k in (0, 0.002, 5.0)]
        assert np.diff(stamps).min() > 0
        assert first_stamp(7.5, lock_step=lock_step, wall=noon) == 7.5
    assert first_stamp(0.0, lock_step=False, wall=noon) == noon
    # Tools know simulated time by its distance from the wall clock.
    assert first_stamp(0.0, lock_step=True, wall=noon) == DAY / 2
    assert first_stamp(0.0, lock_step=True, wall=20_000 * DAY) > 0
