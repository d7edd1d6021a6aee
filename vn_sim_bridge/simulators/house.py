"""The embedded houses as a backend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.contacts import WORLD_VERSION, World
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.houses.objects import object_scene
from vn_sim_bridge.navigation.tasks import Placed
from vn_sim_bridge.render.pack import Lights, Objects, no_objects
from vn_sim_bridge.render.randomisation import Appearance, Randomisation, draw_appearance
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.sensor import expose
from vn_sim_bridge.simulator import Capabilities, Frames, Motion


class HouseBackend:
    """N robots in embedded houses (see `Backend`).

    Args:
        houses: the houses.
        house_index: [N] the house of each robot.
        robot: footprint and camera.
        size: side of the square pictures [pixels].
        threads: threads that draw.
        randomisation: what `dress` draws light and camera from; default: nothing varies.
        models: names of the objects that may stand in the houses; objects: most at a time.
    """

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True, tilt=True,
                                scene=True)
    world_version = WORLD_VERSION
    routes = None  # nothing keeps a robot from turning

    def __init__(self, houses: Sequence[House], house_index: Sequence[int], *, robot: RobotSpec,
                 size: int = 84, threads: int = 1, randomisation: Randomisation | None = None,
                 models: Sequence[str] = (), objects: int = 0):
        self.houses = list(houses)
        for house in self.houses:
            if robot.footprint_radius > house.footprint_radius:
                raise UserError('the robot fits into the floor map of the house '
                                f'(footprint radius <= {house.footprint_radius} m)',
                                robot.footprint_radius, 'use a smaller robot')
        self.robot = robot
        self.world = World(self.houses, np.asarray(house_index), robot.footprint_radius)
        self.num_envs = len(self.world.house_index)
        self.randomisation = randomisation or Randomisation()
        self._renderer = Rasterizer([*(house.scene for house in self.houses),
                                     *map(object_scene, models)], size, threads=threads)
        self.objects = no_objects(self.num_envs, objects)
        self._all = np.arange(self.num_envs)
        self._frames = None
        self._appearance = None
        self.dress(self._all, 0, Stream.APPEARANCE, self._all, 0 * self._all)

    @property
    def poses(self) -> np.ndarray:
        """[N,4] x, y, yaw, pitch; a view that changes with the next move."""
        return self.world.poses

    @property
    def house_index(self) -> np.ndarray:
        """[N] the house of each robot."""
        return self.world.house_index

    @property
    def seen_from(self) -> np.ndarray:
        """[N,4]: pictures are drawn from where the robots are."""
        return self.world.poses

    def enter(self, env_ids: np.ndarray, houses: np.ndarray) -> None:
        """Put robots [K] into houses [K]; their poses are still to be set."""
        self.world.house_index[env_ids] = houses

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4]."""
        self.world.poses[env_ids] = poses

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""
        return Motion(*self.world.move(delta, self._all if env_ids is None else env_ids))

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        return self.world.reach(env_id, headings, length)

    def appearance(self, seed: int, stream: Stream, env, episode) -> Appearance:
        """Light and camera of some episodes, or of some goal pictures."""
        return draw_appearance(self.randomisation, self._renderer.rooms, seed, stream, env,
                               episode)

    def dress(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream, env,
              episode) -> None:
        """Draw light and camera of robots [K] anew, for the counters [K] of their episodes."""
        drawn = self.appearance(seed, stream, env, episode)
        if self._appearance is None:
            self._appearance = drawn
            return
        for part, rows in zip(self._appearance, drawn, strict=True):
            part[env_ids] = rows

    def set_objects(self, env_id: int, placed: Sequence[Placed]) -> None:
        """Put these objects, and no others, into the house of one robot."""
        self._stand(self.objects, env_id, self.world.house_index[env_id], placed)

    def _stand(self, objects: Objects, row: int, house_index: int, placed: Sequence[Placed]
               ) -> None:
        house = self.houses[house_index]
        objects.scene[row] = -1
        for m, item in enumerate(placed):
            objects.scene[row, m] = len(self.houses) + item.model
            objects.pose[row, m] = item.x, item.y, 0.0, item.yaw
            objects.room[row, m] = house.room_index(item.x, item.y)

    def object_models(self) -> np.ndarray:
        """[N,M] int64: which model each object is; -1: absent."""
        return np.where(self.objects.scene >= 0, self.objects.scene - len(self.houses), -1)

    def observe(self, env_ids: np.ndarray | None = None,
                keys: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras. All robots: one buffer, valid until the next call.

        Args:
            env_ids: [K] which robots; default all.
            keys: [K] uint64, of the sensor's noise; default: one noise for every call.
        """
        if env_ids is None:
            self._frames = self._draw(self.world.house_index, self.world.poses, self._frames,
                                      self._appearance, keys, self.objects)
            return self._frames
        return self._draw(self.world.house_index[env_ids], self.world.poses[env_ids], None,
                          Appearance(*(part[env_ids] for part in self._appearance)), keys,
                          Objects(*(part[env_ids] for part in self.objects)))

    def view(self, house_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Appearance | None = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """Pictures from any poses [K,4] in the given houses [K]; by default in standard light.

        Args:
            out: buffers to fill; keys: as in `observe`.
            appearance: light and camera of each picture.
            placed: the objects in each picture; default none.
        """
        if appearance is None:
            appearance = draw_appearance(Randomisation(), self._renderer.rooms, 0,
                                         Stream.APPEARANCE, np.arange(len(poses)), 0)
        objects = None
        if placed is not None:
            objects = no_objects(len(poses), max(map(len, placed)))
            for k, items in enumerate(placed):
                self._stand(objects, k, house_index[k], items)
        return self._draw(house_index, poses, out, appearance, keys, objects)

    def cameras(self, poses: np.ndarray | None = None, appearance: Appearance | None = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Where cameras are and look, [K,5] as `Rasterizer.render` takes them, and their fov [K].

        Args:
            poses: [K,4] of the robots that hold them; default: the robots as they stand now.
            appearance: of each picture; default: that of the robots' episodes.
        """
        robot = self.robot
        poses = self.world.poses if poses is None else poses
        appearance = appearance or self._appearance
        cameras = np.column_stack([poses[:, :2], robot.camera_height + appearance.height,
                                   poses[:, 2],
                                   poses[:, 3] + robot.camera_pitch + appearance.pitch])
        return cameras, robot.camera_fov + appearance.fov

    def _draw(self, house_index, poses, out, appearance, keys, objects) -> Frames:
        cameras, fov = self.cameras(poses, appearance)
        frames = Frames(*self._renderer.render(
            house_index, cameras, fov, out,
            lights=Lights(appearance.cube, appearance.lamps), objects=objects))
        if self.randomisation.noise[1] > 0 or self.randomisation.blur[1] > 0:
            if keys is None:
                keys = np.arange(len(poses)).astype(np.uint64)
            expose(frames.rgb, appearance.noise, appearance.blur, keys)
        return frames
