"""Cameras of picture pairs: other lenses, formats, heights and pitches than the standard one's."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vn_nav.observation import OUTSIDE_GREY
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, uniform
from vn_sim_bridge.simulator import Frames


@dataclasses.dataclass(frozen=True)
class Lenses:
    """What is drawn for each group of views, which share a camera."""

    share: float = 0.3  # of the groups that have another lens than the robot's
    fov_deg: tuple[float, float] = (55.0, 100.0)  # horizontal, drawn between
    wide_share: float = 0.2  # of the groups whose pictures are wider than high
    least_aspect: float = 0.5  # height of the picture, in widths
    mast_share: float = 0.2  # of the groups whose cameras are at another height
    mast: tuple[float, float] = (0.3, 1.7)  # m above the floor, drawn between
    pitched_share: float = 0.15  # of the groups whose cameras look up or down
    pitch_deg: tuple[float, float] = (-10.0, 38.0)  # down, drawn between
    swayed_share: float = 0.5  # of those, whose views are pitched apart, as of a hand-held camera
    sway_deg: float = 10.0  # off the group's pitch, at most

    def draw(self, seed: int, groups: np.ndarray, robot: RobotSpec
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fields of view [K] rad, heights of the pictures [K] in widths, of the cameras [K] m.

        Args:
            seed: of the draws; groups: [K] their numbers; robot: whose camera is the usual one.
        """
        draws = uniform(seed, Stream.PAIR_LENS, groups[:, None], 0, np.arange(6))
        low, high = map(math.radians, self.fov_deg)
        fovs = np.where(draws[:, 0] < self.share, low + (high - low) * draws[:, 1],
                        robot.camera_fov)
        aspects = np.where(draws[:, 2] < self.wide_share,
                           self.least_aspect + (1 - self.least_aspect) * draws[:, 3], 1.0)
        low, high = self.mast
        masts = np.where(draws[:, 4] < self.mast_share, low + (high - low) * draws[:, 5],
                         robot.camera_height)
        return fovs, aspects, masts

    def pitches(self, seed: int, groups: np.ndarray, views: np.ndarray) -> np.ndarray:
        """How far cameras [V] look down beyond the robot's own pitch [rad].

        Args:
            seed: of the draws; groups: [V] numbers of the views' groups.
            views: [V] numbers of the views, each another one in its group.
        """
        draws = uniform(seed, Stream.PAIR_LENS, groups[:, None], 1, np.arange(3))
        sways = uniform(seed, Stream.PAIR_LENS, groups, 2, views)
        low, high = map(math.radians, self.pitch_deg)
        pitch = low + (high - low) * draws[:, 1]
        pitch += np.where(draws[:, 2] < self.swayed_share,
                          math.radians(self.sway_deg) * (2 * sways - 1), 0)
        return np.where(draws[:, 0] < self.pitched_share, pitch, 0)


def cut(frames: Frames, aspects: np.ndarray) -> None:
    """Take away, in place, what lies above and below pictures [K] of such heights in widths."""
    size = frames.rgb.shape[-1]
    for k in np.flatnonzero(aspects < 1):
        edge = round(size * (1 - aspects[k]) / 2)
        for rows in (slice(0, edge), slice(size - edge, size)):
            frames.rgb[k, :, rows] = OUTSIDE_GREY
            frames.depth[k, rows] = 0
            frames.labels[k, rows] = 0
