"""Our houses in SUNCG's format, in both layouts: for tests, and for other programs.

A house becomes `house/<id>/house.json` with rooms, objects, materials and transforms, and the
files that it names; `ModelCategoryMapping.csv` and `colormap_coarse.csv` hold the classes of all
houses in the folder. `converted` writes House3D's one `house.obj` a house, too. Baked light is
left out: the format has none.
"""

from __future__ import annotations

import colorsys
import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TextIO

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.mesh_export import texture_picture, triangles_of_faces
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.suncg.axes import to_suncg
from vn_sim_bridge.suncg.labels import FILE
from vn_sim_bridge.suncg.place import CARPET, ROBOT_HEIGHT

COLOURS = 'colormap_coarse.csv'
STRUCTURE = {'floor': 'f', 'ceiling': 'c', 'wall': 'w'}
GROUPS = {'f': 'Floor', 'c': 'Ceiling', 'w': 'WallInside'}
# Of our classes: SUNCG's coarse class and that of NYU's 40. The fine class is ours.
CLASSES = {
    'wall': ('wall', 'wall'), 'floor': ('floor', 'floor'), 'ceiling': ('ceiling', 'ceiling'),
    'door': ('door', 'door'), 'window': ('window', 'window'),
    'picture': ('picture_frame', 'picture'), 'rug': ('rug', 'floor_mat'), 'bed': ('bed', 'bed'),
    'nightstand': ('stand', 'night_stand'), 'wardrobe': ('wardrobe_cabinet', 'cabinet'),
    'desk': ('desk', 'desk'), 'chair': ('chair', 'chair'), 'table': ('table', 'table'),
    'sofa': ('sofa', 'sofa'), 'armchair': ('sofa', 'sofa'), 'tv': ('television', 'television'),
    'tv_stand': ('tv_stand', 'otherfurniture'), 'bookshelf': ('shelving', 'bookshelf'),
    'counter': ('kitchen_cabinet', 'counter'), 'fridge': ('kitchen_appliance', 'refridgerator'),
    'stove': ('kitchen_appliance', 'otherfurniture'), 'sink': ('sink', 'sink'),
    'toilet': ('toilet', 'toilet'), 'bathtub': ('bathtub', 'bathtub'),
    'washbasin': ('bathroom_stuff', 'sink'), 'plant': ('plant', 'otherprop'),
    'lamp': ('indoor_lamp', 'lamp'), 'cabinet': ('kitchen_cabinet', 'cabinet'),
    'stool': ('chair', 'chair'), 'mirror': ('mirror', 'mirror'),
    'bin': ('trash_can', 'otherprop'), 'coffee_table': ('table', 'table'),
    'washing_machine': ('household_appliance', 'otherprop'), 'box': ('decoration', 'box'),
    'piano': ('music', 'otherfurniture'), 'dresser': ('dresser', 'dresser'),
    'shower': ('shower', 'shower_curtain'), 'coat_rack': ('hanger', 'otherprop'),
    'bench': ('bench_chair', 'chair'), 'aquarium': ('pet', 'otherprop'),
    'radiator': ('heater', 'otherstructure'), 'clock': ('clock', 'otherprop'),
    'fireplace': ('fireplace', 'otherstructure'), 'microwave': ('kitchen_appliance', 'otherprop'),
    'whiteboard': ('whiteboard', 'whiteboard'), 'ottoman': ('ottoman', 'chair'),
}
OTHER = ('unknown', 'otherprop')
ROOM_TYPES = {'kitchen': 'Kitchen', 'dining_room': 'Dining_Room', 'living_room': 'Living_Room',
              'bathroom': 'Toilet', 'bedroom': 'Bedroom', 'office': 'Office', 'hall': 'Hall'}


class _Look(NamedTuple):
    """A material: texture of the scene and colour."""

    texture: int
    colour: tuple[float, float, float]


class _Mesh(NamedTuple):
    """Triangles of one material, y up."""

    look: _Look
    points: np.ndarray  # [V,3] m
    uv: np.ndarray  # [V,2], v upwards
    triangles: np.ndarray  # [T,3]


class _Thing(NamedTuple):
    """A node of house.json with its meshes in the house's axes."""

    node: dict
    meshes: dict[str, list[_Mesh]]  # by 'f', 'c', 'w', or '' of an object


