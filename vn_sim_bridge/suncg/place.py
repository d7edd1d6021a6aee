"""A level of a SUNCG house as a place: floor, obstacles, doors, rooms, goals.

House3D's conventions are options: `boxes` takes objects as their bounding boxes between 0.15 and
0.75 m; `targets` are the five room types that RoomNav sends robots to.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.floor import mesh_raster
from vn_sim_bridge.floor.floor_map import CELL, Rect
from vn_sim_bridge.floor.mesh_floor import (
    HEIGHT,
    STEP,
    facing_up,
    mesh_floor,
    rectangles_of_cells,
)
from vn_sim_bridge.houses.house import Room
from vn_sim_bridge.meshes.goals import mesh_goals
from vn_sim_bridge.meshes.place import MOST_TEXELS, MeshPlace
from vn_sim_bridge.render.mesh_scene import mesh_scene
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.suncg.axes import box_to_map
from vn_sim_bridge.suncg.geometry import SIDES, Piece, layout_of, read_pieces
from vn_sim_bridge.suncg.house_json import Level, Node, read_house
from vn_sim_bridge.suncg.labels import DOORS, Categories

ROBOT_HEIGHT = 0.75  # m, of House3D
CARPET = 0.15  # m: lower than that, House3D drives over it
WALL_REACH = 0.2  # m that a door clears before and behind itself: the thickness of the wall
TARGETS = ('kitchen', 'dining_room', 'living_room', 'bathroom', 'bedroom')
SAME_TYPE = {'toilet': 'bathroom', 'guest_room': 'bedroom'}  # as in House3D
OPENING = 'opening'  # what is in nobody's way
OBSTACLES = ('mesh', 'boxes')


@dataclasses.dataclass(frozen=True)
class Options:
    """How a level is read."""

    level: int = 0
    obstacles: str = 'mesh'  # of OBSTACLES
    targets: str = 'house3d'  # 'all': every room type is one that robots are sent to
    layout: str = ''  # '': by the files that are there


def read_place(name: str, data: Path, house_id: str, categories: Categories, robot: RobotSpec,
               options: Options, goals_per_room: int = 1, goal_seed: int = 0
               ) -> tuple[MeshPlace, Scene]:
    """A level of a house and its scene, its floor at z = 0.

    Args:
        name: of the scene.
        data: folder with `house`, and `room`, `object` and `texture`.
        house_id: of the house.
        categories: classes of its models.
        robot: whose floor it is, and whose camera takes the goal pictures.
        options: see there.
        goals_per_room, goal_seed: see `Setup`.

    Raises:
        UserError: files that are missing or broken, or no floor for the robot.
    """
    house = read_house(data / 'house' / house_id / 'house.json')
    level = house.level(options.level)
    pieces = read_pieces(data, house, level, categories,
                         options.layout or layout_of(data, house_id))
    floor_z = _floor_height(pieces, level, house.scale)
    pieces = [piece._replace(surfaces=tuple(
        surface._replace(corners=surface.corners - (0.0, 0.0, floor_z))
        for surface in piece.surfaces)) for piece in pieces]
    corners, kinds = _solids(pieces, categories, options, house.scale, floor_z)
    boxes = options.obstacles == 'boxes'
    found = mesh_floor(corners, kinds, (*categories.names, OPENING), robot.footprint_radius,
                       height=ROBOT_HEIGHT if boxes else HEIGHT,
                       step=CARPET if boxes else STEP, passable=(OPENING,), unknown=(), name=name)
    scene = mesh_scene([surface for piece in pieces for surface in piece.surfaces], name,
                       most_texels=MOST_TEXELS)
    rooms = rooms_of(pieces, level, options.targets, house.scale)
    goals = mesh_goals(scene, found.floor, rooms, categories.names, robot, goals_per_room,
                       goal_seed)
    return MeshPlace(name, found.outline, found.floor, found.obstacles, found.obstacle_rects,
                     rooms, goals, found.area, robot.footprint_radius, floor_z), scene


def _floor_height(pieces: Sequence[Piece], level: Level, scale: float) -> float:
    """Of most of the rooms' floors [m]; the level's lowest point where there is none."""
    corners = [piece.corners for piece in pieces if piece.role == 'floor']
    if not corners:
        return float(level.low[1]) * scale
    all_corners = np.concatenate(corners)
    up = all_corners[facing_up(all_corners)]
    if not len(up):
        return float(level.low[1]) * scale
    area = np.linalg.norm(np.cross(up[:, 1] - up[:, 0], up[:, 2] - up[:, 0]), axis=1)
    height = up[:, :, 2].mean(axis=1)
    order = np.argsort(height)
    passed = np.cumsum(area[order])
    return float(height[order][np.searchsorted(passed, passed[-1] / 2)])


def is_door(node: Node, categories: Categories, floor_z: float, scale: float) -> bool:
    """Whether robots drive through: doors, fences, arches, windows that reach the floor."""
    if node.type != 'Object':
        return False
    kind = categories.model(node.model).nyu40
    return kind in DOORS or (kind == 'window' and node.low[1] * scale - floor_z < CARPET)


def _solids(pieces: Sequence[Piece], categories: Categories, options: Options, scale: float,
            floor_z: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles [T,3,3] that are floor or in the way, and their kinds [T].

    The ground around a house is neither: robots stay inside.
    """
    if options.obstacles not in OBSTACLES:
        raise UserError(f'obstacles are one of {", ".join(OBSTACLES)}', options.obstacles,
                        'choose one of them')
    opening = len(categories.names)
    doors = []
    for piece in pieces:
        if piece.node is not None and is_door(piece.node, categories, floor_z, scale):
            doors.append(_door_way(piece.node, scale))
    corners: list[np.ndarray] = []
    kinds: list[np.ndarray] = []

    def add(own: np.ndarray, kind: int) -> None:
        corners.append(own)
        kinds.append(np.full(len(own), kind))

    boxed: set[str] = set()
    for piece in pieces:
        if piece.role == 'ground':
            continue
        own, label = piece.corners, int(piece.surfaces[0].label)
        if piece.role == 'wall':
            for low, high in doors:
                own = outside_column(own, low, high)
            add(own, label)
        elif piece.role == 'object' and piece.node is not None:
            if is_door(piece.node, categories, floor_z, scale):
                add(own, opening)
            elif options.obstacles == 'boxes':
                add(own, opening)  # still something to stand on, if it is a rug
                if piece.node.id not in boxed:
                    boxed.add(piece.node.id)
                    add(_box(piece.node, scale, floor_z), label)
            else:
                add(own, label)
        else:
            add(own, label)
    return np.concatenate(corners), np.concatenate(kinds)


