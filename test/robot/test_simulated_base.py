"""The base under the simulated robot: limits are kept, profiles within them are not touched."""

import dataclasses
import math

import numpy as np
import pytest

from vn_nav.policy.motion import ActionExecutor
from vn_nav.resources import share_file
from vn_nav.robot import AXES, RobotSpec, load_robot
from vn_sim_bridge.floor.floor_map import clearance
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.robot.simulated_base import SimulatedBase
from vn_sim_bridge.robot.simulated_robot import TICK, SimulatedRobot

STANDARD = RobotSpec()
ROBOTS = [STANDARD, load_robot(share_file('config/robots/demo_base.yaml'))]
FASTEST = np.array([STANDARD.max_velocity(axis) for axis in AXES])
STEP = np.array([STANDARD.acceleration(axis) for axis in AXES]) * TICK


def simulated(robot=STANDARD, noise=False, **options):
    """A robot where the most room is, and how much that is [m]."""
    found = SimulatedRobot('house:7?rooms=2', robot=robot, size=16, noise=noise, seed=3, **options)
    found.begin_episode(0)
    floor = found.place.floor
    gap = clearance(floor.origin, floor.free.shape, found.place.obstacle_rects)[floor.free]
    found.simulator.place(np.array([0]), np.array([[*floor.centres()[np.argmax(gap)], 0.3, 0.0]]))
    return found


def test_no_command_is_faster_than_the_robot_file_allows():
    robot = simulated()
    rng = np.random.default_rng(0)
    before = np.zeros(4)
    for k in range(400):
        command = rng.choice([-1e308, -20.0, -0.4, 0.0, 0.1, 5.0, 20.0, 1e308], 4)
        pose = robot.pose.copy()
        robot.drive(command if k % 40 < 30 else np.zeros(4))
        assert (np.abs(robot.base.velocity) <= FASTEST).all()
        assert (np.abs(robot.base.velocity - before) <= STEP * (1 + 1e-5)).all()
        before = robot.base.velocity.copy()
        assert math.dist(robot.pose[:2], pose[:2]) <= math.sqrt(2) * STANDARD.max_linear * TICK


@pytest.mark.parametrize('command', [(5.0, 0, 0, 0), (0, 0, -20.0, 0), (0, 1.0, 0, 0)])
def test_it_brakes_within_the_time_and_the_way_of_its_limits(command):
    robot, axis = simulated(), int(np.flatnonzero(command)[0])
    for _ in range(30):
        robot.drive(np.array(command, float))
    assert abs(robot.velocity[axis]) == FASTEST[axis]
    pose, ticks = robot.pose.copy(), 0
    while robot.velocity.any():
        judged = robot.drive(np.zeros(4))
        ticks += 1
        assert (judged is None) == robot.velocity.any(), 'judged at rest'
    seconds = FASTEST[axis] / STEP[axis] * TICK
    assert seconds - TICK <= ticks * TICK <= seconds + TICK
    way = math.dist(robot.pose[:2], pose[:2]) if axis < 2 else abs(robot.pose[2] - pose[2])
    assert way == pytest.approx(FASTEST[axis] * seconds / 2, abs=FASTEST[axis] * TICK)


@pytest.mark.slow
@pytest.mark.parametrize('spec', ROBOTS, ids=lambda robot: robot.name)
def test_whole_actions_are_driven_bit_for_bit_as_they_were_commanded(spec):
    """Also against a wall, where the profile ends at full speed: `tick` knows no limits."""
    limited, free = (simulated(spec, noise=True) for _ in range(2))
    rng, contacts = np.random.default_rng(1), 0
    for action in rng.choice(len(spec.actions), 60, p=[0.5, 0.1, 0.1, 0.1, 0.1, 0.1, 0, 0]):
        executors = []
        for robot in (limited, free):
            executor = ActionExecutor(spec, tolerance=1e-6, creep=0.0)
            executor.begin(int(action), robot.odometry)
            executors.append(executor)
        over = False
        while not over:
            (velocity, over), (same, _) = (
                executor.velocity(TICK, robot.odometry)
                for executor, robot in zip(executors, (limited, free), strict=True))
            assert np.array_equal(velocity, same)
            judged, expected = limited.drive(velocity), free.tick(velocity)
            assert np.array_equal(limited.pose, free.pose)
            assert np.array_equal(limited.odometry, free.odometry)
            assert np.array_equal(limited.velocity, free.velocity)
            assert judged == expected
        contacts += judged.collided
    assert contacts > 5, 'some of them ended at a wall'


def test_a_reversal_is_one_motion():
    robot = simulated()
    robot.drive(np.array([STEP[0], 0, 0, 0]))
    back = np.array([-0.3, 0, 0, 0])
    assert robot.drive(back) is None and not robot.velocity.any(), 'it passes zero'
    assert robot.drive(back) is None and robot.velocity[0] == -STEP[0]
    assert robot.episode.decisions == 0
    assert robot.drive(np.zeros(4)) is not None
    assert robot.episode.decisions == 1


