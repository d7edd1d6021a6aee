"""How a goal ends, as policy_node says it on topics; and by the action, where it can be built."""

import json
import math
import signal
import time

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from fake_robot import RELIABLE, FakeRobot
from geometry_msgs.msg import PoseStamped
from ros_harness import child, wait_until, write_checkpoint
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger

from vn_nav.nodes.goal_output import GoalOutput
from vn_nav.nodes.qos import qos
from vn_nav.policy.goal_record import Code
from vn_nav.policy.navigator import Limits, Navigator
from vn_nav.robot import RobotSpec

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.fixture
def robot():
    rclpy.init()
    robot = FakeRobot(odometry=RELIABLE)
    robot.said, robot.felt, robot.guessed = [], [], []
    for name, kind, keep in (
            ('goal_status', String, lambda m: robot.said.append(json.loads(m.data))),
            ('goal_feedback', String, lambda m: robot.felt.append(json.loads(m.data))),
            ('goal_estimate', PoseStamped, robot.guessed.append)):
        robot.node.create_subscription(kind, name, keep, qos(name))
    yield robot
    robot.close()
    rclpy.shutdown()


def test_the_estimate_is_a_pose_in_the_frame_of_odometry(robot):
    """A goal 1 m ahead of a robot at (2, 3) that looks along +y; then without odometry."""
    output = GoalOutput(robot.node, Navigator(RobotSpec(), Limits(1.0, 1.0)))
    wait_until(lambda: output.publishers[2].get_subscription_count(), robot.spin)
    ahead, stamp = np.array([1.0, 0.0, math.pi / 2]), Time(sec=7, nanosec=5)
    output.decided(0.4, ahead, np.array([2.0, 3.0, math.pi / 2]), 'robot2/odom', stamp)
    wait_until(lambda: robot.guessed, robot.spin)
    output.decided(0.4, None, None, 'robot2/odom', stamp)  # no idea: nothing
    output.decided(0.4, ahead, None, '', stamp)
    wait_until(lambda: robot.guessed[1:], robot.spin)
    by_odometry, by_robot = robot.guessed
    assert by_odometry.header == Header(stamp=stamp, frame_id='robot2/odom')
    place, turn = by_odometry.pose.position, by_odometry.pose.orientation
    assert (place.x, place.y, abs(turn.z)) == pytest.approx((2.0, 4.0, 1.0))
    assert by_robot.header.frame_id == 'base_link' and by_robot.pose.position.x == 1.0


def until(robot, status, number=None):
    """Spin until the newest goal has a status; what was said of it."""
    wait_until(lambda: robot.said and robot.said[-1]['status'] == status
               and number in (None, robot.said[-1]['goal']), robot.spin,
               what=lambda: f'{status} of goal {number}, but {robot.said[-3:]}')
    return robot.said[-1]


def test_goals_end_and_say_how(robot, tmp_path):
    checkpoint = write_checkpoint(tmp_path / 'policy')
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint,
               goal_decisions=3):
        robot.show_goal(0)
        until(robot, 'waiting', 1)
        robot.enable()
        until(robot, 'active', 1)
        failed = until(robot, 'failed', 1)
        assert failed['error_code'] == Code.BUDGET and failed['decisions'] == 3
        assert failed['seconds'] > 0 and '3 decisions' in failed['error_msg']
        robot.says('failed')
        robot.wait_for_zero()
        assert [one['decisions'] for one in robot.felt][-1] <= 3 and robot.felt[0]['state']
        assert not robot.guessed  # this policy has no idea of where the goal is
        # Another goal is driven to without another `enable`; a person takes it back.
        robot.show_goal(1)
        until(robot, 'active', 2)
        assert robot.call(SetBool, 'enable', data=False).success
        assert until(robot, 'cancelled', 2)['error_msg'] == 'disabled'
        robot.enable()
        until(robot, 'active', 2)
        assert robot.call(Trigger, 'stop').success
        assert '~/stop' in until(robot, 'cancelled', 2)['error_msg']
        assert robot.call(Trigger, 'reset').success
        # The camera falls silent.
        robot.show_goal(2)
        robot.enable()
        until(robot, 'active', 3)
        robot.sends.discard('image')
        assert until(robot, 'failed', 3)['error_code'] == Code.CAMERA_LOST
        # Who comes late hears the newest one.
        late = []
        robot.node.create_subscription(String, 'goal_status', late.append, qos('goal_status'))
        wait_until(lambda: late, robot.spin)
        assert json.loads(late[-1].data)['error_code'] == Code.CAMERA_LOST


def test_an_arrival_is_success(robot, tmp_path):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=sure):
        robot.show_goal(0)
        robot.enable()
        done = until(robot, 'succeeded', 1)
        assert done['error_code'] == 0 and done['decisions'] == 1
        wait_until(lambda: robot.felt, robot.spin)
        assert robot.felt[-1]['arrival'] == pytest.approx(0.93, abs=0.01)


def test_a_blocked_robot_gives_up(robot, tmp_path):
    """Odometry that stands still, whatever is commanded."""
    checkpoint = write_checkpoint(tmp_path / 'policy')
    robot.publish_odometry = lambda: _stand(robot)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint,
               progress_decisions=4):
        robot.show_goal(0)
        robot.enable()
        begun = time.monotonic()
        failed = until(robot, 'failed', 1)
        assert failed['error_code'] == Code.NO_PROGRESS and time.monotonic() - begun < 60


def test_a_node_that_ends_says_how_its_goal_ended(robot, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log',
               checkpoint=write_checkpoint(tmp_path / 'policy')) as process:
        robot.show_goal(0)
        robot.enable()
        until(robot, 'active', 1)
        process.send_signal(signal.SIGINT)
        ended = until(robot, 'failed', 1)
        assert ended['error_code'] == Code.STOPPED and 'ends' in ended['error_msg']
        wait_until(lambda: process.poll() is not None, robot.spin)
        assert process.returncode == 0


def test_who_enables_by_itself_obeys_a_person(robot, tmp_path):
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', auto_enable=True,
               checkpoint=write_checkpoint(tmp_path / 'policy')):
        robot.show_goal(0)
        until(robot, 'active', 1)
        assert robot.call(SetBool, 'enable', data=False).success
        until(robot, 'cancelled', 1)
        robot.spin_for(1.5)
        assert robot.said[-1]['status'] == 'cancelled' and not robot.moving()
        robot.show_goal(1)  # that is another thing
        until(robot, 'active', 2)


def _stand(robot):
    from nav_msgs.msg import Odometry

    from vn_msgs_py.motion import fill_odometry
    message = Odometry()
    message.header.stamp = robot.stamp()
    robot.odometry.publish(fill_odometry(message, 0.0, 0.0, 0.0, [0.0] * 4))
