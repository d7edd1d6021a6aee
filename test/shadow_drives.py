"""Drives that a policy is shown: fixtures, and one whose clock is set back."""

from rosbags.typesys import Stores, get_typestore
from small_bags import FIXTURE, START, drive, make

from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
BASE = FIXTURE.parent.parent / 'config' / 'robots' / 'demo_base.yaml'
FOREIGN = FIXTURE.parent / 'foreign_robot'
NAMES = ('image: /camera/color/image_raw\nodometry: /odometry/filtered\n'
         'command: /base/cmd_vel\n')
END = 'std_msgs/msg/UInt8'
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
