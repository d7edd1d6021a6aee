"""Where the goal may be on the map: looks vote for poses, near ones refine, misses refute."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vn_nav.arrival import wrap_angle

VOTES_FROM = 1.5  # odds of a look that votes
MERGE_M, MERGE_RAD = 1.2, math.radians(50)  # votes so near each other are for one place
ODDS_MOST = 20.0  # a look's
NEAR = 0.7  # m: from here on a look is worth no more for being nearer
MISS_M, MISS_RAD = 1.3, math.radians(35)  # seen from so near, the goal would be recognised
MISS_BELOW = 0.35  # co-visibility that refutes there
WEIGHT_MOST = 200.0
PROGRESS_M, PATIENCE = 0.2, 12  # decisions in which a way has to become shorter by so much
AGAIN = 3.0  # times as much evidence is asked after each attempt in vain
LIKELY = 0.1  # probability of having arrived under which a look says that it is not here
FORGET = 0.1  # weight under which a hypothesis is dropped


@dataclasses.dataclass
class Hypothesis:
    """A pose that the goal may have.

    Attributes:
        pose: [3] x, y [m], yaw [rad] on the map, by all that is known.
        voted: [3], by the votes alone.
        weight: evidence: sum of odds over distance.
        precision: of the position [1/m^2], of the votes together.
        refuted: how often the robot stood at it, or was on its way there, in vain.
        doubted: looks in a row, standing there, that did not say so.
        likeliest: the highest probability of having arrived, of these looks.
        nearest: the least cost to go on the way there [m]; waited: decisions since then.
        told: somebody who knows the place says where it is.
    """

    pose: np.ndarray
    weight: float
    precision: float
    refuted: int = 0
    nearest: float = math.inf
    waited: int = 0
    doubted: int = 0
    likeliest: float = 0.0
    told: bool = False
    voted: np.ndarray = dataclasses.field(init=False)

    def __post_init__(self):
        self.voted = np.array(self.pose, float)

    def is_stuck(self, cost: float) -> bool:
        """Whether the robot, on its way here at a cost, has come no nearer for too long."""
        if cost < self.nearest - PROGRESS_M:
            self.nearest, self.waited = cost, 0
        else:
            self.waited += 1
        if self.waited < PATIENCE:
            return False
        self.nearest, self.waited = math.inf, 0
        return True


def on_map(pose: np.ndarray, position: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """The goal's pose [3], seen from a robot's pose [3] at a position [2] with a heading [2]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([pose[0] + c * position[0] - s * position[1],
                     pose[1] + s * position[0] + c * position[1],
                     wrap_angle(pose[2] + math.atan2(heading[1], heading[0]))])


class Hypotheses:
    """All poses that the goal may have, for one robot.

    Args:
        gathers, refutes: see `vn_nav.policy.search.searcher.Rules`.
    """

    def __init__(self, gathers: bool = True, refutes: bool = True):
        self._gathers, self._refutes = gathers, refutes
        self.all: list[Hypothesis] = []

    def look(self, pose: np.ndarray, position: np.ndarray, sigma: float, heading: np.ndarray,
             co_visible: float) -> None:
        """Take in what one picture says.

        Args:
            pose: [3] of the robot on the map.
            position, heading: [2] of the goal in the robot's frame; sigma: m of the position.
            co_visible: probability that the picture shows some of what the goal shows.
        """
        for own in self.all if self._refutes else ():
            gap, turn = apart(pose, own.pose)
            if gap < MISS_M and turn < MISS_RAD and co_visible < MISS_BELOW:
                own.weight *= 0.5
        odds = min(co_visible / max(1 - co_visible, 1e-6), ODDS_MOST)
        if odds > VOTES_FROM:
            far = float(np.hypot(*position))
            self._vote(on_map(pose, position, heading), odds / max(far, NEAR),
                       co_visible / max(sigma, 0.15) ** 2)
        self.all = [own for own in self.all if own.weight > FORGET]

    def suggest(self, pose: np.ndarray, weight: float, precision: float) -> Hypothesis:
        """Take in a pose [3] that no look, but somebody who knows the place, says.

        Returns:
            The hypothesis: a new one, or one that looks have made there.
        """
        near = self._near(pose)
        if near is None:
            self.all.append(Hypothesis(np.array(pose, float), weight, precision, told=True))
            return self.all[-1]
        near.weight, near.told = min(near.weight + weight, WEIGHT_MOST), True
        return near

    def refute(self, own: Hypothesis) -> None:
        """The robot stood there, and it was not the goal; or it did not get there."""
        if not self._refutes:
            return
        own.refuted += 1
        own.weight *= 0.25 if own.likeliest > LIKELY else 0.02
        own.likeliest = 0.0

    def worth_trying(self, least: float) -> list[Hypothesis]:
        """Those with enough evidence, the best first; after each attempt in vain more is asked.

        Args:
            least: evidence that is enough for a first attempt.
        """
        return sorted((own for own in self.all if own.weight >= least * AGAIN**own.refuted),
                      key=lambda own: -own.weight / AGAIN**own.refuted)

    def best(self, *, untried: bool = False) -> Hypothesis | None:
        """The one with most evidence; with `untried` of those that were never refuted."""
        return max((own for own in self.all if not (untried and own.refuted)),
                   key=lambda own: own.weight, default=None)

    def _near(self, pose: np.ndarray) -> Hypothesis | None:
        """The one with most evidence of those that a vote for a pose is for."""
        near = [own for own in self.all
                if apart(own.voted, pose)[0] < MERGE_M and apart(own.voted, pose)[1] < MERGE_RAD]
        return max(near, key=lambda own: own.weight, default=None)

    def _vote(self, pose: np.ndarray, weight: float, precision: float) -> None:
        if not self._gathers:
            self.all.clear()
        own = self._near(pose)
        if own is None:
            self.all.append(Hypothesis(pose, weight, precision))
            return
        # The newest look counts at least a fifth: odometry drifts, and near looks are better.
        gain = max(precision / (own.precision + precision), 0.2)
        own.voted[:2] += gain * (pose[:2] - own.voted[:2])
        own.voted[2] = wrap_angle(own.voted[2] + gain * wrap_angle(pose[2] - own.voted[2]))
        own.pose = own.voted.copy()
        own.precision = min(own.precision + precision, 400.0)
        own.weight = min(own.weight + weight / (1 + own.refuted), WEIGHT_MOST)


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Distance [m] and difference of the headings [rad] of two poses [3]."""
    return (float(np.hypot(*(one[:2] - other[:2]))),
            abs(wrap_angle(float(one[2] - other[2]))))
