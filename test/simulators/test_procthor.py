"""`procthor:` rooms, walls with holes, boxes and meshes; Unity's frame becomes ours once."""

import gzip
import json

import numpy as np
import pytest
from conformance import ROBOT, SIZE, Conformance
from mesh_places import box, surface
from procthor_houses import point, small_house, thing

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh_export import export_mesh
from vn_sim_bridge.meshes.procthor import rotation
from vn_sim_bridge.render.mesh_scene import mesh_scene
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator
from vn_sim_bridge.thor.frame import pose_to_ours

ASSETS = {'Bed': [{'assetId': 'Bed_1', 'boundingBox': point(1.0, 0.8, 2.0)}],
          'DiningTable': [{'assetId': 'DiningTable_1', 'boundingBox': point(1.0, 0.8, 0.6)}]}


@pytest.fixture
def written(tmp_path):
    """A function that writes a house and opens it."""
    (tmp_path / 'assets.json').write_text(json.dumps(ASSETS))

    def opened(house=None, options='', size=64, num_envs=1):
        (tmp_path / 'house.json').write_text(json.dumps(house or small_house()))
        return open_simulator([f'procthor:{tmp_path}/house.json?assets={tmp_path}/assets.json'
                               f'{options}'], Setup(num_envs, ROBOT, size))
    opened.folder = tmp_path
    return opened


def standing(x, z, rotation, horizon=0.0):
    """The pose of an agent of AI2-THOR, in its own words: m and degrees, clockwise from z."""
    return pose_to_ours({'position': point(x, 0.9, z), 'rotation': point(0, rotation, 0),
                         'cameraHorizon': horizon}, 0.0)


def rect_in_unity(rect):
    """x0, z0, x1, z1 of a rectangle of the map."""
    return -rect[3], rect[0], -rect[1], rect[2]


def look(simulator, x, z, rotation, horizon=0.0):
    """Depth and class in the middle of the picture of an agent of AI2-THOR."""
    frames = simulator.view(np.array([0]), standing(x, z, rotation, horizon)[None])
    middle = frames.depth.shape[1] // 2
    return float(frames.depth[0, middle, middle]), simulator.label_names[
        frames.labels[0, middle, middle]]


@pytest.mark.slow
class TestProcthor(Conformance):
    @pytest.fixture(autouse=True)
    def files(self, tmp_path_factory):
        self.path = tmp_path_factory.mktemp('houses') / 'two.jsonl.gz'
        narrow = small_house(objects=[])
        with gzip.open(self.path, 'wt') as file:
            file.write(json.dumps(small_house()) + '\n' + json.dumps(narrow) + '\n')

    def make(self, num_envs, size=SIZE):
        return open_simulator([f'procthor:{self.path}?index=0-1'], Setup(num_envs, ROBOT, size))


def test_rooms_walls_doors_and_windows_are_where_the_house_has_them(written):
    simulator = written()
    (place,) = simulator.places
    assert [(room.name, room.kind) for room in place.rooms] == [('kitchen', 'kitchen'),
                                                                ('bedroom', 'bedroom')]
    # The map's x is Unity's z, its y Unity's -x.
    assert place.rooms[0].rect == pytest.approx((0, -4, 4, 0), abs=.11)
    assert place.rooms[1].rect == pytest.approx((0, -8, 4, -4), abs=.11)
    assert {goal.room for goal in place.goals} == {'kitchen', 'bedroom'}
    # To the right of z, along z = 1, the door is open up to the far wall.
    assert look(simulator, 1.0, 1.0, 90) == (pytest.approx(7.0, abs=.01), 'wall')
    assert look(simulator, 3.0, 3.0, 90) == (pytest.approx(1.0, abs=.01), 'wall')
    assert look(simulator, 5.0, 3.5, 270) == (pytest.approx(1.0, abs=.01), 'wall')
    assert look(simulator, 5.0, 1.0, 0) == (pytest.approx(3.0, abs=.01), 'wall')
    assert look(simulator, 6.0, 2.5, 90, -12) == (
        pytest.approx(2 / np.cos(np.radians(12)), abs=.02), 'window')
    assert look(simulator, 1.0, 2.0, 90, 57)[1] == 'floor'
    assert look(simulator, 1.0, 2.0, 90, -57)[1] == 'ceiling'
    labels = simulator.view(np.array([0]), standing(2.0, 1.0, 90)[None]).labels
    assert simulator.label_names.index('door') in labels, 'its frame'
    assert place.distance_to(place.goals[0]).maximum < 12, 'through the door'
    assert place.floor.free.sum() * 0.01 > 18


def test_a_robot_drives_through_the_door_and_not_through_walls(written):
    simulator = written(num_envs=2)
    simulator.place(np.arange(2), np.array([standing(3, 1, 90), standing(3, 3, 90)]))
    for _ in range(4):
        motion = simulator.move(np.array([[0.5, 0, 0, 0]] * 2))
    assert not motion.collided[0] and simulator.poses[0, 1] == pytest.approx(-5.0)
    assert motion.collided[1]
    assert simulator.poses[1, 1] == pytest.approx(ROBOT.footprint_radius - 4, abs=.02)


