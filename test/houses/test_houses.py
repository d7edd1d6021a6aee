"""Procedural houses: varied, whole, and the same every time."""

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_sim_bridge.floor.floor_map import CELL, clearance, main_component
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.layout import DOOR_WIDTH
from vn_sim_bridge.houses.looks import STANDARD, UNSEEN
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.splits import SPLITS, split_of
from vn_sim_bridge.houses.textures import TEXTURES


def test_equal_seeds_give_equal_houses_and_others_differ():
    one, same, other = generate_house(3), generate_house(3), generate_house(4)
    for name in ('vertices', 'face_uv', 'face_colour', 'face_label', 'light', 'group_box'):
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
            distance = house.geodesic(*goal.pose[:2]).at(house.floor.centres())
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
            if obstacle.label not in ('wall', 'outside'):
                x0, y0, x1, y1 = obstacle.rect
                assert house.room_at((x0 + x1) / 2, (y0 + y1) / 2)
    assert len(labels) >= 25, sorted(labels)


def test_geodesic_distance_in_the_open_is_the_straight_line():
    house = generate_house(0, rooms=1)
    cells = house.floor.centres()
    room = clearance(house.floor.origin, house.floor.free.shape, house.obstacle_rects)
    start = cells[np.argmax(room[house.floor.free])]  # where there is most room around
    distance = house.geodesic(*start).at(cells)
    straight = np.hypot(*(cells - start).T)
    near = straight < room.max() - 0.2
    assert near.sum() > 30
    assert np.abs(distance[near] - straight[near]).max() < 0.6 * CELL
    assert (distance >= straight - 0.02).all()


def test_geodesic_distance_goes_through_doors():
    house = generate_house(7, rooms=5)
    field = house.geodesic(*house.goals[0].pose[:2])
    others = np.array([goal.pose[:2] for goal in house.goals[1:]])
    straight = np.hypot(*(others - house.goals[0].pose[:2]).T)
    assert (field.at(others) >= straight - 0.02).all()
    assert (field.at(others) > straight + 0.3).any()


@pytest.mark.parametrize('seed, rooms', [(-1, 5), (13_000, 5), (1.5, 5), (0, 0), (0, 13)])
def test_impossible_houses_are_refused(seed, rooms):
    with pytest.raises(UserError, match='received'):
        generate_house(seed, rooms=rooms)


@pytest.mark.slow  # 60 houses
def test_houses_are_distinct():
    seen = {generate_house(seed, rooms=2).scene.vertices.tobytes() for seed in range(60)}
    assert len(seen) == 60


def test_splits_are_disjoint_and_frozen():
    assert {name: (seeds.start, seeds.stop) for name, seeds in SPLITS.items()} == {
        'train': (0, 10_000), 'validation': (10_000, 11_000), 'test': (11_000, 12_000),
        'unseen_look': (12_000, 13_000)}
    assert [split_of(seed) for seed in (0, 9_999, 10_000, 11_500, 12_000)] == [
        'train', 'train', 'validation', 'test', 'unseen_look']


@pytest.mark.slow  # 24 houses
def test_the_unseen_look_shares_nothing_with_the_standard_one():
    for field in STANDARD._fields:
        one, other = ({value} if isinstance(value, str) else set(value)
                      for value in (getattr(STANDARD, field), getattr(UNSEEN, field)))
        assert one and other and not one & other, field
    neutral = {'plain', 'plaster', 'marble', 'tiles', 'books', 'window', 'door', 'leaves',
               'fabric', 'fire', 'water', 'clock', 'keys', 'brick', 'stripes', 'wood', 'carpet'}
    used = []
    for seeds in (range(12), range(12_000, 12_012)):
        names = list(TEXTURES)
        used.append({names[k] for seed in seeds for k in np.unique(
            generate_house(seed, rooms=7).scene.face_texture)} - neutral)
    assert not used[0] & used[1], used[0] & used[1]
    assert len(used[0]) > 20 and len(used[1]) > 15


@pytest.mark.slow  # 30 houses of nine rooms
def test_furniture_has_many_classes_of_several_parts():
    parts = {}
    for seed in range(30):
        scene = generate_house(seed, rooms=9).scene
        for group in range(len(scene.group_room)):
            faces = slice(scene.group_start[group], scene.group_start[group + 1])
            labels = scene.face_label[faces]
            main = LABELS[np.bincount(labels).argmax()]
            parts[main] = max(parts.get(main, 0), len(labels))
    furniture = set(parts) - {'wall', 'floor', 'ceiling', 'door', 'window', 'picture', 'rug'}
    several = {name for name in furniture if parts[name] > 6}  # more than one box
    assert len(several) >= 25, sorted(several)


def test_two_wings_leave_the_corner_out():
    shapes = [generate_house(seed, rooms=8) for seed in range(12)]
    winged = [house for house in shapes if any(o.label == 'outside' for o in house.obstacles)]
    assert 2 <= len(winged) < 12
    for house in winged:
        for obstacle in house.obstacles:
            if obstacle.label == 'outside':
                x0, y0, x1, y1 = obstacle.rect
                cells = house.floor.centres()
                assert not ((cells[:, 0] > x0) & (cells[:, 0] < x1) & (cells[:, 1] > y0)
                            & (cells[:, 1] < y1)).any()


def test_doors_are_kept_free():
    for seed in range(8):
        house = generate_house(seed, rooms=6)
        furniture = [o.rect for o in house.obstacles if o.label not in ('wall', 'outside')]
        scene = house.scene
        doors = [k for k in range(len(scene.group_room)) if (
            scene.face_label[scene.group_start[k]:scene.group_start[k + 1]] == LABELS.index(
                'door')).all()]
        assert len(doors) >= 5
        for door in doors:
            x0, y0, _, x1, y1, _ = scene.group_box[door]
            for rect in furniture:
                gap = max(rect.x0 - x1, x0 - rect.x1, rect.y0 - y1, y0 - rect.y1)
                assert gap > 0.05, (seed, rect)


def test_light_is_darker_in_corners_and_brighter_under_the_lamp():
    house = generate_house(7, rooms=1)
    scene = house.scene
    floor = int(np.argmax(scene.face_label == LABELS.index('floor')))
    first, width = scene.face_light[floor]
    rows = 1 + int(round(scene.face_light_map[floor, 2] * np.ptp(
        scene.vertices[scene.face_start[floor]:scene.face_start[floor + 1], 1]) / 1.6))
    nodes = scene.light[first:first + width * rows].reshape(rows, width)
    ambient, lamp = nodes & np.uint64(0xFFFF), nodes >> np.uint64(16) & np.uint64(0xFFFF)
    corners = ambient[[0, 0, -1, -1], [0, -1, 0, -1]].astype(int)
    assert corners.max() < 0.75 * ambient.max() and ambient.max() > 230
    assert lamp.max() > 2 * np.median(lamp[[0, 0, -1, -1], [0, -1, 0, -1]].astype(int))
