"""The shipped robots load, and say what they claim to say."""

import pytest

from vn_nav.resources import share_file
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot

ROBOTS = sorted(path.stem for path in share_file('config/robots').glob('*.yaml'))


@pytest.mark.parametrize('name', ROBOTS)
def test_robot_loads(name):
    robot = load_robot(share_file(f'config/robots/{name}.yaml'))
    assert robot.name == name
    assert robot.with_actions(DRIVE_ACTIONS).action_names == DRIVE_ACTIONS


def test_the_standard_robot_is_the_default():
    assert load_robot(share_file('config/robots/standard.yaml')) == RobotSpec()


def test_the_demo_base_takes_under_a_second_for_an_action():
    robot = load_robot(share_file('config/robots/demo_base.yaml')).with_actions(DRIVE_ACTIONS)
    assert max(robot.nominal_duration(action) for action in range(4)) < 1.0