def export_suncg(house: House, folder: str | Path, house_id: str = '', *,
                 converted: bool = False) -> str:
    """Write a house; other houses in the folder stay.

    Args:
        house: of this package.
        folder: the data set's.
        house_id: its name there; default: of its scene ('house_7').
        converted: also write House3D's house.obj.

    Returns:
        The name.

    Raises:
        UserError: files that cannot be written.
    """
    folder = Path(folder)
    house_id = house_id or house.name.partition('?')[0].replace(':', '_') + (
        f'_{len(house.rooms)}' if '?' in house.name else '')
    things = _things(house, house_id)
    try:
        for name in ('house', 'room', 'object', 'texture'):
            (folder / name).mkdir(parents=True, exist_ok=True)
        _write_textures(house.scene, things, folder / 'texture')
        for thing in things:
            _write_models(thing, folder, house_id)
        own = folder / 'house' / house_id
        own.mkdir(exist_ok=True)
        nodes = [thing.node for thing in things]
        everything = [mesh for thing in things for meshes in thing.meshes.values()
                      for mesh in meshes]
        (own / 'house.json').write_text(json.dumps({
            'version': 'suncg@1.0.0', 'id': house_id, 'up': [0, 1, 0], 'front': [0, 0, 1],
            'scaleToMeters': 1, 'levels': [{'id': '0', 'bbox': _bounds(everything),
                                            'nodes': nodes}],
            'bbox': _bounds(everything)}, indent=1))
        _merge_csv(folder / FILE, (
            'index', 'model_id', 'fine_grained_class', 'coarse_grained_class',
            'empty_struct_obj', 'nyuv2_40class', 'wnsynsetid', 'wnsynsetkey'), 'model_id',
            _categories(things))
        _merge_csv(folder / COLOURS, ('name', 'r', 'g', 'b'), 'name', _colours())
        if converted:
            _write_converted(things, own)
    except OSError as error:
        raise UserError('the files of a house can be written', f'{folder}: {error}',
                        'choose another folder') from error
    return house_id


def _things(house: House, house_id: str) -> list[_Thing]:
    """Rooms, and objects by instance and class."""
    scene = house.scene
    rooms: dict[int, dict[str, list[int]]] = {k: {} for k in range(len(house.rooms))}
    objects: dict[tuple[int, int], list[int]] = {}
    face_room = np.repeat(scene.group_room, np.diff(scene.group_start))
    for face in range(len(scene.face_label)):
        letter = STRUCTURE.get(LABELS[scene.face_label[face]])
        if letter:
            rooms[int(face_room[face])].setdefault(letter, []).append(face)
        else:
            key = int(scene.face_instance[face]), int(scene.face_label[face])
            objects.setdefault(key, []).append(face)
    things = []
    for k, room in enumerate(house.rooms):
        meshes = {letter: _meshes(scene, faces) for letter, faces in rooms[k].items()}
        node = {'id': f'0_{k}', 'type': 'Room', 'valid': 1, 'modelId': f'fr_0rm_{k}',
                'roomTypes': [ROOM_TYPES[room.kind]],
                'nodeIndices': [], 'hideCeiling': 0, 'hideFloor': 0, 'hideWalls': 0,
                'bbox': _bounds([mesh for own in meshes.values() for mesh in own])}
        things.append(_Thing(node, meshes))
    meshes_of = {key: _meshes(scene, faces) for key, faces in objects.items()}
    footprints = _footprints(house, {key: _bounds(own) for key, own in meshes_of.items()})
    for (instance, label), own in meshes_of.items():
        box = _bounds(own)
        node = {'id': f'0_{len(things)}', 'type': 'Object', 'valid': 1,
                'modelId': f'{house_id}_{instance}_{LABELS[label]}', 'state': 0,
                'bbox': footprints[instance, label]}
        middle = np.mean([box['min'], box['max']], axis=0)
        middle[1] = box['min'][1]
        turn = _turn(instance)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, middle
        node['transform'] = matrix.T.reshape(-1).tolist()  # column by column
        node['materials'] = [{'name': f'm_{k}', 'diffuse': _hex(mesh.look.colour),
                              'texture': _texture_name(mesh.look.texture)}
                             for k, mesh in enumerate(own)]
        x, z = middle[0], -middle[2]
        things[house.room_index(float(x), float(z))].node['nodeIndices'].append(len(things))
        things.append(_Thing(node, {'': own}))
    return things


