"""AI2-THOR's frame and names, as ours: needs neither its client nor Unity."""

import math

import numpy as np
import pytest
from procthor_houses import small_house, thing

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.meshes.procthor import house_surfaces
from vn_sim_bridge.meshes.vocabulary import Vocabulary
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators.house import HouseSimulator
from vn_sim_bridge.simulators.thor import SIMULATOR
from vn_sim_bridge.thor.frame import (
    TO_MAP,
    point_to_ours,
    point_to_thor,
    points_to_ours,
    points_to_thor,
    pose_to_ours,
    pose_to_thor,
)
from vn_sim_bridge.thor.names import LABEL_NAMES, SPLITS, class_of, scene_names
from vn_sim_bridge.thor.place import floor_of


def agent(x, z, rotation, horizon=0.0):
    return {'position': {'x': x, 'y': 0.9, 'z': z},
            'rotation': {'x': 0.0, 'y': rotation, 'z': 0.0}, 'cameraHorizon': horizon}


def test_poses_come_back_as_they_went():
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = rng.uniform([-9, -9, -math.pi, -0.4], [9, 9, math.pi, 0.9])
        told = pose_to_thor(pose, 0.9, 0.1)
        assert 0 <= told['rotation']['y'] < 360 and told['y'] == 0.9
        back = pose_to_ours({'position': told, 'rotation': told['rotation'],
                             'cameraHorizon': told['horizon']}, 0.1)
        assert np.allclose(back, pose, atol=1e-12)
        assert point_to_ours(point_to_thor(*pose[:3])) == tuple(pose[:3])


def test_what_is_right_of_it_in_unity_is_right_of_it_here():
    # As Unity has it: at rotation r the agent faces (sin r, cos r) of (x, z); right is r + 90.
    for rotation in (0.0, 30.0, 90.0, 200.0, 330.0):
        r = math.radians(rotation)
        start = pose_to_ours(agent(1.0, 2.0, rotation), 0.0)
        ahead = pose_to_ours(agent(1.0 + math.sin(r), 2.0 + math.cos(r), rotation), 0.0)
        right = pose_to_ours(agent(1.0 + math.cos(r), 2.0 - math.sin(r), rotation), 0.0)
        c, s = math.cos(start[2]), math.sin(start[2])
        assert np.allclose((ahead - start)[:2], [c, s])
        assert np.allclose((right - start)[:2], [s, -c])
        turned = pose_to_ours(agent(1.0, 2.0, rotation + 10), 0.0)  # clockwise: to the right
        assert math.isclose(math.sin(turned[2] - start[2]), -math.sin(math.radians(10)))
    assert pose_to_ours(agent(0, 0, 0, horizon=30), 0.0)[3] == pytest.approx(math.radians(30))
    assert point_to_ours({'x': 0.0, 'y': 1.5, 'z': 0.0}) == (0.0, 0.0, 1.5)  # up is up


def test_a_house_of_procthor_has_one_map_in_both_simulators():
    """Corners, objects and headings: `thor` asks the engine for them, `procthor` the file."""
    house = small_house(objects=[thing('Bed', 1, 7, .4, 3, 30)])
    made = house_surfaces(house, Vocabulary(), 'house', boxes={'Bed_1': (1.0, 0.8, 2.0)},
                          meshes=None, doors_as_given=False)
    for room, entry in zip(made.rooms, house['rooms'], strict=True):
        there = [point_to_ours(corner)[:2] for corner in entry['floorPolygon']]
        assert np.allclose(room.polygons[0], there)
    # The bed lies as an agent that stands and is turned as it is: 2 m ahead, 1 m across.
    bed = house['objects'][0]
    at = pose_to_ours({'position': bed['position'], 'rotation': bed['rotation'],
                       'cameraHorizon': 0.0}, 0.0)
    (corners,) = [surface.corners.reshape(-1, 3) for surface in made.surfaces
                  if surface.label == Vocabulary().id('bed')]
    c, s = math.cos(at[2]), math.sin(at[2])
    own = (corners[:, :2] - at[:2]) @ [[c, -s], [s, c]]  # ahead and left of it
    assert np.allclose([np.ptp(own, axis=0), own.min(axis=0)], [(2.0, 1.0), (-1.0, -0.5)])
    points = np.random.default_rng(0).uniform(-5, 5, (9, 3))
    ours = points_to_ours(points)
    assert np.allclose([point_to_ours(dict(zip('xyz', p, strict=True))) for p in points], ours)
    assert np.allclose(points_to_thor(ours), points)
    assert np.linalg.det(TO_MAP) == pytest.approx(-1), 'a left-handed frame becomes right-handed'


