"""A robot of this process, for a training over topics."""

import threading
import time

import numpy as np
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool, UInt8

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry, twist_to_array
from vn_nav.bags.poses import integrate
from vn_nav.nodes.qos import qos


class Robot:
    """A robot of this process: a camera, wheels that obey, a bumper, and who judges."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('robot', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publishers = {name: self.node.create_publisher(kind, name, qos(name))
                           for name, kind in (
                               ('image_raw', Image), ('odom', Odometry), ('goal_image', Image),
                               ('camera_info', CameraInfo), ('collision', Bool),
                               ('goal_camera_info', CameraInfo),
                               ('arrived', Bool), ('episode_end', UInt8))}
        self.node.create_subscription(Twist, 'cmd_vel', self._obey, qos('cmd_vel', depth=50))
        self.commands, self.pose, self.velocity = [], np.zeros(3), np.zeros(4)
        self.heard = self.due = self.ticked = 0.0
        self.camera = True

    def _obey(self, message):
        self.heard, self.velocity = time.monotonic(), twist_to_array(message)
        self.commands.append((self.heard, self.velocity))

    def picture(self, shade):
        pixels = np.full((36, 36, 3), shade, np.uint8)
        message = fill_image(Image(), pixels, 'rgb8')
        message.header.stamp = self.node.get_clock().now().to_msg()
        return message

    def show_goal(self, shade):
        self.publishers['goal_image'].publish(self.picture(shade))

    def spin(self):
        """A moment of its life: 50 times a second it measures, 25 times it looks."""
        now = time.monotonic()
        if now >= self.due:
            if now - self.heard > 0.5:
                self.velocity = np.zeros(4)  # as bases do
            self.pose = integrate(self.pose, self.velocity[:3], now - (self.ticked or now))
            self.ticked, self.due = now, now + 0.02
            odometry = fill_odometry(Odometry(), *self.pose, self.velocity)
            odometry.header.stamp = self.node.get_clock().now().to_msg()
            self.publishers['odom'].publish(odometry)
            if self.camera:
                self.publishers['image_raw'].publish(self.picture(int(now * 25) % 200))
        self.executor.spin_once(timeout_sec=0.005)

    @property
    def moves(self):
        return bool(self.commands) and self.commands[-1][1].any()

    def close(self):
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class Lively:
    """A robot that lives in a thread of its own while this one trains."""

    def __init__(self, robot):
        self.robot, self.ends = robot, False
        self.thread = threading.Thread(target=self._live, daemon=True)

    def _live(self):
        while not self.ends:
            self.robot.spin()

    def __enter__(self):
        self.thread.start()
        return self.robot

    def __exit__(self, *_):
        self.ends = True
        self.thread.join(5)