def _footprints(house: House, boxes: dict[tuple[int, int], dict]) -> dict[tuple[int, int], dict]:
    """Bounding boxes of objects; seen from above they are what the house's own map takes.

    That leaves out a mantelpiece, and has the floor in front of a desk. Of a piece with several
    classes (a table with its chairs) the largest object gets the whole piece's rectangle.

    Args:
        house: with its obstacles.
        boxes: of the triangles, by instance and class.
    """
    pieces: dict[int, list[tuple[int, int]]] = {}
    for key, box in boxes.items():
        if box['min'][1] > ROBOT_HEIGHT or box['max'][1] < CARPET:
            continue  # a rug, or a lamp at the ceiling
        pieces.setdefault(key[0], []).append(key)
    plans = {instance: np.array([_plan(boxes[key]) for key in keys])
             for instance, keys in pieces.items()}
    whole = {instance: np.array([*plan[:, :2].min(axis=0), *plan[:, 2:].max(axis=0)])
             for instance, plan in plans.items()}
    found = dict(boxes)
    for obstacle in house.obstacles:
        if obstacle.label in ('wall', 'outside'):
            continue
        rect = np.array(obstacle.rect)
        best = max(whole, key=lambda instance: _overlap(whole[instance], rect))
        sizes = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in plans[best]]
        key = pieces[best][int(np.argmax(sizes))]
        x0, y0, x1, y1 = map(float, rect)
        found[key] = {'min': [x0, boxes[key]['min'][1], -y1],
                      'max': [x1, boxes[key]['max'][1], -y0]}
    return found


def _plan(box: dict) -> tuple[float, float, float, float]:
    return box['min'][0], -box['max'][2], box['max'][0], -box['min'][2]


def _overlap(one: np.ndarray, two: np.ndarray) -> float:
    """Shared area of two rectangles over the area of both."""
    sides = np.minimum(one[2:], two[2:]) - np.maximum(one[:2], two[:2])
    shared = float(np.prod(np.maximum(sides, 0)))
    return shared / max(float(np.prod(one[2:] - one[:2]) + np.prod(two[2:] - two[:2])) - shared,
                        1e-9)


def _turn(instance: int) -> np.ndarray:
    """[3,3] a quarter turn or more about y: models do not all face as they stand."""
    angle = math.pi / 2 * (instance % 4)
    c, s = round(math.cos(angle)), round(math.sin(angle))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], float)


def _meshes(scene: Scene, faces: Iterable[int]) -> list[_Mesh]:
    by_look: dict[_Look, list[int]] = {}
    for face in faces:
        # Colours are written with 8 bits: as many as the format has.
        red, green, blue = (round(float(value) * 255) / 255 for value in scene.face_colour[face])
        look = _Look(int(scene.face_texture[face]), (red, green, blue))
        by_look.setdefault(look, []).append(face)
    found = []
    for look, own in by_look.items():
        points, uv, triangles = triangles_of_faces(scene, own)
        found.append(_Mesh(look, to_suncg(points), np.stack([uv[:, 0], 1 - uv[:, 1]], 1),
                           triangles))
    return found


def _bounds(meshes: Sequence[_Mesh]) -> dict:
    points = np.concatenate([mesh.points for mesh in meshes])
    return {'min': points.min(axis=0).tolist(), 'max': points.max(axis=0).tolist()}


def _hex(colour: Sequence[float]) -> str:
    return '#' + ''.join(f'{round(value * 255):02x}' for value in colour)


def _texture_name(number: int) -> str:
    return f'vn_nav_{number}'


def _write_textures(scene: Scene, things: Sequence[_Thing], folder: Path) -> None:
    used = {mesh.look.texture for thing in things for meshes in thing.meshes.values()
            for mesh in meshes}
    for number in sorted(used):
        path = folder / f'{_texture_name(number)}.png'
        rgb = texture_picture(scene.textures, number)
        if not cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)):
            raise OSError(f'{path} cannot be written')


def _write_models(thing: _Thing, folder: Path, house_id: str) -> None:
    node = thing.node
    for letter, meshes in thing.meshes.items():
        if letter:
            (folder / 'room' / house_id).mkdir(exist_ok=True)
            path = folder / 'room' / house_id / f'{node["modelId"]}{letter}.obj'
        else:
            (folder / 'object' / node['modelId']).mkdir(exist_ok=True)
            path = folder / 'object' / node['modelId'] / f'{node["modelId"]}.obj'
            matrix = np.array(node['transform']).reshape(4, 4).T
            back = np.linalg.inv(matrix)
            meshes = [mesh._replace(points=mesh.points @ back[:3, :3].T + back[:3, 3])
                      for mesh in meshes]
        with open(path, 'w') as out:
            out.write(f'mtllib {path.with_suffix(".mtl").name}\n')
            _write_meshes(out, node['modelId'], meshes, [f'm_{k}' for k in range(len(meshes))],
                          (1, 1))
        with open(path.with_suffix('.mtl'), 'w') as out:
            for k, mesh in enumerate(meshes):
                # An object's own look stands in house.json: its model is grey.
                plain = mesh.look._replace(colour=(0.5, 0.5, 0.5)) if not letter else mesh.look
                _write_material(out, f'm_{k}', plain, '../../texture')


