"""From actions to velocities: exact on odometry, within limits, never stuck."""

import math

import numpy as np
import pytest

from vn_nav.policy.motion import ActionExecutor, cruise, ramp
from vn_nav.resources import share_file
from vn_nav.robot import THESIS_ACTIONS, RobotSpec, load_robot

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
