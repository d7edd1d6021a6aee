"""What policy_node says of its goal: `goal_status`, `goal_feedback` and `goal_estimate`."""

from __future__ import annotations

import json
import math
import time

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped
from rclpy.duration import Duration
from std_msgs.msg import String

from vn_msgs_py.motion import yaw_to_quaternion
from vn_nav.bags.mapping.pose_graph import compose
from vn_nav.nodes.qos import qos
from vn_nav.policy.navigator import Navigator

BASE = 'base_link'


class GoalOutput:
    """Publishes where a goal stands; its owner holds the lock of the navigator.

    Args:
        node: that publishes.
        navigator: has the goal.

    Attributes:
        publishers: what was made.
        arrival, distance: probability that the robot has arrived, and metres to where the goal is
            taken to be, at the newest decision; NaN: unknown.
        estimate: the same as a pose, in a frame; None: unknown.
        stamp: seconds and nanoseconds of the newest goal's picture.
    """

    def __init__(self, node, navigator: Navigator):
        self._navigator = navigator
        self._status, self._feedback, self._estimate = self.publishers = [
            node.create_publisher(kind, name, qos(name)) for kind, name in (
                (String, 'goal_status'), (String, 'goal_feedback'),
                (PoseStamped, 'goal_estimate'))]
        self._said: tuple | None = None
        self._of = 0  # number of the goal of what follows
        self.arrival = self.distance = math.nan
        self.estimate: PoseStamped | None = None
        self.stamp = 0, 0

    def status(self) -> dict:
        """Where the newest goal stands, as JSON's values."""
        goal = self._navigator.goal
        return {'goal': goal.number, 'stamp': self.stamp, 'status': goal.status.value,
                'error_code': int(goal.code), 'error_msg': goal.message,
                'decisions': self._navigator.decisions,
                'seconds': round(goal.seconds(time.monotonic()), 2)}

    def publish(self) -> None:
        """Say where the newest goal stands, when that has changed."""
        goal = self._navigator.goal
        if goal.number != self._of:
            self._of, self.arrival, self.distance = goal.number, math.nan, math.nan
            self.estimate = None
        now = goal.number, goal.status, goal.code, goal.message
        if now != self._said:
            self._said = now
            self._status.publish(String(data=json.dumps(self.status())))

    def deliver(self) -> None:
        """Wait until what was said has been heard, for 200 ms at most."""
        self._status.wait_for_all_acked(Duration(seconds=0.2))

    def decided(self, arrival: float, goal: np.ndarray | None, pose: np.ndarray | None,
                frame: str, stamp) -> None:
        """Say what the newest decision was made of.

        Args:
            arrival: probability that the robot has arrived; NaN: the policy does not know.
            goal: [3] x, y [m], yaw [rad] of the goal in the robot's frame; None: no idea.
            pose: [3] of odometry at the picture; None: unknown.
            frame: of the odometry.
            stamp: of the picture, as a message.
        """
        self.arrival = arrival
        self.distance = math.nan if goal is None else float(np.hypot(*goal[:2]))
        self.estimate = None
        if goal is not None:
            self.estimate = PoseStamped(
                pose=pose_message(goal if pose is None else compose(pose, goal)))
            self.estimate.header.frame_id = BASE if pose is None else frame
            self.estimate.header.stamp = stamp
            self._estimate.publish(self.estimate)
        self._feedback.publish(String(data=json.dumps(
            self.status() | {'state': self._navigator.state.value, 'arrival': _number(arrival),
                             'distance_remaining': _number(self.distance)})))


def _number(value: float) -> float | None:
    """For JSON, which has no NaN."""
    return None if math.isnan(value) else round(value, 3)


def pose_message(pose: np.ndarray) -> Pose:
    """A pose [3] x, y [m], yaw [rad]."""
    message = Pose()
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    (message.orientation.x, message.orientation.y, message.orientation.z,
     message.orientation.w) = yaw_to_quaternion(float(pose[2]))
    return message
