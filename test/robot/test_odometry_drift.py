"""Drifting odometry: its statistics, that the truth stays, and that actions still end."""

import math

import numpy as np
import pytest

from vn_nav.policy.motion import ActionExecutor
from vn_nav.resources import share_file
from vn_nav.robot import load_robot
from vn_sim_bridge.counter_random import Stream, normal
from vn_sim_bridge.floor.floor_map import clearance
from vn_sim_bridge.navigation.tasks import wrap_angle
from vn_sim_bridge.robot.odometry import Uncertainty, advance, drift_errors
from vn_sim_bridge.robot.simulated_robot import TICK, SimulatedRobot

ROBOTS = 300
BASE = load_robot(share_file('config/robots/demo_base.yaml'))


def errors(motions, drift=1.0):
    """Pose errors [ROBOTS,3] of odometry after motions [K,3], in the frame of the start."""
    truth = np.zeros(3)
    for motion in motions:
        truth = advance(truth, motion)
    ends = []
    for seed in range(ROBOTS):
        numbers = normal(seed, Stream.ODOMETRY, np.arange(3)[:, None], 0, np.arange(len(motions)))
        pose = np.zeros(3)
        for motion, own in zip(motions, numbers.T, strict=True):
            pose = advance(pose, motion, drift_errors(motion, drift, own))
        ends.append(pose - truth)
    return np.array(ends)


def rms(values):
    return math.sqrt(np.mean(np.square(values)))


def test_ten_metres_straight_are_one_to_two_per_cent_off():
    off = errors([(0.1, 0.0, 0.0)] * 100)
    assert rms(np.hypot(off[:, 0], off[:, 1])) / 10 == pytest.approx(0.0144, rel=0.15)
    assert math.degrees(rms(off[:, 2])) == pytest.approx(1.28, rel=0.15)
    assert np.abs(off.mean(axis=0)).max() < 0.03  # no preferred side
    twice = errors([(0.1, 0.0, 0.0)] * 100, drift=2.0)
    assert rms(twice[:, 2]) == pytest.approx(2 * rms(off[:, 2]), rel=0.01)


def test_ten_minutes_of_turns_and_driving_are_a_few_degrees_off():
    # Forty places two metres apart, a turn around at each.
    turn, metres = [(0.0, 0.0, math.pi / 5)] * 10, [(0.2, 0.0, 0.0)] * 10
    off = errors((turn + metres) * 40)
    assert math.degrees(rms(wrap_angle(off[:, 2]))) == pytest.approx(4.6, rel=0.15)


def test_short_ticks_and_long_ones_drift_alike():
    long = errors([(0.2, 0.0, 0.1)] * 15)
    short = errors([(0.02, 0.0, 0.01)] * 150)
    for axis in range(3):
        assert rms(short[:, axis]) == pytest.approx(rms(long[:, axis]), rel=0.2)


@pytest.fixture(scope='module')
def robot():
    robot = SimulatedRobot('house:7?rooms=2', robot=BASE, size=16, noise=False)
    robot.begin_episode(0)
    floor = robot.place.floor
    gap = clearance(floor.origin, floor.free.shape, robot.place.obstacle_rects)[floor.free]
    robot.middle = floor.centres()[np.argmax(gap)]  # where nothing is in the way
    return robot


def circle(robot, drift, seed=0):
    """Drive on a small circle with pauses from the same start; odometry and true poses."""
    robot.simulator.place(np.array([0]), np.array([[*robot.middle, 0.3, 0.0]]))
    robot.odometry, robot.odometry_drift, robot.seed = np.zeros(3), drift, seed
    robot.tick_count = 0
    said, true = [], []
    for k in range(100):
        robot.tick(np.array([0.2, 0.0, 1.0, 0.0]) * (k % 20 < 15))
        said.append(robot.odometry.copy())
        true.append(robot.pose[:3].copy())
    return np.array(said), np.array(true)


def test_no_drift_is_the_motion_itself_and_drift_leaves_the_truth_alone(robot):
    said, true = circle(robot, 0.0)
    c, s = math.cos(0.3), math.sin(0.3)
    x, y = (true[:, :2] - robot.middle).T
    assert np.allclose(said[:, :2], np.column_stack([c * x + s * y, c * y - s * x]), atol=1e-9)
    drifting, same = circle(robot, 3.0)
    assert np.array_equal(true, same)
    gaps = np.abs(drifting - said).max(axis=1)
    assert gaps[-1] > 1e-3
    still = [k for k in range(1, 100) if k % 20 >= 15]
    assert all(np.array_equal(drifting[k], drifting[k - 1]) for k in still)  # at rest it rests


