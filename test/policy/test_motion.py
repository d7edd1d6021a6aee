"""From actions to velocities: exact on odometry, within limits, never stuck."""

import math

import numpy as np
import pytest

from vn_nav.policy.motion import ActionExecutor, cruise, ramp
from vn_nav.resources import share_file
from vn_nav.robot import THESIS_ACTIONS, RobotSpec, load_robot
from vn_sim_bridge.robot.simulated_base import SimulatedBase

DT = 0.05
SLOW = RobotSpec()
QUICK = load_robot(share_file('config/robots/demo_base.yaml'))


def drive(executor, action, *, blocked=False, odometry=True, pose=(1.0, 2.0, 0.7)):
    """A perfect base that ticks; returns displacement in the start frame, ticks, velocities."""
    pose = np.array(pose)
    start = pose.copy()
    executor.begin(action, pose.copy() if odometry else None)
    velocities, tilt = [], 0.0
    for _ in range(400):
        velocity, over = executor.velocity(DT, pose.copy() if odometry else None)
        if over:
            break
        velocities.append(velocity)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        if not blocked:
            pose += DT * np.array([c * velocity[0] - s * velocity[1],
                                   s * velocity[0] + c * velocity[1], velocity[2]])
            pose[2] = (pose[2] + math.pi) % (2 * math.pi) - math.pi
        tilt += DT * velocity[3]
    c, s = math.cos(start[2]), math.sin(start[2])
    dx, dy = pose[:2] - start[:2]
    turn = (pose[2] - start[2] + math.pi) % (2 * math.pi) - math.pi
    return np.array([c * dx + s * dy, -s * dx + c * dy, turn, tilt]), np.array(velocities)


@pytest.mark.parametrize('robot', [SLOW, QUICK], ids=['slow', 'quick'])
@pytest.mark.parametrize('action', range(len(THESIS_ACTIONS)))
@pytest.mark.parametrize('odometry', [True, False])
def test_every_action_ends_where_it_should(robot, action, odometry):
    executor = ActionExecutor(robot, tolerance=1e-6, creep=0.0)
    entry = THESIS_ACTIONS[action]
    moved, velocities = drive(executor, action, odometry=odometry, pose=(1, 2, 3.1))
    assert np.allclose(moved, [entry.dx, entry.dy, entry.dyaw, entry.dpitch], atol=1e-5)
    # From rest to rest in the nominal time, and a few ticks.
    assert abs(len(velocities) * DT - robot.nominal_duration(action)) < 0.2


@pytest.mark.parametrize('robot', [SLOW, QUICK], ids=['slow', 'quick'])
def test_speed_and_acceleration_stay_within_limits(robot):
    for action, entry in enumerate(THESIS_ACTIONS):
        _, velocities = drive(ActionExecutor(robot, tolerance=1e-6, creep=0.0), action)
        speed = np.abs(velocities).sum(axis=1)
        assert speed.max() <= robot.max_velocity(entry.axis) + 1e-9
        steps = np.abs(np.diff(np.concatenate([[0], speed, [0]])))
        assert steps.max() <= robot.acceleration(entry.axis) * DT * 1.001
        others = np.delete(velocities, ('dx', 'dy', 'dyaw', 'dpitch').index(entry.axis), axis=1)
        assert (others == 0).all()


def test_a_blocked_action_gives_up_after_one_and_a_half_times_its_duration():
    executor = ActionExecutor(SLOW, tolerance=1e-6, creep=0.0)
    _, velocities = drive(executor, 0, blocked=True)
    assert len(velocities) * DT == pytest.approx(1.5 * SLOW.nominal_duration(0), abs=0.11)
    assert executor.action is None


def test_continuous_mode_ramps_towards_the_cruise_velocity():
    target = cruise(SLOW, 5)
    assert target[2] == -SLOW.max_angular
    velocity = np.zeros(4)
    for _ in range(200):
        following = ramp(velocity, target, SLOW, DT)
        assert np.abs(following - velocity).max() <= SLOW.angular_acceleration * DT + 1e-12
        velocity = following
    assert np.allclose(velocity, target)


class LateBase:
    """Follows commands by a delay and a lag, on a straight line or on the spot."""

    def __init__(self, robot, delay, lag):
        self.base = SimulatedBase(robot, DT)
        self.base.respond(delay, lag)
        self.pose = np.zeros(3)

    def follow(self, velocity):
        vx, _, wz, _ = self.base.follow(velocity, self.base.velocity)
        self.pose = self.pose + DT * np.array(
            [vx * math.cos(self.pose[2]), vx * math.sin(self.pose[2]), wz])

    def drive(self, executor, action):
        """One action, and until it stands: how far it came, beyond what was asked for."""
        before, over = self.pose, False
        executor.begin(action, self.pose)
        while not over:
            velocity, over = executor.velocity(DT, self.pose)
            self.follow(velocity)
        while self.base.late or self.base.velocity.any():
            self.follow(np.zeros(4))
        entry = executor.robot.actions[action]
        moved = self.pose - before
        along = moved[2] if entry.axis == 'dyaw' else math.copysign(
            math.hypot(*moved[:2]), entry.size)
        return math.copysign(1.0, entry.size) * along - abs(entry.size)


@pytest.mark.parametrize('delay, lag', [(0.15, 0.15), (0.1, 0.0), (0.0, 0.1)])
def test_how_far_a_late_base_rolls_on_is_learned(delay, lag):
    robot = load_robot(share_file('config/robots/harsh_base.yaml'))
    names = robot.action_names
    for turn, forward in (('rotate_left', 'forward'), ('rotate_right', 'backward')):
        base, stubborn = (LateBase(robot, delay, lag) for _ in range(2))
        executor = ActionExecutor(robot, tolerance=0.004, creep=0.02, learns=True)
        plain = ActionExecutor(robot, tolerance=0.004, creep=0.02)
        over = np.array([[base.drive(executor, names.index(name)) for name in (turn, forward)]
                         for _ in range(8)])
        first = [stubborn.drive(plain, names.index(name)) for name in (turn, forward)]
        assert over[0] == pytest.approx(first), 'nothing is known at first'
        assert (np.array(first) > [math.radians(3), 0.02]).all()
        assert np.abs(over[4:, 0]).max() < math.radians(3), np.degrees(over[:, 0])
        assert np.abs(over[4:, 1]).max() < 0.03, over[:, 1]


def test_a_base_that_follows_at_once_learns_nothing():
    robot = RobotSpec()
    base = LateBase(robot, 0.0, 0.0)
    executor = ActionExecutor(robot, tolerance=0.004, creep=0.02, learns=True)
    for action in (0, 4, 0, 5, 1):
        assert abs(base.drive(executor, action)) < 0.009
    assert not any(executor.roll.values())


def test_a_pose_that_was_set_is_no_rolling():
    executor = ActionExecutor(RobotSpec(), tolerance=0.004, creep=0.02, learns=True)
    LateBase(RobotSpec(), 0.0, 0.0).drive(executor, 0)
    executor.begin(0, np.array([7.0, 0.0, 0.0]))
    assert not any(executor.roll.values())


def test_a_robot_that_was_pushed_after_a_stop_learns_nothing_of_it():
    executor = ActionExecutor(RobotSpec(), tolerance=0.004, creep=0.02, learns=True)
    base = LateBase(RobotSpec(), 0.0, 0.0)
    base.drive(executor, 0)
    executor.abandon()
    executor.begin(0, base.pose + [0.1, 0.0, 0.0])
    assert not any(executor.roll.values())
