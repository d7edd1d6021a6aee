"""What a task or a sensor asks of places beside `Place`; a place without it is told so."""

import dataclasses

import pytest

from examples.corridor import Corridor, CorridorSimulator
from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.floor.places import have_floors, walled, with_rooms
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulator import Setup

SCENE = 'examples.corridor:5'
ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)


def make(place, promised, **options):
    """An environment in a corridor, of a simulator that promises more than corridors have."""
    simulator = CorridorSimulator([place], Setup(1, ROBOT, 24))
    simulator.capabilities = dataclasses.replace(simulator.capabilities, **promised)
    return NavigationEnv(EnvConfig(scenes=(SCENE,), num_envs=1, size=24, **options), ROBOT,
                         simulator=simulator)


def test_a_house_is_a_place_of_every_kind_and_a_corridor_of_none():
    house, corridor = generate_house(7, rooms=1), Corridor(SCENE, 5)
    for kind in (walled, with_rooms):
        assert kind(house) is house
        with pytest.raises(UserError, match=SCENE):
            kind(corridor)
    assert have_floors([house]) and not have_floors([house, corridor])


@pytest.mark.parametrize('promised, options, rule', [
    ({'walls': True}, {'privileged': ('explorer_action',)}, 'floor, obstacles'),
    ({'rooms': True}, {'task': 'room'}, 'rooms and floor'),
])
def test_places_that_lack_what_the_simulator_promises_are_named(promised, options, rule):
    with pytest.raises(UserError, match=f'{rule}.*{SCENE}'):
        make(Corridor(SCENE, 5), promised, **options)


@pytest.mark.parametrize('task', ['object', 'collect'])
def test_a_simulator_that_places_objects_names_them(task):
    with pytest.raises(UserError, match=f'task_objects.*{task}'):
        make(Corridor(SCENE, 5), {'placeable_objects': True}, task=task)


def test_distances_of_a_place_with_a_floor_are_over_that_floor():
    place = Corridor(SCENE, 5)
    place.floor = generate_house(7, rooms=1).floor
    env = make(place, {})
    with pytest.raises(UserError, match='StraightDistance'):
        env.reset(seed=0)
