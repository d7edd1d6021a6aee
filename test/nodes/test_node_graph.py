"""policy_node among others on the graph, and what it leaves there in each lifecycle state."""

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from fake_robot import LATCHED, RELIABLE, robot_and_node
from geometry_msgs.msg import Twist, TwistStamped
from lifecycle_msgs.msg import Transition
from ros_harness import PATIENCE, wait_until, write_checkpoint
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from vn_nav.nodes.qos import qos
from vn_nav.resources import share_file

pytestmark = [pytest.mark.ros, pytest.mark.slow]
TOPICS = ('cmd_vel', 'action', 'action_names', 'arrived')


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint')


def test_several_publishers_of_the_clock_are_named(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'use_sim_time': True},
                        robot={'odometry': RELIABLE, 'sim_time': True}) as (robot, _):
        robot.drive()
        assert not any('several' in status[2] for status in robot.statuses)
        other = robot.node.create_publisher(Clock, '/clock', qos('/clock'))
        _, level, *_ = robot.says('/clock has several publishers')
        assert level == DiagnosticStatus.WARN
        robot.node.destroy_publisher(other)
        named = len(robot.statuses)
        wait_until(lambda: any('several' not in status[2] for status in robot.statuses[named:]),
                   robot.spin)


def test_a_listener_of_the_other_twist_is_named_with_the_cure(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        context = rclpy.Context()  # a participant of its own: in one a topic has one type
        rclpy.init(context=context)
        base = rclpy.create_node('base', context=context)
        base.create_subscription(TwistStamped, 'cmd_vel', lambda _: None, 10)
        try:
            status = robot.says('base subscribes to geometry_msgs/msg/TwistStamped')
            assert status[1] == DiagnosticStatus.ERROR
            assert 'set enable_stamped_cmd_vel to true' in status[2]
        finally:
            base.destroy_node()
            rclpy.shutdown(context=context)


def test_a_listener_that_wants_history_is_named(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        robot.node.create_subscription(Twist, 'cmd_vel', lambda _: None, LATCHED)
        robot.says('transient local')
        assert qos('cmd_vel').durability != LATCHED.durability


def test_beside_another_publisher_of_commands_it_does_not_become_active(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'autostart': False}) as (robot, _):
        other = robot.node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
        assert robot.transition(Transition.TRANSITION_CONFIGURE)
        wait_until(lambda: robot.node.count_publishers('cmd_vel') == 2, robot.spin)
        robot.spin_for(1.0)  # the node has met it as well
        assert not robot.transition(Transition.TRANSITION_ACTIVATE)
        assert robot.state() == 'inactive'
        assert 'alone publishes its command topic' in (tmp_path / 'log').read_text()
        robot.node.destroy_publisher(other)
        wait_until(lambda: robot.transition(Transition.TRANSITION_ACTIVATE), robot.spin)


def test_a_stop_that_is_reset_at_once_still_sends_its_zeros(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        clients = [robot.node.create_client(Trigger, f'/policy_node/{name}')
                   for name in ('stop', 'reset')]
        wait_until(lambda: all(client.service_is_ready() for client in clients), robot.spin)
        robot.drive()
        for client in clients:
            client.call_async(Trigger.Request())
        robot.wait_for_zero(10)
        robot.spin_for(1.5)
        moved = [k for k, (_, velocity) in enumerate(robot.commands) if velocity.any()]
        assert len(robot.commands) - moved[-1] > 5, 'zeros, from the first one'
        robot.enable()
        wait_until(robot.moving, robot.spin)


def test_an_inactive_node_sends_nothing_and_a_clean_one_has_no_topics(checkpoint, tmp_path):
    """The topics stay while it is inactive, as those of every lifecycle node do."""
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        assert robot.transition(Transition.TRANSITION_DEACTIVATE)
        robot.wait_for_zero()
        robot.says('idle: the node is not active')
        robot.spin_for(0.5)
        heard, said = len(robot.commands), len(robot.arrived)
        robot.show_goal(1)  # pictures and odometry go on as well
        assert 'not active' in robot.refusal()
        for name in ('stop', 'reset'):
            assert robot.call(Trigger, name).success
        robot.spin_for(1.5)
        assert len(robot.commands) == heard and len(robot.arrived) == said
        assert all(robot.node.count_publishers(topic) == 1 for topic in TOPICS)
        assert robot.transition(Transition.TRANSITION_CLEANUP)
        wait_until(lambda: not any(robot.node.count_publishers(topic) for topic in TOPICS),
                   robot.spin)
        assert robot.transition(Transition.TRANSITION_CONFIGURE)
        assert robot.transition(Transition.TRANSITION_ACTIVATE)
        robot.drive()


def test_a_finalized_node_keeps_no_publisher(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        wait_until(lambda: robot.node.count_publishers('cmd_vel'), robot.spin)
        assert robot.transition(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        wait_until(lambda: not robot.node.count_publishers('cmd_vel'), robot.spin)


def test_full_pictures_are_verified_by_local_features(tmp_path):
    node = {'verify': 'sift', 'inference_timeout': 1.0}
    with robot_and_node(share_file('models/search'), tmp_path, node=node,
                        robot={'size': (320, 240), 'odometry': RELIABLE}) as (robot, _):
        robot.drive()


def test_a_policy_that_does_not_search_verifies_nothing(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'verify': 'sift'}) as (_, process):
        assert process.wait(PATIENCE) == 2
    assert 'local features verify' in (tmp_path / 'log').read_text()
