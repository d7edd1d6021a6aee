"""The camera's tilt as a joint: policy_node's commands without it, and where the joint goes."""

import math

import numpy as np
import pytest
from fake_robot import RELIABLE, robot_and_node
from ros_harness import wait_until, write_checkpoint
from std_msgs.msg import Float64MultiArray

from vn_nav.robot import MAX_TILT, RobotSpec

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(240)]


@pytest.mark.parametrize('joint', [True, False])
def test_a_tilt_is_a_position_of_a_joint_or_a_rate_in_the_twist(tmp_path, joint):
    # Nothing else to do: every decision tilts the camera.
    checkpoint = write_checkpoint(tmp_path / 'checkpoint', actions=('look_down', 'look_up'))
    node = {'tilt_topic': '/tilt/commands'} if joint else {}
    with robot_and_node(checkpoint, tmp_path, node=node,
                        robot={'odometry': RELIABLE}) as (robot, _):
        angles = []
        robot.node.create_subscription(Float64MultiArray, '/tilt/commands',
                                       lambda message: angles.append(message.data[0]), 100)
        robot.show_goal()
        robot.enable()
        if not joint:
            wait_until(robot.moving, robot.spin)
            assert abs(robot.commands[-1][1][3]) > 0 and not angles
            return
        wait_until(lambda: int(robot.statuses[-1][3]['decisions']) >= 3 and len(angles) > 40,
                   robot.spin)
        sent = np.array([velocity for _, velocity in robot.commands])
        assert len(sent) and not sent.any(), 'the base is told to stand'
        steps = np.abs(np.diff(angles))
        assert steps.max() <= RobotSpec().max_angular / 20 + 1e-9
        assert np.abs(angles).max() <= MAX_TILT
        # Whole actions, from the last one's end: every turn of the way is at a multiple of 30 deg.
        ends = [one for one, two, three in zip(angles, angles[1:], angles[2:], strict=False)
                if (two - one) * (three - two) < 0]
        for angle in ends:
            assert math.degrees(angle) % 30 == pytest.approx(0, abs=3) or (
                math.degrees(angle) % 30 == pytest.approx(30, abs=3))
