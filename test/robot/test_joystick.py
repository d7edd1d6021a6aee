"""The joystick drives a whole house by velocities alone, and as a person would."""

import math

import numpy as np
import pytest

from vn_nav.robot import RobotSpec
from vn_nav.scenes import house_scene
from vn_sim_bridge.floor.floor_map import clearance
from vn_sim_bridge.navigation.tasks import wrap_angle
from vn_sim_bridge.robot.joystick import (
    ANGULAR_RAMP,
    LINEAR_RAMP,
    MAX_ANGULAR,
    MAX_LINEAR,
    Joystick,
    cover,
    tour,
    way,
)
from vn_sim_bridge.robot.simulated_robot import TICK, SimulatedRobot

HOUSE, ROOMS = 12_000, 5  # of the unseen look


def robot_at_its_start(house=HOUSE, rooms=ROOMS):
    robot = SimulatedRobot(house_scene(house, rooms), robot=RobotSpec(), size=16,
                           noise=False, seed=1, stop='declared', max_decisions=10**9,
                           odometry_drift=1.0)
    robot.begin_episode(0)
    return robot


def drive(robot, joystick, seconds):
    """True poses [K,3], velocities [K,4] and whether something was touched."""
    poses, velocities = [robot.pose[:3].copy()], []
    for _ in range(round(seconds / TICK)):
        velocities.append(joystick.velocity(robot.pose))
        robot.tick(velocities[-1])
        poses.append(robot.pose[:3].copy())
    return np.array(poses), np.array(velocities), robot._touched


@pytest.fixture(scope='module')
def shown():
    robot = robot_at_its_start()
    joystick = Joystick(robot.place, *robot.pose[:2])
    return robot, joystick, *drive(robot, joystick, 90)


def test_a_person_holds_the_stick(shown):
    _, _, _, velocities, touched = shown
    assert not touched
    forward, left, turn, tilt = np.abs(velocities).max(axis=0)
    assert 0.2 < forward <= MAX_LINEAR and 0.6 < turn <= MAX_ANGULAR and left == tilt == 0
    change = np.abs(np.diff(velocities, axis=0)).max(axis=0) / TICK
    assert change[0] <= LINEAR_RAMP + 1e-9 and change[2] <= ANGULAR_RAMP + 1e-9
    both = (np.abs(velocities[:, 0]) > 0.05) & (np.abs(velocities[:, 2]) > 0.05)
    assert both.mean() > 0.05, 'curves, not only straight lines and turns'
    assert (velocities[:, 2] > 0.5).any() and (velocities[:, 2] < -0.5).any()


def test_it_turns_around_at_every_place(shown):
    _, joystick, poses, velocities, _ = shown
    assert joystick.visited >= 4
    turns = np.abs(wrap_angle(np.diff(poses[:, 2])))
    for place in joystick.places[:joystick.visited - 1]:
        here = (np.hypot(*(poses[1:, :2] - place).T) < 0.2) & (np.abs(velocities[:, 0]) < 0.03)
        assert turns[here].sum() > math.radians(340)


@pytest.fixture(scope='module')
def covering():
    house = robot_at_its_start().place
    gap = clearance(house.floor.origin, house.floor.free.shape, house.obstacle_rects)
    return house, gap - house.footprint_radius


def test_the_places_cover_the_floor(covering):
    house, gap = covering
    cells = house.floor.centres()
    counts = []
    for spacing in (1.0, 2.0):
        places, fields = cover(house, gap, spacing)
        near = np.min([field.at(cells) for field in fields], axis=0)
        assert (near <= 0.8 * spacing).mean() > 0.85
        assert {house.room_at(*place) for place in places} >= {r.name for r in house.rooms}
        counts.append(len(places))
    assert len(cells) * 0.01 * 0.6 < counts[0] < len(cells) * 0.01 * 1.4  # one a square metre
    assert counts[1] < counts[0] / 2


def test_the_tour_goes_through_a_room_at_a_time(covering):
    house, gap = covering
    places, fields = cover(house, gap, 1.0)
    order = tour(places, fields, places[0])
    assert sorted(order) == list(range(len(places)))
    between = np.array([field.at(places) for field in fields])
    assert between[order[:-1], order[1:]].sum() < 1.8 * len(places)
    rooms = [name for k in order if (name := house.room_at(*places[k]))]
    assert sum(a != b for a, b in zip(rooms[:-1], rooms[1:], strict=True)) <= 2 * len(house.rooms)


def test_a_way_keeps_clear_of_obstacles(covering):
    house, gap = covering
    places, _ = cover(house, gap, 2.0)
    for start, end in zip(places[:-1], places[1:], strict=True):
        points = way(house.floor, gap, tuple(start), end)
        assert np.hypot(*(points[0] - start).T) < 0.1 and np.array_equal(points[-1], end)
        assert np.hypot(*np.diff(points, axis=0).T).max() < 0.25
        x, y = (points - house.floor.origin).T / 0.1
        assert house.floor.free[y.astype(int), x.astype(int)].all()


def test_without_turns_it_does_not_stop_and_then_drives_back(covering):
    house, _ = covering
    robot = robot_at_its_start()
    joystick = Joystick(house, *robot.pose[:2], spacing=2.5, turns=False)
    poses, velocities, touched = drive(robot, joystick, 60)
    assert not touched and joystick.visited >= 3
    assert (velocities[100:, 0] > 0.05).mean() > 0.7
    visited, count = [], len(joystick.places)
    for _ in range(3 * count):  # as if it were there at once
        before = joystick.visited
        visited.append(joystick._next)
        while joystick.visited == before:
            joystick.velocity(np.array([*joystick.places[joystick._next], 0.0]))
    steps = np.abs(np.diff(visited))
    assert set(visited) == set(range(count)) and (steps == 1).all()


def test_where_it_does_not_get_on_it_backs_off(covering):
    house, _ = covering
    robot = robot_at_its_start()
    joystick = Joystick(house, *robot.pose[:2])
    x, y = robot.pose[:2]
    along = joystick.velocity(robot.pose)  # it has a way now
    heading = math.atan2(*(joystick._ahead(x, y) - (x, y))[::-1])
    pushed = [joystick.velocity(np.array([x, y, heading]))[0] for _ in range(200)]
    assert along is not None and max(pushed) > 0.05 and min(pushed) < -0.05


@pytest.mark.slow
def test_ten_minutes_show_the_house():
    robot = robot_at_its_start()
    joystick = Joystick(robot.place, *robot.pose[:2])
    poses, _, touched = drive(robot, joystick, 600)
    cells = robot.place.floor.centres()
    near = [np.hypot(*(poses[::5, :2] - cell).T).min() <= 0.6 for cell in cells]
    assert not touched and np.mean(near) > 0.88
    assert {robot.place.room_at(*pose[:2]) for pose in poses} >= {
        room.name for room in robot.place.rooms}
