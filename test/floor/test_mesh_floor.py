"""A mesh's floor: storeys, obstacles, free cells, stairs; an embedded house gives its own map."""

import numpy as np
import pytest
from mesh_places import (
    DOOR,
    FLOOR,
    box,
    flat,
    house_surfaces,
    room_surfaces,
    surface,
    together,
)

from vn_nav.errors import UserError
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.floor.mesh_floor import (
    choose_level,
    floor_levels,
    mesh_floor,
    rectangles_of_polygons,
)
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.procedural import generate_house

RADIUS = 0.18


def floor_of(surfaces, **more):
    return mesh_floor(*together(surfaces), LABELS, RADIUS, **more)


def is_free(found, x, y):
    i, j = int((y - found.outline.y0) / CELL), int((x - found.outline.x0) / CELL)
    return bool(found.floor.free[i, j])


def test_a_room_is_free_but_for_its_table():
    found = floor_of(room_surfaces())
    assert is_free(found, 1, 1) and is_free(found, 5, 3)
    assert not is_free(found, 2.5, 1.5), 'under the table'
    assert not is_free(found, 2.5, 2.12) and is_free(found, 2.5, 2.35), 'its rim, and beside it'
    assert not is_free(found, 0.12, 2) and is_free(found, 0.35, 2), 'the wall keeps its distance'
    labels = {label for _, label in found.obstacles}
    assert labels == {'wall', 'table', 'outside'}
    table = next(rect for rect, label in found.obstacles if label == 'table')
    assert np.allclose(table, (2, 1, 3, 2), atol=0.011)
    assert found.area == pytest.approx(5.6 * 3.6 - 1.4 * 1.4, rel=0.06)


def test_what_lies_low_or_hangs_high_is_no_obstacle():
    things = [surface(box(1, 1, 0, 2, 2, .1), FLOOR), surface(box(3, 1, 1.3, 4, 2, 2), DOOR)]
    found = floor_of([*room_surfaces()[:-1], *things])
    assert is_free(found, 1.5, 1.5) and is_free(found, 3.5, 1.5)
    lower = floor_of([*room_surfaces()[:-1], *things], height=1.4, step=0.05)
    assert not is_free(lower, 3.5, 1.5)
    open_door = floor_of([*room_surfaces()[:-1], *things], height=1.4, passable={'door'})
    assert is_free(open_door, 3.5, 1.5)


@pytest.mark.parametrize(('seed', 'rooms'), [(7, 5), (3, 2), (12007, 6)])
def test_an_embedded_house_gives_its_own_map(seed, rooms):
    house = generate_house(seed, rooms=rooms)
    (level,) = floor_levels(together(house_surfaces(house))[0])
    assert level.z == pytest.approx(0, abs=1e-3)
    found = floor_of(house_surfaces(house))
    free = np.mean([is_free(found, x, y) for x, y in house.floor.centres()])
    # A house's map has whole outlines of furniture, a mesh what is under a table or between legs.
    assert free > 0.97
    assert found.floor.free.sum() < 1.3 * house.floor.free.sum()


def two_storeys():
    """A room of 24 m2, above it one of 32 m2, and a stair through a hole between them."""
    lower, upper = room_surfaces(), room_surfaces(3.0, 8.0)
    upper[0] = surface(np.concatenate([flat(0, 0, 5, 4, 3), flat(5, 0, 6, 1, 3),
                                       flat(6, 0, 8, 4, 3)]), FLOOR)
    lower[1] = surface(flat(0, 0, 4, 4, 2.5, False), lower[1].label)
    steps = [surface(box(5, 3.7 - .3 * k, 0, 6, 4 - .3 * k, .3 * (k + 1)), FLOOR, 20 + k)
             for k in range(10)]
    return [*lower, *upper, *steps]


def test_storeys_are_found_and_chosen():
    surfaces = two_storeys()
    levels = floor_levels(together(surfaces)[0])
    assert [round(level.z, 2) for level in levels] == [0, 3]
    assert choose_level(levels).z == pytest.approx(3), 'the larger one'
    assert choose_level(levels, 0).z == pytest.approx(0)
    with pytest.raises(UserError, match='0 to 1.*2.*1: 3.00 m'):
        choose_level(levels, 2)


def test_stairs_are_left_out():
    surfaces = two_storeys()
    corners, labels = together(surfaces)
    lower = mesh_floor(corners, labels, LABELS, RADIUS)
    assert is_free(lower, 1, 3) and not is_free(lower, 5.5, 3.8), 'its steps are obstacles'
    upper = mesh_floor(corners - (0, 0, 3), labels, LABELS, RADIUS)
    assert is_free(upper, 7, 2) and is_free(upper, 1, 3)
    assert not any(is_free(upper, x, y) for x in (5.3, 5.7) for y in (1.6, 2.5, 3.5))
    over = [rect for rect, label in upper.obstacles if label == 'outside'
            and rect.x0 <= 5.5 <= rect.x1 and rect.y0 <= 3 <= rect.y1]
    assert over, 'nothing to stand on is something that a move ends at'


def test_a_roof_and_the_ground_around_are_no_storeys():
    scene = [*room_surfaces(), surface(flat(-20, -20, 30, 30, -.3), FLOOR),
             surface(flat(-1, -1, 7, 5, 2.6), FLOOR)]
    (level,) = floor_levels(together(scene)[0])
    assert level.z == pytest.approx(0, abs=1e-3)
    found = floor_of(scene)
    assert is_free(found, 1, 1) and found.area < 24
    garden = [*room_surfaces(), surface(flat(-20, -20, -.1, 30, 0), FLOOR)]
    assert floor_of(garden).area < 24, 'the part under the ceiling, though the other is larger'


def test_holes_of_a_scan_and_gaps_in_doors_are_floor():
    left = [s for s in room_surfaces() if s.label != FLOOR]
    pieces = [surface(flat(0, 0, 2.2, 4), FLOOR), surface(flat(2.5, 0, 6, 4), FLOOR)]
    assert is_free(floor_of([*left[:-1], *pieces]), 2.35, 2)


def test_what_has_no_class_and_is_tall_counts_as_wall():
    unnamed = LABELS.index('object')
    scene = [s._replace(label=unnamed) for s in room_surfaces()]
    labels = {label for _, label in floor_of(scene).obstacles}
    assert labels == {'wall', 'object', 'outside'}


@pytest.mark.parametrize(('scene', 'rule'), [
    ([surface(flat(0, 0, .15, .15), FLOOR)], 'radius 0.18 m has floor'),
    ([surface(flat(0, 0, 6, 6, 0, False), FLOOR)], 'has a floor'),
    ([surface(flat(0, 0, 9000, 9000), FLOOR)], 'square metres'),
])
def test_what_has_no_floor_is_refused(scene, rule):
    with pytest.raises(UserError, match=rule):
        floor_of(scene)
    with pytest.raises(UserError, match='square metres'):
        choose_level(floor_levels(scene[0].corners))


def test_polygons_become_rectangles():
    shape = np.array([(0, 0), (4, 0), (4, 2), (2, 2), (2, 3), (0, 3)], float)
    rects = rectangles_of_polygons([shape])
    assert sum(rect.area for rect in rects) == pytest.approx(10, rel=0.1)
    inside = [any(r.x0 <= x <= r.x1 and r.y0 <= y <= r.y1 for r in rects)
              for x, y in ((1, 1), (3.5, 1), (1, 2.8), (3, 2.5))]
    assert inside == [True, True, True, False]
