"""Embedded houses: `house:SEED`, `house:SEED?rooms=N`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import ROOMS, SceneName, house_scene, options_of, whole_number
from vn_sim_bridge.floor.contacts import World
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.objects import GOAL_OBJECTS, object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.splits import SPLITS
from vn_sim_bridge.render.drawn import DrawnSimulator
from vn_sim_bridge.render.pack import Lights
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.simulator import Frames, Motion, Setup


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


class HouseSimulator(DrawnSimulator):
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
        goal_randomisation: of goal pictures; default: the same.
    """

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
                   models=setup.models, objects=setup.objects,
                   goal_randomisation=setup.goal_randomisation)

    def __init__(self, houses: Sequence[House], place_index: Sequence[int] | np.ndarray, *,
                 robot: RobotSpec, size: int = 84, threads: int = 1,
                 randomisation: Randomisation | None = None, models: Sequence[str] = (),
                 objects: int = 0, goal_randomisation: Randomisation | None = None):
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
        self._renderer: Rasterizer | None = Rasterizer(  # None: closed
            [*(house.scene for house in self.places), *map(object_scene, models)], size,
            threads=threads)
        self._set_up(randomisation, objects, goal_randomisation)

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

    @property
    def _lamps(self) -> int:
        return self._painter.rooms

    @property
    def _first_model(self) -> int:
        return len(self.places)

    def _room_index(self, place_index: int, x: float, y: float) -> int:
        return self.places[place_index].room_index(x, y)

    def _render(self, place_index, poses, out, appearance, objects) -> Frames:
        cameras, fov = self.cameras(poses, appearance)
        return Frames(*self._painter.render(
            place_index, cameras, fov, out,
            lights=Lights(appearance.cube, appearance.lamps), objects=objects))

    def close(self) -> None:
        """Let go of the pictures and of what the renderer holds."""
        self._frames = self._renderer = None


SIMULATOR = HouseSimulator
