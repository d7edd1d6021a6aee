"""`goal_node`: shows the robot a picture from a file, as a latched `goal_image`.

Run: `ros2 run vn_nav goal_node --ros-args -p picture:=kitchen.jpg`; it stays until Ctrl-C, so that
a policy that starts later still gets the picture. Start it again with another picture for the next
goal.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rclpy.node import Node
from sensor_msgs.msg import Image

from vn_msgs_py.images import fill_image
from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.process import run_node, spin
from vn_nav.nodes.qos import qos

PARAMETERS = {'picture': ('', "JPEG or PNG, taken by the robot's camera")}


class GoalNode(Node):
    """Publishes one picture."""

    def __init__(self):
        super().__init__('goal_node')
        given = parameters.declare(self, PARAMETERS, read_only=True,
                                   others=policy_parameters.PARAMETERS)['picture']
        path = Path(given)
        if not path.is_file():
            raise UserError('the goal is a picture file', given,
                            'give one with --ros-args -p picture:=kitchen.jpg')
        picture = read_goal_picture(path)
        self.publisher = self.create_publisher(Image, 'goal_image', qos('goal_image'))
        message = fill_image(Image(), picture, 'rgb8')
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(message)
        self.get_logger().info(f'showing {path}, {picture.shape[1]} x {picture.shape[0]}')


def main(args=None) -> int:
    """Entry point: until a signal; exit code 2 and one line for a bad picture."""
    return run_node('goal_node', lambda _: GoalNode(), spin, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
