"""A drive as a graph: odometry, keyframes with their features, and nodes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.dataset import MAX_DEPTH, DriveSet, Pictures
from vn_nav.bags.drive import ODOMETRY_JUMP_M
from vn_nav.bags.mapping.pose_graph import Edges, between, compose, odometry_covariance
from vn_nav.bags.mapping.two_view import Camera
from vn_nav.bags.stamped import EPISODE_GAP_S
from vn_nav.robot import RobotSpec

KEYFRAME_M_RAD = (0.3, math.radians(20))  # m, rad between keyframes,
NODE_M_RAD = (0.5, math.radians(60))  # and between nodes of the graph
# Standard deviations of odometry between two episodes.
EPISODE_ODOMETRY_M_RAD = (1.0, math.radians(30))


class DriveGraph:
    """Odometry, keyframes and nodes of a drive."""

    def __init__(self, drives: DriveSet, robot: RobotSpec, pictures: Pictures,
                 stretch: np.ndarray | None, show: Callable[[float], None]):
        self.odometry = np.array(drives.pose, np.float64)
        steps = between(self.odometry[:-1], self.odometry[1:])
        ways = np.hypot(steps[:, 0], steps[:, 1])
        self.stretch = (np.zeros(len(self.odometry), np.int64) if stretch is None else stretch)
        carried = (np.diff(drives.episode) != 0) & (
            (np.abs(np.diff(drives.time)) > EPISODE_GAP_S) | (ways > ODOMETRY_JUMP_M)) | (
                np.diff(self.stretch) != 0)
        self.way, self.turn, self.net = (  # m driven, rad turned, rad to the left, [N]
            np.append(0.0, np.cumsum(np.where(carried, 0.0, moved)))
            for moved in (ways, np.abs(steps[:, 2]), steps[:, 2]))
        part = np.append(0, np.cumsum(carried))
        self.key = self._every(KEYFRAME_M_RAD, part)  # pictures [K]
        self.node = self._every(NODE_M_RAD, part)  # pictures [A]
        self.edges = self._odometry_edges(part)
        shares, before = self._shares(self.key)
        self.near = np.minimum(before + (shares > 0.5), len(self.node) - 1)  # node of a keyframe
        self.offset = between(self.odometry[self.node[self.near]], self.odometry[self.key])
        self.camera = Camera(robot, pictures.shape[-1])
        self.features = []
        for count, k in enumerate(self.key):
            show(count / len(self.key))
            self.features.append(self.camera.look(pictures[k], _depth(drives, k)))

    def spread(self, nodes: np.ndarray) -> np.ndarray:
        """Poses [N,3] of all pictures from those of the nodes [A,3].

        What two nodes say differently is spread over the motion between them.
        """
        shares, before = self._shares(np.arange(len(self.odometry)))
        after = np.minimum(before + 1, len(nodes) - 1)
        one, other = (compose(nodes[at], between(self.odometry[self.node[at]], self.odometry))
                      for at in (before, after))
        out = one + shares[:, None] * (other - one)
        out[:, 2] = wrap_angle(one[:, 2] + shares * wrap_angle(other[:, 2] - one[:, 2]))
        return out

    def _shares(self, pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where pictures lie from the node before them to the next, [K] in [0, 1]; that node."""
        moved = self.way / NODE_M_RAD[0] + self.turn / NODE_M_RAD[1]
        before = np.searchsorted(self.node, pictures, side='right') - 1
        after = np.minimum(before + 1, len(self.node) - 1)
        span = moved[self.node[after]] - moved[self.node[before]]
        return (moved[pictures] - moved[self.node[before]]) / np.maximum(span, 1e-12), before

    def _every(self, apart: tuple[float, float], part: np.ndarray) -> np.ndarray:
        """Pictures a distance or a turn apart, and the first and last of each part."""
        moved = np.floor(self.way / apart[0] + self.turn / apart[1])
        begins = np.append(True, np.diff(part) > 0)
        return np.flatnonzero(begins | np.append(begins[1:], True)
                              | np.append(True, np.diff(moved) > 0))

    def _odometry_edges(self, part: np.ndarray) -> Edges:
        at = self.node
        motion = between(self.odometry[at[:-1]], self.odometry[at[1:]])
        covariance = odometry_covariance(motion, np.diff(self.way[at]), np.diff(self.turn[at]))
        covariance[np.diff(part[at]) > 0] += np.diag(
            [*2 * EPISODE_ODOMETRY_M_RAD[:1], EPISODE_ODOMETRY_M_RAD[1]])**2
        first = np.arange(len(at) - 1)
        return Edges(first, first + 1, 0 * motion, 0 * motion, motion, covariance)


def _depth(drives: DriveSet, picture: int) -> np.ndarray | None:
    """Depth of a picture [m], 0 where unknown or far."""
    if drives.depth is None:
        return None
    depth = drives.depth[picture]
    return np.where(depth == 255, 0.0, depth * (MAX_DEPTH / 255))
