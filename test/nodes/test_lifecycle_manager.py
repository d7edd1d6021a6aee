"""policy_node under Nav2's lifecycle_manager: its calls, in its order, without a bond.

The manager is in no wheel. What it asks of a node it asks over the two services of lifecycle
nodes (nav2_lifecycle_manager of Jazzy: startup, pause, resume, reset and shutdown).
"""

import pytest
import rclpy
import yaml
from fake_robot import FakeRobot
from lifecycle_msgs.msg import Transition
from paths import ROOT
from ros_harness import child, wait_until, write_checkpoint

pytestmark = [pytest.mark.ros, pytest.mark.slow]

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
SHUTDOWN = Transition.TRANSITION_UNCONFIGURED_SHUTDOWN


@pytest.fixture
def robot():
    rclpy.init()
    robot = FakeRobot()
    yield robot
    robot.close()
    rclpy.shutdown()


def test_the_manager_brings_it_up_pauses_it_and_shuts_it_down(robot, tmp_path):
    checkpoint = write_checkpoint(tmp_path / 'checkpoint')
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=checkpoint,
               autostart=False) as process:
        assert robot.state() == 'unconfigured'  # the manager configures it, not the node
        for transitions, state in (
                ((CONFIGURE, ACTIVATE), 'active'),  # startup
                ((DEACTIVATE,), 'inactive'),  # pause
                ((ACTIVATE,), 'active'),  # resume
                ((DEACTIVATE, CLEANUP), 'unconfigured'),  # reset
                ((CONFIGURE, ACTIVATE), 'active')):
            for transition in transitions:
                assert robot.transition(transition), (tmp_path / 'log').read_text()
            assert robot.state() == state
        assert not any(velocity.any() for _, velocity in robot.commands), 'that takes ~/enable'
        robot.drive()
        robot.transition(DEACTIVATE)
        robot.wait_for_zero()
        for transition in (CLEANUP, SHUTDOWN):
            robot.transition(transition)
        assert robot.state() == 'finalized'
        assert process.poll() is None


def test_it_has_no_bond_and_the_manager_is_told_so(robot, tmp_path):
    """A manager that waits for a bond would abort its start."""
    with child('vn_nav.nodes.policy_node', tmp_path / 'log',
               checkpoint=write_checkpoint(tmp_path / 'checkpoint')):
        wait_until(lambda: robot.state() == 'active', robot.spin)
        topics = {name for name, _ in robot.node.get_topic_names_and_types()}
        assert '/cmd_vel' in topics
        bonded = '/bond' in topics
    managers = yaml.safe_load((ROOT / 'config/graph/lifecycle_manager.yaml').read_text())
    timeout = managers['/**/lifecycle_manager_policy']['ros__parameters']['bond_timeout']
    assert not bonded and timeout == 0.0
