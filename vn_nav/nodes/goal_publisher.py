"""Shows a policy a goal picture: `goal_image`, and `goal_camera_info` where its lens is known."""

from __future__ import annotations

import math

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.images import fill_image
from vn_nav.nodes.qos import qos


class GoalPublisher:
    """Both topics are latched: a policy that starts later gets the newest goal.

    Args:
        node: that publishes.

    Attributes:
        stamp: seconds and nanoseconds of the newest goal.
    """

    def __init__(self, node: Node):
        self._node, self.stamp = node, (0, 0)
        self._picture = node.create_publisher(Image, 'goal_image', qos('goal_image'))
        self._camera: Publisher | None = None

    def show(self, picture: np.ndarray, fov: float | None) -> str:
        """Publish a goal.

        Args:
            picture: [H,W,3] uint8 RGB.
            fov: of its shorter side [rad]; None: as of the robot's camera.

        Returns:
            What was shown, in words.
        """
        height, width = picture.shape[:2]
        message = fill_image(Image(), picture, 'rgb8')
        message.header.stamp = now = self._node.get_clock().now().to_msg()
        self.stamp = now.sec, now.nanosec
        lens = "as wide as the robot's camera: the file does not say its focal length"
        if fov is not None:
            lens = f'{math.degrees(fov):.0f} deg on its shorter side'
            if self._camera is None:
                self._camera = self._node.create_publisher(CameraInfo, 'goal_camera_info',
                                                           qos('goal_camera_info'))
            # Before the picture: nobody has to take that twice.
            self._camera.publish(fill_camera_info(CameraInfo(header=message.header), width,
                                                  height, fov))
        self._picture.publish(message)
        return f'{width} x {height}, {lens}'
