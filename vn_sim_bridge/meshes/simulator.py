"""Robots in places made of triangles: continuous motion with contacts, pictures by our renderer.

`gltf`, `procthor` and `suncg` are subclasses that say how a place is read.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

from vn_nav.scenes import SceneName
from vn_sim_bridge.floor.contacts import move_among, reach_among
from vn_sim_bridge.houses.objects import object_scene
from vn_sim_bridge.meshes.lazy import BUDGET, LazyPlace, PlaceCache
from vn_sim_bridge.meshes.place import MeshPlace
from vn_sim_bridge.render.drawn import DrawnSimulator
from vn_sim_bridge.render.pack import Lights
from vn_sim_bridge.render.randomisation import Appearance
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Frames, Motion, Objects, Setup, no_objects

Maker = Callable[[], tuple[MeshPlace, Scene]]


class MeshSimulator(DrawnSimulator):
    """N robots in meshes. A subclass writes `open`: it names its places and how each is read.

    Every place is a `floor.places.RoomPlace`. A robot's place stays in memory; others as far as
    the budget goes.

    Args:
        names: of the scenes.
        makers: of each scene: a function that makes place and scene (`place.make_place`).
        setup: robots, camera, pictures.
        label_names: behind the class ids; those of `houses.labels` come first, for the tasks.
        rooms: whether places know their rooms.
        budget: bytes of places that are kept though no robot is in them.
    """

    places: list[LazyPlace]

    @classmethod
    @abc.abstractmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> MeshSimulator:
        """See `BaseSimulator.open`."""

    def __init__(self, names: Sequence[str], makers: Sequence[Maker], setup: Setup,
                 label_names: Sequence[str], *, rooms: bool = True, budget: int = BUDGET):
        self.cache = PlaceCache(makers, functools.partial(_renderer, setup), budget)
        super().__init__([LazyPlace(name, self.cache, index)
                          for index, name in enumerate(names)], setup)
        self.label_names = tuple(label_names)
        if not rooms:
            self.capabilities = dataclasses.replace(self.capabilities, rooms=False)
        self._set_up(setup.randomisation, setup.objects, setup.goal_randomisation)
        self._use()
        for index in sorted(set(self.place_index.tolist())):  # what is wrong is said now
            self.cache.get(index)

    def _use(self) -> None:
        self.cache.in_use = frozenset(self.place_index.tolist())

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`."""
        super().enter(env_ids, places)
        self._use()

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""
        env_ids = self._all if env_ids is None else np.asarray(env_ids)
        done, touched = np.zeros((len(env_ids), 4)), np.zeros(len(env_ids), bool)
        for index, rows in _by_place(self.place_index[env_ids]):
            rects = self.cache.get(index).place.obstacle_rects
            done[rows], touched[rows] = move_among(rects, self.robot.footprint_radius, self.poses,
                                                   delta[rows], env_ids[rows])
        return Motion(done, touched)

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        rects = self.cache.get(int(self.place_index[env_id])).place.obstacle_rects
        x, y = self.poses[env_id, :2]
        return reach_among(rects, self.robot.footprint_radius, x, y, np.asarray(headings, float),
                           length)

    @property
    def _lamps(self) -> int:
        return 1  # all rooms have the same

    def _render(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None,
                appearance: Appearance, objects: Objects | None) -> Frames:
        objects = no_objects(len(poses)) if objects is None else objects
        cameras, fov = self.cameras(poses, appearance)
        frames = out or _buffers(len(poses), self.setup.size)
        lights = Lights(appearance.cube, appearance.lamps)
        for index, rows in _by_place(place_index):
            renderer = self.cache.get(index).renderer
            if renderer.rooms > lights.lamps.shape[1]:  # all rooms have the same lamp
                lights = Lights(lights.cube, np.repeat(lights.lamps[:, :1], renderer.rooms, 1))
            if len(rows) == len(poses):  # all in one place: no copies
                renderer.render(np.zeros(len(rows), np.int64), cameras, fov, frames,
                                lights=lights, objects=objects)
                continue
            drawn = renderer.render(
                np.zeros(len(rows), np.int64), cameras[rows], fov[rows],
                lights=Lights(*(part[rows] for part in lights)),
                objects=Objects(*(part[rows] for part in objects)))
            for whole, part in zip(frames, drawn, strict=True):
                whole[rows] = part
        return frames

    def close(self) -> None:
        """Let go of the places and pictures."""
        self._frames = None
        self.cache.clear()


def _renderer(setup: Setup, scene: Scene) -> Rasterizer:
    """What draws a place and the objects that may stand in it."""
    return Rasterizer([scene, *map(object_scene, setup.models)], setup.size,
                      threads=setup.threads)


def _by_place(place_index: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The places of some robots [K], and the rows of each."""
    return [(int(index), np.nonzero(place_index == index)[0])
            for index in np.unique(place_index)]


def _buffers(count: int, size: int) -> Frames:
    return Frames(np.empty((count, 3, size, size), np.uint8),
                  np.empty((count, size, size), np.float32),
                  np.empty((count, size, size), np.uint8),
                  np.empty((count, size, size), np.uint16))
