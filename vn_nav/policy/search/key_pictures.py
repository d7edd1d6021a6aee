"""What pictures have in common with the key pictures of a taught place: votes for poses there."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.policy.search.eyes import Eyes, Placed, goal_places, likeness
from vn_nav.policy.search.lens import pose_in_metres
from vn_nav.policy.search.taught import TaughtPlace

ALIKE, TRACKED = 8, 4  # key pictures that a picture is compared with: most alike; about the robot
VIEW_M, VIEW_RAD = 0.6, math.radians(35)  # a key picture so near is about the robot
VOTES_FROM, ODDS_MOST = 1.5, 20.0  # odds of co-visibility that vote, and what is the most
NEAR = 0.7  # m: from here on a key picture is worth no more for being nearer
LEAST_SIGMA = 0.1  # m
TOGETHER_M, TOGETHER_RAD = 0.8, math.radians(35)  # votes so near are for one pose
MODES = 4  # poses that one picture may have
DOUBT = 5.0  # weight that votes have to outweigh


@dataclasses.dataclass
class Mode:
    """A pose that a picture may have been taken from.

    Attributes:
        pose: [3] x, y [m], yaw [rad] in the frame of the drive.
        share: of the picture's evidence, in (0, 1).
        precision: of the position [1/m^2].
    """

    pose: np.ndarray
    share: float
    precision: float


class Votes(NamedTuple):
    """Of K key pictures, for where a picture was taken."""

    poses: np.ndarray  # [K,3] in the frame of the drive
    odds: np.ndarray  # [K] of co-visibility
    weights: np.ndarray  # [K]: odds over distance
    precisions: np.ndarray  # [K] 1/m^2 of the position


class _Seen(NamedTuple):
    """Of K pairs."""

    there: np.ndarray  # [K,3] pose of the second picture as seen from the first
    sigma: np.ndarray  # [K] m of its position
    heading_sigma: np.ndarray  # [K] rad
    co_visible: np.ndarray  # [K] logit


class KeyPictures:
    """The key pictures of a place, seen by a policy's eyes.

    Args:
        eyes: what sees.
        place: what the policy was taught.

    Attributes:
        poses: [K,3] in the frame of the drive.
    """

    def __init__(self, eyes: Eyes, place: TaughtPlace):
        self._eyes, self.poses = eyes, place.poses.astype(float)
        self._zoom = float(place.zoom[0])
        self._seen = eyes.see(place.pictures).features
        self._maps = eyes.encode_goals(place.pictures)
        self._places = goal_places(self._maps, self._seen.shape[2:])

    def poses_of_goal(self, goal_maps: np.ndarray) -> list[Mode]:
        """Where a goal picture may have been taken, the best first.

        Args:
            goal_maps: [1,...] of `Eyes.encode_goals`.
        """
        seen = self._in_metres(self._eyes.compare(
            self._seen, np.repeat(goal_maps, len(self._seen), axis=0)))
        return modes_of(_votes(compose(self.poses, seen.there), seen, turned=False))

    def recognise(self, image: np.ndarray, about: np.ndarray | None) -> tuple[list[Mode], float]:
        """Where a picture [1,3,S,S] may have been taken, the best first.

        Args:
            image: uint8.
            about: [3] pose about which it is expected; None: nobody knows.

        Returns:
            The poses, and the highest co-visibility of the key pictures close to `about`; nan
            where there is none so close.
        """
        seen = self._eyes.see(image)
        rows = np.argsort(-likeness(self._places, seen.places[0]))[:ALIKE]
        close = np.zeros(0, np.int64)
        if about is not None:
            off = np.hypot(np.hypot(*(self.poses[:, :2] - about[:2]).T) / VIEW_M,
                           wrap_angle(self.poses[:, 2] - about[2]) / VIEW_RAD)
            close = np.argsort(off)[:TRACKED]
            rows = np.union1d(rows, close)
            close = close[off[close] < 1]
        found = self._in_metres(self._eyes.compare(
            np.repeat(seen.features, len(rows), axis=0), self._maps[rows]))
        poses = compose(self.poses[rows], between(found.there, np.zeros(3)))
        votes = _votes(poses, found, turned=True)
        tracked = votes.odds[np.isin(rows, close)]
        return modes_of(votes), float(
            (tracked / (1 + tracked)).max()) if len(tracked) else math.nan

    def _in_metres(self, said: Placed) -> _Seen:
        position, sigma, heading, heading_sigma = pose_in_metres(*said[:4], self._zoom)
        return _Seen(np.column_stack([position, np.arctan2(heading[:, 1], heading[:, 0])]), sigma,
                     heading_sigma, said.co_visible)


def _votes(poses: np.ndarray, seen: _Seen, turned: bool) -> Votes:
    """Votes for poses, of what was seen; `turned`: its heading has turned the position."""
    odds = np.minimum(np.exp(np.minimum(seen.co_visible, 20.0)), ODDS_MOST)
    far = np.hypot(*seen.there[:, :2].T)
    variance = seen.sigma**2 + LEAST_SIGMA**2
    if turned:
        variance = variance + (far * np.minimum(seen.heading_sigma, 1.5))**2
    return Votes(poses, odds, odds / np.maximum(far, NEAR), 1 / variance)


def modes_of(votes: Votes) -> list[Mode]:
    """Poses that votes agree on, with most evidence first."""
    rows = np.flatnonzero(votes.odds > VOTES_FROM)
    total = float(votes.weights[rows].sum()) + DOUBT
    found: list[Mode] = []
    while len(rows) and len(found) < MODES:
        poses, weights = votes.poses[rows], votes.weights[rows]
        gap = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
        turn = np.abs(wrap_angle(poses[:, None, 2] - poses[None, :, 2]))
        agree = (gap < TOGETHER_M) & (turn < TOGETHER_RAD)
        best = int(np.argmax(agree @ weights))
        own = agree[best]
        precision = votes.precisions[rows][own]
        pull = weights[own] * precision
        pull = pull / pull.sum()
        yaw = poses[best, 2] + pull @ wrap_angle(poses[own, 2] - poses[best, 2])
        # Votes of one picture err together: more of them make it no surer than the best is.
        found.append(Mode(np.array([*(pull @ poses[own, :2]), wrap_angle(float(yaw))]),
                          float(weights[own].sum()) / total, float(precision.max())))
        rows = rows[~own]
    return sorted(found, key=lambda mode: -mode.share)
