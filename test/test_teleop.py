"""Keys and joysticks as velocities."""

import math

import numpy as np
import pytest

from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.teleop import FIRST_HOLD_S, HOLD_S, Axes, Joystick, Keyboard, limits_of

WHOLE = RobotSpec()
BASE = WHOLE.with_actions(DRIVE_ACTIONS)  # differential, with a fixed camera


def test_a_robot_is_asked_for_what_it_can_do_alone():
    assert (limits_of(WHOLE) > 0).all()
    assert limits_of(BASE).tolist() == [WHOLE.max_linear, 0, WHOLE.max_angular, 0]
    keys = Keyboard(limits_of(BASE))
    keys.press('q', 0.0)  # sideways
    assert not keys.velocity(0.1).any()


def test_a_key_drives_while_it_is_held():
    keys = Keyboard(limits_of(WHOLE))
    assert keys.velocity(0.0) is None
    keys.press('w', 1.0)
    # The terminal repeats it after up to 0.7 s, then every 30 ms.
    for now in (1.0, 1.5, 1.7):
        assert keys.velocity(now).tolist() == [WHOLE.max_linear, 0, 0, 0]
    for k in range(10):
        keys.press('w', 1.7 + 0.03 * k)
    assert keys.velocity(1.97 + HOLD_S - 0.01) is not None
    assert keys.velocity(1.97 + HOLD_S + 0.01) is None, 'it was let go'
    keys.press('w', 5.0)
    assert keys.velocity(5.0 + FIRST_HOLD_S + 0.01) is None, 'it was tapped'


@pytest.mark.parametrize('text', [' ', 'k', '\n', '\x1b[Z', 'ä'])
def test_any_other_key_stops_at_once(text):
    keys = Keyboard(limits_of(WHOLE))
    keys.press('w', 0.0)
    keys.press(text, 0.1)
    assert keys.velocity(0.1) is None and not keys.left


@pytest.mark.parametrize('parts', [['\x1b[A'], ['\x1b', '[A'], ['\x1b[', 'A'], ['d\x1b[A']])
def test_arrows_come_in_pieces(parts):
    keys = Keyboard(limits_of(WHOLE))
    for part in parts:
        keys.press(part, 0.0)
    assert keys.velocity(0.1)[0] == WHOLE.max_linear


@pytest.mark.parametrize('key', ['x', '\x03', '\x04'])
def test_a_key_leaves(key):
    keys = Keyboard(limits_of(WHOLE))
    keys.press(f'w{key}w', 0.0)
    assert keys.left and keys.velocity(0.0) is None


def joystick(**layout):
    return Joystick(limits_of(WHOLE), Axes(**layout), timeout=0.5)


def test_a_joystick_drives_while_its_button_is_held_and_it_speaks():
    stick, axes, buttons = joystick(), [0.0, 1.0, 0.0, -0.55], [0] * 8
    assert not stick.take(axes, buttons, 0.0)
    assert stick.velocity(0.1) is None, 'nobody holds the button'
    buttons[4] = 1
    stick.take(axes, buttons, 1.0)
    assert stick.velocity(1.4) == pytest.approx([WHOLE.max_linear, 0, -0.5 * WHOLE.max_angular, 0])
    assert stick.velocity(1.51) is None, 'its radio is out of reach'
    stick.take(axes, buttons, 2.0)
    stick.take(axes, [0] * 8, 2.1)
    assert stick.velocity(2.1) is None, 'let go'


def test_the_middle_of_a_stick_is_no_command():
    stick = joystick(left=0)
    stick.take([0.09, -0.1, 0.0, 0.0], [1] * 5, 0.0)
    assert not stick.velocity(0.0).any()
    stick.take([7.0, 0.0, 0.0, 0.0], [1] * 5, 0.0)
    assert stick.velocity(0.0)[1] == WHOLE.max_linear, 'no more than the most'


@pytest.mark.parametrize(('axes', 'buttons', 'says'), [
    ([0.0, 1.0, 0.0, 0.0], [1] * 4, 'dead-man button is number 4'),
    ([0.0, 1.0], [1] * 5, 'none with number 3'),
    ([0.0, math.nan, 0.0, 0.0], [1] * 5, 'axis 1 of the joystick says nan')])
def test_a_joystick_with_another_layout_drives_nothing(axes, buttons, says):
    stick = joystick()
    stick.take([0.0, 1.0, 0.0, 0.0], [1] * 5, 0.0)
    assert stick.velocity(0.0) is not None
    assert says in stick.take(axes, buttons, 0.1)
    assert stick.velocity(0.1) is None


def test_tilt_is_up_where_the_stick_is_pushed_up():
    stick = joystick(tilt=2)
    stick.take([0.0, 0.0, 1.0, 0.0], [1] * 5, 0.0)
    assert stick.velocity(0.0)[3] < 0 and np.count_nonzero(stick.velocity(0.0)) == 1
