"""What the stack must know of a robot: its actions, limits, camera and footprint.

Units are SI. Axes follow REP 103: x forward, y left, z up; yaw is positive to the left, pitch is
positive downwards (a right-handed rotation about y).
"""

from __future__ import annotations

import dataclasses
import math
import reprlib
from collections.abc import Sequence
from pathlib import Path

from vn_nav.errors import UserError
from vn_nav.structured_file import read_yaml


@dataclasses.dataclass(frozen=True)
class Action:
    """One discrete action: a displacement of the base, or of the camera's tilt."""

    name: str
    dx: float = 0.0  # m, forward
    dy: float = 0.0  # m, left
    dyaw: float = 0.0  # rad, left
    dpitch: float = 0.0  # rad, down; carried by Twist.angular.y

    def __post_init__(self):
        if not isinstance(self.name, str) or not 0 < len(self.name) <= NAME_LENGTH:
            raise UserError(f'an action has a name of 1 to {NAME_LENGTH} characters',
                            reprlib.repr(self.name), 'correct the robot file')
        for axis in AXES:
            _check_number(f'{axis} of action {self.name}', getattr(self, axis), -MAX_MOVE,
                          MAX_MOVE)
        moved = [axis for axis in AXES if getattr(self, axis)]
        if len(moved) != 1:
            raise UserError(
                'an action moves along exactly one of dx, dy, dyaw, dpitch',
                dataclasses.asdict(self),
                'split it into several actions',
            )

    @property
    def axis(self) -> str:
        """The one axis it moves along: 'dx', 'dy', 'dyaw' or 'dpitch'."""
        return next(axis for axis in AXES if getattr(self, axis))

    @property
    def size(self) -> float:
        """Signed length [m] or angle [rad] along `axis`."""
        return getattr(self, self.axis)


class NamedAction(Action):
    """An action of a simulator that is no motion of a base: it has a name alone."""

    def __post_init__(self):
        if any(getattr(self, axis) for axis in AXES):
            raise UserError('an action that is no motion moves nothing', self.name,
                            'use Action')

    @property
    def axis(self) -> str:
        """An axis along which it is 0 long."""
        return AXES[0]


AXES = ('dx', 'dy', 'dyaw', 'dpitch')
NAME_LENGTH = 100  # characters
MAX_ACTIONS = 256
MAX_MOVE = 100.0  # m or rad, of an action
MAX_TILT = math.radians(60.0)  # of the camera, either way
SMALLEST = 1e-3  # of what is positive, in the field's unit
# What no robot of ours goes beyond, in the field's unit: a slip of units or of a digit.
LARGEST = {
    'footprint_radius': 10.0, 'camera_height': 100.0, 'camera_fov': math.radians(179),
    'camera_pitch': math.pi / 2, 'max_linear': 20.0, 'max_angular': 50.0,
    'linear_acceleration': 200.0, 'angular_acceleration': 500.0,
}


def _check_number(name: str, value: object, least: float, most: float) -> None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise UserError(f'{name} is a number', reprlib.repr(value), 'correct the robot file')
    if not least <= value <= most:  # not a number is neither
        raise UserError(f'{name} lies between {least:g} and {most:g}', value,
                        'correct the robot file; angles in degrees end in _deg')


# Thesis, section 5.6 and table 5.5: the actions of the continuous environments.
THESIS_ACTIONS = (
    Action('forward', dx=0.5),
    Action('backward', dx=-0.2),
    Action('left', dy=0.35),
    Action('right', dy=-0.35),
    Action('rotate_left', dyaw=math.radians(30)),
    Action('rotate_right', dyaw=-math.radians(30)),
    Action('look_up', dpitch=-math.radians(30)),
    Action('look_down', dpitch=math.radians(30)),
)
# What a differential drive with a fixed camera can do.
DRIVE_ACTIONS = ('forward', 'backward', 'rotate_left', 'rotate_right')


