"""SUNCG houses as places: doors, obstacles, levels, rooms; and House3D's conventions."""

import json

import numpy as np
import pytest
from suncg_files import GATE, box_obj, floor_quad, quads_obj, room, thing, write_house

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec, load_robot
from vn_nav.scenes import parse_scene
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator
from vn_sim_bridge.simulators.suncg import quantised
from vn_sim_bridge.suncg.labels import FILE, Categories
from vn_sim_bridge.suncg.place import Options, outside_column, read_place, room_kind

LEFT, RIGHT = (-7.0, -3.0), (-1.0, -1.0)  # in either room


def place_of(folder, **options):
    return read_place('suncg:h', folder, 'h', Categories(folder / FILE, 'fine'), RobotSpec(),
                      Options(**options))[0]


def way(place, start=LEFT, end=RIGHT):
    return place.geodesic(*end).at(np.array([start]))[0]


def test_a_door_clears_the_wall_that_it_stands_in(tmp_path):
    place = place_of(write_house(tmp_path / 'a'))
    assert np.hypot(6, 2) <= way(place) < 7  # through the gate at (-4, -2)
    shut = place_of(write_house(tmp_path / 'b', changes={'0_3': {'valid': 0}}))
    assert np.isinf(way(shut)) or not np.isfinite(shut.geodesic(*RIGHT).values).any()


@pytest.mark.parametrize('low, open_', [(0.0, True), (0.9, False)])
def test_a_window_that_reaches_the_floor_is_a_door(tmp_path, low, open_):
    box = (GATE[0][0], low, GATE[0][2]), GATE[1]
    write_house(tmp_path, changes={'0_3': {'valid': 0}}, models={'pane': box_obj(*box)},
                extra=[thing(4, 'pane', *box, -4, 2)])
    assert np.isfinite(way(place_of(tmp_path))) == open_


def test_obstacles_are_meshes_or_boxes_between_house3d_s_heights(tmp_path):
    # A table without legs on one side, a shelf that hangs at 0.8 m, a mat of 0.1 m.
    arch = quads_obj([(-1, .0, 0), (-1, .7, 0), (-.9, .7, 0), (-.9, 0, 0)],
                     [(.9, .0, 0), (.9, .7, 0), (1, .7, 0), (1, 0, 0)])
    arch_box = (-1, 0, -.01), (1, .7, .01)
    hung, mat = ((-.5, .8, -.2), (.5, 1.0, .2)), ((-.5, 0, -.5), (.5, .1, .5))
    write_house(tmp_path, models={'chest': arch, 'shelf': box_obj(*hung), 'mat': box_obj(*mat)},
                changes={'0_2': {'bbox': {
                    'min': [arch_box[0][0] - 6, 0, arch_box[0][2] + 2],
                    'max': [arch_box[1][0] - 6, .7, arch_box[1][2] + 2]}}},
                extra=[thing(4, 'shelf', *hung, -2, 3.5), thing(5, 'mat', *mat, -1.5, 1.5)])
    mesh, boxes = place_of(tmp_path), place_of(tmp_path, obstacles='boxes')

    def free(place, x, y):
        return np.isfinite(place.geodesic(*RIGHT).at(np.array([[x, y]]))[0]) and not any(
            rect.x0 <= x <= rect.x1 and rect.y0 <= y <= rect.y1 for rect, _ in place.obstacles)

    assert free(mesh, -6, -2) and not free(boxes, -6, -2)  # between the legs
    assert not free(mesh, -2, -3.3) and free(boxes, -2, -3.3)  # under the shelf
    assert free(mesh, -1.5, -1.5) and free(boxes, -1.5, -1.5)  # on the mat
    with pytest.raises(UserError, match='mesh, boxes'):
        place_of(tmp_path, obstacles='balls')


def test_a_large_box_is_not_free_inside(tmp_path):
    low, high = (-0.9, 0, -0.9), (0.9, 2.0, 0.9)
    write_house(tmp_path, models={'chest': box_obj(low, high)},
                changes={'0_2': thing(2, 'chest', low, high, -6, 2)})
    place = place_of(tmp_path, obstacles='boxes')
    assert any(label == 'chest' and rect.x0 <= -6 <= rect.x1 and rect.y0 <= -2 <= rect.y1
               for rect, label in place.obstacles)


def test_triangles_are_cut_out_of_a_column():
    corners = np.array([[[-2, 0, 0], [2, 0, 0], [2, 0, 2]], [[-2, 0, 0], [2, 0, 2], [-2, 0, 2]],
                        [[5, 5, 0], [6, 5, 0], [5, 6, 0]]], float)  # a wall, and what is apart
    left = outside_column(corners, np.array([-0.5, -0.2]), np.array([0.5, 0.2]))
    area = np.linalg.norm(np.cross(left[:, 1] - left[:, 0], left[:, 2] - left[:, 0]), axis=1) / 2
    assert area.sum() == pytest.approx(8 - 2 + 0.5)
    wall = left[left[:, :, 1].max(axis=1) < 1]
    assert not ((wall[:, :, 0].min(axis=1) < 0.4) & (wall[:, :, 0].max(axis=1) > -0.4)).any()


