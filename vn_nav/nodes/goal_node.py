"""`goal_node`: shows the robot a picture from a file, as a latched `goal_image`.

Run: `ros2 run vn_nav goal_node --ros-args -p picture:=kitchen.jpg`; it stays until Ctrl-C, so that
a policy that starts later still gets the picture. Start it again with another picture for the next
goal.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rclpy.node import Node

from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.goal_publisher import GoalPublisher
from vn_nav.nodes.process import run_node, spin

PARAMETERS = {'picture': ('', "JPEG, PNG or HEIC, of the robot's camera or a phone")}


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
        picture, fov = read_goal_picture(path)
        shown = GoalPublisher(self).show(picture, fov)
        self.get_logger().info(f'showing {path}, {shown}')


def main(args=None) -> int:
    """Entry point: until a signal; exit code 2 and one line for a bad picture."""
    return run_node('goal_node', lambda _: GoalNode(), spin, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
