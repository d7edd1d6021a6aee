"""Ranges that robots measure, for the maps of their policies: `EnvConfig.ranges`."""

from __future__ import annotations

import numpy as np

from vn_nav.measured_ranges import DepthCamera, Scanner
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, normal
from vn_sim_bridge.datasets.view_ranges import ranges_of_depth
from vn_sim_bridge.floor.places import walled
from vn_sim_bridge.floor.rays import ray_cast
from vn_sim_bridge.navigation.base_motion import Counters
from vn_sim_bridge.robot import lidar
from vn_sim_bridge.simulator import Frames, Simulator

SCAN_NOISE = 0.01  # m, sigma of a ray
DEPTH_NOISE = 0.01  # of the range, sigma of a column


class EpisodeRanges:
    """What the range sensors of N robots say at every picture.

    `scan` is a planar laser scanner above the robot's centre, all around: rays against what stops
    the robot, with Gaussian noise. `depth` is the depth picture of the robot's camera, read by the
    same rule as on a robot (`vn_nav.measured_ranges`).

    Args:
        kind: 'scan' or 'depth'.
        simulator: whose robots they are.
        robot: with the camera.
        size: side of the pictures [pixels].

    Attributes:
        scanner: what measures.
    """

    def __init__(self, kind: str, simulator: Simulator, robot: RobotSpec, size: int):
        self._simulator = simulator
        self._rects: np.ndarray | None = None
        if kind == 'scan':
            own = [walled(place).obstacle_rects for place in simulator.places]
            self._rects = np.concatenate(own)
            self._first_rect = np.cumsum([0, *map(len, own)])
            self.scanner = Scanner(lidar.scan_angles(), lidar.NEAREST, lidar.FARTHEST)
        else:
            self.scanner = DepthCamera.of_square(size, robot.camera_fov, robot.camera_height,
                                                 robot.camera_pitch).scanner(size, size)

    def measure(self, frames: Frames, counters: Counters, step: np.ndarray) -> np.ndarray:
        """Ranges [N,K] float32 m along the scanner's bearings, by REP 117.

        Args:
            frames: the newest pictures.
            counters: of the robots' episodes.
            step: [N] decisions of the episodes so far.
        """
        bearings = self.scanner.bearings
        seeds, numbers, episodes = (part[:, None] for part in counters)
        noise = normal(seeds, Stream.RANGES, numbers, episodes,
                       len(bearings) * step[:, None] + np.arange(len(bearings)))
        if self._rects is None:
            poses = self._simulator.seen_from
            found = ranges_of_depth(frames.depth, *self._simulator.cameras(), poses[:, 2],
                                    bearings)
            found *= 1 + DEPTH_NOISE * noise
            found[found > self.scanner.farthest] = np.nan
            return found
        found = ray_cast(self._simulator.poses, self._simulator.place_index, bearings,
                         self._rects, self._first_rect)
        return lidar.limited(found + (SCAN_NOISE * noise).astype(np.float32))