def test_levels_are_chosen_by_number(tmp_path):
    ground, _ = room(0, -8, -4, 'Kitchen')
    upper, texts = room(9, -8, -4, 'Bedroom', y=3.0)
    upper['id'] = '1_0'
    write_house(tmp_path, levels=[
        {'id': '0', 'nodes': [ground]}, {'id': '1', 'nodes': [upper]}, {'id': '2', 'bbox': {}}])
    for letter, text in texts.items():
        (tmp_path / 'room' / 'h' / f'fr_0rm_9{letter}.obj').write_text(text)
    below, above = place_of(tmp_path), place_of(tmp_path, level=1)
    assert (below.level, above.level) == (0.0, 3.0)
    assert [r.kind for r in below.rooms] == ['kitchen']
    assert {r.kind for r in above.rooms} == {'bedroom'} and above.area > 8
    with pytest.raises(UserError, match='level 2'):
        place_of(tmp_path, level=2)  # with nothing in it
    with pytest.raises(UserError, match='0 to 2'):
        place_of(tmp_path, level=3)


def test_room_types_are_house3d_s(tmp_path):
    assert room_kind(['Toilet', 'Bathroom']) == ['bathroom']
    assert room_kind(['Guest_Room', 'Living_Room']) == ['bedroom', 'living_room']
    write_house(tmp_path, changes={'0_0': {'roomTypes': ['Hall']}})
    place = place_of(tmp_path)
    assert [(r.name, r.kind) for r in place.rooms] == [('hall', ''), ('bedroom', 'bedroom')]
    assert [r.kind for r in place_of(tmp_path, targets='all').rooms] == ['hall', 'bedroom']
    assert {goal.room for goal in place.goals} == {'hall', 'bedroom'}


def test_a_room_that_is_no_rectangle_is_several_ones(tmp_path):
    write_house(tmp_path)
    (tmp_path / 'room' / 'h' / 'fr_0rm_1f.obj').write_text(
        quads_obj(floor_quad(-4, 0, 0, 2), floor_quad(-4, 2, -2, 4)))
    place = place_of(tmp_path)
    own = [r.rect for r in place.rooms if r.name == 'bedroom']
    assert len(own) == 2 and sum(rect.area for rect in own) == pytest.approx(12)
    assert place.room_at(-3, -3) == 'bedroom' and place.room_at(-1, -3) == ''


def test_house3d_s_conventions(tmp_path):
    depth = np.array([0.0, 0.05, 7.02, 19.99, 45.0], np.float32)
    steps = quantised(depth) * 255 / 20
    assert np.allclose(steps, np.rint(steps), atol=1e-5) and steps[-1] == 255
    assert np.abs(quantised(depth[:4]) - depth[:4]).max() <= 20 / 255 / 2 + 1e-6
    write_house(tmp_path)
    robot = load_robot('config/robots/house3d.yaml')
    assert robot.footprint_radius == 0.1 and robot.camera_height == 0.75
    assert np.degrees(robot.camera_fov) == pytest.approx(60)
    scenes = [f'suncg:h?data={tmp_path}&depth={kind}' for kind in ('metres', 'house3d')]
    exact, stepped = (open_simulator([scene], Setup(1, robot, 24)) for scene in scenes)
    pose = np.array([[*RIGHT, 2.0, 0.0]])
    seen = [s.view(np.zeros(1, int), pose).depth for s in (exact, stepped)]
    assert np.array_equal(seen[1], quantised(seen[0])) and not np.array_equal(*seen)


def test_missing_data_is_said_when_a_scene_is_opened(tmp_path, monkeypatch):
    monkeypatch.delenv('SUNCG_PATH', raising=False)
    setup = Setup(1, RobotSpec(), 24)
    with pytest.raises(UserError, match='SUNCG_PATH.*docs/simulators/suncg.md'):
        open_simulator(['suncg:h'], setup)
    with pytest.raises(UserError, match='a folder house'):
        open_simulator([f'suncg:h?data={tmp_path}'], setup)
    write_house(tmp_path)
    monkeypatch.setenv('SUNCG_PATH', str(tmp_path))
    open_simulator(['suncg:h'], setup).close()
    for scene, words in (('suncg:other', 'there is no'), ('suncg:h?level=3', '0 to 0'),
                         ('suncg:h?labels=all', 'nyu40'), ('suncg:h?level=x', 'whole number'),
                         ('suncg:h?obstacles=x', 'boxes'), ('suncg:h?layout=x', 'house3d'),
                         ('suncg:h?depth=x', 'metres'), ('suncg:h?colour=x', 'colour')):
        with pytest.raises(UserError, match=words) as told:
            open_simulator([scene], setup)
        assert '\n' not in str(told.value)
    with pytest.raises(UserError, match='one labels'):
        open_simulator(['suncg:h?labels=fine', 'suncg:h?labels=coarse'], setup)
    (tmp_path / FILE).unlink()
    with pytest.raises(UserError, match=FILE):
        open_simulator(['suncg:h'], setup)
    (tmp_path / 'house' / 'h' / 'house.json').write_text(json.dumps({'id': 'h'}))
    with pytest.raises(UserError):
        open_simulator([str(parse_scene('suncg:h'))], setup)
