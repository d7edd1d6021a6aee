"""A robot that searches in a taught place: it finds out where it is, and recalls map and goal.

Localisation may fail or be wrong, and the place may have changed: what is recalled never outweighs
what is seen, and the robot searches as anywhere while it does not know where it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.policy.search.grid import CELL, Prior
from vn_nav.policy.search.hypotheses import MERGE_M, MERGE_RAD, Hypothesis, apart
from vn_nav.policy.search.key_pictures import KeyPictures, Mode
from vn_nav.policy.search.searcher import Searcher
from vn_nav.policy.search.taught import TaughtPlace

SAME_M, SAME_RAD = 0.8, math.radians(35)  # looks that say poses so near say one
FADE = 0.2  # of what earlier looks said, at a look that is sure
MISSED_BELOW, MISSED = 0.35, 0.7  # co-visibility of the views about it that speaks against a pose
LEAST_GAIN = 0.15  # of the newest look for the pose: odometry drifts
PRECISION_MOST = 200.0  # 1/m^2
FORGET = 0.05  # weight under which a pose is dropped
SURE, LEAD = 1.2, 2.0  # weight, and times that of the next pose, from which on a pose is believed
DOUBTED, DOUBT_LEAD = 0.6, 1.0  # below these it is not believed any more
GOAL_WEIGHT = 40.0  # evidence that a goal's pose has, as `Hypothesis.weight`, if it is sure
# A goal that the robot was not nearer to than this is tried again, so many times.
TRIED_M, TRIES = 1.0, 3
GOALS, GOAL_SHARE = 3, 0.1  # poses of it at most, each of so much of its picture's evidence


class Localiser:
    """Where a robot is in the frame of a drive.

    Attributes:
        poses: those that it may have, the best first, with `share` as weight of all looks.
        sure: the first of them is believed.
    """

    def __init__(self):
        self.poses: list[Mode] = []
        self.sure = False

    def move(self, done: np.ndarray) -> None:
        """Follow the robot: [3] forward, left [m], turned [rad]."""
        for own in self.poses:
            own.pose = compose(own.pose, done)

    def look(self, modes: Sequence[Mode], tracked: float) -> None:
        """Take in what a picture says.

        Args:
            modes: poses that it may have been taken from.
            tracked: co-visibility of the views about the best pose; nan: there are none.
        """
        told = sum(mode.share for mode in modes)
        if self.poses and tracked < MISSED_BELOW:
            self.poses[0].share *= MISSED
        for own in self.poses:
            own.share *= 1 - FADE * told
        for mode in modes:
            near = [own for own in self.poses if _same(own.pose, mode.pose)]
            if not near:
                self.poses.append(Mode(mode.pose, mode.share, mode.precision))
                continue
            own = max(near, key=lambda own: own.share)
            gain = max(mode.precision / (own.precision + mode.precision), LEAST_GAIN)
            own.pose = own.pose + gain * np.array([
                *(mode.pose[:2] - own.pose[:2]), wrap_angle(float(mode.pose[2] - own.pose[2]))])
            own.precision = min(own.precision + mode.precision, PRECISION_MOST)
            own.share += mode.share
        self.poses = sorted((own for own in self.poses if own.share > FORGET),
                            key=lambda own: -own.share)
        first, second = ([own.share for own in self.poses] + [0.0, 0.0])[:2]
        least, lead = (DOUBTED, DOUBT_LEAD) if self.sure else (SURE, LEAD)
        self.sure = first >= least and first >= lead * second


class Recall:
    """What one robot recalls of a taught place during a search.

    Args:
        place: what was taught; keys: its pictures, as the policy sees them.

    Attributes:
        localiser: where it is; goals: where the goal may be, in the frame of the drive.
    """

    def __init__(self, place: TaughtPlace, keys: KeyPictures):
        self.place, self.keys = place, keys
        self.begin([])

    def begin(self, goals: Sequence[Mode]) -> None:
        """Begin a search, anywhere in the place or elsewhere."""
        self.localiser = Localiser()
        self._pose: np.ndarray | None = None
        self._frame: np.ndarray | None = None  # of the drive on the robot's map, last believed
        self.new_goals(goals)

    def new_goals(self, goals: Sequence[Mode]) -> None:
        """Search for something else, from where the robot is."""
        self.goals: list[Mode] = []
        for goal in goals[:GOALS]:
            gaps = [apart(goal.pose, own.pose) for own in self.goals]
            if goal.share >= GOAL_SHARE and not any(
                    gap < MERGE_M and turn < MERGE_RAD for gap, turn in gaps):
                self.goals.append(goal)  # nearer ones would be one hypothesis
        self._tries = [TRIES] * len(self.goals)
        self._suggested: list[Hypothesis | None] = [None] * len(self.goals)

    def look(self, searcher: Searcher, image: np.ndarray) -> None:
        """Take in a picture [1,3,S,S], and tell the search what is known.

        Args:
            searcher: of the robot, where it was when the picture was taken.
            image: uint8.
        """
        localiser = self.localiser
        if self._pose is not None:
            localiser.move(between(self._pose, searcher.pose))
        self._pose = searcher.pose.copy()
        localiser.look(*self.keys.recognise(
            image, localiser.poses[0].pose if localiser.poses else None))
        if not localiser.sure:
            searcher.grid.prior = None
            self._withdraw(searcher)
            return
        own = localiser.poses[0].pose
        frame = compose(searcher.pose, between(own, np.zeros(3)))  # of the drive, on the map
        if self._frame is not None and not _same(
                own, compose(between(self._frame, np.zeros(3)), searcher.pose)):
            self._withdraw(searcher, refuted=True)
        self._frame = frame
        searcher.grid.prior = self._map(searcher, frame)
        self._suggest(searcher, frame)

    def _map(self, searcher: Searcher, frame: np.ndarray) -> Prior:
        """The map of the drive, laid on the robot's."""
        grid, place = searcher.grid, self.place
        back = between(frame, np.zeros(3))
        c, s = math.cos(back[2]), math.sin(back[2])
        # Cell (column, row) of the robot's map has its centre at origin + CELL * (cell + 0.5).
        x, y = grid.origin + 0.5 * CELL
        offset = np.array([back[0] + c * x - s * y, back[1] + s * x + c * y])
        shift = (offset - place.origin) / CELL - 0.5
        matrix = np.array([[c, -s, shift[0]], [s, c, shift[1]]])
        side = grid.seen.shape[::-1]
        return Prior(*(cv2.warpAffine(layer, matrix, side,
                                      flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
                       for layer in (place.log_odds, place.seen, place.lane)))

    def _suggest(self, searcher: Searcher, frame: np.ndarray) -> None:
        """Say where the goal may be; looks change what speaks for it, not where it is.

        Two pictures of a drive tell that better than the robot sees it on its way.
        """
        for k, goal in enumerate(self.goals):
            own = self._suggested[k]
            if own is None:
                own = self._suggested[k] = searcher.hypotheses.suggest(
                    compose(frame, goal.pose), GOAL_WEIGHT * goal.share, goal.precision)
            own.pose[:] = own.voted[:] = compose(frame, goal.pose)
            if own.refuted and self._tries[k] and apart(own.pose, searcher.pose)[0] > TRIED_M:
                # It did not get there: that says nothing of the goal.
                self._tries[k] -= 1
                own.refuted, own.weight = 0, GOAL_WEIGHT * goal.share

    def _withdraw(self, searcher: Searcher, refuted: bool = False) -> None:
        """The robot is not where it was thought to be: nor is the goal.

        Where the robot has been in vain it is `refuted`, and stays so, if it may be so after all.
        """
        for k, own in enumerate(self._suggested):
            if own is not None and (refuted or own.refuted == 0):
                searcher.hypotheses.all = [one for one in searcher.hypotheses.all
                                           if one is not own]
                self._suggested[k] = None


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    gap, turn = apart(one, other)
    return gap < SAME_M and turn < SAME_RAD
