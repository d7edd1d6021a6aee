"""Embedded houses: `house:SEED`, `house:SEED?rooms=N`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import ROOMS, SceneName, house_scene, options_of, whole_number
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.contacts import World
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.objects import GOAL_OBJECTS, object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.splits import SPLITS
from vn_sim_bridge.render.pack import Lights
from vn_sim_bridge.render.randomisation import Appearance, Randomisation, draw_appearance
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.sensor import expose
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Motion,
    Objects,
    Placed,
    Setup,
    no_objects,
)


class ScenesBySeed(Sequence):
    """Names of houses, made when they are asked for: a split has thousands."""

    def __init__(self, seeds: range):
        self._seeds = seeds

    def __len__(self) -> int:
        return len(self._seeds)

    def __getitem__(self, index):
        found = self._seeds[index]
        return ScenesBySeed(found) if isinstance(found, range) else house_scene(found)


def open_houses(scenes: Sequence[SceneName], goals_per_room: int = 1, goal_seed: int = 0
                ) -> list[House]:
    """The houses of some scenes.

    Raises:
        UserError: a scene that is no house.
    """
    return [generate_house(
        whole_number(scene, 'seed', scene.place),
        rooms=whole_number(scene, 'number of rooms',
                           options_of(scene, ('rooms',)).get('rooms', str(ROOMS))),
        goals_per_room=goals_per_room, goal_seed=goal_seed) for scene in scenes]


# Pixels, houses and motion together. Whoever changes one of them raises it and trains the shipped
# models again: a checkpoint is only worth its figures in the world that it was measured in.
WORLD_VERSION = '2'


class HouseSimulator(BaseSimulator):
    """N robots in embedded houses (see `Simulator`).

    Args:
        houses: the houses.
        place_index: [N] the house of each robot.
        robot: footprint and camera.
        size: side of the square pictures [pixels].
        threads: threads that draw.
        randomisation: what `apply_appearance` draws light and camera from; default: nothing
            varies.
        models: names of the objects that may stand in the houses; objects: most at a time.
    """

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True, tilt=True,
                                rooms=True, walls=True, placeable_objects=True, appearance=True,
                                other_goals=True)
    places: list[House]
    version = WORLD_VERSION
    label_names = LABELS
    task_objects = {'object': GOAL_OBJECTS, 'collect': ('apple', 'lemon')}
    splits = {name: ScenesBySeed(seeds) for name, seeds in SPLITS.items()}

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> HouseSimulator:
        """See `BaseSimulator.open`."""
        houses = open_houses(scenes, setup.goals_per_room, setup.goal_seed)
        return cls(houses, np.arange(setup.num_envs) % len(houses), robot=setup.robot,
                   size=setup.size, threads=setup.threads, randomisation=setup.randomisation,
                   models=setup.models, objects=setup.objects)

    def __init__(self, houses: Sequence[House], place_index: Sequence[int] | np.ndarray, *,
                 robot: RobotSpec, size: int = 84, threads: int = 1,
                 randomisation: Randomisation | None = None, models: Sequence[str] = (),
                 objects: int = 0):
        self.places = list(houses)
        for house in self.places:
            if robot.footprint_radius > house.footprint_radius:
                raise UserError('the robot fits into the floor map of the house '
                                f'(footprint radius <= {house.footprint_radius} m)',
                                robot.footprint_radius, 'use a smaller robot')
        self.robot = robot
        self.world = World(self.places, np.asarray(place_index), robot.footprint_radius)
        # One array each, in the world and here: a move changes both.
        self.poses, self.place_index = self.world.poses, self.world.place_index
        self.num_envs = len(self.place_index)
        self.randomisation = randomisation or Randomisation()
        self._renderer: Rasterizer | None = Rasterizer(  # None: closed
            [*(house.scene for house in self.places), *map(object_scene, models)], size,
            threads=threads)
        self.objects = no_objects(self.num_envs, objects)
        self._all = np.arange(self.num_envs)
        self._frames: Frames | None = None
        self._appearance = self.appearance(0, Stream.APPEARANCE, self._all, 0 * self._all)

    @property
    def _painter(self) -> Rasterizer:
        assert self._renderer is not None  # not closed yet
        return self._renderer

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""
        return Motion(*self.world.move(delta, self._all if env_ids is None else env_ids))

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        return self.world.reach(env_id, headings, length)

    def appearance(self, seed: int | np.ndarray, stream: Stream, env, episode) -> Appearance:
        """Light and camera of some episodes, or of some goal pictures."""
        return draw_appearance(self.randomisation, self._painter.rooms, seed, stream, env,
                               episode)

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env, episode) -> None:
        """Draw light and camera of robots [K] anew, for the counters [K] of their episodes."""
        drawn = self.appearance(seed, stream, env, episode)
        for part, rows in zip(self._appearance, drawn, strict=True):
            part[env_ids] = rows

    def set_objects(self, env_id: int, placed: Sequence[Placed]) -> None:
        """Put these objects, and no others, into the house of one robot."""
        self._stand(self.objects, env_id, self.world.place_index[env_id], placed)

    def _stand(self, objects: Objects, row: int, place_index: int, placed: Sequence[Placed]
               ) -> None:
        house = self.places[place_index]
        objects.scene[row] = -1
        for m, item in enumerate(placed):
            objects.scene[row, m] = len(self.places) + item.model
            objects.pose[row, m] = item.x, item.y, 0.0, item.yaw
            objects.room[row, m] = house.room_index(item.x, item.y)

    def object_models(self) -> np.ndarray:
        """[N,M] int64: which model each object is; -1: absent."""
        return np.where(self.objects.scene >= 0, self.objects.scene - len(self.places), -1)

    def observe(self, env_ids: np.ndarray | None = None,
                keys: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras. All robots: one buffer, valid until the next call.

        Args:
            env_ids: [K] which robots; default all.
            keys: [K] uint64, of the sensor's noise; default: one noise for every call.
        """
        if env_ids is None:
            self._frames = self._draw(self.world.place_index, self.world.poses, self._frames,
                                      self._appearance, keys, self.objects)
            return self._frames
        return self._draw(self.world.place_index[env_ids], self.world.poses[env_ids], None,
                          Appearance(*(part[env_ids] for part in self._appearance)), keys,
                          Objects(*(part[env_ids] for part in self.objects)))

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Appearance | None = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """Pictures from any poses [K,4] in houses [K]; by default in standard light.

        Args:
            out: buffers to fill; keys: as in `observe`.
            appearance: light and camera of each picture.
            placed: the objects in each picture; default none.
        """
        if appearance is None:
            appearance = draw_appearance(Randomisation(), self._painter.rooms, 0,
                                         Stream.APPEARANCE, np.arange(len(poses)), 0)
        objects = None
        if placed is not None:
            objects = no_objects(len(poses), max(map(len, placed)))
            for k, items in enumerate(placed):
                self._stand(objects, k, place_index[k], items)
        return self._draw(place_index, poses, out, appearance, keys, objects)

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

    def _draw(self, place_index, poses, out, appearance, keys, objects) -> Frames:
        cameras, fov = self.cameras(poses, appearance)
        frames = Frames(*self._painter.render(
            place_index, cameras, fov, out,
            lights=Lights(appearance.cube, appearance.lamps), objects=objects))
        if self.randomisation.noise[1] > 0 or self.randomisation.blur[1] > 0:
            if keys is None:
                keys = np.arange(len(poses)).astype(np.uint64)
            expose(frames.rgb, appearance.noise, appearance.blur, keys)
        return frames

    def close(self) -> None:
        """Let go of the pictures and of what the renderer holds."""
        self._frames = self._renderer = None


SIMULATOR = HouseSimulator
