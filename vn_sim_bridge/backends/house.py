"""The embedded houses as a backend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.backends.base import Capabilities, Frames, Motion
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.world import WORLD_VERSION, World


class HouseBackend:
    """N robots in embedded houses (see `Backend`).

    Args:
        houses: the houses.
        house_index: [N] the house of each robot.
        robot: footprint and camera.
        size: side of the square pictures [pixels].
        threads: threads that draw.
    """

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True, tilt=True)
    world_version = WORLD_VERSION

    def __init__(self, houses: Sequence[House], house_index: Sequence[int], *, robot: RobotSpec,
                 size: int = 84, threads: int = 1):
        self.houses = list(houses)
        for house in self.houses:
            if robot.footprint_radius > house.footprint_radius:
                raise UserError('the robot fits into the floor map of the house '
                                f'(footprint radius <= {house.footprint_radius} m)',
                                robot.footprint_radius, 'use a smaller robot')
        self.robot = robot
        self.world = World(self.houses, np.asarray(house_index), robot.footprint_radius)
        self.num_envs = len(self.world.house_index)
        self._renderer = Rasterizer([house.scene for house in self.houses], size, threads=threads)
        self._all = np.arange(self.num_envs)
        self._frames = None

    @property
    def poses(self) -> np.ndarray:
        """[N,4] x, y, yaw, pitch; a view that changes with the next move."""
        return self.world.poses

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4]."""
        self.world.poses[env_ids] = poses

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""
        return Motion(*self.world.move(delta, self._all if env_ids is None else env_ids))

    def observe(self, env_ids: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras. All robots: one buffer, valid until the next call."""
        if env_ids is not None:
            return self.view(self.world.house_index[env_ids], self.world.poses[env_ids])
        self._frames = self.view(self.world.house_index, self.world.poses, self._frames)
        return self._frames

    def view(self, house_index: np.ndarray, poses: np.ndarray,
             out: Frames | None = None) -> Frames:
        """Pictures from any poses [K,4] in the given houses [K]."""
        cameras = np.column_stack([poses[:, :2], np.full(len(poses), self.robot.camera_height),
                                   poses[:, 2], poses[:, 3] + self.robot.camera_pitch])
        return Frames(*self._renderer.render(house_index, cameras, self.robot.camera_fov, out))
