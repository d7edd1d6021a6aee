"""Motion: partial moves, no sliding, noise; numbers from counters."""

import math

import numpy as np
import pytest

from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, normal, uniform
from vn_sim_bridge.floor import contacts
from vn_sim_bridge.floor.contacts import (
    MAX_TILT,
    ROTATION_NOISE,
    TRANSLATION_NOISE,
    World,
    motion_noise,
)
from vn_sim_bridge.houses.procedural import generate_house

RADIUS = RobotSpec().footprint_radius


@pytest.fixture
def world():
    """Four robots in an empty-ish room; robot 0 stands in its largest free place."""
    house = generate_house(0, rooms=1)
    world = World([house], np.zeros(4, int), RADIUS)
    world.house = house
    world.poses[:, :2] = house.goals[0].pose[:2]
    return world


def clearance(world, n=0):
    x, y = world.poses[n, :2]
    rects = world.house.obstacle_rects
    dx = np.maximum(np.maximum(rects[:, 0] - x, x - rects[:, 2]), 0)
    dy = np.maximum(np.maximum(rects[:, 1] - y, y - rects[:, 3]), 0)
    return np.hypot(dx, dy).min()


def test_a_free_move_is_exact(world):
    start = world.poses[0].copy()
    done, touched = world.move(np.array([[0.05, 0.02, 0, 0]]), np.array([0]))
    assert np.allclose(done, [[0.05, 0.02, 0, 0]]) and not touched[0]
    assert np.allclose(world.poses[0], start + [0.05, 0.02, 0, 0])
    done, _ = world.move(np.array([[0, 0, math.radians(350), 0]]), np.array([0]))
    assert world.poses[0, 2] == pytest.approx(math.radians(-10))


@pytest.mark.parametrize('heading', np.linspace(-3, 3, 13))
def test_a_blocked_move_ends_at_the_contact_and_does_not_slide(world, heading):
    world.poses[0, 2] = heading
    start = world.poses[0].copy()
    done, touched = world.move(np.array([[20.0, 0, 0, 0]]), np.array([0]))
    assert touched[0] and 0 <= done[0, 0] < 20
    direction = world.poses[0, :2] - start[:2]
    assert np.allclose(direction, done[0, 0] * np.array([math.cos(heading), math.sin(heading)]))
    assert RADIUS - 1e-9 <= clearance(world) < RADIUS + 0.002
    again, touched = world.move(np.array([[0.5, 0, 0, 0]]), np.array([0]))
    assert touched[0] and again[0, 0] < 0.002


def test_robots_never_enter_obstacles(world):
    rng = np.random.default_rng(0)
    for _ in range(300):
        world.move(np.column_stack([rng.normal(0, 0.4, (4, 2)), rng.normal(0, 1, 4),
                                    np.zeros(4)]), np.arange(4))
        assert min(clearance(world, n) for n in range(4)) >= RADIUS - 1e-9


def test_many_ticks_travel_as_far_as_one_move(world):
    world.move(np.array([[0.4, 0, 0, 0]]), np.array([0]))
    for _ in range(40):
        world.move(np.array([[0.01, 0, 0, 0]]), np.array([1]))
    assert np.allclose(world.poses[0], world.poses[1], atol=1e-3)


def test_tilt_is_limited(world):
    done, _ = world.move(np.array([[0, 0, 0, 2.0]]), np.array([2]))
    assert done[0, 3] == pytest.approx(MAX_TILT)


@pytest.mark.parametrize('ticks', [1, 15])
def test_noise_adds_up_to_the_same_variance_in_ticks(ticks):
    """One decision drawn at once, or spread over the ticks of a motion (docs, "Noise")."""
    rng = np.random.default_rng(1)
    total = np.zeros((4000, 4))
    for _ in range(ticks):
        wanted = np.tile([0.5 / ticks, 0, 0, 0], (4000, 1))
        total += motion_noise(wanted, np.full(4000, 0.5), rng.standard_normal(4000))
    assert total[:, 0].mean() == pytest.approx(0.5, abs=0.002)
    assert total[:, 0].std() == pytest.approx(TRANSLATION_NOISE, rel=0.06)
    assert (total[:, 1:] == 0).all()
    turn = np.tile([0, 0, 0.5, 0], (4000, 1))
    noisy = motion_noise(turn, np.full(4000, 0.5), rng.standard_normal(4000))
    assert noisy[:, 2].std() == pytest.approx(ROTATION_NOISE, rel=0.06)
    exact = motion_noise(turn, np.full(4000, 0.5), rng.standard_normal(4000), exact_turns=True)
    assert np.array_equal(exact, turn)
    assert np.array_equal(motion_noise(np.array([[0, 0, 0, 0.5]]), np.ones(1), np.ones(1)),
                          [[0, 0, 0, 0.5]])


def test_counter_numbers_are_functions_of_their_counter():
    envs = np.arange(1000)
    whole = uniform(5, Stream.GOAL, envs, 3, 7)
    assert np.array_equal(whole[[10, 500]], uniform(5, Stream.GOAL, np.array([10, 500]), 3, 7))
    assert not np.isclose(whole, uniform(5, Stream.START_YAW, envs, 3, 7)).any()
    assert not np.isclose(whole, uniform(6, Stream.GOAL, envs, 3, 7)).any()
    assert abs(whole.mean() - 0.5) < 0.03 and 0 <= whole.min() and whole.max() < 1
    numbers = normal(5, Stream.MOTION_NOISE, np.arange(20_000), 0, 0)
    assert abs(numbers.mean()) < 0.03 and abs(numbers.std() - 1) < 0.03
    assert abs(np.corrcoef(numbers[:-1], numbers[1:])[0, 1]) < 0.03


def test_rectangles_far_away_change_nothing():
    """A mesh has thousands: only near ones are looked at, and the contact is the same."""
    rng = np.random.default_rng(5)
    low = rng.uniform(-6, 6, (3000, 2))
    rects = np.column_stack([low, low + rng.uniform(0.01, 0.12, (3000, 2))])
    poses = np.zeros((40, 4))
    while True:  # robots that touch nothing yet
        free = [contacts._collides(*pose[:2], rects, 0.05) for pose in poses]
        if not any(free):
            break
        poses[free, :2] = rng.uniform(-5, 5, (sum(free), 2))
    poses[:, 2] = rng.uniform(-3, 3, 40)
    length = rng.uniform(0.1, 1.5, 40)
    delta = np.column_stack([length, np.zeros((40, 3))])
    want = [contacts._travel(x, y, math.cos(yaw), math.sin(yaw), gone, rects, 0.05)
            for (x, y, yaw, _), gone in zip(poses, length, strict=True)]
    ends = poses[0, :2] + want[0] * np.array([math.cos(poses[0, 2]), math.sin(poses[0, 2])])
    assert np.array_equal(contacts.reach_among(rects, 0.05, *poses[0, :2], poses[:1, 2],
                                               length[0])[0], ends)
    done, touched = contacts.move_among(rects, 0.05, poses, delta, np.arange(40))
    assert np.allclose(done[:, 0], want, rtol=0, atol=1e-15) and touched.any()
    assert np.array_equal(touched, np.array(want) < length)
