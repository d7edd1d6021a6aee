"""A house: its scene, what stands in the way, and distances a robot has to drive."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np

from vn_sim_bridge.floor.floor_map import FloorMap, Rect, Room, floor_map
from vn_sim_bridge.floor.on_floor import OnFloor
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Goal


class Obstacle(NamedTuple):
    """What a robot cannot drive through: a rectangle on the floor."""

    rect: Rect
    label: str


@dataclasses.dataclass(frozen=True)
class House(OnFloor):
    """One house, the same for every run of the same generator version and seed."""

    name: str
    seed: int
    outline: Rect
    scene: Scene
    rooms: tuple[Room, ...]
    obstacles: tuple[Obstacle, ...]
    goals: tuple[Goal, ...]
    footprint_radius: float  # m, of the robot that the floor map is for

    @property
    def area(self) -> float:
        """Floor inside the walls [m^2]."""
        return sum(room.rect.area for room in self.rooms)

    @functools.cached_property
    def obstacle_rects(self) -> np.ndarray:
        """[M,4] float64: x0, y0, x1, y1 of every obstacle."""
        return np.array([obstacle.rect for obstacle in self.obstacles], float)

    @functools.cached_property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""
        return floor_map(self.outline, self.obstacle_rects, self.footprint_radius)

    def plan(self) -> dict:
        """What a map needs of the house, ready for JSON; lengths in m, poses as in `Goal`."""
        return {
            'scene': self.name, 'house': self.seed, 'bounds': list(self.outline),
            'area': self.area,
            'rooms_list': [{'name': room.name, 'rect': list(room.rect)} for room in self.rooms],
            'walls': [list(o.rect) for o in self.obstacles if o.label == 'wall'],
            'obstacles': [[*o.rect, o.label] for o in self.obstacles
                          if o.label not in ('wall', 'outside')],
            'outside': [list(o.rect) for o in self.obstacles if o.label == 'outside'],
            'goals': [{'room': goal.room, 'pose': list(goal.pose)} for goal in self.goals],
        }

    def room_index(self, x: float, y: float) -> int:
        """Index of the room nearest to a point."""
        gaps = [math.hypot(max(r.x0 - x, 0, x - r.x1), max(r.y0 - y, 0, y - r.y1))
                for r in (room.rect for room in self.rooms)]
        return int(np.argmin(gaps))
