"""A ProcTHOR house as surfaces and rooms: walls with holes cut out, boxes or meshes for objects.

Unity's frame becomes the map's by `thor.frame`, as in the simulator `thor`: one house, one map.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh import read_parts
from vn_sim_bridge.houses.mesh_export import texture_picture
from vn_sim_bridge.houses.polygons import triangles_of
from vn_sim_bridge.houses.textures import TEXTURES, texture_library
from vn_sim_bridge.meshes.parts import surfaces_of
from vn_sim_bridge.meshes.place import RoomOutline
from vn_sim_bridge.meshes.thor_sizes import SIZES, UNKNOWN
from vn_sim_bridge.meshes.vocabulary import OTHER, Vocabulary, class_name
from vn_sim_bridge.notices import say_once
from vn_sim_bridge.render.mesh_scene import Surface
from vn_sim_bridge.thor.frame import TO_MAP, points_to_ours

# Files of meshes are right-handed (glTF): their x is Unity's -x.
FROM_FILE = np.diag([-1.0, 1.0, 1.0])
EDGE = 1e-3  # m: nearer points are one
JAMB, JAMB_DEPTH = 0.04, 0.12  # m, of a door's frame
ENDINGS = ('.glb', '.gltf', '.obj')
OUTSIDE_ROOM = 'exterior'
# Our textures for the words in a material's name; the last one is for all others.
FLOORS = (('wood', 'planks'), ('tile', 'tiles'), ('carpet', 'carpet'), ('brick', 'brick'),
          ('marble', 'marble'), ('concrete', 'concrete'), ('', 'parquet'))
WALLS = (('brick', 'brick'), ('tile', 'tiles'), ('', 'plaster'))


class Hole(NamedTuple):
    """A rectangle in a wall: metres along it from its first point, and heights."""

    start: float
    end: float
    low: float
    high: float
    kind: str  # 'door' or 'window'
    shut: bool


class Wall(NamedTuple):
    """A wall over a line of the floor."""

    name: str
    first: np.ndarray  # [2] m in the map
    along: np.ndarray  # [2] unit vector
    length: float
    low: float
    high: float
    room: str
    colour: np.ndarray
    texture: str


class HouseSurfaces(NamedTuple):
    """What a house is made of."""

    surfaces: list[Surface]
    rooms: list[RoomOutline]


def house_categories(house: dict) -> Counter[str]:
    """How often each type of object occurs."""
    return Counter(_type(entry) for entry in _all(house.get('objects') or ()))


def house_surfaces(house: dict, vocabulary: Vocabulary, name: str, *,
                   boxes: dict[str, tuple[float, float, float]], meshes: Path | None,
                   doors_as_given: bool) -> HouseSurfaces:
    """The surfaces and rooms of a house.

    Args:
        house: its JSON.
        vocabulary: of the simulator.
        name: for errors.
        boxes: sizes x, y, z [m] by the asset's id.
        meshes: a folder with files called as assets; None: boxes alone.
        doors_as_given: shut doors are shut; else every door is a hole.

    Raises:
        UserError: a house that does not follow ProcTHOR's form.
    """
    try:
        return _house(house, vocabulary, name, boxes, meshes, doors_as_given)
    except UserError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        fault = f'{error} is missing' if isinstance(error, KeyError) else str(error)
        raise UserError('a house has rooms, walls, doors, windows and objects in the form of '
                        'ProcTHOR', f'{name}: {fault}', 'take a house of ProcTHOR-10K, or one '
                        'that procthor has made') from error


def _house(house, vocabulary, name, boxes, meshes, doors_as_given) -> HouseSurfaces:
    polygons = {str(room['id']): _flat(room['floorPolygon']) for room in house['rooms']}
    if not polygons:
        raise UserError('a house has rooms', name, 'choose another house')
    walls = [wall for entry in house['walls'] if not entry.get('empty')
             for wall in [_wall(entry)] if wall.length > EDGE]
    ceiling = max((wall.high for wall in walls), default=2.5)
    surfaces, instance = [], 1
    for room in house['rooms']:
        polygon = polygons[str(room['id'])]
        material = room.get('floorMaterial')
        for label, z, up, texture, colour in (
                ('floor', 0.0, True, _texture(material, FLOORS), _colour(material)),
                ('ceiling', ceiling, False, 'plain', np.full(3, 0.95))):
            surfaces.append(_textured(_polygon(polygon, z, up), texture, colour,
                                      vocabulary.id(label), instance))
            instance += 1
    holes = _holes(house, {wall.name: wall for wall in walls}, doors_as_given)
    for wall in walls:
        seen = [_as_seen_by(wall, *hole) for hole in holes]
        own = [hole for hole in seen if hole is not None]
        towards = _inner_side(wall, polygons)
        quads = list(_cut(wall, own, towards))
        surfaces.append(_textured(np.concatenate(quads), wall.texture, wall.colour,
                                  vocabulary.id('wall'), instance) if quads else _nothing())
        instance += 1
        for hole in own:
            surfaces += _filling(wall, hole, towards, vocabulary, instance)
            instance += 1
    surfaces += _objects(house, vocabulary, boxes, meshes, name, instance)
    return HouseSurfaces([surface for surface in surfaces if len(surface.corners)],
                         _rooms(house, polygons))


def _rooms(house: dict, polygons: dict[str, np.ndarray]) -> list[RoomOutline]:
    """Rooms with names of their own."""
    seen: Counter[str] = Counter()
    found = []
    for room in house['rooms']:
        kind = class_name(str(room.get('roomType', 'room')))
        seen[kind] += 1
        called = kind.replace('_', ' ') + (f' {seen[kind]}' if seen[kind] > 1 else '')
        found.append(RoomOutline(called, kind, [polygons[str(room['id'])]]))
    return found


def _flat(points: list[dict]) -> np.ndarray:
    """A polygon [n,2] of the floor in the map, without points twice."""
    found = points_to_ours([(point['x'], 0.0, point['z']) for point in points])[:, :2]
    keep = np.linalg.norm(found - np.roll(found, 1, axis=0), axis=1) > EDGE
    if keep.sum() < 3:
        raise ValueError('a floorPolygon has fewer than three corners')
    return found[keep]


def _polygon(polygon: np.ndarray, z: float, up: bool) -> np.ndarray:
    """Triangles [T,3,3] of a polygon at a height."""
    x, y = polygon.T
    area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    ordered = polygon if (area > 0) == up else polygon[::-1]
    points = np.column_stack([ordered, np.full(len(ordered), z)])
    return points[triangles_of(np.array([len(points)]), points)]


def _wall(entry: dict) -> Wall:
    points = points_to_ours([(point['x'], point['y'], point['z']) for point in entry['polygon']])
    first = points[0, :2]
    gaps = np.linalg.norm(points[:, :2] - first, axis=1)
    far = int(np.argmax(gaps > EDGE)) if (gaps > EDGE).any() else 0
    step = points[far, :2] - first
    length = float(np.linalg.norm(step))
    material = entry.get('material')
    return Wall(str(entry['id']), first, step / max(length, EDGE), length,
                float(points[:, 2].min()), float(points[:, 2].max()), str(entry.get('roomId', '')),
                _colour(material), _texture(material, WALLS))


def _holes(house: dict, walls: dict[str, Wall], doors_as_given: bool
           ) -> list[tuple[np.ndarray, np.ndarray, Hole]]:
    """Holes, each with the first point and direction of the wall that it is measured along."""
    found = []
    for kind in ('door', 'window'):
        for entry in house.get(f'{kind}s') or ():
            wall = walls.get(str(entry.get('wall0'))) or walls.get(str(entry.get('wall1')))
            if wall is None:
                continue  # the room is open there
            if entry.get('holePolygon'):
                ends = entry['holePolygon'][:2]
            else:
                ends = [entry['boundingBox']['min'], entry['boundingBox']['max']]
            (a, low), (b, high) = sorted((float(end['x']), float(end['y'])) for end in ends)
            shut = (doors_as_given and kind == 'door' and bool(entry.get('openable'))
                    and float(entry.get('openness', 0.0)) <= 0)
            found.append((wall.first, wall.along, Hole(
                a, b, wall.low + min(low, high), wall.low + max(low, high), kind, shut)))
    return found


def _as_seen_by(wall: Wall, first: np.ndarray, along: np.ndarray, hole: Hole) -> Hole | None:
    """A hole in metres along this wall; None: it is in another one."""
    ends = []
    for share in (hole.start, hole.end):
        gap = first + share * along - wall.first
        beside = abs(gap[0] * wall.along[1] - gap[1] * wall.along[0])
        if beside > 0.05:
            return None
        ends.append(float(gap @ wall.along))
    start, end = max(min(ends), 0.0), min(max(ends), wall.length)
    high = min(hole.high, wall.high)
    if end - start < EDGE or high - hole.low < EDGE:
        return None
    return hole._replace(start=start, end=end, high=high)


def _inner_side(wall: Wall, polygons: dict[str, np.ndarray]) -> np.ndarray:
    """The normal [2] of the side that its room sees; of an outer wall the one away from rooms."""
    normal = np.array([-wall.along[1], wall.along[0]])
    point = wall.first + 0.5 * wall.length * wall.along + 0.05 * normal
    own = polygons.get(wall.room)
    if own is not None:
        return normal if _inside(own, point) else -normal
    return -normal if any(_inside(other, point) for other in polygons.values()) else normal


def _inside(polygon: np.ndarray, point: np.ndarray) -> bool:
    return cv2.pointPolygonTest(polygon.astype(np.float32), point.tolist(), False) >= 0


def _cut(wall: Wall, holes: list[Hole], towards: np.ndarray) -> Iterator[np.ndarray]:
    """Triangles of a wall around its holes."""
    stops = sorted({0.0, wall.length, *(value for hole in holes for value in (
        hole.start, hole.end))})
    for start, end in zip(stops[:-1], stops[1:], strict=True):
        if end - start < EDGE:
            continue
        middle, low = 0.5 * (start + end), wall.low
        for hole in sorted((h for h in holes if h.start < middle < h.end), key=lambda h: h.low):
            if hole.low - low > EDGE:
                yield _quad(wall, start, end, low, hole.low, towards)
            low = max(low, hole.high)
        if wall.high - low > EDGE:
            yield _quad(wall, start, end, low, wall.high, towards)


def _quad(wall: Wall, start: float, end: float, low: float, high: float, towards: np.ndarray
          ) -> np.ndarray:
    """Two triangles of a wall that face a side."""
    a, b = (wall.first + share * wall.along for share in (start, end))
    if wall.along[1] * towards[0] - wall.along[0] * towards[1] < 0:
        a, b = b, a
    corners = np.array([(*a, low), (*b, low), (*b, high), (*a, high)])
    return corners[[[0, 1, 2], [0, 2, 3]]]


def _filling(wall: Wall, hole: Hole, towards: np.ndarray, vocabulary: Vocabulary,
             instance: int) -> list[Surface]:
    """A window's pane, or a door's frame, and its leaf if it is shut."""
    pane = _quad(wall, hole.start, hole.end, hole.low, hole.high, towards)
    if hole.kind == 'window':
        return [Surface(pane, None, np.array([0.75, 0.86, 0.95]), None, vocabulary.id('window'),
                        instance)]
    label, wood = vocabulary.id('door'), np.array([0.55, 0.4, 0.27])
    frame = [_post(wall, start, start + JAMB, hole.low, hole.high)
             for start in (hole.start, hole.end - JAMB)]
    frame.append(_post(wall, hole.start, hole.end, hole.high - JAMB, hole.high))
    found = [Surface(np.concatenate(frame), None, wood, None, label, instance)]
    if hole.shut:
        found.append(Surface(_post(wall, hole.start, hole.end, hole.low, hole.high, 0.04), None,
                             0.8 * wood, None, label, instance))
    return found


def _post(wall: Wall, start: float, end: float, low: float, high: float,
          depth: float = JAMB_DEPTH) -> np.ndarray:
    """The triangles of a box in a wall."""
    matrix = np.eye(4)
    across = np.array([-wall.along[1], wall.along[0]])
    matrix[:2, 0], matrix[:2, 1] = (end - start) / 2 * wall.along, depth / 2 * across
    matrix[2, 2] = (high - low) / 2
    matrix[:2, 3] = wall.first + (start + end) / 2 * wall.along
    matrix[2, 3] = (low + high) / 2
    return CUBE @ matrix[:3, :3].T + matrix[:3, 3]


def _cube() -> np.ndarray:
    """Triangles [12,3,3] of the cube from -1 to 1, seen from outside."""
    found = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            corners = np.array([sign * np.eye(3)[axis] + a * u + sign * b * v
                                for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            found += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return np.array(found)


CUBE = _cube()


def _objects(house: dict, vocabulary: Vocabulary, boxes: dict, meshes: Path | None, name: str,
             instance: int) -> list[Surface]:
    """Meshes where there are some, else boxes; a line says how many of each."""
    surfaces: list[Surface] = []
    drawn: Counter[bool] = Counter()
    guessed = 0
    for number, entry in enumerate(_all(house.get('objects') or ()), instance):
        label = vocabulary.id(_type(entry))
        if label == vocabulary.id(OTHER):
            label = vocabulary.id(str(entry.get('assetId', '')).split('_')[0])
        position = np.array([float(entry['position'][axis]) for axis in 'xyz'])
        turn = rotation(entry.get('rotation') or {})
        asset = str(entry.get('assetId', ''))
        path = None if meshes is None else next(
            (meshes / f'{asset}{ending}' for ending in ENDINGS
             if (meshes / f'{asset}{ending}').is_file()), None)
        drawn[path is not None] += 1
        matrix = np.eye(4)
        if path is not None:
            parts = read_parts(path)
            points = np.concatenate([part.corners for part in parts]) @ FROM_FILE.T
            middle = (points.min(axis=(0, 1)) + points.max(axis=(0, 1))) / 2
            matrix[:3, :3] = TO_MAP @ turn @ FROM_FILE
            matrix[:3, 3] = TO_MAP @ (position - turn @ middle)
            surfaces += surfaces_of(parts, matrix, [label] * len(parts), [number] * len(parts))
            continue
        guessed += asset not in boxes
        size = np.array(boxes.get(asset, SIZES.get(_type(entry), UNKNOWN)))
        corners = (CUBE * (size / 2)) @ (TO_MAP @ turn).T + TO_MAP @ position
        surfaces.append(Surface(corners[:, ::-1], None, _tint(_type(entry)), None, label, number))
    if drawn[False]:
        say_once(f'{name}: {drawn[False]} of {sum(drawn.values())} objects are labelled boxes, '
                 f'{guessed} of them of the usual size of their type: AI2-THOR has no meshes to '
                 'read here (options meshes=FOLDER, assets=FILE)')
    return surfaces


def rotation(angles: dict[str, Any]) -> np.ndarray:
    """[3,3] of Unity's angles [deg] in Unity's axes: about z, then x, then y."""
    x, y, z = (math.radians(float(angles.get(axis, 0.0))) for axis in 'xyz')
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in (x, y, z))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def _all(objects) -> Iterator[dict]:
    """Objects, and what stands on them."""
    for entry in objects:
        yield entry
        yield from _all(entry.get('children') or ())


def _type(entry: dict) -> str:
    """An object's type: 'Bed' of 'Bed|2|0'."""
    return str(entry.get('objectType') or str(entry.get('id', '')).split('|')[0])


