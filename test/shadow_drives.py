"""Drives that a policy is shown: fixtures, one whose clock is set back, one with a scanner."""

import math

import numpy as np
from rosbags.typesys import Stores, get_typestore
from small_bags import FIXTURE, INFO, START, camera_info, drive, header, make

from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
BASE = FIXTURE.parent.parent / 'config' / 'robots' / 'demo_base.yaml'
FOREIGN = FIXTURE.parent / 'foreign_robot'
NAMES = ('image: /camera/color/image_raw\nodometry: /odometry/filtered\n'
         'command: /base/cmd_vel\n')
END = 'std_msgs/msg/UInt8'
SCAN = 'sensor_msgs/msg/LaserScan'
SPEED, WALLS = 0.3, (3.0, 1.5)  # m/s; m ahead of the start, and to either side
STORE = get_typestore(Stores.ROS2_JAZZY)


def two_drives():
    """Two episodes, the second by a clock that was set back."""
    one = drive(4.0)
    one.append(('/episode_end', END, START + 5 * 10**9, make(END, data=1)))
    two = []
    for name, kind, log_time, message in drive(4.0, seed=1):
        if hasattr(message, 'header'):
            message.header.stamp.sec -= 1000
        two.append((name, kind, log_time + 10 * 10**9, message))
    return one + two


def scan(time, x, mount_x=0.0):
    """What a scanner, turned about and `mount_x` ahead of a robot at x, measures of the walls."""
    bearings = math.pi + np.radians(np.arange(-180, 180))
    with np.errstate(divide='ignore'):
        ahead = (WALLS[0] - x - mount_x) / np.where(np.cos(bearings) > 0, np.cos(bearings), np.nan)
        aside = WALLS[1] / np.abs(np.sin(bearings))
    ranges = np.fmin(ahead, aside).astype(np.float32)
    ranges[ranges > 12] = np.inf
    return make(SCAN, header=header(time, 'laser'), angle_min=-math.pi, angle_max=math.pi,
                angle_increment=math.radians(1), range_min=0.1, range_max=12.0, ranges=ranges,
                intensities=np.zeros(0, np.float32))


def scanned_drive(fov_deg=70.0, mount_x=0.1):
    """Towards a wall, by a narrow camera that shows noise; the scans lie between the pictures."""
    messages = []
    for name, kind, log_time, message in drive(5.0, speed=SPEED):
        if kind == INFO:
            message = camera_info(log_time - 6_000_000, 16 / math.tan(math.radians(fov_deg) / 2))
            scanned = log_time + 24_000_000  # 30 ms after the picture, recorded 90 ms later
            messages.append(('/scan', SCAN, scanned + 60_000_000, scan(
                scanned, SPEED * (scanned - START) * 1e-9, mount_x)))
        messages.append((name, kind, log_time, message))
    return sorted(messages, key=lambda message: message[2])