def _box(node: Node, scale: float, floor_z: float) -> np.ndarray:
    """The bounding box of an object [12,3,3], cut at the robot's height; [0,3,3]: not in the way.

    The cut gives it a lid: what is inside a large box is not free.
    """
    low, high = box_to_map(node.low * scale, node.high * scale)
    low[2], high[2] = low[2] - floor_z, high[2] - floor_z
    if low[2] >= ROBOT_HEIGHT or high[2] <= CARPET:
        return np.zeros((0, 3, 3))
    high[2] = min(high[2], ROBOT_HEIGHT)
    sides = (low + high) / 2 + SIDES * (high - low) / 2
    return sides[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


def _door_way(node: Node, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """What a door clears, seen from above: least and greatest corner [2] m."""
    low, high = box_to_map(node.low * scale, node.high * scale)
    low, high = low[:2].copy(), high[:2].copy()
    thin = int(np.argmin(high - low))
    low[thin] -= WALL_REACH
    high[thin] += WALL_REACH
    return low, high


def outside_column(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The parts of triangles [T,3,3] outside of a column with these corners [2] in the plan."""
    beside = ((corners[:, :, :2].max(axis=1) <= low + 1e-9)
              | (corners[:, :, :2].min(axis=1) >= high - 1e-9)).any(axis=1)
    found = [corners[beside]]
    inside = list(corners[~beside])
    for axis in (0, 1):
        for limit, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            rest: list[np.ndarray] = []
            for polygon in inside:
                side = sign * (polygon[:, axis] - limit)
                if (outer := _clipped(polygon, -side)) is not None:
                    found.append(_fan(outer))
                if (inner := _clipped(polygon, side)) is not None:
                    rest.append(inner)
            inside = rest
    return np.concatenate(found)


def _clipped(polygon: np.ndarray, side: np.ndarray) -> np.ndarray | None:
    """The part of a polygon [n,3] where `side` [n] is positive; None: nothing."""
    if (side <= 1e-9).all():
        return None
    points = []
    for k in range(len(polygon)):
        after = (k + 1) % len(polygon)
        if side[k] >= 0:
            points.append(polygon[k])
        if (side[k] >= 0) != (side[after] >= 0):
            share = side[k] / (side[k] - side[after])
            points.append(polygon[k] + share * (polygon[after] - polygon[k]))
    return np.array(points) if len(points) >= 3 else None


def _fan(polygon: np.ndarray) -> np.ndarray:
    return np.stack([polygon[[0, k, k + 1]] for k in range(1, len(polygon) - 1)])


def room_kind(types: Sequence[str]) -> list[str]:
    """Types of a room in House3D's names, each once; a toilet is a bathroom."""
    found = [text.strip().lower().replace(' ', '_') for text in types]
    return list(dict.fromkeys(SAME_TYPE.get(kind, kind) for kind in found if kind))


def rooms_of(pieces: Sequence[Piece], level: Level, targets: str, scale: float
             ) -> tuple[Room, ...]:
    """The rooms of a level, by their floors; where there is none, by their bounding boxes.

    A room that is no rectangle, or has several types, is several ones of one name. Rooms that
    nobody is sent to have the kind ''.
    """
    if targets not in ('house3d', 'all'):
        raise UserError('targets are house3d or all', targets, 'choose one of them')
    found: list[Room] = []
    seen: dict[str, int] = {}
    for node in level.nodes:
        if node.type != 'Room':
            continue
        kinds = room_kind(node.room_types)
        called = ' and '.join(kinds).replace('_', ' ') or 'room'
        seen[called] = seen.get(called, 0) + 1
        name = called + (f' {seen[called]}' if seen[called] > 1 else '')
        floors = [piece.corners for piece in pieces
                  if piece.role == 'floor' and piece.node is node]
        if floors and len(up := _facing_up(np.concatenate(floors))):
            rects = floor_rectangles(up)
        else:
            low, high = box_to_map(node.low * scale, node.high * scale)
            rects = [Rect(float(low[0]), float(low[1]), float(high[0]), float(high[1]))]
        wanted = [kind for kind in kinds if targets == 'all' or kind in TARGETS] or ['']
        found += [Room(name, kind, rect) for kind in wanted for rect in rects]
    return tuple(found)


def floor_rectangles(corners: np.ndarray) -> list[Rect]:
    """Rectangles over the plan of a floor's triangles [T,3,3], to half a cell; its rim exactly."""
    low, high = corners[:, :, :2].min(axis=(0, 1)), corners[:, :, :2].max(axis=(0, 1))
    columns, rows = np.maximum(np.ceil((high - low) / CELL - 1e-6).astype(int), 1)
    mask = np.zeros((rows, columns), bool)
    mesh_raster.supported(corners, np.ones(len(corners), bool), low[0], low[1], CELL, -np.inf,
                          np.inf, mask)
    found = []
    for x0, y0, x1, y1 in rectangles_of_cells(mask, low):
        least = [edge if start - edge < CELL else start
                 for start, edge in zip((x0, y0), low, strict=True)]
        most = [edge if edge - end < CELL else end
                for end, edge in zip((x1, y1), high, strict=True)]
        found.append(Rect(*map(float, (*least, *most))))
    return found


def _facing_up(corners: np.ndarray) -> np.ndarray:
    return corners[facing_up(corners)]
