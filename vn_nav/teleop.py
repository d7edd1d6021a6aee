"""Driving by hand: what keys and a joystick say a robot shall do. No ROS here.

Velocities are [4]: forward, left [m/s], turn to the left, camera down [rad/s]. What the robot has
no action for it cannot do: a differential base does not go sideways, a fixed camera does not tilt.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vn_nav.robot import AXES, RobotSpec

KEYS = {  # axis and sign
    'w': ('dx', 1), 's': ('dx', -1), 'a': ('dyaw', 1), 'd': ('dyaw', -1),
    'q': ('dy', 1), 'e': ('dy', -1), 'r': ('dpitch', -1), 'f': ('dpitch', 1),
}
ARROWS = {'A': 'w', 'B': 's', 'C': 'd', 'D': 'a'}  # what terminals send after ESC [
LEAVE = {'x', '\x03', '\x04'}
# A terminal tells no release. A key that is held comes again after 0.2 to 0.7 s, then every 30 ms.
FIRST_HOLD_S, HOLD_S, REPEATS_S = 0.75, 0.2, 0.15


def limits_of(robot: RobotSpec) -> np.ndarray:
    """[4] the fastest along each axis; 0: it has no action there."""
    able = {action.axis for k, action in enumerate(robot.actions) if k not in robot.impossible}
    return np.array([robot.max_velocity(axis) if axis in able else 0.0 for axis in AXES])


class Keyboard:
    """Keys of a terminal as velocities: a key drives as long as it is held.

    Args:
        limits: [4] of the velocities, as of `limits_of`.

    Attributes:
        left: the key to leave was pressed.
    """

    def __init__(self, limits: np.ndarray):
        self._limits, self.left = limits, False
        self._velocity, self._until, self._last = np.zeros(4), -math.inf, ('', -math.inf)
        self._rest = ''  # of a sequence that has not come whole

    def press(self, text: str, now: float) -> None:
        """Take what the terminal sent at a time [s]. Any key without a meaning stops."""
        text, self._rest = self._rest + text, ''
        while text and not self.left:
            if '\x1b['.startswith(text[:2]) and len(text) < 3:
                self._rest = text  # the rest is under way
                return
            if text.startswith('\x1b['):
                self._take(ARROWS.get(text[2], ''), now)
                text = text[3:]
            else:
                self._take(text[0], now)
                text = text[1:]

    def _take(self, key: str, now: float) -> None:
        self.left = key in LEAVE
        if key not in KEYS:
            self._until = -math.inf
            return
        axis, sign = KEYS[key]
        self._velocity = np.zeros(4)
        self._velocity[AXES.index(axis)] = sign * self._limits[AXES.index(axis)]
        repeats = self._last[0] == key and now - self._last[1] < REPEATS_S
        self._until, self._last = now + (HOLD_S if repeats else FIRST_HOLD_S), (key, now)

    def velocity(self, now: float) -> np.ndarray | None:
        """[4] at a time [s]; None: no key is held."""
        return self._velocity if now < self._until else None


@dataclasses.dataclass(frozen=True)
class Axes:
    """Which axes and buttons of a joystick mean what; numbers from 0, -1: none."""

    forward: int = 1
    left: int = -1
    turn: int = 3
    tilt: int = -1
    dead_man: int = 4  # button that is held while driving
    dead_zone: float = 0.1  # share of an axis about its middle that counts as nothing


class Joystick:
    """Messages of a joystick as velocities, while its dead-man button is held.

    Args:
        limits: [4] of the velocities, as of `limits_of`.
        axes: its layout; timeout: without a message the robot stands still [s].
    """

    def __init__(self, limits: np.ndarray, axes: Axes, timeout: float):
        self._limits, self._axes, self._timeout = limits, axes, timeout
        self._velocity: np.ndarray | None = None
        self._until = -math.inf

    def take(self, axes: Sequence[float], buttons: Sequence[int], now: float) -> str:
        """A message at a time [s].

        Returns:
            What is wrong with it; empty: nothing. A message with a fault stops the robot.
        """
        self._velocity, self._until = None, now + self._timeout
        own = self._axes
        if not 0 <= own.dead_man < len(buttons):
            return (f'the joystick has {len(buttons)} buttons, and the dead-man button is number '
                    f'{own.dead_man}: set dead_man')
        velocity = np.zeros(4)
        for k, (number, sign) in enumerate(((own.forward, 1), (own.left, 1), (own.turn, 1),
                                            (own.tilt, -1))):
            if number < 0:
                continue
            if number >= len(axes):
                return f'the joystick has {len(axes)} axes, none with number {number}'
            if not math.isfinite(axes[number]):
                return f'axis {number} of the joystick says {axes[number]}'
            share = min(max(float(axes[number]), -1.0), 1.0)
            beyond = max(abs(share) - own.dead_zone, 0.0) / (1 - own.dead_zone)
            velocity[k] = math.copysign(beyond, share) * sign * self._limits[k]
        if buttons[own.dead_man]:
            self._velocity = velocity
        return ''

    def velocity(self, now: float) -> np.ndarray | None:
        """[4] at a time [s]; None: the button is not held, or nothing has come for too long."""
        return self._velocity if now < self._until else None