@dataclasses.dataclass(frozen=True)
class RobotSpec:
    """A robot as data. The defaults are the standard robot, driven with conservative limits."""

    name: str = 'standard'
    actions: tuple[Action, ...] = THESIS_ACTIONS
    footprint_radius: float = 0.18  # m
    camera_height: float = 1.0  # m above the floor
    camera_fov: float = math.radians(90)  # rad, horizontal and vertical of the square picture
    camera_pitch: float = 0.0  # rad, down
    max_linear: float = 0.3  # m/s
    max_angular: float = 0.8  # rad/s
    linear_acceleration: float = 0.5  # m/s^2
    angular_acceleration: float = 1.6  # rad/s^2
    differential: bool = False  # it cannot move sideways: such actions of a policy are left out

    def __post_init__(self):
        if not isinstance(self.differential, bool):
            raise UserError('differential is true or false', reprlib.repr(self.differential),
                            'correct the robot file')
        if not isinstance(self.name, str) or len(self.name) > NAME_LENGTH:
            raise UserError(f'the name of a robot is text of at most {NAME_LENGTH} characters',
                            reprlib.repr(self.name), 'correct the robot file')
        for field, most in LARGEST.items():
            least = -most if field == 'camera_pitch' else SMALLEST
            _check_number(f'{field} of robot {self.name!r}', getattr(self, field), least, most)
        if len(self.actions) > MAX_ACTIONS:
            raise UserError(f'a robot has at most {MAX_ACTIONS} actions', len(self.actions),
                            f'correct the actions of robot {self.name!r}')
        if len(set(self.action_names)) != len(self.actions) or not self.actions:
            raise UserError('a robot has at least one action, each with its own name',
                            self.action_names, f'correct the actions of robot {self.name!r}')

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names in table order; an action's index is its place here."""
        return tuple(action.name for action in self.actions)

    @property
    def moves(self) -> tuple[tuple[float, float, float], ...]:
        """What each action does to the base: dx, dy [m], dyaw [rad]."""
        return tuple((action.dx, action.dy, action.dyaw) for action in self.actions)

    @property
    def impossible(self) -> tuple[int, ...]:
        """Numbers of the actions that the base cannot do: sideways on a differential drive."""
        return tuple(k for k, action in enumerate(self.actions)
                     if self.differential and action.axis == 'dy' and action.size)

    def with_actions(self, names: tuple[str, ...] | list[str],
                     moves: tuple[tuple[float, float, float], ...] = ()) -> RobotSpec:
        """The same robot with only the named actions, in the given order.

        Args:
            names: of the actions. Sideways ones need not be among those of a differential
                robot: they become `impossible`.
            moves: dx, dy, dyaw that a policy expects of them; empty: it does not care.

        Raises:
            UserError: a name that this robot does not have, or an action of another size; nothing
                is left that it can do.
        """
        table = {action.name: action for action in self.actions}
        if self.differential:
            table = _sideways(names, moves) | table
        for name in names:
            if name not in table:
                raise UserError(f'every action of the policy exists on robot {self.name!r}', name,
                                f'its actions are {", ".join(table)}: use another robot file or '
                                'another checkpoint')
        chosen = dataclasses.replace(self, actions=tuple(table[name] for name in names))
        for name, expected, own in zip(names, moves, chosen.moves, strict=bool(moves)):
            if not all(math.isclose(a, b, abs_tol=1e-4)
                       for a, b in zip(expected, own, strict=True)):
                raise UserError(f'the policy knows how far {name} moves the robot: '
                                f'{expected} (m, m, rad)', f'{own} on robot {self.name!r}',
                                'use a robot file with that action, or train a policy for this '
                                'robot')
        if len(chosen.impossible) == len(names):
            raise UserError(f'robot {self.name!r} can do one of the actions at least', names,
                            'use another checkpoint')
        return chosen

    def max_velocity(self, axis: str) -> float:
        """Speed limit [m/s or rad/s] along an axis of `AXES`."""
        return self.max_linear if axis in ('dx', 'dy') else self.max_angular

    def acceleration(self, axis: str) -> float:
        """Acceleration limit [m/s^2 or rad/s^2] along an axis of `AXES`."""
        return self.linear_acceleration if axis in ('dx', 'dy') else self.angular_acceleration

    def nominal_duration(self, action: int) -> float:
        """Seconds that an action takes from rest to rest under the robot's limits.

        A trapezoidal profile, or a triangular one where an action is too short for the limit.
        """
        size = abs(self.actions[action].size)
        axis = self.actions[action].axis
        speed, acceleration = self.max_velocity(axis), self.acceleration(axis)
        if size >= speed**2 / acceleration:
            return size / speed + speed / acceleration
        return 2.0 * math.sqrt(size / acceleration)


def load_robot(path: str | Path) -> RobotSpec:
    """Read a robot from YAML: the fields of `RobotSpec`; angles in degrees end in `_deg`.

    Raises:
        UserError: a missing file, one that is no YAML mapping in UTF-8 or has a key twice, an
            unknown field, or a value of a wrong type or outside its range.
    """
    path = Path(path)
    data = read_yaml(path, 'a robot file', 'see config/robots/ for examples')
    try:
        data = _degrees_to_radians(data)
        if 'actions' in data:
            entries = data['actions']
            if not (isinstance(entries, list) and all(map(_is_mapping, entries))):
                raise UserError('actions is a list of mappings, such as {name: forward, dx: 0.5}',
                                reprlib.repr(entries), 'see config/robots/ for examples')
            data['actions'] = tuple(Action(**_degrees_to_radians(entry)) for entry in entries)
        return RobotSpec(**data)
    except TypeError as error:
        known = ', '.join(field.name for field in dataclasses.fields(RobotSpec))
        raise UserError('a robot file has only known fields', f'{path}: {error}',
                        f'the fields are {known}') from error
    except UserError as error:
        raise UserError(error.rule, f'{path}: {error.received}', error.remedy) from error


def _sideways(names: Sequence[str], moves: Sequence[tuple[float, float, float]]
              ) -> dict[str, Action]:
    """Actions of a policy that move sideways, by what it says of them, or as the thesis's do."""
    known = {action.name: action.dy for action in THESIS_ACTIONS}
    if moves:
        known = {name: dy for name, (dx, dy, dyaw) in zip(names, moves, strict=True)
                 if not dx and not dyaw}
    return {name: Action(name, dy=known[name]) for name in names if known.get(name)}


def _is_mapping(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(key, str) for key in value)


def _degrees_to_radians(data: dict) -> dict:
    out = {}
    for key, value in data.items():
        name = key.removesuffix('_deg')
        if name != key:
            _check_number(key, value, -36_000.0, 36_000.0)
            value = math.radians(value)
        if name in out:
            raise UserError('a value is given once, in degrees or in radians', key,
                            f'leave out {name} or {name}_deg')
        out[name] = value
    return out