def test_doors_that_are_shut_are_shut_if_told_so(written):
    simulator = written(options='&doors=as_given')
    assert look(simulator, 1.0, 1.0, 90) == (pytest.approx(3.0, abs=.05), 'door')
    assert simulator.places[0].floor.free.sum() * 0.01 < 13, 'one room'


def test_objects_are_labelled_boxes_of_their_sizes_and_it_says_so(written, capsys):
    simulator = written()
    assert '4 of 4 objects are labelled boxes, 2 of them of the usual size' in (
        capsys.readouterr().err)
    # A bed of 1 m x 2 m, turned by 90 degrees, stands across: x from 6 to 8, z from 2.5 to 3.5.
    rect = next(rect for rect, label in simulator.places[0].obstacles if label == 'bed')
    assert np.allclose(rect_in_unity(rect), (6, 2.5, 8, 3.5), atol=.025)
    assert look(simulator, 4.6, 3.0, 90, 20)[1] == 'bed'
    shown = simulator.view(np.array([0]), standing(0.6, 2.5, 90, 11)[None]).labels
    names = {simulator.label_names[k] for k in np.unique(shown)}
    assert {'table', 'mug'} <= names, 'what stands on it as well'


def test_unitys_angles_are_left_handed():
    # About y, seen from above, they run clockwise: 90 degrees turn z (ahead) to x (right).
    assert np.allclose(rotation({'y': 90}) @ [0, 0, 1], [1, 0, 0])
    assert np.allclose(rotation({'x': 90}) @ [0, 0, 1], [0, -1, 0]), 'nose down'
    assert np.allclose(rotation({'x': 30, 'y': 90, 'z': 20}),
                       rotation({'y': 90}) @ rotation({'x': 30}) @ rotation({'z': 20}))


def test_meshes_of_a_folder_take_the_place_of_boxes(written, capsys):
    folder = written.folder / 'meshes'
    folder.mkdir()
    # An L: its long leg along the file's x, its short one at the file's -x end.
    shape = [surface(box(0, 0, 0, 2, .4, .5), 1), surface(box(0, 0, 0, .4, 1, .5), 1)]
    export_mesh(mesh_scene(shape, 'L'), folder / 'Bed_1.glb')
    house = small_house(objects=[thing('Bed', 1, 6, .25, 3)])
    simulator = written(house, f'&meshes={folder}')
    assert 'labelled boxes' not in capsys.readouterr().err
    rects = np.array([rect_in_unity(rect) for rect, label in simulator.places[0].obstacles
                      if label == 'bed'])
    low, high = np.min(rects, axis=0)[:2], np.max(rects, axis=0)[2:]
    assert np.allclose((*low, *high), (5, 2.5, 7, 3.5), atol=.02), 'by its middle'
    # The file's x is Unity's -x: the short leg is at the greater x.
    inside = [any(x0 <= x <= x1 and z0 <= z <= z1 for x0, z0, x1, z1 in rects)
              for x, z in ((6.8, 2.7), (5.2, 2.7), (6.8, 3.3), (5.2, 3.3))]
    assert inside == [True, False, True, True]


def test_many_houses_in_a_file(tmp_path):
    path = tmp_path / 'train.jsonl.gz'
    with gzip.open(path, 'wt') as file:
        for k in range(5):
            house = small_house(objects=[thing('Bed', 1, 5 + .5 * k, .4, 3)])
            file.write(json.dumps(house) + '\n')
    simulator = open_simulator([f'procthor:{path}?index=1-3'], Setup(1, ROBOT, SIZE))
    assert [place.name[-1] for place in simulator.places] == ['1', '2', '3']
    assert simulator.cache.loads == 1
    middles = [np.mean([-rect[1] - rect[3] for rect, label in place.obstacles
                        if label == 'bed']) / 2 for place in simulator.places]
    assert np.allclose(middles, [5.5, 6, 6.5], atol=.02)
    for options, rule in (('', 'needs index'), ('?index=9', 'smaller index'),
                          ('?index=0-9', 'smaller index'),  # not when a robot gets there
                          ('?index=3-1', 'FIRST-LAST'), ('?index=a', 'needs index'),
                          ('?index=1&doors=ajar', 'open or as_given'),
                          ('?index=1&meshes=none', 'option meshes'),
                          ('?index=1&assets=none.json', 'option assets')):
        with pytest.raises(UserError, match=rule):
            open_simulator([f'procthor:{path}{options}'], Setup(1, ROBOT, SIZE))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UserError, match='whole JSON'):
        open_simulator([f'procthor:{path}?index=4'], Setup(1, ROBOT, SIZE))


@pytest.mark.parametrize(('text', 'rule'), [
    ('{"rooms": ', 'whole JSON'), ('[]', 'object with rooms'),
    ('{"rooms": []}', 'a house has rooms'),
    ('{"rooms": [{"id": "room|1"}], "walls": []}', 'floorPolygon'),
])
def test_what_is_no_house_is_one_line(tmp_path, text, rule):
    (tmp_path / 'house.json').write_text(text)
    with pytest.raises(UserError, match=rule) as caught:
        open_simulator([f'procthor:{tmp_path}/house.json'], Setup(1, ROBOT, SIZE))
    assert '\n' not in str(caught.value)
    with pytest.raises(UserError, match='procthor.md'):
        open_simulator([f'procthor:{tmp_path}/none.json'], Setup(1, ROBOT, SIZE))
