"""Places made of triangles: goals, rooms, contacts, and only some of them in memory."""

import functools

import numpy as np
import pytest
from conformance import ROBOT, SIZE, Conformance
from mesh_places import FLOOR, TABLE, WALL, box, flat, house_surfaces, room_surfaces, surface

from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS
from vn_nav.scenes import parse_scene
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.meshes.place import PlaceRules, RoomOutline, make_place
from vn_sim_bridge.meshes.semantics import split_large
from vn_sim_bridge.meshes.simulator import MeshSimulator
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.simulator import Placed, Setup

LEFT = np.array([(0, 0), (3, 0), (3, 4), (0, 4)], float)
RIGHT = LEFT + (3, 0)
ROOMS = (RoomOutline('kitchen', 'kitchen', [LEFT]), RoomOutline('bedroom', 'bedroom', [RIGHT]))


class RoomSimulator(MeshSimulator):
    """Rooms of different widths: the scene's place is the width in decimetres."""

    @classmethod
    def open(cls, scenes, setup, **more):
        return cls([str(scene) for scene in scenes],
                   [functools.partial(cls.read, str(scene), int(scene.place), setup)
                    for scene in scenes], setup, LABELS, **more)

    @staticmethod
    def read(name, width, setup):
        return make_place(name, room_surfaces(z=1.0, width=width / 10), LABELS, setup.robot,
                          rooms=ROOMS, goals_per_room=setup.goals_per_room,
                          goal_seed=setup.goal_seed)


def rooms(num_envs, widths=(60, 80), budget=2 << 30, **more):
    return RoomSimulator.open([parse_scene(f'mesh:{width}') for width in widths],
                              Setup(num_envs, ROBOT, more.pop('size', SIZE), **more),
                              budget=budget)


@pytest.mark.slow
class TestMesh(Conformance):
    def make(self, num_envs, size=SIZE):
        return rooms(num_envs, size=size)


