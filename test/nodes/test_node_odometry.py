"""The pose of odometry that policy_node gives its policy with a picture."""

import json
import math
import threading
import time

import numpy as np
import pytest
import rclpy
from fake_robot import broken_node
from nav_msgs.msg import Odometry
from ros_harness import wait_until, write_checkpoint
from sensor_msgs.msg import Image
from std_msgs.msg import String

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry
from vn_nav.nodes.camera_pictures import CameraPictures
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.policy_inputs import PolicyInputs
from vn_nav.policy.navigator import Limits, Navigator, Phase
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.robot import RobotSpec

pytestmark = pytest.mark.ros
LONG = 1e3  # s


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint', size=36)


class Recording(PolicyRuntime):
    """Keeps what it is given."""

    def __init__(self, checkpoint):
        super().__init__(checkpoint)
        self.poses, self.breaks = [], 0

    def act(self, image, odometry=None, scan=None, zoom=1.0, view=None):
        self.poses.append(odometry)
        return super().act(image, odometry, scan, zoom, view)

    def reset_odometry(self):
        self.breaks += 1
        super().reset_odometry()


class Inside:
    """The parts of a policy node that odometry passes, without its output thread.

    Args:
        mode: as the node's parameter.
    """

    def __init__(self, checkpoint, mode):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('policy_node', context=self.context)
        self.runtime, self.wake = Recording(checkpoint), threading.Condition()
        robot = RobotSpec().with_actions(self.runtime.action_names)
        self.navigator = Navigator(robot, Limits(LONG, LONG, inference_timeout=LONG,
                                                 odometry_timeout=LONG),
                                   continuous=mode != 'stop_and_go')
        self.output = CommandOutput(self.node, self.navigator, self.wake, period=0.05,
                                    lock_step=False, stamped=False)
        shadow = mode == 'shadow'
        self.worker = DecisionWorker(
            self.node, self.navigator, self.runtime, CameraPictures(self.runtime), self.output,
            self.wake, lock_step=False, shadow=shadow)
        self.inputs = PolicyInputs(self.node, self.navigator, self.worker, self.output, self.wake,
                                   compressed=False, lock_step=False, shadow=shadow)
        self.runs = True
        self.thread = threading.Thread(target=self.worker.run, args=(lambda: self.runs,))
        self.thread.start()
        self.worker.show_goal(self.picture())
        self.until(lambda: self.navigator.goal_ready)
        with self.wake:
            for since in (2.0, 0.0):
                self.navigator.good_frame(time.monotonic() - since)
            assert self.navigator.enable(time.monotonic())[0]

    def until(self, condition):
        wait_until(condition, lambda: time.sleep(0.001))

    def picture(self):
        return fill_image(Image(), np.full((36, 36, 3), 90, np.uint8), 'rgb8')

    def measure(self, stamp, *pose):
        message = fill_odometry(Odometry(), *pose, np.zeros(4))
        message.header.stamp.sec = int(stamp)
        message.header.stamp.nanosec = round(stamp % 1 * 1e9)
        self.output.take_odometry(message)

    def look(self, stamp):
        """The pose given with a picture of this stamp."""
        seen = len(self.runtime.poses)
        self.worker.show_frame(self.picture(), stamp, time.monotonic())
        self.until(lambda: self.navigator.ready_to_move)
        assert len(self.runtime.poses) == seen + 1
        with self.wake:  # the action is carried out
            while self.navigator.phase is Phase.MOVE or self.navigator.ready_to_move:
                self.navigator.step(time.monotonic(), 0.05, None, stamp)
        return self.runtime.poses[-1]

    def close(self):
        with self.wake:
            self.runs = False
            self.wake.notify_all()
        self.thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def inside(checkpoint, request):
    parts = Inside(checkpoint, request.param)
    yield parts
    parts.close()


