"""The parts of policy_node between its callbacks and its commands, without its output thread."""

import threading
import time

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from ros_harness import wait_until
from sensor_msgs.msg import Image

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry
from vn_nav.nodes.camera_pictures import CameraPictures
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.policy_inputs import PolicyInputs
from vn_nav.policy.navigator import Limits, Navigator, Phase
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.robot import RobotSpec

LONG = 1e3  # s


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
    """A policy node in parts, enabled, at a goal.

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
