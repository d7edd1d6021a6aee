"""A bridge in a process of its own, and what is heard of it: for tests of simulators over ROS."""

import contextlib
import json
from typing import NamedTuple

from ros_harness import child, wait_until


class Bridged(NamedTuple):
    """A bridge that runs."""

    node: object  # that listens
    heard: dict  # messages by topic: scene, image_raw, goal_image, ground_truth/odom
    command: object  # publisher of cmd_vel
    spin: object  # hears what has come; for `wait_until`
    facts: dict  # of the topic scene


@contextlib.contextmanager
def bridged(scene, log, **parameters):
    """A bridge of a scene, heard from on every topic."""
    import rclpy
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Image
    from std_msgs.msg import String

    from vn_nav.nodes.qos import qos
    rclpy.init()
    node, heard = rclpy.create_node('bridge_listener'), {}
    try:
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        for name, kind in (('scene', String), ('image_raw', Image), ('goal_image', Image),
                           ('ground_truth/odom', Odometry)):
            heard[name] = []
            node.create_subscription(kind, name, heard[name].append, qos(name, depth=10))
        command = node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))

        def spin():
            executor.spin_once(timeout_sec=0.02)
        with child('vn_sim_bridge.bridge_node', log, scene=scene, **parameters):
            wait_until(lambda: all(heard.values()), spin)
            yield Bridged(node, heard, command, spin, json.loads(heard['scene'][0].data))
    finally:
        node.destroy_node()
        rclpy.shutdown()
