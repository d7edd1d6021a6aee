"""The shipped robots load, and say what they claim to say."""

import pytest

from vn_nav.errors import UserError
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


BOMB = b'a: &a [x, x]\n' + b''.join(  # 33 million words, if somebody wrote them out
    b'%c: &%c [*%c, *%c]\n' % (k, k, k - 1, k - 1) for k in range(ord('b'), ord('z'))
) + b'name: *y\n'


@pytest.mark.parametrize('content, word', [
    (b'name: caf\xe9', 'UTF-8'),  # Latin-1
    (b'max_linear: 0.3\nmax_linear: 3.0', 'twice'),
    (b'actions:\n- {name: forward, dx: 0.5, dx: 5.0}', 'twice'),
    (b'camera_fov: 1.0\ncamera_fov_deg: 90', 'in degrees or in radians'),
    (b'max_linear: fast', 'max_linear'), (b'max_linear: [0.3]', 'max_linear'),
    (b'max_linear: true', 'max_linear'), (b'max_linear: .nan', 'max_linear'),
    (b'max_linear: .inf', 'max_linear'), (b'max_linear: 300', 'max_linear'),
    (b'max_linear: 1.0e-300', 'max_linear'), (b'max_linear: 0', 'max_linear'),
    (b'camera_fov_deg: wide', 'camera_fov_deg'), (b'camera_fov_deg: 720', 'camera_fov'),
    (b'camera_pitch: down', 'camera_pitch'), (b'name: 5', 'name'), (b'name: [a]', 'name'),
    (b'5: 3', 'mapping'), (b'- a', 'mapping'), (b'', 'mapping'), (b'a: [', 'YAML'),
    (b'actions: forward', 'actions'), (b'actions: 5', 'actions'), (b'actions: [5]', 'actions'),
    (b'actions: []', 'at least one action'), (b'actions: [{5: 3}]', 'actions'),
    (b'actions: [{name: forward, dx: far}]', 'dx'), (b'actions: [{dx: 0.5}]', 'known fields'),
    (b'actions: [{name: forward, dx: 1.0e9}]', 'dx'), (b'speed: 3', 'known fields'),
    (b'actions: [{name: {}, dx: 0.5}]', 'name'), (b'name: ' + b'x' * 5_000_000, '4 MB'),
    (b'[' * 3_000, 'YAML'), (BOMB, 'name'),
])
def test_a_bad_robot_file_is_one_short_line(tmp_path, content, word):
    path = tmp_path / 'robot.yaml'
    path.write_bytes(content)
    with pytest.raises(UserError, match=word) as caught:
        load_robot(path)
    assert len(str(caught.value)) < 700 and '\n' not in str(caught.value)
