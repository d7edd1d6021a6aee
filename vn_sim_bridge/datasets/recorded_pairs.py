"""Picture pairs out of an `ImageGraph`: what `view_pairs.PairSampler` draws in scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_nav.co_visibility import co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, uniform
from vn_sim_bridge.datasets.pair_poses import BEHIND, CLOSE, NEARBY
from vn_sim_bridge.recorded.image_graph import ImageGraph
from vn_sim_bridge.simulators.recorded import cameras_at, turned

SHAKEN = math.radians(10)  # either way: every view is turned a little, see `turned`


class GraphPairs:
    """Pairs of pictures of a place, with what relates them (a `PairSource`).

    A goal is one of some nodes; robots stand about it as in `PairSampler`, as far as there are
    such nodes. Everything is a function of the seed and the number of the draw.

    Args:
        graph: the place.
        robot: its camera.
        goals: [G] nodes to draw goals from.
        seed: of the draws.
    """

    def __init__(self, graph: ImageGraph, robot: RobotSpec, goals: Sequence[int] | np.ndarray,
                 seed: int = 0):
        if len(goals) < 1:
            raise UserError('pairs have goals', 'none', 'name some nodes')
        self.count = 0  # robots placed so far
        self._graph, self._robot, self._seed = graph, robot, seed
        self._goals = np.asarray(goals, np.int64)

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """The next pairs: `image`, `goal` [K,3,S,S] uint8, `goal_pose` [K,4], `overlap` [K]."""
        groups = self.draw_groups(count, 1)
        forth = groups['first'] % 2 == 1  # of a robot towards its goal
        return {'image': groups['image'][1::2], 'goal': groups['image'][::2],
                'goal_pose': groups['goal_pose'][forth], 'overlap': groups['overlap'][forth]}

    def draw_groups(self, count: int, robots: int = 3) -> dict[str, np.ndarray]:
        """Views in groups, each of a goal and of several robots, see `PairSampler.draw_groups`.

        Returns:
            image: [V,3,S,S] uint8; first, second: [K] int64; goal_pose: [K,4]; overlap: [K],
                -1 where nobody knows.
        """
        if count < 1 or robots < 1:
            raise UserError('a draw has at least one group, and that one robot', (count, robots),
                            'draw more')
        graph, size = self._graph, 1 + robots
        numbers = np.arange(self.count, self.count + count * robots)
        self.count += count * robots
        draws = uniform(self._seed, Stream.PAIR, numbers[:, None], 1, np.arange(5))
        goals = self._goals[(draws[::robots, 0] * len(self._goals)).astype(np.int64)]
        others = _robots(draws, np.repeat(goals, robots), graph.poses)
        nodes = np.concatenate([goals[:, None], others.reshape(count, robots)], axis=1).ravel()
        shake = np.concatenate([draws[::robots, 3:4], draws[:, 4].reshape(count, robots)], axis=1)
        shake = (2 * shake.ravel() - 1) * SHAKEN
        poses = graph.poses[nodes].copy()
        poses[:, 2] += shake
        first, second = np.nonzero(~np.eye(size, dtype=bool))
        start = size * np.arange(count)[:, None]
        first, second = (start + first).reshape(-1), (start + second).reshape(-1)
        return {
            'image': turned(graph.pictures[nodes], shake, self._robot),
            'first': first, 'second': second,
            'goal_pose': relative_pose(poses[first], poses[second]),
            'overlap': self._overlap(nodes, poses, first, second),
        }

    def _overlap(self, nodes, poses, first, second) -> np.ndarray:
        graph = self._graph
        if graph.depth is None:
            return graph.co_visibility(poses[first], poses[second], self._robot.camera_fov)
        depth = graph.depth[nodes].astype(np.float32)
        cameras, fov = cameras_at(graph.poses[nodes], self._robot)
        points = lift(depth, cameras, fov)
        return co_visible(points[second], depth[first], cameras[first], fov[first])


@numba.njit(cache=True)
def _stands(kind, pose, goal):
    """Whether a robot stands about a goal as pairs of a kind do (0: anywhere)."""
    gap = math.hypot(goal[0] - pose[0], goal[1] - pose[1])
    turn = abs((goal[2] - pose[2] + math.pi) % (2 * math.pi) - math.pi)
    if kind == 1:
        return gap <= NEARBY[1] and turn <= NEARBY[2]
    if kind == 2:
        return gap <= CLOSE[1] and turn <= CLOSE[2]
    if kind == 3:
        line = math.atan2(goal[1] - pose[1], goal[0] - pose[0])
        return 0 < gap <= BEHIND[1] and (
            abs((line - pose[2] + math.pi) % (2 * math.pi) - math.pi) <= BEHIND[2]) and (
            abs((line - goal[2] + math.pi) % (2 * math.pi) - math.pi) <= BEHIND[3])
    return True


@numba.njit(cache=True)
def _robots(draws, goals, poses):
    """For each goal another node, by uniform numbers [K,>=3]."""
    chosen = np.empty(len(goals), np.int64)
    fits = np.empty(len(poses), np.int64)
    for n in range(len(goals)):
        kind = 0
        if draws[n, 1] < NEARBY[0]:
            kind = 1
        elif draws[n, 1] < NEARBY[0] + CLOSE[0]:
            kind = 2
        elif draws[n, 1] < NEARBY[0] + CLOSE[0] + BEHIND[0]:
            kind = 3
        count = 0
        while count == 0:
            for k in range(len(poses)):
                if k != goals[n] and _stands(kind, poses[k], poses[goals[n]]):
                    fits[count] = k
                    count += 1
            kind = 0  # where nobody stands so, anywhere
        chosen[n] = fits[int(draws[n, 2] * count)]
    return chosen
