"""The camera's tilt as a joint: positions for a controller, in place of a rate in the Twist."""

from __future__ import annotations

import numpy as np
from std_msgs.msg import Float64MultiArray

from vn_nav.robot import MAX_TILT


class TiltOutput:
    """Adds up the tilt rates of commands, and publishes where the joint has to be.

    Of the kind that ros2_control's `forward_command_controller` and `position_controllers` take.

    Args:
        node: that publishes.
        name: of the topic.
        period: that a command holds [s].
        home: where the joint is at first [rad], positive down (REP 103, about y).

    Attributes:
        publisher: of the positions.
        angle: where the joint has to be [rad].
    """

    def __init__(self, node, name: str, period: float, home: float):
        self.publisher = node.create_publisher(Float64MultiArray, name, 1)
        self._period, self.angle = period, home

    def without_tilt(self, velocity: np.ndarray) -> np.ndarray:
        """What is left of a velocity [4] for the base; its tilt rate is published here."""
        if not velocity[3]:
            return velocity
        self.angle = float(np.clip(self.angle + self._period * velocity[3], -MAX_TILT, MAX_TILT))
        self.publisher.publish(Float64MultiArray(data=[self.angle]))
        return velocity * [1.0, 1.0, 1.0, 0.0]
