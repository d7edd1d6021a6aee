"""Procedural houses: varied, whole, and the same every time."""

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_sim_bridge.houses.house import CELL, main_component
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.layout import DOOR_WIDTH
from vn_sim_bridge.houses.procedural import generate_house


def test_equal_seeds_give_equal_houses_and_others_differ():
    one, same, other = generate_house(3), generate_house(3), generate_house(4)
    for name in ('vertices', 'face_uv', 'face_colour', 'face_label', 'group_sphere'):
        assert np.array_equal(getattr(one.scene, name), getattr(same.scene, name))
    assert one.goals == same.goals
    assert one.scene.vertices.shape != other.scene.vertices.shape or not np.array_equal(
        one.scene.vertices, other.scene.vertices)


@pytest.mark.parametrize('rooms', range(1, 13))
def test_every_room_has_a_goal_and_every_free_cell_is_reachable(rooms):
    for seed in range(4):
        house = generate_house(seed, rooms=rooms)
        assert len(house.rooms) == rooms
        assert {goal.room for goal in house.goals} == {room.name for room in house.rooms}
        free = house.floor.free
        assert np.array_equal(main_component(free), free)
        for goal in house.goals:
            distance = house.geodesic(*goal.pose[:2]).distance(house.floor.centres())
            assert np.isfinite(distance).all()
            assert house.room_at(*goal.pose[:2]) == goal.room


def test_the_standard_house_is_large_enough():
    for seed in range(20):
        house = generate_house(seed, rooms=5)
        assert house.area >= 60 and len(house.goals) >= 4
    assert DOOR_WIDTH >= 0.85


def test_furniture_is_labelled_and_stands_in_its_room():
    labels = set()
    for seed in range(12):
        house = generate_house(seed, rooms=7)
        labels |= {LABELS[label] for label in np.unique(house.scene.face_label)}
        for obstacle in house.obstacles:
            if obstacle.label != 'wall':
                x0, y0, x1, y1 = obstacle.rect
                assert house.room_at((x0 + x1) / 2, (y0 + y1) / 2)
    assert len(labels) >= 25, sorted(labels)


def test_geodesic_distance_in_the_open_is_the_straight_line():
    house = generate_house(0, rooms=1)
    cells = house.floor.centres()
    start = cells[np.argmin(np.hypot(*(cells - cells.mean(0)).T))]
    distance = house.geodesic(*start).distance(cells)
    straight = np.hypot(*(cells - start).T)
    near = straight < 1.0
    assert np.abs(distance[near] - straight[near]).max() < 0.6 * CELL
    assert (distance >= straight - 0.02).all()


def test_geodesic_distance_goes_through_doors():
    house = generate_house(7, rooms=5)
    field = house.geodesic(*house.goals[0].pose[:2])
    others = np.array([goal.pose[:2] for goal in house.goals[1:]])
    straight = np.hypot(*(others - house.goals[0].pose[:2]).T)
    assert (field.distance(others) >= straight - 0.02).all()
    assert (field.distance(others) > straight + 0.3).any()


@pytest.mark.parametrize('seed, rooms', [(-1, 5), (1.5, 5), (0, 0), (0, 13)])
def test_impossible_houses_are_refused(seed, rooms):
    with pytest.raises(UserError, match='received'):
        generate_house(seed, rooms=rooms)
