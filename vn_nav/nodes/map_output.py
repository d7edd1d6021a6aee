"""What a policy that searches knows of the place, to look at: `~/map` and `~/hypotheses`."""

from __future__ import annotations

import math
import time

import numpy as np
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import OccupancyGrid

from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.nodes.goal_output import BASE, pose_message
from vn_nav.nodes.qos import qos
from vn_nav.policy.search.grid import CELL
from vn_nav.policy.search.searcher import Searcher

PERIOD_S = 1.0  # who looks at the map wants no more


class MapOutput:
    """Publishes the map when somebody listens.

    Args:
        node: that publishes.
        period: s of steady time between two maps at least.

    Attributes:
        publishers: what was made.
    """

    def __init__(self, node, period: float = PERIOD_S):
        self._map = node.create_publisher(OccupancyGrid, '~/map', qos('policy_node/map'))
        self._hypotheses = node.create_publisher(PoseArray, '~/hypotheses',
                                                 qos('policy_node/hypotheses'))
        self.publishers = [self._map, self._hypotheses]
        self._due, self._period = -math.inf, period

    def publish(self, searcher: Searcher, pose: np.ndarray | None, frame: str, stamp) -> None:
        """Publish what a searcher knows, if it is time and somebody listens.

        Args:
            searcher: at its newest picture.
            pose: [3] x, y [m], yaw [rad] of the robot there by odometry; None: unknown, the map
                is then as the robot sees it.
            frame: name of the frame of the odometry.
            stamp: of the picture, as a message.
        """
        now = time.monotonic()
        listened = [publisher.get_subscription_count() > 0 for publisher in self.publishers]
        if now < self._due or not any(listened):
            return
        self._due = now + self._period
        # The searcher's map lies in a frame of its own, which begins with the episode.
        base = np.zeros(3) if pose is None else pose
        begin = compose(base, between(searcher.pose, np.zeros(3)))
        frame = BASE if pose is None else frame
        if listened[0]:
            self._publish(self._map, _map_message(searcher, begin), frame, stamp)
        if listened[1]:
            best = sorted(searcher.hypotheses.all, key=lambda own: -own.weight)
            self._publish(self._hypotheses, PoseArray(
                poses=[pose_message(compose(begin, own.pose)) for own in best]), frame, stamp)

    @staticmethod
    def _publish(publisher, message, frame: str, stamp) -> None:
        message.header.frame_id, message.header.stamp = frame, stamp
        publisher.publish(message)


def _map_message(searcher: Searcher, begin: np.ndarray) -> OccupancyGrid:
    """The map, whose frame lies at a pose [3]."""
    grid, message = searcher.grid, OccupancyGrid()
    cells = grid.occupancy()
    message.info.resolution = CELL
    message.info.height, message.info.width = cells.shape
    message.info.origin = pose_message(compose(begin, np.array([*grid.origin, 0.0])))
    message.data.frombytes(cells.tobytes())
    return message