@pytest.mark.slow
@pytest.mark.parametrize(('drift', 'noise'), [(2.0, False), (0.0, True), (1.0, True)])
def test_odometry_says_how_far_off_it_is(robot, drift, noise):
    """The covariance against the scatter of 200 drives: a way, a turn, a curve."""
    spread, robot.noise = [], noise
    start = np.array([[*robot.middle, 0.0, 0.0]])
    ticks = [(0.4, 0, 0, 0)] * 10 + [(0, 0, 1.5, 0)] * 12 + [(0.3, 0, 1.0, 0)] * 10
    for seed in range(200):
        robot.simulator.place(np.array([0]), start.copy())
        robot.odometry, robot.odometry_drift, robot.seed = np.zeros(3), drift, seed
        robot.uncertainty, robot.tick_count = Uncertainty(drift, TICK), 0
        for velocity in ticks:
            robot.tick(np.array(velocity))
        off = robot.odometry - robot.pose[:3]
        off[:2] += robot.middle
        spread.append([*off[:2], wrap_angle(off[2])])
    robot.noise = False
    spread, said = np.cov(np.array(spread).T), robot.uncertainty.pose
    assert np.sqrt(np.diag(said)) == pytest.approx(np.sqrt(np.diag(spread)), rel=0.2)
    # Directions too: with the said covariance the scatter is a unit ball, about.
    white = np.linalg.solve(np.linalg.cholesky(said), np.linalg.cholesky(spread))
    assert np.linalg.svd(white, compute_uv=False) == pytest.approx(np.ones(3), abs=0.35)
    assert (np.linalg.eigvalsh(robot.uncertainty.twist) > 0).all()


def test_uncertainty_grows_with_the_way_and_not_at_rest(robot):
    uncertainty = Uncertainty(1.0, TICK)
    known = uncertainty.pose.copy()
    assert (np.linalg.eigvalsh(known) > 0).all()
    sizes = []
    for _ in range(50):
        uncertainty.add(0.0, (0.02, 0.0, 0.0))
        sizes.append(np.trace(uncertainty.pose))
    assert (np.diff(sizes) > 0).all() and uncertainty.twist[0, 0] > 1e-3
    driven = uncertainty.pose.copy()
    uncertainty.rest()
    assert np.array_equal(uncertainty.pose, driven) and uncertainty.twist[0, 0] < 1e-5
    assert math.sqrt(driven[0, 0]) == pytest.approx(0.02, rel=0.05)  # of a metre: 2 %


def test_the_seed_says_how_it_drifts(robot):
    one, again, other = (circle(robot, 1.0, seed)[0] for seed in (4, 4, 5))
    assert np.array_equal(one, again)
    assert not np.allclose(one, other, atol=1e-4)


def test_the_robots_turns_have_the_models_variance(robot):
    ends = []
    for seed in range(40):
        said, true = circle(robot, 1.0, seed)
        ends.append(wrap_angle(said[-1, 2] + 0.3 - true[-1, 2]))
    turned, driven = 75 * TICK, 75 * TICK * 0.2
    assert rms(ends) == pytest.approx(math.sqrt(1e-5 * turned + 5e-5 * driven), rel=0.4)


@pytest.mark.parametrize('exact', [True, False])
def test_actions_closed_on_odometry_end_where_they_should(robot, exact):
    executor = (ActionExecutor(BASE, tolerance=1e-6, creep=0.0) if exact
                else ActionExecutor(BASE, tolerance=0.004, creep=0.02))
    for drift, way, turn in ((0.0, 0.005, math.radians(0.5)), (1.0, 0.07, math.radians(1.2))):
        robot.odometry_drift, robot.seed = drift, 3
        for name in ('forward', 'backward', 'rotate_left', 'rotate_right') * 3:
            action = BASE.action_names.index(name)
            robot.simulator.place(np.array([0]), np.array([[*robot.middle, 0.0, 0.0]]))
            before = robot.pose.copy()
            executor.begin(action, robot.odometry)
            ticks, over = 0, False
            while not over:
                velocity, over = executor.velocity(TICK, robot.odometry)
                robot.drive(velocity)
                ticks += 1
            assert ticks < BASE.nominal_duration(action) / TICK + 12  # it does not creep for ever
            done = math.dist(robot.pose[:2], before[:2])
            turned = float(wrap_angle(robot.pose[2] - before[2]))
            wanted = BASE.actions[action]
            if wanted.axis == 'dx':
                assert done == pytest.approx(abs(wanted.size), abs=way)
            else:
                assert turned == pytest.approx(wanted.size, abs=turn)
