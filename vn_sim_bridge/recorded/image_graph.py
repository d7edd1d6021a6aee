"""A place made of recorded pictures: where a robot was driven, as somewhere to learn in.

Pictures with poses are the nodes of a graph whose edges are the robot's own moves between them
(Kulhanek, Derner, Babuska 2021 fine-tuned a policy in such a grid of pictures of an office). Free
is what lies beside the driven path, as a floor of the same type as a house's; and of that, what
some picture shows (`pose_lattice`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.co_visibility import co_visible_by_poses, relative_pose
from vn_nav.errors import UserError
from vn_nav.observation import preprocess
from vn_nav.robot import RobotSpec
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, FloorMap
from vn_sim_bridge.recorded.open_poses import in_sight
from vn_sim_bridge.recorded.pose_lattice import PoseMap
from vn_sim_bridge.simulator import Goal

MARGIN = 0.3  # m beside the driven path
JUMP = 0.7  # m between two pictures in a row: farther apart, nobody knows the way
SAME = (0.1, math.radians(5))  # m, rad: sides of the boxes of poses
KEPT = 3  # pictures of a box: more of them show the same once more
APART = (1.0, math.radians(60))  # m, rad: what counts as one between two goals
CLOSE = 0.25  # goals nearer than that are one
PLAIN = 8.0  # grey levels: a goal picture that varies less shows nothing
LEAST_GOALS = 4
RECORDED_SCENE = 'bag:drive'  # a drive that nobody named
LEAST_WAY = 2.0  # m between some two of the poses
ALIKE, SHOWN_SIDE = 0.95, 16  # correlation of small pictures from which on they are one view


@dataclasses.dataclass(frozen=True)
class ImageGraph:
    """Recorded pictures as a place (`simulator.Place`) with K nodes, S pixels a side."""

    name: str  # of its scene, 'bag:my_drive'
    pictures: np.ndarray  # [K,3,S,S] uint8
    poses: np.ndarray  # [K,3] float64 x, y [m], yaw [rad]
    depth: np.ndarray | None  # [K,S,S] float16 m along the optical axis; 0: unknown
    episode: np.ndarray  # [K] int64: of the bag
    map: PoseMap
    goals: tuple[Goal, ...]
    goal_nodes: tuple[int, ...]  # where their pictures are
    world_version: str  # of the simulator that drew the pictures, or `recorded`
    words: tuple[str, ...]  # what became of the pictures, for people

    @property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""
        return self.map.floor

    def distance_to(self, goal: Goal) -> FloorDistance:
        """Shortest driving distance from anywhere to a goal."""
        return FloorDistance(self.floor, *goal.pose[:2])

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [K,2] and headings [K] of the pictures."""
        return self.poses[:, :2], self.poses[:, 2]

    def with_goals(self, chosen: Sequence[int]) -> ImageGraph:
        """The same place with some of its goals."""
        return dataclasses.replace(self, goals=tuple(self.goals[k] for k in chosen),
                                   goal_nodes=tuple(self.goal_nodes[k] for k in chosen))

    def in_sight(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """Whether the straight way from poses to goals [N,>=2] is all floor, [N] bool."""
        return _in_sight(np.ascontiguousarray(poses[:, :2], float),
                         np.ascontiguousarray(goal_poses[:, :2], float), self.floor.free,
                         *self.floor.origin)

    def co_visibility(self, poses: np.ndarray, goal_poses: np.ndarray, fov: float) -> np.ndarray:
        """What poses [N,>=3] alone say of what two pictures share; see `co_visible_by_poses`.

        A straight way over the floor stands for having driven it: nothing is in between.
        """
        gap = np.hypot(*(goal_poses[:, :2] - poses[:, :2]).T)
        driven = np.where(self.in_sight(poses, goal_poses), gap, np.inf)
        return co_visible_by_poses(relative_pose(poses, goal_poses), driven, fov)

    def plan(self) -> dict:
        """See `House.plan`; what is no floor counts as outside."""
        free, (x0, y0) = self.floor.free, self.floor.origin
        rows, columns = free.shape
        outside = []
        for i in range(rows):
            edges = np.flatnonzero(np.diff(free[i], prepend=True, append=True))
            outside += [[x0 + a * CELL, y0 + i * CELL, x0 + b * CELL, y0 + (i + 1) * CELL]
                        for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return {'scene': self.name, 'area': float(free.sum() * CELL**2),
                'bounds': [x0, y0, x0 + columns * CELL, y0 + rows * CELL],
                'rooms_list': [], 'walls': [], 'obstacles': [], 'outside': outside,
                'goals': [{'room': goal.room, 'pose': list(goal.pose)} for goal in self.goals]}

    @functools.cached_property
    def shown(self) -> np.ndarray:
        """[K,D] float32 small pictures without mean and of length 1, to find a picture by."""
        return np.stack([_small(picture) for picture in self.pictures])

    def find(self, picture: np.ndarray) -> int | None:
        """The node that shows the same as a picture [3,S,S], if there is one."""
        alike = self.shown @ _small(picture)
        best = int(np.argmax(alike))
        return best if alike[best] >= ALIKE else None


def build_graph(pictures: np.ndarray, poses: np.ndarray, episode: np.ndarray, robot: RobotSpec, *,
                depth: np.ndarray | None = None, farthest: float = 10.0, goals: int = 96,
                goal_pictures: np.ndarray | None = None, margin: float = MARGIN,
                name: str = RECORDED_SCENE, world_version: str) -> ImageGraph:
    """A graph of the pictures of a drive.

    Of many pictures from one pose `KEPT` stay. What a robot cannot drive to and back from, by its
    actions and through poses that pictures show, is left out; the largest part is the place.

    Args:
        pictures: [N,3,S,S] uint8, in the order of the drive; may be memory-mapped.
        poses: [N,3] x, y [m], yaw [rad] in one frame.
        episode: [N] int: between two of them nobody knows the way.
        robot: its actions.
        depth: [N,S,S] uint8, 255 at `farthest` [m] and beyond, 0 where unknown; None: no depth.
        goals: at most so many, spread over places and headings.
        goal_pictures: [G,3,S,S] shown to the robot; what the drive has seen too becomes a goal.
        margin: m beside the driven path that count as free.
        name: of its scene.
        world_version: of the simulator that drew the pictures, or `recorded`.

    Raises:
        UserError: too few pictures, or all of one place.
    """
    if not 0 < margin <= 2:
        raise UserError('the margin beside the driven path lies in (0, 2] m', margin,
                        'choose one within')
    poses = np.array(poses, float)
    poses[:, 2] = wrap_angle(poses[:, 2])
    ways = _ways(poses, episode)
    moves = np.array(robot.moves)
    rows = _thinned(poses)
    first = PoseMap(poses[rows], ways, margin, moves)
    state = first.states(poses[rows])
    kept = rows[(state >= 0) & first.component[state]]
    _check_size(poses, kept)
    whole = PoseMap(poses[kept], ways, margin, moves)
    kept = kept[whole.states(poses[kept]) >= 0]
    words = [f'{len(poses):,} pictures; {len(kept):,} are nodes, {len(poses) - len(rows):,} show '
             'a pose once more']
    if len(kept) < len(rows):
        words.append(f'{len(rows) - len(kept):,} are left out: from the largest connected part '
                     'of the drive the robot gets there, or back, by no actions that pictures '
                     'cover')
    own = np.ascontiguousarray(pictures[kept])
    graph = ImageGraph(
        name=name, pictures=own, poses=poses[kept], episode=np.asarray(episode)[kept],
        depth=None if depth is None else _metres(depth[kept], farthest), map=whole, goals=(),
        goal_nodes=(), world_version=world_version, words=())
    chosen = _spread(graph.poses, _plain(own), goals)
    if goal_pictures is not None and len(goal_pictures):
        found = [node for node in map(graph.find, goal_pictures) if node is not None]
        words.append(f'{len(found)} of {len(goal_pictures)} goal pictures are found among them')
        chosen = list(dict.fromkeys([*found, *chosen]))
    if len(chosen) < LEAST_GOALS:
        raise UserError('a place has goals: pictures with something to see, from several places '
                        'and headings', f'{len(chosen)} of {len(kept)} pictures',
                        'drive through the place and look around in it')
    words.append(f'{graph.floor.free.sum() * CELL**2:.1f} m2 of floor, {len(chosen)} goals')
    return dataclasses.replace(
        graph, words=tuple(words), goal_nodes=tuple(chosen),
        goals=tuple(Goal((*graph.poses[k].tolist(), 0.0), f'picture {k}') for k in chosen))


def _metres(stored: np.ndarray, farthest: float) -> np.ndarray:
    metres = ((np.arange(256) + 0.5) * (farthest / 255)).astype(np.float16)
    metres[0], metres[255] = 0.0, np.inf  # unknown; somewhere beyond
    return metres[stored]


def _check_size(poses: np.ndarray, kept: np.ndarray) -> None:
    remedy = 'drive on through the place, forth and back, and turn on the spot here and there'
    wide = np.ptp(poses[kept, :2], axis=0).max() if len(kept) else 0.0
    if wide < LEAST_WAY:
        raise UserError(
            f'a drive to learn from leads through a place: at least {LEAST_WAY:g} m from one end '
            'to the other, connected by moves of the robot that pictures cover',
            f'{wide:.1f} m, {len(kept)} pictures, of a drive that is '
            f'{np.ptp(poses[:, :2], axis=0).max():.1f} m wide', remedy)


def _ways(poses: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Straight pieces [W,2,2] between pictures in a row."""
    pieces = np.stack([poses[:-1, :2], poses[1:, :2]], axis=1)
    near = np.hypot(*(pieces[:, 1] - pieces[:, 0]).T) <= JUMP
    return pieces[near & (np.diff(episode) == 0)]


def _thinned(poses: np.ndarray) -> np.ndarray:
    """Rows of poses, at most `KEPT` a box, those farthest apart in time."""
    box = np.floor(np.column_stack([poses[:, :2] / SAME[0], poses[:, 2] / SAME[1]])).astype(int)
    _, number = np.unique(box, axis=0, return_inverse=True)
    number = number.ravel()
    order = np.argsort(number, kind='stable')
    first = np.flatnonzero(np.diff(number[order], prepend=-1))
    count = np.diff(first, append=len(order))
    chosen = [order[a + np.unique(np.linspace(0, n - 1, min(KEPT, n)).astype(int))]
              for a, n in zip(first, count, strict=True)]
    return np.sort(np.concatenate(chosen))


def _plain(pictures: np.ndarray) -> np.ndarray:
    """Pictures that show nothing to tell a place by, [K] bool."""
    return np.array([picture.mean(axis=0).std() < PLAIN for picture in pictures])


def _spread(poses: np.ndarray, plain: np.ndarray, most: int) -> list[int]:
    """Rows far from one another in place and heading, by farthest point sampling."""
    gap = np.where(plain, -1.0, np.inf)
    chosen: list[int] = []
    while len(chosen) < most:
        # The first one is where the drive is widest.
        far = gap if chosen else np.where(plain, -1.0, np.hypot(
            *(poses[:, :2] - poses[:, :2].mean(axis=0)).T))
        k = int(np.argmax(far))
        if gap[k] < CLOSE:
            break
        chosen.append(k)
        turn = np.abs(wrap_angle(poses[:, 2] - poses[k, 2]))
        own = np.hypot(np.hypot(*(poses[:, :2] - poses[k, :2]).T) / APART[0], turn / APART[1])
        gap = np.where(plain, -1.0, np.minimum(gap, own))
    return chosen


def _small(picture: np.ndarray) -> np.ndarray:
    small = preprocess(picture.transpose(1, 2, 0), SHOWN_SIDE).astype(np.float32).ravel()
    small -= small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


@numba.njit(cache=True)
def _in_sight(poses, goals, free, x, y):
    found = np.empty(len(poses), np.bool_)
    for n in range(len(poses)):
        found[n] = in_sight(poses[n, 0], poses[n, 1], goals[n, 0], goals[n, 1], x, y, free)
    return found
