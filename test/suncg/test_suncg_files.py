"""What SUNCG's files say: axes, nodes, classes; and what is refused."""

import json
import math

import numpy as np
import pytest
from suncg_files import CHEST, HEAD, box_obj, thing, write_house

from vn_nav.errors import UserError
from vn_sim_bridge.suncg import axes
from vn_sim_bridge.suncg.geometry import read_pieces
from vn_sim_bridge.suncg.house_json import read_house
from vn_sim_bridge.suncg.labels import FILE, NYU40, Categories, read_colours


def pieces_of(folder, level=0, labels='fine', layout='suncg'):
    house = read_house(folder / 'house' / 'h' / 'house.json')
    return read_pieces(folder, house, house.level(level), Categories(folder / FILE, labels),
                       layout)


def object_of(folder, node):
    (piece,) = [piece for piece in pieces_of(folder) if piece.node and piece.node.id == node]
    return piece


def outward(corners):
    """Whether triangles of a convex body are turned outwards."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return ((corners.mean(axis=1) - corners.mean(axis=(0, 1))) * normal).sum(axis=1) > 0


def test_axes_are_turned_and_turned_back():
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert np.allclose(axes.to_suncg(axes.to_map(points)), points)
    assert axes.to_map([1.0, 2.0, 3.0]).tolist() == [1.0, -3.0, 2.0]  # right, up, towards us
    rows = axes.to_map(np.eye(3))
    assert np.linalg.det(rows) == pytest.approx(1)  # no mirror image
    low, high = axes.box_to_map([0, 0, 1], [1, 2, 4])
    assert low.tolist() == [0, -4, 0] and high.tolist() == [1, -1, 2]
    for yaw in (-3.0, -0.4, 0.0, 1.2, 3.1):
        assert axes.yaw_to_map(axes.yaw_to_suncg(yaw)) == pytest.approx(yaw)
        degrees = math.radians(float(axes.yaw_to_suncg(yaw)))
        front = np.array([math.cos(degrees), 0, math.sin(degrees)])  # as House3D's camera has it
        assert np.allclose(axes.to_map(front), [math.cos(yaw), math.sin(yaw), 0])


def test_a_node_s_transform_is_stored_column_by_column(tmp_path):
    turned = [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, -6, 0.5, 1, 1]  # a quarter turn about y
    write_house(tmp_path, changes={'0_2': {'transform': turned}})
    corners = object_of(tmp_path, '0_2').corners
    # The chest is 0.8 m along x and 0.6 along z; turned, 0.6 and 0.8; z = 1 is our y = -1.
    assert np.allclose(corners.min(axis=(0, 1)), [-6.3, -1.4, 0.5])
    assert np.allclose(corners.max(axis=(0, 1)), [-5.7, -0.6, 1.1])
    assert outward(corners).all()


def test_a_mirrored_node_is_not_inside_out(tmp_path):
    mirror = [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -6, 0, 2, 1]
    write_house(tmp_path, changes={'0_2': {'transform': mirror, 'isMirrored': 1}})
    assert outward(object_of(tmp_path, '0_2').corners).all()


def test_an_open_door_has_another_model(tmp_path):
    write_house(tmp_path, changes={'0_3': {'state': 1}},
                models={'gate/gate_0': box_obj((0, 0, 0), (1.2, 2, 0.05))})
    corners = object_of(tmp_path, '0_3').corners
    assert np.ptp(corners, axis=(0, 1)) == pytest.approx([1.2, 0.05, 2.0])
    (tmp_path / 'object' / 'gate' / 'gate_0.obj').unlink()
    with pytest.raises(UserError, match='gate_0.obj'):
        pieces_of(tmp_path)


def test_materials_of_a_node_replace_those_of_its_model(tmp_path):
    import cv2
    write_house(tmp_path, models={'chest': 'mtllib chest.mtl\n' + box_obj(*CHEST, 'front_1')},
                changes={'0_2': {'materials': [
                    {'diffuse': '#000000'}, {'diffuse': '#ff8000', 'texture': 'oak'}]}})
    (tmp_path / 'object' / 'chest' / 'chest.mtl').write_text('newmtl front_1\nKd 0.1 0.1 0.1\n')
    with pytest.raises(UserError, match='oak'):
        pieces_of(tmp_path)
    (tmp_path / 'texture').mkdir()
    cv2.imwrite(str(tmp_path / 'texture' / 'oak.jpg'), np.full((4, 4, 3), 90, np.uint8))
    (surface,) = object_of(tmp_path, '0_2').surfaces
    assert np.allclose(surface.colour, [1, 128 / 255, 0]) and surface.picture.shape == (4, 4, 3)
    assert surface.uv.max() == 1 and surface.uv.min() == 0
    house = read_house(tmp_path / 'house' / 'h' / 'house.json')
    assert [item.texture for item in house.level(0).nodes[2].materials] == [None, 'oak']


def test_hidden_parts_invalid_nodes_and_persons_are_left_out(tmp_path):
    write_house(tmp_path, models={'man': box_obj(*CHEST)},
                changes={'0_0': {'hideCeiling': 1, 'hideWalls': 1}, '0_2': {'valid': 0}},
                extra=[thing(4, 'man', *CHEST, -2, 2)])
    seen = [(piece.role, piece.node.id) for piece in pieces_of(tmp_path)]
    assert seen == [('floor', '0_0'), ('floor', '0_1'), ('ceiling', '0_1'), ('wall', '0_1'),
                    ('object', '0_3')]


def test_boxes_and_ground_are_drawn(tmp_path):
    box = {'id': '0_4', 'type': 'Box', 'valid': 1, 'dimensions': [1, 2, 3],
           'transform': [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -2, 1, 2, 1],
           'materials': [{'diffuse': '#00ff00'}]}
    ground = {'id': '0_5', 'type': 'Ground', 'valid': 1, 'modelId': 'gd',
              'bbox': {'min': [-9, -1, -1], 'max': [1, -1, 5]}}
    write_house(tmp_path, extra=[box, ground])
    (tmp_path / 'room' / 'h' / 'gdf.obj').write_text(box_obj((-9, -1.2, -1), (1, -1, 5)))
    found = {piece.role: piece for piece in pieces_of(tmp_path)}
    corners = found['box'].corners
    assert np.allclose(corners.min(axis=(0, 1)), [-2.5, -3.5, 0]) and outward(corners).all()
    assert np.allclose(corners.max(axis=(0, 1)), [-1.5, -0.5, 2])
    assert np.allclose(found['box'].surfaces[0].colour, [0, 1, 0])
    assert np.allclose(found['ground'].corners.max(axis=(0, 1)), [1, 1, -1])
    categories = Categories(tmp_path / FILE, 'fine')
    assert categories.names[found['ground'].surfaces[0].label] == 'ground'


def test_a_house_that_was_converted_for_house3d_has_its_nodes_by_their_boxes(tmp_path):
    write_house(tmp_path, extra=[thing(4, 'chest', *CHEST, -2, 2)])
    text, count = '', 0
    for group, low, high in (
            ('Model#chest', (-6.4, 0, 1.7), (-5.6, 0.6, 2.3)),
            ('Model#chest', (-2.4, 0, 1.7), (-1.6, 0.6, 2.3)),
            ('Floor#0_0', (-8, -0.1, 0), (-4, 0, 4)),
            ('WallInside#0_1_2', (-4, 0, 0), (0, 2, 0.1)),
            ('WallOutside#1_1_2', (-4, 3, 0), (0, 5, 0.1)),
            ('Ground', (-9, -1, -1), (1, -0.9, 5))):
        lines = box_obj(low, high).replace('g box', f'g {group}').splitlines()
        for line in lines:
            if line.startswith('f '):
                line = 'f ' + ' '.join(str(int(word.split('/')[0]) + count)
                                       for word in line.split()[1:])
            text += line + '\n'
        count += 8
    (tmp_path / 'house' / 'h' / 'house.obj').write_text(text)
    found = pieces_of(tmp_path, layout='house3d')
    assert [(piece.role, piece.node and piece.node.id) for piece in found] == [
        ('object', '0_2'), ('object', '0_4'), ('floor', '0_0'), ('wall', '0_1'), ('ground', None)]
    assert np.allclose(found[1].corners.min(axis=(0, 1)), [-2.4, -2.3, 0])
    assert len({int(piece.surfaces[0].instance) for piece in found}) == 5


def test_classes_come_from_the_column_that_is_asked_for(tmp_path):
    write_house(tmp_path)
    for column, name in (('nyu40', 'cabinet'), ('fine', 'chest'), ('coarse', 'storage_bench')):
        categories = Categories(tmp_path / FILE, column)
        assert categories.names[categories.of_model('chest')] == name
        assert categories.names[0] == 'nothing' and len(set(categories.names)) == len(
            categories.names)
    nyu40 = Categories(tmp_path / FILE, 'nyu40')
    assert nyu40.names == ('nothing', *NYU40) and len(NYU40) == 40
    assert nyu40.names[nyu40.of_structure('ground')] == 'otherstructure'
    assert nyu40.names[nyu40.of_structure('ceiling')] == 'ceiling'
    assert 'person' not in Categories(tmp_path / FILE, 'coarse').names
    assert Categories(tmp_path / FILE, 'coarse').room_objects()['bathroom'] == ('toilet',)
    with pytest.raises(UserError, match='names every model'):
        nyu40.of_model('piano')


def test_a_colour_map_is_read_without_case(tmp_path):
    path = tmp_path / 'colours.csv'
    path.write_text('name,r,g,b\nGround,1,2,3\nSofa,0,137,65\n')
    assert read_colours(path) == {'ground': (1, 2, 3), 'sofa': (0, 137, 65)}
    path.write_text('name,r,g,b\nSofa,0,300,65\n')
    with pytest.raises(UserError, match='0 to 255'):
        read_colours(path)


@pytest.mark.parametrize('change, words', [
    ({'levels': []}, 'no levels'), ({'up': [0, 0, 1]}, 'up axis'), ({'id': None}, 'is missing'),
    ({'scaleToMeters': 0}, 'scaleToMeters')])
def test_a_broken_house_json_is_one_line(tmp_path, change, words):
    write_house(tmp_path)
    path = tmp_path / 'house' / 'h' / 'house.json'
    data = json.loads(path.read_text()) | change
    if change.get('id', '') is None:
        del data['id']
    path.write_text(json.dumps(data))
    with pytest.raises(UserError, match=words) as told:
        read_house(path)
    assert '\n' not in str(told.value)


@pytest.mark.parametrize('node, words', [
    ({'transform': [1, 2]}, '16 numbers'), ({'type': 'Sphere'}, 'Sphere'),
    ({'modelId': ''}, 'modelId'), ({'materials': [{'diffuse': 'red'}]}, '#rrggbb'),
    ({'bbox': {'min': [1, 0, 0], 'max': [0, 0, 0]}}, 'bounding box')])
def test_a_broken_node_is_one_line(tmp_path, node, words):
    write_house(tmp_path, changes={'0_2': node})
    with pytest.raises(UserError, match=words):
        read_house(tmp_path / 'house' / 'h' / 'house.json')


def test_a_broken_file_of_classes_is_one_line(tmp_path):
    path = tmp_path / FILE
    with pytest.raises(UserError, match='copy it from'):
        Categories(path)
    path.write_text('index,model_id\n0,chest\n')
    with pytest.raises(UserError, match='nyuv2_40class'):
        Categories(path)
    path.write_text(HEAD + '0,chest,chest\n')
    with pytest.raises(UserError, match='line 2'):
        Categories(path)
    with pytest.raises(UserError, match='nyu40, fine, coarse'):
        Categories(path, 'rough')


def test_what_is_missing_is_named(tmp_path):
    write_house(tmp_path)
    (tmp_path / 'object' / 'chest' / 'chest.obj').unlink()
    with pytest.raises(UserError, match='chest.obj'):
        pieces_of(tmp_path)
    house = read_house(tmp_path / 'house' / 'h' / 'house.json')
    with pytest.raises(UserError, match='levels 0 to 0'):
        house.level(1)
    with pytest.raises(UserError, match='house.obj'):
        pieces_of(tmp_path, layout='house3d')


def test_a_room_without_walls_in_its_folder_is_said(tmp_path, capsys):
    write_house(tmp_path)
    (tmp_path / 'room' / 'h' / 'fr_0rm_1w.obj').unlink()
    assert ('wall', '0_1') not in [(piece.role, piece.node.id) for piece in pieces_of(tmp_path)]
    told = capsys.readouterr().err
    assert 'fr_0rm_1w.obj' in told and told.count('\n') == 1
