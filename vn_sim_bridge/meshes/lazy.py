"""Places that are read when they are needed, and let go of again: a split may have thousands."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vn_sim_bridge.floor.floor_map import FloorMap, Rect
from vn_sim_bridge.floor.on_floor import OnFloor
from vn_sim_bridge.houses.house import Room
from vn_sim_bridge.meshes.place import MeshPlace
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Goal

BUDGET = 2 << 30  # bytes of places that are kept though no robot is in them


class Loaded(NamedTuple):
    """A place, and what draws it."""

    place: MeshPlace
    renderer: Rasterizer
    size: int  # bytes


class Facts(NamedTuple):
    """What is asked of a place that nobody is in: it stays when the place is let go of."""

    goals: tuple[Goal, ...]
    rooms: tuple[Room, ...]
    floor: FloorMap


class PlaceCache:
    """The places that were used last, and facts of all that were ever read.

    Args:
        makers: of each place: a function that reads it.
        render: makes what draws a scene.
        budget: bytes that are kept beyond what is in use.
    """

    def __init__(self, makers: Sequence[Callable[[], tuple[MeshPlace, Scene]]],
                 render: Callable[[Scene], Rasterizer], budget: int = BUDGET):
        self._makers, self._render, self.budget = list(makers), render, budget
        self._kept: OrderedDict[int, Loaded] = OrderedDict()
        self._facts: dict[int, Facts] = {}
        self.loads = 0  # places read so far, again or not
        self.in_use: frozenset[int] = frozenset()  # are never let go of

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, index: int) -> Loaded:
        """The place of that number, read if it is not there.

        Raises:
            UserError: it cannot be read.
        """
        found = self._kept.get(index)
        if found is None:
            place, scene = self._makers[index]()
            renderer = self._render(scene)
            size = sum(part.nbytes for part in renderer.pack) + place.obstacle_rects.nbytes * 6
            found = self._kept[index] = Loaded(place, renderer, size)
            self._facts[index] = Facts(place.goals, place.rooms, place.floor)
            self.loads += 1
            self._shrink(index)
        self._kept.move_to_end(index)
        return found

    def facts(self, index: int) -> Facts:
        """Of the place of that number, which is read once for them; raises as `get` does."""
        if index not in self._facts:
            self.get(index)
        return self._facts[index]

    def _shrink(self, newest: int) -> None:
        """Let go of the oldest ones that nobody uses."""
        total = sum(entry.size for entry in self._kept.values())
        for index in list(self._kept):
            if total <= self.budget:
                break
            if index != newest and index not in self.in_use:
                total -= self._kept.pop(index).size

    def clear(self) -> None:
        """Let go of everything."""
        self._kept.clear()


class LazyPlace(OnFloor):
    """A `MeshPlace` by its number: goals, rooms and floor stay, the rest may have to be read.

    Args:
        name: of its scene.
        cache, index: where it is.
    """

    def __init__(self, name: str, cache: PlaceCache, index: int):
        self.name, self._cache, self._index = name, cache, index

    @property
    def whole(self) -> MeshPlace:
        """All of it."""
        return self._cache.get(self._index).place

    @property
    def goals(self) -> tuple[Goal, ...]:
        """Where goal pictures are taken."""
        return self._cache.facts(self._index).goals

    @property
    def rooms(self) -> tuple[Room, ...]:
        """Rectangles of rooms; several of one name are one room."""
        return self._cache.facts(self._index).rooms

    @property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""
        return self._cache.facts(self._index).floor

    @property
    def outline(self) -> Rect:
        """Of the map."""
        return self.whole.outline

    @property
    def area(self) -> float:
        """Of the free floor [m^2]."""
        return self.whole.area

    @property
    def footprint_radius(self) -> float:
        """Of the robot that the floor map is for [m]."""
        return self.whole.footprint_radius

    @property
    def obstacles(self) -> tuple[tuple[Rect, str], ...]:
        """What a robot cannot drive through, and what it is."""
        return self.whole.obstacles

    @property
    def obstacle_rects(self) -> np.ndarray:
        """[M,4] x0, y0, x1, y1 [m] of every obstacle."""
        return self.whole.obstacle_rects

    def plan(self) -> dict:
        """What a map needs, see `House.plan`."""
        return self.whole.plan()
