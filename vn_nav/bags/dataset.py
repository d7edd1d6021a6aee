"""A bag as arrays to learn from; `vn_nav.bags.drive_cache.load_drives` makes them."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from vn_nav.bags.roles import Topics
from vn_nav.robot import RobotSpec

MAX_DEPTH = 10.0  # m, stored as 255; 0: unknown


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What to make of a bag."""

    robot: RobotSpec
    size: int = 84  # side of the square pictures [pixels]
    topics: Topics = Topics()
    every: bool = False  # every picture, and not only those where an action begins
    threads: int = 2  # that decode


class Pictures(Protocol):
    """Rows that are read when they are asked for: an array, or `one_place.Rows` of one."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __len__(self) -> int: ...

    def __getitem__(self, chosen: Any, /) -> np.ndarray: ...


@dataclasses.dataclass
class DriveSet:
    """The steps of a bag. N steps, S pixels a side, G goal pictures, A actions of the robot.

    A step is a picture at which an action begins, or with which an episode ends. Arrays are
    memory-mapped: what is not looked at takes no memory.
    """

    image: Pictures  # [N,3,S,S] uint8
    pose: np.ndarray  # [N,3] float64 x, y [m], yaw [rad] in the frame of the odometry
    time: np.ndarray  # [N] float64 s, stamps
    action: np.ndarray  # [N] int16, that begins here; `segmenter.NO_ACTION`: none, or the end
    episode: np.ndarray  # [N] int64
    goal: np.ndarray  # [N] int64 into goals, -1: no goal was shown
    goals: np.ndarray  # [G,3,S,S] uint8
    depth: Pictures | None  # [N,S,S] uint8, 255 at `MAX_DEPTH`, 0 where unknown
    labels: np.ndarray | None  # [N,S,S] class ids, uint8, or uint16 where the bag has them so
    facts: dict  # what the bag held and what did not fit

    def __len__(self) -> int:
        return len(self.image)

    def episodes(self) -> list[slice]:
        """The steps of each episode, in order."""
        edges = np.flatnonzero(np.diff(self.episode)) + 1
        return [slice(int(a), int(b)) for a, b in
                zip([0, *edges], [*edges, len(self.episode)], strict=True) if b > a]
