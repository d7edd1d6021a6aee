"""SUNCG-format houses for tests, written by hand: two rooms with a wall, a door and a chest."""

import json
from pathlib import Path

from vn_sim_bridge.suncg.labels import FILE

HEAD = ('index,model_id,fine_grained_class,coarse_grained_class,empty_struct_obj,nyuv2_40class,'
        'wnsynsetid,wnsynsetkey\n')
CLASSES = (('Wall', 'wall', 'wall', 'wall'), ('chest', 'chest', 'storage_bench', 'cabinet'),
           ('gate', 'door', 'door', 'door'), ('pane', 'window', 'window', 'window'),
           ('toilet', 'toilet', 'toilet', 'toilet'), ('man', 'man', 'person', 'person'),
           ('mat', 'rug', 'rug', 'floor_mat'), ('shelf', 'shelf', 'shelving', 'shelves'))
IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def box_obj(low, high, material=None):
    """The text of an OBJ with a cuboid, y up, its faces turned outwards."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    points = [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
    faces = ['5 7 8 6', '1 2 4 3', '3 4 8 7', '1 5 6 2', '2 6 8 4', '1 3 7 5']
    lines = [f'v {x} {y} {z}' for x, y, z in points]
    lines += ['vt 0 0', 'vt 1 0', 'vt 1 1', 'vt 0 1', 'g box']
    if material:
        lines.append(f'usemtl {material}')
    for face in faces:
        lines.append('f ' + ' '.join(f'{corner}/{k}' for k, corner in enumerate(face.split(), 1)))
    return '\n'.join(lines) + '\n'


def quads_obj(*quads):
    """The text of an OBJ with quadrilaterals, each four points."""
    lines = [f'v {x} {y} {z}' for quad in quads for x, y, z in quad]
    lines += [f'f {4 * k + 1} {4 * k + 2} {4 * k + 3} {4 * k + 4}' for k in range(len(quads))]
    return '\n'.join(lines) + '\n'


def floor_quad(x0, z0, x1, z1, y=0.0):
    """Facing up."""
    return [(x0, y, z0), (x0, y, z1), (x1, y, z1), (x1, y, z0)]


def moved(x, y, z):
    """A transform as house.json has it: column by column."""
    return [*IDENTITY[:12], x, y, z, 1]


def room(k, x0, x1, kind, y=0.0):
    """A room of 4 m between two x, and the text of its floor, ceiling and walls."""
    floor = quads_obj(floor_quad(x0, 0, x1, 4, y))
    ceiling = quads_obj(floor_quad(x0, 0, x1, 4, y + 2.5)[::-1])
    corners = [(x0, 0), (x0, 4), (x1, 4), (x1, 0)]
    walls = []
    for (ax, az), (bx, bz) in zip(corners, [*corners[1:], corners[0]], strict=True):
        walls.append([(bx, y, bz), (ax, y, az), (ax, y + 2.5, az), (bx, y + 2.5, bz)])
    node = {'id': f'0_{k}', 'type': 'Room', 'valid': 1, 'modelId': f'fr_0rm_{k}',
            'roomTypes': [kind] if kind else [],
            'bbox': {'min': [x0, y, 0], 'max': [x1, y + 2.5, 4]}}
    return node, {'f': floor, 'c': ceiling, 'w': quads_obj(*walls)}


def thing(number, model, low, high, x, z, **more):
    """A node of an object that stands at (x, 0, z); `low` and `high` are its model's corners."""
    return {'id': f'0_{number}', 'type': 'Object', 'valid': 1, 'modelId': model,
            'transform': moved(x, 0, z), 'bbox': {
                'min': [low[0] + x, low[1], low[2] + z],
                'max': [high[0] + x, high[1], high[2] + z]}} | more


CHEST = (-0.4, 0.0, -0.3), (0.4, 0.6, 0.3)
GATE = (-0.05, 0.0, -0.6), (0.05, 2.0, 0.6)


def write_house(folder, *, extra=(), models=None, changes=None, levels=None):
    """Two rooms, x from -8 to 0, a wall without a hole at x = -4 and a gate in it; chest at left.

    Args:
        folder: of the data set.
        extra: nodes of the level, beside those.
        models: texts of OBJ files by the model's name, beside chest and gate.
        changes: to nodes, by id.
        levels: instead of all of that.
    """
    folder = Path(folder)
    rooms = [room(0, -8, -4, 'Kitchen'), room(1, -4, 0, 'Guest_Room')]
    nodes = [node for node, _ in rooms] + [thing(2, 'chest', *CHEST, -6, 2),
                                           thing(3, 'gate', *GATE, -4, 2), *extra]
    for node in nodes:
        node.update((changes or {}).get(node['id'], {}))
    (folder / 'house' / 'h').mkdir(parents=True)
    (folder / 'room' / 'h').mkdir(parents=True)
    (folder / 'house' / 'h' / 'house.json').write_text(json.dumps({
        'id': 'h', 'up': [0, 1, 0], 'front': [0, 0, 1], 'scaleToMeters': 1,
        'levels': levels or [{'id': '0', 'nodes': nodes, 'bbox': {
            'min': [-8, 0, 0], 'max': [0, 2.5, 4]}}]}))
    for node, texts in rooms:
        for letter, text in texts.items():
            (folder / 'room' / 'h' / f'{node["modelId"]}{letter}.obj').write_text(text)
    for model, text in ({'chest': box_obj(*CHEST), 'gate': box_obj(*GATE)} | (
            models or {})).items():
        (folder / 'object' / model.partition('/')[0]).mkdir(parents=True, exist_ok=True)
        name = model if '/' in model else f'{model}/{model}'
        (folder / 'object' / f'{name}.obj').write_text(text)
    (folder / FILE).write_text(HEAD + ''.join(
        f'{k},{model},{fine},{coarse},2,{nyu},,\n'
        for k, (model, fine, coarse, nyu) in enumerate(CLASSES)))
    return folder
