"""Measured ranges: what a laser scanner or a depth camera says of how far a place is free.

Pure functions of numbers. A leaf: the simulator measures by it, a policy's map takes it, the node
reads messages with it. Angles in radians, positive to the left; lengths in metres.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError

LOWEST, HIGHEST = 0.15, 1.2  # m above the floor: what a robot drives into, by a depth picture
DEPTH_FARTHEST = 8.0  # m to which depth is believed
DEPTH_COLUMNS = 96  # bearings that a wider depth picture is read along
MOST_RAYS = 20_000  # of a scan
FULL_TURN = 1e-3  # rad that a full turn may be off


class RangeSource(NamedTuple):
    """Which topic of a robot measured ranges come from."""

    scan: str  # name of a topic of LaserScan; '': none
    depth: str  # name of a topic of depth pictures, with `camera_info` beside it; '': none
    mount: tuple[float, float, float]  # x ahead, y to the left [m], yaw [rad] of the sensor

    def __bool__(self) -> bool:
        return bool(self.scan or self.depth)

    def check(self) -> None:
        """Raise `UserError` where both topics are named."""
        if self.scan and self.depth:
            raise UserError('the map takes ranges from one topic',
                            f'scan_topic {self.scan}, depth_topic {self.depth}',
                            'leave one of them empty')

    def check_policy(self, searches: bool) -> None:
        """Raise `UserError` where a topic is named for a policy that has no map.

        Args:
            searches: it has one.
        """
        if self and not searches:
            named = f'scan_topic {self.scan}' if self.scan else f'depth_topic {self.depth}'
            raise UserError('measured ranges are for policies that search with a map',
                            f'{named}; this one has none', 'leave it empty')


@dataclasses.dataclass(frozen=True)
class Scanner:
    """A range sensor on a robot.

    Attributes:
        bearings: [K] of its rays, growing, a full turn in all at most.
        nearest: nearer than this it measures nothing: a range of minus infinity is less.
        farthest: farther than this it measures nothing: a range of infinity is more.
        clear_from: from here on a ray that passes says that the floor is free. A camera looks
            over what is low and near.
        mount: x ahead, y to the left, yaw of the sensor on the robot.
    """

    bearings: np.ndarray
    nearest: float
    farthest: float
    clear_from: float = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Scan:
    """What a scanner has measured.

    Attributes:
        scanner: that measured.
        ranges: [K] to the first obstacle along each ray, by REP 117: infinity where there is none
            within `farthest`, minus infinity where one is nearer than `nearest`, NaN: unknown.
    """

    scanner: Scanner
    ranges: np.ndarray

    def seen_from(self, pose: np.ndarray) -> Scan:
        """The same scan for a robot that has moved since.

        Args:
            pose: [3] of the robot when it was taken, as the robot sees it now.
        """
        x, y, yaw = self.scanner.mount
        c, s = math.cos(pose[2]), math.sin(pose[2])
        mount = (float(pose[0] + c * x - s * y), float(pose[1] + s * x + c * y),
                 float(pose[2] + yaw))
        return Scan(dataclasses.replace(self.scanner, mount=mount), self.ranges)


def laser_scan(ranges: np.ndarray, angle_min: float, angle_increment: float, nearest: float,
               farthest: float, mount: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scan:
    """A scan as a driver publishes it.

    A number outside [nearest, farthest] means nothing, as its message wants it.

    Args:
        ranges: [K].
        angle_min: bearing of the first ray; angle_increment: from each to the next, negative
            where it turns to the right.
        nearest, farthest: see `Scanner`.
        mount: see `Scanner`.

    Raises:
        UserError: numbers that no scanner has.
    """
    ranges = np.array(ranges, np.float32)
    numbers = angle_min, angle_increment, nearest, farthest, *mount
    turn = abs(angle_increment) * (len(ranges) - 1) if ranges.ndim == 1 else math.nan
    rules = (
        (ranges.ndim == 1 and 2 <= ranges.size <= MOST_RAYS, f'a scan has 2 to {MOST_RAYS} rays',
         ranges.shape),
        (all(map(math.isfinite, numbers)), 'angles, limits and the pose of a scanner are finite',
         numbers),
        (0 <= nearest < farthest, 'a scanner measures from its least range to its largest',
         (nearest, farthest)),
        (angle_increment != 0 and turn <= 2 * math.pi + FULL_TURN,
         'the rays of a scan make a full turn at most', (angle_increment, len(ranges))),
    )
    for kept, rule, received in rules:
        if not kept:
            raise UserError(rule, received, 'check the driver of the scanner')
    ranges[np.isfinite(ranges) & ((ranges < nearest) | (ranges > farthest))] = np.nan
    bearings = angle_min + angle_increment * np.arange(len(ranges))
    if angle_increment < 0:
        bearings, ranges = bearings[::-1].copy(), ranges[::-1].copy()
    return Scan(Scanner(bearings, float(nearest), float(farthest), mount=mount), ranges)


@dataclasses.dataclass(frozen=True)
class DepthCamera:
    """A depth camera on a robot.

    Attributes:
        focal: [2] across and down [pixels].
        centre: [2] column and row [pixels] of the optical axis; the first pixel's centre is 0.5.
        height: m above the floor; pitch: down.
        mount: x, y, yaw, as of `Scanner`.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    height: float
    pitch: float = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @staticmethod
    def of_square(size: int, fov: float, height: float, pitch: float = 0.0) -> DepthCamera:
        """With square pictures of a side [pixels] and a field of view."""
        focal = size / 2 / math.tan(fov / 2)
        return DepthCamera((focal, focal), (size / 2, size / 2), height, pitch)

    def scanner(self, height: int, width: int) -> Scanner:
        """What it is as a scanner, of pictures with so many rows and columns.

        Raises:
            UserError: a camera that cannot see what stands on the floor ahead.
        """
        columns = min(width, DEPTH_COLUMNS)
        across = (self.centre[0] - width * (np.arange(columns) + 0.5) / columns) / self.focal[0]
        down = self.pitch + math.atan((height - self.centre[1]) / self.focal[1])
        # Nearer than this something just high enough is below the picture.
        clear_from = (self.height - LOWEST) / math.tan(down) if down > 0 else math.inf
        if self.height <= LOWEST:
            clear_from = 0.0
        if not clear_from < DEPTH_FARTHEST or abs(self.pitch) >= math.pi / 3:
            raise UserError('a depth camera sees the floor ahead', f'{self.height:g} m high, '
                            f'pitch {math.degrees(self.pitch):.3g} deg',
                            'check camera_height and camera_pitch of the robot')
        return Scanner(np.arctan(across[::-1]), 0.0, DEPTH_FARTHEST, clear_from, self.mount)

    def scan(self, depth: np.ndarray) -> Scan:
        """What a depth picture says.

        Where nothing stands between `LOWEST` and `HIGHEST` above the floor the range is unknown.

        Args:
            depth: [H,W] m along the optical axis; 0 or NaN: unknown.
        """
        from vn_nav.depth_ranges import least_ranges  # Numba: other policies need none
        scanner = self.scanner(*depth.shape)
        slopes = np.tan(scanner.bearings)
        ranges = least_ranges(np.asarray(depth, np.float32), *self.focal, *self.centre,
                              self.height, self.pitch, 0.0, slopes)
        ranges[ranges > DEPTH_FARTHEST] = np.nan
        return Scan(scanner, ranges)