def _write_meshes(out: TextIO, group: str, meshes: Sequence[_Mesh], materials: Sequence[str],
                  first: tuple[int, int]) -> tuple[int, int]:
    vertex, coordinate = first
    out.write(f'g {group}\n')
    for mesh, material in zip(meshes, materials, strict=True):
        out.writelines(f'v {x:.7f} {y:.7f} {z:.7f}\n' for x, y, z in mesh.points)
        out.writelines(f'vt {u:.7f} {v:.7f}\n' for u, v in mesh.uv)
        out.write(f'usemtl {material}\n')
        for row in mesh.triangles:
            out.write('f ' + ' '.join(f'{vertex + k}/{coordinate + k}' for k in row) + '\n')
        vertex += len(mesh.points)
        coordinate += len(mesh.uv)
    return vertex, coordinate


def _write_material(out: TextIO, name: str, look: _Look, textures: str) -> None:
    red, green, blue = look.colour
    out.write(f'newmtl {name}\nKd {red:.6f} {green:.6f} {blue:.6f}\n'
              f'map_Kd {textures}/{_texture_name(look.texture)}.png\n')


def _write_converted(things: Sequence[_Thing], folder: Path) -> None:
    """House3D's house.obj and house.mtl."""
    first, number = (1, 1), 0
    with open(folder / 'house.obj', 'w') as out, open(folder / 'house.mtl', 'w') as library:
        out.write('mtllib house.mtl\n')
        for thing in things:
            for letter, meshes in thing.meshes.items():
                group = (f'{GROUPS[letter]}#{thing.node["id"]}' if letter
                         else f'Model#{thing.node["modelId"]}')
                names = [f'm{number + k}' for k in range(len(meshes))]
                for name, mesh in zip(names, meshes, strict=True):
                    _write_material(library, name, mesh.look, '../../texture')
                number += len(meshes)
                first = _write_meshes(out, group, meshes, names, first)


def _categories(things: Sequence[_Thing]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for name in STRUCTURE:
        rows.append({'model_id': name.capitalize(), 'fine_grained_class': name,
                     'coarse_grained_class': name, 'empty_struct_obj': 1, 'nyuv2_40class': name})
    for thing in things:
        if thing.node['type'] == 'Object':
            model = thing.node['modelId']
            label = next(name for name in sorted(LABELS, key=len, reverse=True)
                         if model.endswith(f'_{name}'))
            coarse, nyu40 = CLASSES.get(label, OTHER)
            rows.append({'model_id': model, 'fine_grained_class': label,
                         'coarse_grained_class': coarse, 'empty_struct_obj': 2,
                         'nyuv2_40class': nyu40})
    return rows


def _colours() -> list[dict[str, object]]:
    names = sorted({coarse for coarse, _ in (*CLASSES.values(), OTHER)}) + ['Ground', 'Box']
    rows: list[dict[str, object]] = []
    for k, name in enumerate(names):
        colour = colorsys.hsv_to_rgb(k * 0.618034 % 1, 0.5 + 0.5 * (k % 2), 1 - 0.2 * (k % 3))
        rows.append({'name': name, **{letter: round(255 * value) for letter, value
                                      in zip('rgb', colour, strict=True)}})
    return rows


def _merge_csv(path: Path, columns: Sequence[str], key: str,
               rows: Sequence[dict[str, object]]) -> None:
    """Write rows into a file beside those of other houses."""
    kept: dict[str, dict] = {}
    if path.is_file():
        with open(path, newline='') as file:
            kept = {row[key]: row for row in csv.DictReader(file)}
    kept |= {str(row[key]): row for row in rows}
    with open(path, 'w', newline='') as file:
        writer = csv.DictWriter(file, columns, restval='', extrasaction='ignore')
        writer.writeheader()
        for index, row in enumerate(kept.values()):
            writer.writerow({**row, **({'index': index} if 'index' in columns else {})})