def test_a_place_is_moved_to_its_floor_and_drawn_from_there():
    place, scene = RoomSimulator.read('mesh:60', 60, Setup(1, ROBOT))
    assert place.level == pytest.approx(1) and scene.vertices[:, 2].min() == pytest.approx(0)
    simulator = rooms(1, (60,))
    frames = simulator.view(np.array([0]), np.array([[1.0, 2.0, 0.0, 0.0]]))
    assert frames.depth[0, SIZE // 2, SIZE // 2] == pytest.approx(5.0, abs=0.01)
    assert frames.labels[0, SIZE // 2, SIZE // 2] == WALL
    assert {FLOOR, TABLE} <= set(np.unique(frames.labels))


def test_goals_lie_in_their_rooms_and_show_something():
    simulator = rooms(1, (60,), goals_per_room=3, size=48)
    (place,) = simulator.places
    assert [goal.room for goal in place.goals] == ['kitchen'] * 3 + ['bedroom'] * 3
    for goal in place.goals:
        assert (goal.pose[0] < 3) == (goal.room == 'kitchen')
    seen = simulator.view(np.zeros(6, int), np.array([goal.pose for goal in place.goals]))
    assert (seen.depth > 0).all() and (np.median(seen.depth, axis=(1, 2)) > 1.2).all()
    assert place.room_at(1, 1) == 'kitchen' and place.room_at(9, 9) == ''
    others = rooms(1, (60,), goal_seed=1).places[0].goals
    assert [goal.pose for goal in others] != [goal.pose for goal in place.goals][:2]


def test_without_rooms_goals_are_spread_and_named_by_what_they_show():
    place, _ = make_place('mesh:x', room_surfaces(width=9), LABELS, ROBOT)
    assert len(place.goals) >= 4
    assert any(goal.room.startswith('table') for goal in place.goals)
    at = np.array([goal.pose[:2] for goal in place.goals])
    assert max(np.hypot(*(a - b)) for a in at for b in at) > 3
    assert {'walls', 'outside', 'obstacles', 'goals'} <= place.plan().keys()


def test_robots_stop_at_what_the_pictures_show():
    simulator = rooms(2)
    simulator.place(np.array([0, 1]), np.array([[1.0, 3.0, 0, 0], [1.0, 3.0, 0, 0]]))
    for _ in range(20):
        motion = simulator.move(np.array([[0.5, 0, 0, 0]] * 2))
    assert motion.collided.all()
    gaps = simulator.observe().depth[:, SIZE // 2, SIZE // 2]
    assert np.allclose(gaps, ROBOT.footprint_radius, atol=0.02), 'walls of two different rooms'
    assert np.allclose(simulator.poses[:, 0], np.array([6, 8]) - ROBOT.footprint_radius, atol=.01)


def test_light_and_objects_are_those_of_each_robot():
    simulator = rooms(3, randomisation=Randomisation(exposure=(-1.0, 1.0)), models=('ball',),
                      objects=1)
    simulator.place(np.arange(3), np.array([[1.0, 3.0, 0, 0]] * 3))
    simulator.apply_appearance(np.arange(3), 1, Stream.APPEARANCE, np.arange(3), 0)
    plain = simulator.observe()
    means = plain.rgb.mean(axis=(1, 2, 3))
    assert len(np.unique(means.round(1))) == 3
    before = plain.labels.copy()
    simulator.set_objects(1, [Placed(0, 2.2, 3.0, 0.0)])
    after = simulator.observe().labels
    assert (after[1] == LABELS.index('ball')).any() and np.array_equal(after[[0, 2]],
                                                                       before[[0, 2]])
    assert simulator.object_models().tolist() == [[-1], [0], [-1]]
    some = simulator.observe(np.array([1]))
    assert np.array_equal(some.labels[0], after[1])


def test_places_are_read_when_they_are_needed_and_let_go_of():
    simulator = rooms(2, tuple(range(60, 90)), budget=0)
    assert simulator.cache.loads == 2 and len(simulator.cache) == 2, 'those that robots are in'
    assert len({len(place.goals) for place in simulator.places}) == 1
    assert simulator.cache.loads == 30 and len(simulator.cache) <= 3
    simulator.enter(np.array([0, 1]), np.array([10, 20]))
    simulator.place(np.array([0, 1]), np.array([[1.0, 3.0, 0, 0]] * 2))
    seen = simulator.observe().depth[:, SIZE // 2, SIZE // 2]
    assert np.allclose(seen, [6.0, 7.0], atol=0.01)
    loads = simulator.cache.loads
    for _ in range(5):
        simulator.observe()
        simulator.move(np.zeros((2, 4)))
    assert simulator.cache.loads == loads, 'where robots are nothing is read again'
    simulator.close()
    assert len(simulator.cache) == 0


def test_an_environment_reads_each_place_twice_at_most_when_it_is_made():
    """For goals and floor, and for the pictures of the goals: a split may have large scenes."""
    simulator = rooms(2, tuple(range(60, 80)), budget=0)
    env = NavigationEnv(EnvConfig(num_envs=2, size=SIZE, actions=DRIVE_ACTIONS), ROBOT,
                        simulator=simulator)
    assert len(env.goals) > 20 and simulator.cache.loads <= 2 * 20
    loads = simulator.cache.loads
    for place in simulator.places:
        assert place.goals and place.rooms and place.floor.free.any()
    assert simulator.cache.loads == loads
    env.close()


@pytest.mark.slow
def test_a_scene_of_many_triangles_is_drawn_whole():
    """An embedded house in 400,000 triangles: no buffer overflows, no pixel is lost."""
    house = generate_house(7, rooms=5)
    surfaces = []
    for part in house_surfaces(house):
        colour = np.broadcast_to(part.colour, (len(part.corners), 3))
        corners, _, colour = split_large(part.corners, None, colour, 0.05)
        surfaces.append(part._replace(corners=corners, colour=colour))
    place, scene = make_place('mesh:many', surfaces, LABELS, ROBOT)
    assert scene.triangle_count > 400_000
    whole, split = (Rasterizer([one], 96) for one in (house.scene, scene))
    cells, rng = place.floor.centres(), np.random.default_rng(0)
    cameras = np.column_stack([cells[rng.integers(len(cells), size=12)], np.ones(12),
                               rng.uniform(-3, 3, 12), rng.uniform(-.2, .4, 12)])
    a, b = (renderer.render(np.zeros(12, int), cameras, 1.57) for renderer in (whole, split))
    assert not ((b[1] == 0) & (a[1] > 0)).any(), 'no holes'
    assert (np.abs(a[1] - b[1]) < 0.01).mean() > 0.995 and (a[2] == b[2]).mean() > 0.995


def test_what_is_wrong_is_said_at_the_start():
    with pytest.raises(UserError, match='a storey is a number from 0 to 0'):
        make_place('mesh:x', room_surfaces(), LABELS, ROBOT, rules=PlaceRules(storey=3))
    walls = [surface(box(0, 0, 0, 1, 1, 2)[:0], WALL), surface(flat(0, 0, .1, .1), FLOOR)]
    with pytest.raises(UserError, match='floor of 3 square metres'):
        make_place('mesh:x', walls, LABELS, ROBOT)
