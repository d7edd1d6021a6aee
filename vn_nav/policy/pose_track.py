"""Odometry for a policy: which pose belongs to a picture, and poses in a frame of the episode.

No ROS: the nodes feed it. Poses are [3] float64 x, y [m], yaw [rad].
"""

from __future__ import annotations

import bisect
import collections

import numpy as np

from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.bags.poses import interpolate

KEPT = 512  # poses: five seconds of the fastest bases


class PoseTrack:
    """The newest poses of a robot's odometry, by their stamps.

    Attributes:
        breaks: how often the poses after were not in the frame of those before.
    """

    def __init__(self):
        self._stamps: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._poses: collections.deque[np.ndarray] = collections.deque(maxlen=KEPT)
        self.breaks = 0

    def cut(self) -> None:
        """The odometry jumped or was set anew, or its clock was: forget the poses so far."""
        self._stamps.clear()
        self._poses.clear()
        self.breaks += 1

    def add(self, stamp: float, pose: np.ndarray) -> None:
        """A pose; stamps [s] do not go back."""
        self._stamps.append(stamp)
        self._poses.append(np.array(pose, float))

    def at(self, stamp: float, max_age: float) -> np.ndarray | None:
        """The pose at a stamp [s], between its neighbours, or else the newest before it.

        Args:
            stamp: of a picture.
            max_age: of the newest pose before it [s].

        Returns:
            None: nothing is known of that moment.
        """
        after = bisect.bisect_right(self._stamps, stamp)
        if after == 0 or stamp - self._stamps[after - 1] > max_age:
            return None
        one = self._poses[after - 1]
        if after == len(self._poses):
            return one.copy()
        since, until = self._stamps[after - 1], self._stamps[after]
        return interpolate(one, self._poses[after], (stamp - since) / (until - since))


class EpisodePose:
    """Poses of odometry, seen from where the robot stood when its episode began.

    A motion that a jump of odometry cuts short ends its episode (`Navigator.odometry_jumped`). So
    where the odometry breaks within an episode the robot stood, and its pose here stays the same.
    """

    def __init__(self):
        self._pose = np.zeros(3)
        self._last: np.ndarray | None = None  # of odometry
        self._breaks = 0

    def begin(self) -> None:
        """Begin an episode."""
        self._pose, self._last = np.zeros(3), None

    def follow(self, odometry: np.ndarray | None, breaks: int) -> np.ndarray:
        """Its pose [3] now.

        Args:
            odometry: its pose in the frame of the odometry; None: unknown, it stays.
            breaks: as of the `PoseTrack`.
        """
        if odometry is not None:
            if self._last is not None and breaks == self._breaks:
                self._pose = compose(self._pose, between(self._last, odometry))
            self._last, self._breaks = odometry, breaks
        return self._pose.copy()