@pytest.mark.parametrize('inside', ['stop_and_go'], indirect=True)
def test_at_rest_the_newest_odometry_belongs_to_the_picture(inside, monkeypatch):
    assert inside.look(8.0) is None  # there is none yet
    inside.measure(10.0, 1.0, 2.0, 0.3)
    assert inside.look(9.0) == pytest.approx([1.0, 2.0, 0.3])  # its clock may be another
    inside.measure(10.1, 1.02, 2.0, 0.3)
    assert inside.look(12.0) == pytest.approx([1.02, 2.0, 0.3])
    assert inside.runtime.breaks == 0
    monkeypatch.setattr(inside.output, '_received', time.monotonic() - 2 * LONG)
    assert inside.look(13.0) is None  # silent
    inside.measure(10.2, 1.02, 2.0, 0.3)
    assert inside.look(14.0) is not None and inside.runtime.breaks == 0


@pytest.mark.parametrize('inside', ['stop_and_go'], indirect=True)
def test_a_jump_reaches_the_policy_before_the_pose_after_it(inside):
    inside.measure(10.0, 0.0, 0.0, 0.0)
    inside.look(10.0)
    inside.measure(10.05, 50.0, 0.0, 0.0)
    assert inside.look(11.0) == pytest.approx([50.0, 0.0, 0.0]) and inside.runtime.breaks == 1
    inside.measure(1.0, 50.0, 0.0, 0.0)  # its clock was set back
    assert inside.look(12.0) is not None and inside.runtime.breaks == 2
    assert inside.look(13.0) is not None and inside.runtime.breaks == 2


@pytest.mark.parametrize('inside', ['continuous'], indirect=True)
def test_in_motion_it_is_the_odometry_at_the_stamp(inside):
    inside.measure(1.0, 0.0, 0.0, 0.0)
    inside.measure(1.1, 0.05, 0.0, 0.1)
    assert inside.look(1.05) == pytest.approx([0.025, 0.0, 0.05])
    assert inside.look(1.2) == pytest.approx([0.05, 0.0, 0.1])
    assert inside.look(2.0) is None


@pytest.mark.parametrize('inside', ['shadow'], indirect=True)
def test_in_a_shadow_who_says_what_was_done_may_say_where(inside):
    inside.measure(1.0, 7.0, 0.0, 0.0)

    def executed(stamp, **more):
        inside.inputs._on_executed_action(String(data=json.dumps(
            {'stamp': divmod(round(stamp * 1e9), 10**9), 'action': None} | more)))
    for stamp, more, pose in ((1.05, {}, [7, 0, 0]), (1.1, {'odometry': [1, 2, 3]}, [1, 2, 3]),
                              (1.15, {'odometry': None}, None)):
        executed(stamp, **more)
        found = inside.look(stamp)
        assert found is pose or found == pytest.approx(pose)
    for wrong in ([1, 2], [1, 2, math.nan], 'here'):
        executed(1.17, odometry=wrong)  # refused: nothing is to be decided
    assert inside.worker._executed is None


TELLS = """
from vn_nav.policy.runtime import PolicyRuntime
act = PolicyRuntime.act
def telling(self, image, odometry=None, scan=None, zoom=1.0, view=None):
    print('pose', None if odometry is None else odometry.tolist(), flush=True)
    return act(self, image, odometry, scan, zoom, view)
PolicyRuntime.act = telling
"""


@pytest.mark.slow
def test_a_node_gives_its_policy_the_pose_where_the_robot_stands(checkpoint, tmp_path):
    def poses():
        lines = (tmp_path / 'log').read_text().splitlines()
        return [json.loads(line[5:]) for line in lines if line.startswith('pose [')]
    with broken_node(checkpoint, tmp_path, TELLS) as (robot, _):
        been = [robot.pose.copy()]

        def spin():
            robot.spin()
            been.append(robot.pose.copy())
        robot.show_goal()
        robot.enable()
        wait_until(lambda: len(poses()) >= 4, spin)
        been = np.array(been)
        for pose in poses()[:4]:
            gap = np.abs(been - pose)
            gap[:, 2] = np.abs(np.sin(gap[:, 2] / 2))  # a message's yaw is wrapped
            assert gap.max(axis=1).min() < 1e-6