def test_at_an_obstacle_the_body_needs_no_braking():
    base = SimulatedBase(STANDARD, TICK)
    for _ in range(20):
        base.follow(np.array([0.3, 0, 0, 0]), base.velocity)
    assert base.velocity[0] == 0.3
    assert base.follow(np.array([0.3, 0, 0, 0]), np.zeros(4))[0] == 0.3  # the wheels slip
    assert not base.follow(np.zeros(4), np.zeros(4)).any()
    free = SimulatedBase(STANDARD, TICK)
    free.velocity = np.array([0.3, 0, 0, 0])
    assert free.follow(np.zeros(4), np.array([0.3, 0, 0, 0]))[0] == pytest.approx(0.275)


def test_a_robot_that_is_put_elsewhere_stands():
    robot = simulated()
    for _ in range(10):
        robot.drive(np.array([0.3, 0, 0, 0]))
    robot.begin_episode(1)
    start = robot.pose.copy()
    assert not robot.velocity.any()
    robot.drive(np.zeros(4))
    assert np.array_equal(robot.pose, start)


def test_free_driving_has_no_episode():
    robot = simulated()
    robot.place_freely(4)
    assert robot.episode is None
    for command in [(0.3, 0, 0, 0)] * 5 + [(0, 0, 0, 0)] * 8:
        judged = robot.drive(np.array(command, float)) or None
        if judged:
            assert judged.end == 0
    assert not robot.velocity.any()


def test_a_command_is_heard_late():
    base = SimulatedBase(STANDARD, TICK)
    base.respond(delay=0.1)
    sent = [np.array([0.02, 0, 0, 0]), np.array([0.01, 0, 0, 0]), *[np.zeros(4)] * 3]
    driven, late = [], []
    for command in sent:
        driven.append(base.follow(command, base.velocity)[0])
        late.append(base.late)
    assert driven == [0, 0, 0.02, 0.01, 0]
    assert late == [True, True, True, False, False], 'until the last one that moves is heard'


def test_motors_lag_by_their_time_constant_and_come_to_rest():
    base = SimulatedBase(dataclasses.replace(STANDARD, linear_acceleration=100.0), 0.01)
    base.respond(lag=0.1)
    wanted = np.array([0.3, 0, 0, 0])
    reached = [base.follow(wanted, base.velocity)[0] for _ in range(100)]
    assert reached[9] == pytest.approx(0.3 * (1 - math.exp(-1)), rel=1e-6)
    assert reached[-1] == pytest.approx(0.3, rel=1e-3)
    ticks = 0
    while base.follow(np.zeros(4), base.velocity).any():
        ticks += 1
        assert base.late
    assert ticks == pytest.approx(10 * math.log(0.3 / 0.02), abs=1) and not base.late


def test_a_decision_of_a_late_base_ends_where_it_stands():
    robot = simulated(randomisation=Randomisation(
        command_delay=(0.1, 0.1), motor_lag=(0.1, 0.1), camera_delay=(0.15, 0.15)))
    assert robot.camera_delay == 0.15
    for _ in range(6):
        assert robot.drive(np.array([0.3, 0, 0, 0])) is None
    ends = [robot.drive(np.zeros(4)) for _ in range(40)]
    (judged,) = np.flatnonzero([end is not None for end in ends])
    assert judged > 5 and not robot.moves
    robot.drive(np.array([0.3, 0, 0, 0]))
    robot.begin_episode(1)
    assert not robot.moves, 'nothing is on the way where a robot is put elsewhere'


def test_a_picture_of_another_format_is_a_part_of_the_square():
    wide = RobotSpec(camera_fov=math.radians(60))
    whole = dataclasses.replace(wide, camera_fov=2 * math.atan(4 / 3 * math.tan(math.radians(30))))
    for aspect, shape in ((4 / 3, (48, 64)), (0.75, (64, 48))):
        robot = SimulatedRobot('house:7?rooms=2', robot=wide, size=48, aspect=aspect, seed=3)
        square = SimulatedRobot('house:7?rooms=2', robot=whole, size=64, seed=3)
        for one in (robot, square):
            one.begin_episode(0)
        assert robot.picture_size == shape[::-1]
        cut = (slice(8, 56), slice(None)) if aspect > 1 else (slice(None), slice(8, 56))
        for mine, theirs in ((robot.observe(), square.observe()),
                             (robot.goal_frames(), square.goal_frames())):
            assert mine.rgb.shape[-2:] == mine.depth.shape[-2:] == shape
            np.testing.assert_array_equal(mine.rgb, theirs.rgb[(..., *cut)])
