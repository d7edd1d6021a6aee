"""Corrects drifting odometry by loop closures and pose-graph optimisation.

Keyframes of the drive are compared with those that, by what is known of the drift so far, may show
the same place; what their pictures say of the motion between them (`two_view`) goes into a pose
graph (`pose_graph`) with odometry. The surest come first, and each round of closures narrows what
the next may lie off. Against wrong closures, in this order: a motion on a plane must explain most
matches of the features, it must lie within what odometry allows, a second closure next to it must
say the same, and in the graph a closure loses its weight with what it contradicts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.dataset import MAX_DEPTH, DriveSet, Pictures
from vn_nav.bags.drive import ODOMETRY_JUMP_M
from vn_nav.bags.mapping.pose_graph import (
    GATE,
    Edges,
    Solution,
    between,
    chi_squared,
    compose,
    misfit,
    odometry_covariance,
    relative,
    solve,
)
from vn_nav.bags.mapping.same_place import COMMON_VIEW_M_RAD, MIN_FEATURES, together, unnoticed
from vn_nav.bags.mapping.two_view import Camera
from vn_nav.bags.stamped import EPISODE_GAP_S
from vn_nav.robot import RobotSpec

KEYFRAME_M_RAD = (0.3, math.radians(20))  # m, rad between keyframes,
NODE_M_RAD = (0.5, math.radians(60))  # and between nodes of the graph
# Standard deviations of odometry between two episodes.
EPISODE_ODOMETRY_M_RAD = (1.0, math.radians(30))
# Driven or turned between the two pictures of a closure.
MIN_SEPARATION_M_RAD = (1.0, math.pi)
# Farther apart, two pictures have too little in common.
MAX_BASELINE_M_RAD = (1.2, math.radians(35))
# Standard deviations of candidates in a round, times the factors in ROUNDS.
CANDIDATE_SIGMA_M_RAD = (0.4, math.radians(8))
ROUNDS = (1, 1, 1, 2, 4, 8)
MIN_PRIOR_SIGMA_M_RAD = (0.1, math.radians(2))  # m, rad: of what is known before, at least
CANDIDATES_PER_KEYFRAME = 5  # candidates of a keyframe in a round
MATCHES, SHARE = 15, 0.45  # that must agree, and of all matches
# A closure with a less certain heading is dropped.
MAX_HEADING_SIGMA_RAD = math.radians(6)
KEYFRAME_SIGMA = (0.01, 0.01, 0.006)  # m, m, rad: odometry between keyframes and their nodes
COVARIANCE_FACTOR = 4.0  # times the covariance of a closure, for what its model leaves out,
GRAPH_COVARIANCE_FACTOR = 2.5  # and in the graph: closures of one place share their errors
# A turn on the spot that ends where it began shows how good odometry's heading is: at most so far
# apart [m], so many of them, and by these factors at most it is another than expected.
SPOT, TURNS, FACTOR = (0.15, 1.0), 10, (0.4, 2.5)
SUPPORT_KEYFRAMES = 6  # keyframes between closures that support each other
# m, m, rad: standard deviations of the odometry between them.
SUPPORT_ODOMETRY_SIGMA = (0.05, 0.05, 0.02)
FEWEST = 5  # closures, or odometry stays as it is, and two stretches are no one place
FEATURE_TIME_SHARE = 0.4  # of the time, to find features

CLOSURE = np.dtype([('first', np.int64), ('second', np.int64), ('matches', np.int64),
                    ('motion', np.float64, 3), ('chi', np.float64)])


class OptimisedOdometry(NamedTuple):
    """A drive in one frame; N pictures, K closures."""

    poses: np.ndarray  # [N,3] float64 x, y [m], yaw [rad]; the first is that of odometry
    closures: np.ndarray  # [K] of `CLOSURE`: pictures, matches, motion between them, chi^2
    stretch: np.ndarray  # [N] int64, of each picture; those that were given, and what they hide
    place: np.ndarray  # [S] int64: which of the stretches belong together
    facts: dict  # counts; how far poses were moved [m] and turned [rad], at most; `strain` [chi^2]
    # that is left of odometry where it fits worst, and `strained`, the picture before that


def straighten(drives: DriveSet, robot: RobotSpec, pictures: Pictures | None = None, *,
               stretch: np.ndarray | None = None,
               show: Callable[[float], None] = lambda share: None,
               until: float = math.inf) -> OptimisedOdometry:
    """Correct the poses of a drive by the places that it shows twice.

    Args:
        drives: of one bag, with every picture (`Wanted(every=True)`). Depth is used if it is
            there.
        robot: its camera.
        pictures: [N,3,S,S] uint8; default: those of the drives. 128 to 160 pixels are enough.
        stretch: [N] int64, 0 and up: between two of them odometry does not hold
            (`continuity.divide`); default: it holds throughout.
        show: receives the share that is done.
        until: `time.monotonic()` after which no further round of the search begins, unless
            there are several stretches.

    Returns:
        The poses; as odometry has them where too little was recognised (`facts['corrected']`).
    """
    drive = _Drive(drives, robot, drives.image if pictures is None else pictures, stretch,
                   lambda share: show(FEATURE_TIME_SHARE * share))
    found = _Found(drive)
    solution = solve(drive.odometry[drive.node], drive.edges, found.edges())
    rounds = 0
    for loosen in ROUNDS:
        if rounds and time.monotonic() > until and not drive.stretch.any():
            break
        done = FEATURE_TIME_SHARE + (1 - FEATURE_TIME_SHARE) * rounds / len(ROUNDS)

        def told(share: float, done: float = done) -> None:
            show(done + share * (1 - FEATURE_TIME_SHARE) / len(ROUNDS))

        if found.search(solution, loosen, told):
            solution = found.settle(solution)
        rounds += 1
    facts = {'pictures': len(drive.odometry), 'keyframes': len(drive.key),
             'compared': len(found.tested), 'recognised': len(found.closures),
             'closures': int(found.kept.sum()), 'corrected': bool(found.kept.sum() >= FEWEST),
             'rounds': rounds, 'strain': 0.0}
    own, place = found.places()
    if not facts['corrected']:
        return OptimisedOdometry(drive.odometry.copy(), np.zeros(0, CLOSURE), own, place, facts)
    poses = drive.spread(solution.poses)
    off = between(drive.odometry, poses)
    strain = misfit(solution.poses, drive.edges, solution.shares)
    facts |= {'moved': float(np.hypot(off[:, 0], off[:, 1]).max()),
              'turned': float(np.abs(off[:, 2]).max()), 'strain': float(strain.max(initial=0.0)),
              'strained': int(drive.node[np.argmax(strain)]) if len(strain) else 0}
    return OptimisedOdometry(poses, found.table(solution), own, place, facts)


class _Drive:
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


class _Closure(NamedTuple):
    first: int  # keyframe
    second: int  # a later one
    matches: int
    motion: np.ndarray  # [3]
    covariance: np.ndarray  # [3,3]


class _Found:
    """Closures of a drive."""

    def __init__(self, drive: _Drive):
        self._drive = drive
        self.tested: set[tuple[int, int]] = set()
        self._alike: list[tuple[int, int, bool]] = []  # tight pairs, and whether recognised
        self.closures: list[_Closure] = []
        self.kept = np.zeros(0, bool)

    def edges(self) -> Edges:
        """All closures that were found."""
        return self._edges(self.closures)

    def table(self, solution: Solution) -> np.ndarray:
        """What is kept, as `OptimisedOdometry.closures`."""
        kept = [self.closures[k] for k in np.flatnonzero(self.kept)]
        out = np.zeros(len(kept), CLOSURE)
        for field in ('matches', 'motion'):
            out[field] = [getattr(closure, field) for closure in kept]
        for field in ('first', 'second'):
            out[field] = self._drive.key[[getattr(closure, field) for closure in kept]]
        out['chi'] = solution.chi
        return out

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """`stretch` and `place` of `OptimisedOdometry`."""
        drive, stretch = self._drive, self._drive.stretch.copy()
        first, second, recognised = np.array(self._alike, np.int64).reshape(-1, 3).T
        own = stretch[drive.key[first]] == stretch[drive.key[second]]
        cut = unnoticed(first[own], second[own], recognised[own].astype(bool))
        if cut is not None:
            at = drive.key[cut]
            stretch[at:] += stretch[at] == stretch[at - 1]
        ends = drive.key[self._ends()[:, self.kept]] if self.kept.any() else np.zeros((2, 0), int)
        return stretch, together(int(stretch.max()) + 1, stretch[ends].T, FEWEST)

    def search(self, solution: Solution, loosen: float, show: Callable[[float], None]) -> int:
        """Compare the most promising keyframes; how many were recognised where they may be."""
        poses = self._drive.spread(solution.poses)[self._drive.key]
        covariance = solution.covariance()
        fresh = []
        for pair, *doubt in self._candidates(poses, covariance, loosen):
            show(pair[1] / len(poses))
            self.tested.add(pair)
            expected = between(poses[pair[0]], poses[pair[1]])
            closure = self._compare(*pair, expected, *doubt)
            if self._tight(pair, expected, *doubt):
                self._alike.append((*pair, closure is not None))
            if closure is not None:
                fresh.append(closure)
        if fresh:
            near = chi_squared(*relative(solution, covariance, self._edges(fresh))) < GATE
            fresh = [closure for closure, good in zip(fresh, near, strict=True) if good]
        self.closures += fresh
        return len(fresh)

    def settle(self, solution: Solution) -> Solution:
        """Poses by all closures that hold."""
        edges, odometry = self.edges(), self._odometry(solution)
        self.kept = self._supported(edges, np.ones(len(self.closures), bool))
        while True:  # at each turn there are fewer
            kept = edges.take(self.kept)
            solution = solve(
                solution.poses, odometry,
                kept._replace(covariance=GRAPH_COVARIANCE_FACTOR * kept.covariance),
                self._drive.features[0].scale, solution.shares)
            wrong = solution.chi > GATE
            if not wrong.any():
                return solution
            self.kept[np.flatnonzero(self.kept)[wrong]] = False
            self.kept &= self._supported(edges, self.kept)

    def _odometry(self, solution: Solution) -> Edges:
        """That of the drive, as uncertain as turns on the spot show it to be."""
        drive = self._drive
        first, second = drive.key[self._ends()]
        way, turn = drive.way[second] - drive.way[first], drive.turn[second] - drive.turn[first]
        motion = np.array([closure.motion for closure in self.closures])
        spot = (np.hypot(motion[:, 0], motion[:, 1]) < SPOT[0]) & (way < SPOT[1])
        if spot.sum() < TURNS:
            return drive.edges
        said = between(drive.odometry[first], drive.odometry[second])
        covariance = odometry_covariance(said, way, turn)
        known = solution.shares[1] * (drive.net[second] - drive.net[first])
        off = np.abs(wrap_angle(motion[:, 2] - said[:, 2] + known))[spot]
        factor = np.median(off / np.sqrt(covariance[spot, 2, 2])) / 0.6745  # if it is normal
        factor = np.clip(factor, *FACTOR)
        return drive.edges._replace(covariance=factor**2 * drive.edges.covariance)

    def _ends(self) -> np.ndarray:
        """First and second keyframe of all closures, [2,K]."""
        return np.array([closure[:2] for closure in self.closures], np.int64).reshape(-1, 2).T

    def _edges(self, closures: list[_Closure]) -> Edges:
        drive = self._drive
        first, second = (np.array([c[k] for c in closures], np.int64) for k in (0, 1))
        return Edges(drive.near[first], drive.near[second], drive.offset[first],
                     drive.offset[second], np.array([c.motion for c in closures]).reshape(-1, 3),
                     np.array([c.covariance for c in closures]).reshape(-1, 3, 3))

    def _candidates(self, poses: np.ndarray, covariance: np.ndarray, loosen: float
                    ) -> Iterator[tuple[tuple[int, int], float, float]]:
        """Pairs of keyframes that may show one place; how well place and heading are known."""
        drive = self._drive
        way, turn = drive.way[drive.key], drive.turn[drive.key]
        place = covariance[:, 0, :, 0] + covariance[:, 1, :, 1]
        heading = covariance[:, 2, :, 2]
        for i in range(1, len(poses)):
            past = np.flatnonzero((way[i] - way[:i] > MIN_SEPARATION_M_RAD[0])
                                  | (turn[i] - turn[:i] > MIN_SEPARATION_M_RAD[1]))
            gap = between(poses[past], poses[i])
            metres, angle = np.hypot(gap[:, 0], gap[:, 1]), np.abs(gap[:, 2])
            a, b = drive.near[past], drive.near[i]
            off, twist = (np.sqrt(np.maximum(v[a, a] + v[b, b] - 2 * v[a, b], 0.0))
                          for v in (place, heading))
            good = ((off < CANDIDATE_SIGMA_M_RAD[0] * loosen)
                    & (twist < CANDIDATE_SIGMA_M_RAD[1] * loosen)
                    & (metres < MAX_BASELINE_M_RAD[0] + off)
                    & (angle < MAX_BASELINE_M_RAD[1] + twist))
            cost = (metres / 0.5)**2 + (angle / KEYFRAME_M_RAD[1])**2
            order = [k for k in np.flatnonzero(good)[np.argsort(cost[good])]
                     if (int(past[k]), i) not in self.tested]
            for k in order[:CANDIDATES_PER_KEYFRAME]:
                yield (int(past[k]), i), float(off[k]), float(twist[k])

    def _tight(self, pair: tuple[int, int], expected: np.ndarray, place: float, heading: float
               ) -> bool:
        """Whether two pictures must look alike, see `same_place.unnoticed`."""
        return (math.hypot(*expected[:2]) + place < COMMON_VIEW_M_RAD[0]
                and abs(expected[2]) + heading < COMMON_VIEW_M_RAD[1]
                and min(len(self._drive.features[k].slope) for k in pair) >= MIN_FEATURES)

    def _compare(self, first: int, second: int, expected: np.ndarray, place: float,
                 heading: float) -> _Closure | None:
        one, other = self._drive.features[first], self._drive.features[second]
        seen = self._drive.camera.relate(
            one, other, expected, math.hypot(place, MIN_PRIOR_SIGMA_M_RAD[0]),
            math.hypot(heading, MIN_PRIOR_SIGMA_M_RAD[1]))
        if (seen is None or seen.matches < max(MATCHES, SHARE * seen.tried)
                or seen.covariance[2, 2] > MAX_HEADING_SIGMA_RAD**2):
            return None
        # By the longer of the two: a motion must not weigh more for being seen too short.
        length = math.hypot(*seen.motion[:2])
        along = np.append(seen.motion[:2], 0.0) / max(length, 1e-9) * max(
            length, math.hypot(*expected[:2]))
        covariance = (seen.covariance + one.scale**2 * np.outer(along, along)
                      + np.diag(KEYFRAME_SIGMA)**2)
        return _Closure(first, second, seen.matches, seen.motion, COVARIANCE_FACTOR * covariance)

    def _supported(self, edges: Edges, among: np.ndarray) -> np.ndarray:
        """Which closures another one of `among` [K] beside them supports, [K] bool."""
        first, second = self._ends()
        odometry = self._drive.odometry[self._drive.key]
        order = np.argsort(first, kind='stable')
        out = np.zeros(len(order), bool)
        for step in range(1, len(order)):
            k, m = order[:-step], order[step:]
            close = first[m] - first[k] <= SUPPORT_KEYFRAMES
            if not close.any():
                break
            close &= (np.abs(second[m] - second[k]) <= SUPPORT_KEYFRAMES) & among[k] & among[m]
            k, m = k[close], m[close]
            to = between(odometry[first[k]], odometry[first[m]])
            back = between(odometry[second[m]], odometry[second[k]])
            error = compose(compose(to, edges.motion[m]), back) - edges.motion[k]
            error[:, 2] = wrap_angle(error[:, 2])
            c, s, zero = np.cos(to[:, 2]), np.sin(to[:, 2]), np.zeros(len(to))
            turned = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], 1).reshape(-1, 3, 3)
            spread = (edges.covariance[k] + np.diag(SUPPORT_ODOMETRY_SIGMA)**2
                      + turned @ edges.covariance[m] @ turned.transpose(0, 2, 1))
            agree = chi_squared(error, spread) < GATE
            out[k[agree]] = out[m[agree]] = True
        return out