def test_turns_are_exact_there():
    """Thesis, section 5.6: noise along the motion alone (what it does: `test_corridor`)."""
    assert SIMULATOR.exact_turns and not HouseSimulator.exact_turns


def test_the_camera_looks_no_farther_than_the_agent_can():
    assert pose_to_thor(np.array([0, 0, 0, 2.0]), 0.9, 0.0)['horizon'] == 60
    assert pose_to_thor(np.array([0, 0, 0, -2.0]), 0.9, 0.0)['horizon'] == -30


def test_a_class_has_one_number_in_all_simulators():
    assert LABEL_NAMES[:len(LABELS)] == LABELS
    assert len(set(LABEL_NAMES)) == len(LABEL_NAMES) <= 256  # a picture of labels has a byte
    for name, want in (('TVStand|-1.1|+0.0|+2.2', 'tv_stand'), ('CoffeeTable|1|2|3',
                       'coffee_table'), ('Mug|+1.0|+0.9|-2.0', 'mug'), ('wall_04', 'wall'),
                       ('StandardWallSize', 'wall'), ('Floor|1|2|3', 'floor'),
                       ('SinkBasin', 'sink'), ('CD|1|2|3', 'cd'), ('Thingamajig', 'object'),
                       ('Bed|1|2|3', 'bed'), ('FloorLamp|1|2|3', 'lamp')):
        assert LABEL_NAMES[class_of(name)] == want, name


def test_scenes_and_splits():
    parts = [set(names) for names in SPLITS.values()]
    assert list(map(len, parts)) == [80, 20, 20] and len(set.union(*parts)) == 120
    assert {parse_scene(name).place for part in parts for name in part} <= scene_names()
    assert 'FloorPlan_Val3_5' in scene_names() and 'FloorPlan31' not in scene_names()


@pytest.mark.parametrize('scene', ['thor:FloorPlan31', 'thor:kitchen', 'thor:FloorPlan227_physics',
                                   'thor:FloorPlan1?moves=fly', 'thor:FloorPlan1?rooms=2',
                                   'thor:procthor', 'thor:procthor?file=no_such.json',
                                   'thor:FloorPlan1?file=house.json'])
def test_a_scene_that_there_is_not_is_said_before_anything_starts(scene):
    with pytest.raises(UserError):
        SIMULATOR.open([parse_scene(scene)], Setup(1, RobotSpec()))
    with pytest.raises(UserError, match='same'):
        SIMULATOR.open([parse_scene('thor:FloorPlan1'), parse_scene('thor:FloorPlan2?moves=arm')],
                       Setup(1, RobotSpec()))


def test_a_house_of_procthor_without_a_start_is_refused(tmp_path):
    path = tmp_path / 'house.json'
    path.write_text('{"rooms": [1], "metadata": {}}')
    with pytest.raises(UserError, match='metadata.agent'):
        SIMULATOR.open([parse_scene(f'thor:procthor?file={path}')], Setup(1, RobotSpec()))


def test_the_floor_is_where_it_can_be_reached():
    corridor = [(0.1 * k, 0.0) for k in range(30)] + [(2.9, 0.1 * k) for k in range(30)]
    positions = np.array([*corridor, (9.0, 9.0)]) + (-1.04, 3.07)  # and a pocket
    floor = floor_of(positions)
    centres = floor.centres()
    assert len(centres) == 59
    assert np.allclose(sorted(map(tuple, centres)), sorted({tuple(np.round(p, 9)) for p in
                                                            positions[:-1]}), atol=1e-6)
    far = FloorDistance(floor, *positions[0])
    assert far.at(positions[[59]])[0] == pytest.approx(5.8, abs=0.15)
