"""A goal picture of another camera than the robot's is cut, or padded, to what that one shows."""

import math
import re

import pytest
from fake_robot import broken_node
from ros_harness import wait_until
from sensor_msgs.msg import CameraInfo
from small_search import write_small_search

from vn_msgs_py.camera import fill_camera_info
from vn_nav.lens import zoom_of
from vn_nav.nodes.qos import qos
from vn_nav.observation import fov_across

pytestmark = [pytest.mark.ros, pytest.mark.slow]
# Goals say how they were prepared; pictures have no `zoom` of their own.
TELLS = """
from vn_nav.policy.runtime import PolicyRuntime
prepare = PolicyRuntime.prepare
def tell(self, picture, fov=None, zoom=None):
    if zoom is not None:
        print(f'goal of {fov:.4f} rad at zoom {zoom:.4f}', flush=True)
    return prepare(self, picture, fov, zoom)
PolicyRuntime.prepare = tell
"""
SHOWN = re.compile(r'goal of (\S+) rad at zoom (\S+)')


@pytest.mark.parametrize('first', ['picture', 'camera'])
def test_a_goal_is_cut_by_its_own_camera_to_the_view_of_the_robots(first, tmp_path):
    log = tmp_path / 'log'

    def shown():
        return [tuple(map(float, pair)) for pair in SHOWN.findall(log.read_text())]
    with broken_node(write_small_search(tmp_path / 'policy'), tmp_path, TELLS) as (robot, _):
        # The robot sees 70 deg, the goal's camera 60; the policy learned with 90.
        robot.focal = robot.size[0] / 2 / math.tan(math.radians(35))
        goals = robot.node.create_publisher(CameraInfo, 'goal_camera_info',
                                            qos('goal_camera_info'))
        wait_until(lambda: 'active' in log.read_text() and goals.get_subscription_count()
                   and robot.goal.get_subscription_count(), robot.spin)
        robot.spin_for(0.5)  # it knows the robot's camera
        goal = robot.picture(0, robot.stamp())
        info = fill_camera_info(CameraInfo(header=goal.header), *robot.size, math.radians(60))
        messages = [(robot.goal, goal), (goals, info)]
        for publisher, message in messages if first == 'picture' else reversed(messages):
            publisher.publish(message)
            robot.spin_for(0.3)
        robot.enable()
        wait_until(robot.moving, robot.spin)
        fov, zoom = shown()[-1]
        assert fov == pytest.approx(math.radians(60), abs=1e-3)
        seen = fov_across(math.radians(70), 1.0)
        assert zoom == pytest.approx(zoom_of(seen, math.radians(90)), rel=1e-3)
        count = len(shown())
        robot.show_goal(1)  # of the robot's own camera: the other one says nothing of it
        robot.spin_for(0.5)
        assert len(shown()) == count
