"""Which rooms the task room goes to, and what it is told about them."""

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_sim_bridge.floor.floor_map import FloorMap, Rect
from vn_sim_bridge.houses.house import Room
from vn_sim_bridge.navigation.tasks import RoomGoal, room_classes
from vn_sim_bridge.simulator import Goal


class Flat:
    """Three cells' rooms in a row; the goals that are given."""

    name = 'flat:0'
    floor = FloorMap((0.0, 0.0), np.ones((10, 60), bool))

    def __init__(self, kinds, goals):
        self.rooms = tuple(Room(f'room {k}', kind, Rect(2.0 * k, 0.0, 2.0 * k + 2, 1.0))
                           for k, kind in enumerate(kinds))
        self.goals = tuple(Goal((2.0 * k + 1, 0.5, 0.0, 0.0), f'room {k}') for k in goals)

    def starts(self):
        return self.floor.centres(), None


def test_rooms_without_a_kind_are_no_goals():
    task = RoomGoal([Flat(['', 'bedroom', 'kitchen'], [0, 1, 2])], 1, must_see=False,
                    min_distance=0.5)
    assert task.kinds == ['bedroom', 'kitchen']
    with pytest.raises(UserError, match='flat:0: none'):
        RoomGoal([Flat(['', ''], [0, 1])], 1, must_see=False, min_distance=0.5)


def test_a_type_whose_first_room_nobody_gets_into_is_shown_by_the_next():
    task = RoomGoal([Flat(['bedroom', 'bedroom', 'kitchen'], [1, 2])], 1, must_see=False,
                    min_distance=0.5)
    assert task.kinds == ['bedroom', 'kitchen'] and task.views[0].pose[0] == 3.0
    assert len(task.inside[0]) == 2  # either one will do


def test_a_simulator_may_name_the_objects_of_its_rooms():
    names, own = ('nothing', 'bed', 'kitchen_set'), {'kitchen': ('kitchen_set',)}
    assert room_classes(names, 'kitchen', own) == [2] and room_classes(names, 'bedroom') == [1]
    with pytest.raises(UserError, match='kitchen'):
        room_classes(names, 'kitchen')
    task = RoomGoal([Flat(['kitchen'], [0])], 1, must_see=True, min_distance=0.5,
                    label_names=names, room_objects=own)
    assert task.classes == {'kitchen': [2]}
