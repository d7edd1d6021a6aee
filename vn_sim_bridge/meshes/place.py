"""A place made of triangles: floor, obstacles, rooms, goals; and the scene that is drawn of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from vn_nav.robot import RobotSpec
from vn_sim_bridge.floor.floor_map import FloorMap, Rect
from vn_sim_bridge.floor.mesh_floor import (
    HEIGHT,
    OUTSIDE,
    STEP,
    WALL,
    choose_level,
    floor_levels,
    mesh_floor,
    rectangles_of_polygons,
)
from vn_sim_bridge.floor.on_floor import OnFloor
from vn_sim_bridge.houses.house import Room
from vn_sim_bridge.meshes.goals import mesh_goals
from vn_sim_bridge.render.mesh_scene import Surface, mesh_scene
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Goal

LAMP = 0.7  # of a lamp's light: in standard light nothing is brighter than its own colour
MOST_TEXELS = 48 << 20  # of one place: 256 MB with their halved pictures


class RoomOutline(NamedTuple):
    """Where a room is on the floor."""

    name: str  # for people, its own: 'kitchen', 'bedroom 2'
    kind: str  # 'kitchen', 'bedroom'
    polygons: Sequence[np.ndarray]  # [n,2] m each, in the map frame
    low: float = -math.inf  # m, heights between which it lies: that of its storey
    high: float = math.inf


@dataclasses.dataclass(frozen=True)
class MeshPlace(OnFloor):
    """Has what a `House` has for tasks, contacts and maps (`floor.places.RoomPlace`).

    A room that is no rectangle is several ones of one name in `rooms`.
    """

    name: str
    outline: Rect
    floor: FloorMap
    obstacles: tuple[tuple[Rect, str], ...]
    obstacle_rects: np.ndarray  # [M,4] float64
    rooms: tuple[Room, ...]
    goals: tuple[Goal, ...]
    area: float  # m^2, of the free floor
    footprint_radius: float  # m, of the robot that the floor map is for
    level: float  # m, height of the floor in the frame of the file

    def plan(self) -> dict:
        """What a map needs, see `House.plan`."""
        return {
            'scene': self.name, 'bounds': list(self.outline), 'area': self.area,
            'rooms_list': [{'name': room.name, 'rect': list(room.rect)} for room in self.rooms],
            'walls': [list(rect) for rect, label in self.obstacles if label == WALL],
            'obstacles': [[*rect, label] for rect, label in self.obstacles
                          if label not in (WALL, OUTSIDE)],
            'outside': [list(rect) for rect, label in self.obstacles if label == OUTSIDE],
            'goals': [{'room': goal.room, 'pose': list(goal.pose)} for goal in self.goals],
        }


@dataclasses.dataclass(frozen=True)
class PlaceRules:
    """How a mesh becomes a place.

    Attributes:
        storey: by its number from the lowest, 0; None: the one with the most floor.
        floor_z: height of the floor [m], where it is known already.
        height, step: obstacles lie between them above the floor [m].
        passable: classes that are in nobody's way.
        most_texels: of all textures; larger ones are halved.
    """

    storey: int | None = None
    floor_z: float | None = None
    height: float = HEIGHT
    step: float = STEP
    passable: Collection[str] = ()
    most_texels: int | None = MOST_TEXELS


def make_place(name: str, surfaces: Sequence[Surface], label_names: Sequence[str],
               robot: RobotSpec, *, rooms: Sequence[RoomOutline] = (),
               rules: PlaceRules | None = None, goals_per_room: int = 1, goal_seed: int = 0
               ) -> tuple[MeshPlace, Scene]:
    """A place and its scene, moved so that the chosen storey's floor is z = 0.

    Args:
        name: of the scene, 'gltf:flat.glb'.
        surfaces: everything to be seen and touched; frame: x, y level, z up, metres.
        label_names: behind the surfaces' labels.
        robot: whose floor it is, and whose camera takes the goal pictures.
        rooms: where they are, in the frame of the surfaces.
        rules: see there.
        goals_per_room, goal_seed: see `Setup`.

    Raises:
        UserError: no floor, or nothing to be seen.
    """
    rules = rules or PlaceRules()
    # Both sides of what has two: floors that look down in the file are floors.
    sides = [(surface, turn) for surface in surfaces
             for turn in ((1, -1) if surface.both_sides else (1,))]
    corners = np.concatenate([surface.corners[:, ::turn] for surface, turn in sides])
    kinds = np.concatenate([np.broadcast_to(surface.label, len(surface.corners))
                            for surface, _ in sides])
    level = rules.floor_z
    if level is None:
        level = choose_level(floor_levels(corners), rules.storey, name).z
    moved = np.array([0.0, 0.0, -level])
    found = mesh_floor(corners + moved, kinds, label_names, robot.footprint_radius,
                       height=rules.height, step=rules.step, passable=rules.passable, name=name)
    scene = mesh_scene([surface._replace(corners=surface.corners + moved)
                        for surface in surfaces], name, most_texels=rules.most_texels,
                       lamp=LAMP)
    there = tuple(Room(room.name, room.kind, rect) for room in rooms
                  if room.low - rules.step <= level <= room.high
                  for rect in rectangles_of_polygons(room.polygons))
    goals = mesh_goals(scene, found.floor, there, label_names, robot, goals_per_room, goal_seed)
    return MeshPlace(name, found.outline, found.floor, found.obstacles, found.obstacle_rects,
                     there, goals, found.area, robot.footprint_radius, float(level)), scene
