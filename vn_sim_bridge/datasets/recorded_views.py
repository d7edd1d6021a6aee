"""Pictures out of an `ImageGraph` with their poses, for whom to know the place by heart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, uniform
from vn_sim_bridge.datasets.recorded_pairs import SHAKEN
from vn_sim_bridge.recorded.image_graph import ImageGraph
from vn_sim_bridge.recorded.relight import draw_light, relight
from vn_sim_bridge.simulators.recorded import turned


class GraphViews:
    """Pictures of some nodes, each turned a little and in another light.

    Everything is a function of the seed and the number of the draw.

    Args:
        graph: the place.
        robot: its camera.
        nodes: [K] to draw from.
        seed: of the draws.
    """

    def __init__(self, graph: ImageGraph, robot: RobotSpec, nodes: Sequence[int] | np.ndarray,
                 seed: int = 0):
        self._graph, self._robot, self._seed = graph, robot, seed
        self._nodes, self._count = np.asarray(nodes, np.int64), 0

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The next pictures [K,3,S,S] uint8 and poses [K,3]."""
        numbers = np.arange(self._count, self._count + count)
        self._count += count
        drawn = uniform(self._seed, Stream.VIEW, numbers[:, None], 0, np.arange(2))
        nodes = self._nodes[(drawn[:, 0] * len(self._nodes)).astype(np.int64)]
        shake = (2 * drawn[:, 1] - 1) * SHAKEN
        pictures = turned(self._graph.pictures[nodes], shake, self._robot)
        relight(pictures, draw_light(self._seed, Stream.VIEW_APPEARANCE, numbers, 0 * numbers))
        poses = self._graph.poses[nodes].copy()
        poses[:, 2] += shake
        return pictures, poses