@functools.lru_cache(4096)
def _tint(kind: str) -> np.ndarray:
    """A colour of a type, the same in every house."""
    rng = np.random.default_rng(list(kind.encode()))
    found = 0.25 + 0.65 * rng.random(3)
    found.setflags(write=False)  # it is shared
    return found


def _colour(material: Any) -> np.ndarray:
    """The colour of a material [3]: its own, else one by its name."""
    if isinstance(material, dict):
        own = material.get('color') or {}
        if {'r', 'g', 'b'} <= own.keys():
            return np.clip([float(own[key]) for key in 'rgb'], 0.0, 1.0)
    return 0.55 + 0.45 * _tint(_name(material))


def _name(material: Any) -> str:
    return str(material.get('name', '')) if isinstance(material, dict) else str(material or '')


def _texture(material: Any, table: tuple[tuple[str, str], ...]) -> str:
    """One of our textures for a material."""
    return next(texture for word, texture in table if word in _name(material).lower())


def _textured(corners: np.ndarray, texture: str, colour: np.ndarray, label: int, instance: int
              ) -> Surface:
    """Triangles with one of our textures, which covers a metre."""
    if not len(corners):
        return _nothing()
    normal = np.abs(np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0]))
    if normal[2] >= normal[:2].max():
        uv = corners[..., :2]
    else:
        along = corners[..., 0] if normal[1] > normal[0] else corners[..., 1]
        uv = np.stack([along, -corners[..., 2]], axis=-1)
    return Surface(corners, uv, colour, _picture(texture), label, instance)


_PICTURES: dict[str, np.ndarray] = {}  # one object for each: scenes tell textures apart by it


def _picture(name: str) -> np.ndarray:
    if name not in _PICTURES:
        _PICTURES[name] = texture_picture(texture_library(), TEXTURES[name])
    return _PICTURES[name]


def _nothing() -> Surface:
    return Surface(np.zeros((0, 3, 3)), None, np.ones(3), None, 0, 0)
