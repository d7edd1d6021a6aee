"""Searches a drive for loop closures, and keeps those that hold in its pose graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.mapping.keyframes import KEYFRAME_M_RAD, DriveGraph
from vn_nav.bags.mapping.pose_graph import (
    MAX_CHI2,
    Edges,
    Solution,
    between,
    chi_squared,
    compose,
    odometry_covariance,
    relative,
    solve,
)
from vn_nav.bags.mapping.same_place import COMMON_VIEW_M_RAD, MIN_FEATURES, together, unnoticed

# Driven or turned between the two pictures of a closure.
MIN_SEPARATION_M_RAD = (1.0, math.pi)
# Farther apart, two pictures have too little in common.
MAX_BASELINE_M_RAD = (1.2, math.radians(35))
# Standard deviations of candidates in the first round; see `loop_closure.ROUND_FACTORS`.
CANDIDATE_SIGMA_M_RAD = (0.4, math.radians(8))
MIN_PRIOR_SIGMA_M_RAD = (0.1, math.radians(2))  # m, rad: of what is known before, at least
CANDIDATES_PER_KEYFRAME = 5  # candidates of a keyframe in a round
MIN_INLIERS = 15  # matches that agree with the motion,
MIN_INLIER_SHARE = 0.45  # and their share of all matches
# A closure with a less certain heading is dropped.
MAX_HEADING_SIGMA_RAD = math.radians(6)
# Standard deviations of the odometry between keyframes and their nodes.
KEYFRAME_SIGMA_M_M_RAD = (0.01, 0.01, 0.006)
# Times the covariance of a closure, for what its model leaves out.
CLOSURE_COVARIANCE_FACTOR = 4.0
GRAPH_COVARIANCE_FACTOR = 2.5  # the same in the graph: closures of one place share their errors
# A turn on the spot that ends where it began shows how good odometry's heading is.
MAX_TURN_SHIFT_M, MAX_TURN_WAY_M = 0.15, 1.0  # between its two pictures; driven meanwhile
MIN_TURNS = 10  # turns on the spot to judge by
HEADING_SIGMA_FACTORS = 0.4, 2.5  # least and largest, times the expected standard deviation
MAX_SUPPORT_KEYFRAMES = 6  # keyframes between closures that support each other
# Standard deviations of the odometry between them.
SUPPORT_SIGMA_M_M_RAD = (0.05, 0.05, 0.02)
MIN_CLOSURES = 5  # closures, or odometry stays as it is, and two stretches are no one place

CLOSURE_DTYPE = np.dtype([
    ('first', np.int64), ('second', np.int64), ('matches', np.int64), ('motion', np.float64, 3),
    ('chi', np.float64)])


class _Closure(NamedTuple):
    first: int  # keyframe
    second: int  # a later one
    matches: int
    motion: np.ndarray  # [3]
    covariance: np.ndarray  # [3,3]


class LoopClosures:
    """Closures of a drive: candidates are compared, and what contradicts the graph is dropped."""

    def __init__(self, drive: DriveGraph):
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
        out = np.zeros(len(kept), CLOSURE_DTYPE)
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
        return stretch, together(int(stretch.max()) + 1, stretch[ends].T, MIN_CLOSURES)

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
            near = chi_squared(*relative(solution, covariance, self._edges(fresh))) < MAX_CHI2
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
            wrong = solution.chi > MAX_CHI2
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
        on_spot = ((np.hypot(motion[:, 0], motion[:, 1]) < MAX_TURN_SHIFT_M)
                   & (way < MAX_TURN_WAY_M))
        if on_spot.sum() < MIN_TURNS:
            return drive.edges
        measured = between(drive.odometry[first], drive.odometry[second])
        covariance = odometry_covariance(measured, way, turn)
        known = solution.shares[1] * (drive.net[second] - drive.net[first])
        off = np.abs(wrap_angle(motion[:, 2] - measured[:, 2] + known))[on_spot]
        factor = np.median(off / np.sqrt(covariance[on_spot, 2, 2])) / 0.6745  # if it is normal
        factor = np.clip(factor, *HEADING_SIGMA_FACTORS)
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
        if (seen is None or seen.matches < max(MIN_INLIERS, MIN_INLIER_SHARE * seen.tried)
                or seen.covariance[2, 2] > MAX_HEADING_SIGMA_RAD**2):
            return None
        # By the longer of the two: a motion must not weigh more for being seen too short.
        length = math.hypot(*seen.motion[:2])
        along = np.append(seen.motion[:2], 0.0) / max(length, 1e-9) * max(
            length, math.hypot(*expected[:2]))
        covariance = (seen.covariance + one.scale**2 * np.outer(along, along)
                      + np.diag(KEYFRAME_SIGMA_M_M_RAD)**2)
        return _Closure(first, second, seen.matches, seen.motion,
                        CLOSURE_COVARIANCE_FACTOR * covariance)

    def _supported(self, edges: Edges, among: np.ndarray) -> np.ndarray:
        """Which closures another one of `among` [K] supports, [K] bool."""
        first, second = self._ends()
        odometry = self._drive.odometry[self._drive.key]
        order = np.argsort(first, kind='stable')
        out = np.zeros(len(order), bool)
        for step in range(1, len(order)):
            k, m = order[:-step], order[step:]
            close = first[m] - first[k] <= MAX_SUPPORT_KEYFRAMES
            if not close.any():
                break
            close &= (np.abs(second[m] - second[k]) <= MAX_SUPPORT_KEYFRAMES) & among[k] & among[m]
            k, m = k[close], m[close]
            to = between(odometry[first[k]], odometry[first[m]])
            back = between(odometry[second[m]], odometry[second[k]])
            error = compose(compose(to, edges.motion[m]), back) - edges.motion[k]
            error[:, 2] = wrap_angle(error[:, 2])
            c, s, zero = np.cos(to[:, 2]), np.sin(to[:, 2]), np.zeros(len(to))
            turned = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], 1).reshape(-1, 3, 3)
            spread = (edges.covariance[k] + np.diag(SUPPORT_SIGMA_M_M_RAD)**2
                      + turned @ edges.covariance[m] @ turned.transpose(0, 2, 1))
            agree = chi_squared(error, spread) < MAX_CHI2
            out[k[agree]] = out[m[agree]] = True
        return out
