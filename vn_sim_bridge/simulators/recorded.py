"""A recorded drive, `bag:FOLDER`: a robot sees the picture that was taken nearest to its pose."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import SceneName, options_of
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.recorded.image_graph import ImageGraph
from vn_sim_bridge.recorded.open_poses import FARTHEST, GAP, HEADING, TURNED_MOST, in_sight
from vn_sim_bridge.recorded.pose_lattice import NEAR, TURNED
from vn_sim_bridge.recorded.relight import draw_light, relight
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Motion,
    Setup,
    cameras_at,
)

BUCKET = 0.5  # m, side of the squares that nodes are looked for in
AS_GOOD = 0.5  # a node that is farther than the nearest one by no more may be shown instead
SHARP = math.radians(0.5)  # rad: a picture is not turned by less


class RecordedSimulator(BaseSimulator):
    """N robots in a graph of recorded pictures (see `Simulator`).

    A robot sees the node nearest to its pose in the metric of `pose_lattice`, or one about as
    near, drawn for every picture. What is left between the headings is made up for: under a
    rotation alone the picture of a pinhole camera is known but for what comes in from beyond
    its edges, which are repeated. Moves and turns end, as a contact, where no picture is near.

    Args:
        graph: the place.
        num_envs: robots, N.
        robot: its camera.
        draw: whether to draw among the near nodes; False: always the nearest.
        light: whether every episode has a light of its own, see `relight`. What `view` returns,
            goals too, is as it was recorded.
    """

    # Of a drive with depth pictures.
    capabilities = Capabilities(continuous=True, depth=True, labels=False, geodesic=True,
                                tilt=False)
    version = 'recorded'  # unless a simulator drew the pictures: then its version

    def __init__(self, graph: ImageGraph, num_envs: int, *, robot: RobotSpec, draw: bool = True,
                 light: bool = False):
        super().__init__([graph], Setup(num_envs, robot, graph.pictures.shape[-1]))
        self.graph = graph
        self.capabilities = dataclasses.replace(
            self.capabilities, depth=graph.depth is not None)
        self.version = graph.world_version
        self.poses[:, :3] = graph.poses[0]
        self.planner = graph.map
        self._draw = draw
        self._light = (np.tile(np.arange(256, dtype=np.uint8), (num_envs, 3, 1)) if light
                       else None)
        self._index = _make_index(graph.poses)
        self._node = np.zeros(num_envs, np.int64)  # that was shown last
        self._seen_from = self.poses.copy()
        self._blank = np.zeros((num_envs, *graph.pictures.shape[2:]), np.uint8)

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> RecordedSimulator:
        """See `BaseSimulator.open`; the drive is read as `vn_nav teach` reads it."""
        for scene in scenes:
            options_of(scene, ())
        if len(scenes) != 1:
            raise UserError('robots drive in one recorded drive', ', '.join(map(str, scenes)),
                            'name one bag')
        if setup.models or setup.goal_seed or setup.goals_per_room != 1:
            raise UserError('a recorded drive has the goals that it shows, and no objects',
                            str(scenes[0]), 'leave out other goals and objects')
        return cls(read_graph(scenes[0], setup), setup.num_envs, robot=setup.robot)

    @property
    def seen_from(self) -> np.ndarray:
        """[N,4] where the last pictures were taken."""
        return self._seen_from

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to where no picture is near."""
        env_ids = self._all if env_ids is None else env_ids
        before = self.poses[env_ids]
        ends, share = self.graph.map.drive(before, delta)
        self.poses[env_ids, :3] = ends
        done = np.zeros((len(before), 4))
        # In the frame of the mean heading, as `World` has it.
        heading = before[:, 2] + 0.5 * delta[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        gap = ends[:, :2] - before[:, :2]
        done[:, 0], done[:, 1] = c * gap[:, 0] + s * gap[:, 1], c * gap[:, 1] - s * gap[:, 0]
        done[:, 2] = delta[:, 2] * share
        return Motion(done, share < 1.0)

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        poses = np.repeat(self.poses[[env_id], :3], len(headings), axis=0)
        poses[:, 2] = headings
        return self.graph.map.drive(poses, np.array([[length, 0.0, 0.0]] * len(poses)))[0][:, :2]

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env, episode) -> None:
        """Draw the light of episodes."""
        if self._light is not None:
            env, episode = (np.broadcast_to(part, env_ids.shape) for part in (env, episode))
            self._light[env_ids] = draw_light(seed, stream, env, episode)

    def observe(self, env_ids: np.ndarray | None = None,
                keys: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras.

        Args:
            env_ids: [K] which robots; default all.
            keys: [K] uint64 random numbers to draw the nodes by; None: the nearest ones.
        """
        env_ids = self._all if env_ids is None else env_ids
        poses = self.poses[env_ids]
        nodes = self._nearest(poses, keys if self._draw else None)
        self._node[env_ids] = nodes
        # In place of the node the robot stands where its picture was taken, but as it is turned.
        self._seen_from[env_ids] = poses
        self._seen_from[env_ids, :2] = self.graph.poses[nodes, :2]
        frames = self._frames(nodes, poses[:, 2])
        if self._light is not None:
            relight(frames.rgb, self._light[env_ids])
        return frames

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: None = None, keys: np.ndarray | None = None, placed=None) -> Frames:
        """The pictures nearest to poses [K,4], turned to their headings."""
        return self._frames(self._nearest(poses, None), poses[:, 2])

    def cameras(self, poses: np.ndarray | None = None, appearance: None = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Cameras [K,5] and fov [K] of poses [K,4], or behind the depth that robots saw last."""
        return cameras_at(self.graph.poses[self._node] if poses is None else poses, self.robot)

    def co_visibility(self, goal_poses: np.ndarray) -> np.ndarray:
        """What poses alone say of what robots and goals [N,4] both show, see `ImageGraph`."""
        return self.graph.co_visibility(self.seen_from, goal_poses, self.robot.camera_fov)

    def _nearest(self, poses: np.ndarray, keys: np.ndarray | None) -> np.ndarray:
        draw = keys is not None
        if keys is None:
            keys = np.zeros(len(poses), np.uint64)
        floor = self.graph.floor
        return _nearest(np.ascontiguousarray(poses[:, :3], float), keys, AS_GOOD if draw else 0.0,
                        self.graph.poses, *floor.origin, floor.free, *self._index)

    def _frames(self, nodes: np.ndarray, yaw: np.ndarray) -> Frames:
        graph, count = self.graph, len(nodes)
        residual = yaw - graph.poses[nodes, 2]
        rgb = turned(graph.pictures[nodes], residual, self.robot)
        blank = self._blank if count <= self.num_envs else np.zeros(
            (count, *self._blank.shape[1:]), np.uint8)
        depth = (graph.depth[nodes].astype(np.float32) if graph.depth is not None
                 else blank[:count].astype(np.float32))
        return Frames(rgb, depth, blank[:count], blank[:count].astype(np.uint16))


def read_graph(scene: SceneName, setup: Setup) -> ImageGraph:
    """The place of a recorded drive.

    Raises:
        UserError: no bag, or one that is no place to drive in.
    """
    import tempfile

    from vn_nav.bags.mapping.recorded_place import PlaceOptions, read_place
    from vn_sim_bridge.recorded.image_graph import build_graph
    with tempfile.TemporaryDirectory() as decoded:
        return read_place(Path(scene.place), PlaceOptions(), build_graph, setup.robot, setup.size,
                          Path(decoded))


def turned(pictures: np.ndarray, yaw: np.ndarray, robot: RobotSpec) -> np.ndarray:
    """Pictures [K,3,S,S] as the camera would have taken them turned left by yaw [K] rad."""
    yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
    out = pictures.copy()
    focal = pictures.shape[-1] / 2 / math.tan(robot.camera_fov / 2)
    _turn(pictures, yaw, robot.camera_pitch, focal, out)
    return out


SIMULATOR = RecordedSimulator


class _Index(NamedTuple):
    """Nodes by squares of the floor."""

    left: float  # m, of the corner of square [0, 0]
    low: float
    columns: int
    first: np.ndarray  # [squares+1] of the entries of each
    node: np.ndarray  # [K]


def _make_index(poses: np.ndarray) -> _Index:
    low = poses[:, :2].min(axis=0)
    column, row = np.floor((poses[:, :2] - low) / BUCKET).astype(np.int64).T
    columns = int(column.max()) + 1
    square = row * columns + column
    order = np.argsort(square, kind='stable')
    first = np.searchsorted(square[order], np.arange(columns * (int(row.max()) + 1) + 1))
    return _Index(float(low[0]), float(low[1]), columns, first, order)


@numba.njit(cache=True)
def _misfit(pose, node, most, x, y, free):
    """How far a pose is from that of a node, in `NEAR` and `TURNED`; infinity: more than `most`.

    Or not in sight, or turned away: then the node does not stand for the pose.
    """
    gap = math.hypot(pose[0] - node[0], pose[1] - node[1])
    turn = (pose[2] - node[2] + math.pi) % (2 * math.pi) - math.pi
    misfit = math.hypot(gap / NEAR, turn / TURNED)
    if misfit > most or gap > FARTHEST + CELL or abs(turn) > TURNED_MOST + GAP * HEADING or (
            gap > CELL and not in_sight(pose[0], pose[1], node[0], node[1], x, y, free)):
        return math.inf
    return misfit


@numba.njit(cache=True)
def _nearest(poses, keys, spread, nodes, x, y, free, left, low, columns, first, entries):
    """The nearest node of each pose, or the one that a key draws among those `spread` farther.

    Args:
        x, y, free: corner and cells of the floor.
        left, low, columns, first, entries: see `_Index`.
    """
    chosen = np.zeros(len(poses), np.int64)
    rows = (len(first) - 1) // columns
    around = int(FARTHEST / BUCKET) + 1
    for n in range(len(poses)):
        row = math.floor((poses[n, 1] - low) / BUCKET)
        column = math.floor((poses[n, 0] - left) / BUCKET)
        top, bottom = max(row - around, 0), min(row + around, rows - 1)
        begin, end = max(column - around, 0), min(column + around, columns - 1)
        least = math.inf
        for i in range(top, bottom + 1):
            for k in range(first[i * columns + begin], first[i * columns + end + 1]):
                misfit = _misfit(poses[n], nodes[entries[k]], least, x, y, free)
                if misfit < least:
                    least, chosen[n] = misfit, entries[k]
        if math.isinf(least):  # somebody has put the robot where no picture is
            chosen[n] = _any_nearest(poses[n], nodes)
            continue
        if spread == 0.0:
            continue
        count = 0
        for again in range(2):
            skip = int(keys[n] % np.uint64(count)) if again else 0
            for i in range(top, bottom + 1):
                for k in range(first[i * columns + begin], first[i * columns + end + 1]):
                    if _misfit(poses[n], nodes[entries[k]], least + spread, x, y,
                               free) < math.inf:
                        if again and skip == 0:
                            chosen[n] = entries[k]
                        skip -= 1
                        count += 1 - again
    return chosen


@numba.njit(cache=True)
def _any_nearest(pose, nodes):
    least, chosen = math.inf, 0
    for k in range(len(nodes)):
        turn = (pose[2] - nodes[k, 2] + math.pi) % (2 * math.pi) - math.pi
        misfit = math.hypot(math.hypot(pose[0] - nodes[k, 0], pose[1] - nodes[k, 1]) / NEAR,
                            turn / TURNED)
        if misfit < least:
            least, chosen = misfit, k
    return chosen


@numba.njit(cache=True)
def _turn(pictures, yaw, pitch, focal, out):
    """Resample pictures [K,3,S,S] for a camera turned by yaw [K] about the vertical axis."""
    size = pictures.shape[-1]
    middle = 0.5 * size - 0.5
    cp, sp = math.cos(pitch), math.sin(pitch)
    for n in range(len(pictures)):
        if abs(yaw[n]) < SHARP:
            continue
        c, s = math.cos(yaw[n]), math.sin(yaw[n])
        for v in range(size):
            for u in range(size):
                # The ray of the turned camera: forward, left, up in the level frame of the old.
                right, down = (u - middle) / focal, (v - middle) / focal
                level, up = cp - sp * down, -sp - cp * down
                forward, left = c * level + s * right, s * level - c * right
                ahead = cp * forward - sp * up
                column = min(max(-left / ahead * focal + middle, 0.0), size - 1.0)
                row = min(max(-(sp * forward + cp * up) / ahead * focal + middle, 0.0),
                          size - 1.0)
                j, i = min(int(column), size - 2), min(int(row), size - 2)
                a, b = column - j, row - i
                for k in range(3):
                    value = ((1 - b) * ((1 - a) * pictures[n, k, i, j]
                                        + a * pictures[n, k, i, j + 1])
                             + b * ((1 - a) * pictures[n, k, i + 1, j]
                                    + a * pictures[n, k, i + 1, j + 1]))
                    out[n, k, v, u] = int(value + 0.5)
