"""The parameters of policy_node: declared with type, meaning and range; checked when read."""

from __future__ import annotations

from collections.abc import Iterable

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor

from vn_nav.errors import UserError

# name: (default, meaning, range or None). Ranges are [least, most] in the parameter's unit.
PARAMETERS = {
    'checkpoint': ('', 'folder of the policy; empty: the shipped models/house', None),
    'robot': ('', 'YAML file of the robot; empty: the standard robot', None),
    'mode': ('stop_and_go', 'stop_and_go; continuous: a decision at every frame; shadow: beside '
                            'somebody else who drives, see docs/architecture.md', None),
    'time': ('real_time', 'real_time, or lock_step for the sim bridge in lock_step', None),
    'image_transport': ('raw', 'raw, or compressed: image_raw/compressed', None),
    'enable_stamped_cmd_vel': (False, 'publish TwistStamped instead of Twist', None),
    'autostart': (True, 'configure and activate at the start', None),
    'auto_enable': (False, 'enable motion as soon as it is possible (simulators only)', None),
    'seed': (0, 'of the sampled actions', None),
    'decoding': ('', 'sample or greedy; empty: as the checkpoint was measured', None),
    'stop_threshold': (-1.0, 'probability of arrival above which the robot stands still and says '
                             'so, 0 to 1 (1: never); -1: as the checkpoint says', (-1.0, 1.0)),
    'control_rate': (20.0, 'commands per second [Hz]', (5.0, 100.0)),
    'frame_timeout': (0.25, 'camera silence after which the robot stands still [s]', (0.05, 5.0)),
    'frame_stop_timeout': (1.0, 'camera silence that latches a stop [s]', (0.1, 10.0)),
    'max_frame_age': (0.25, 'older frames are dropped [s]', (0.02, 5.0)),
    'max_frame_ahead': (0.05, 'frames stamped later than now are dropped [s]', (0.0, 5.0)),
    'inference_timeout': (0.1, 'later decisions are discarded [s]', (0.005, 2.0)),
    'odometry_timeout': (0.5, 'odometry silence after which the robot stands still, and in motion '
                              'stops [s]', (0.05, 5.0)),
    'require_odometry': (False, 'enable motion only where odometry has come: without it actions '
                                'run on time alone', None),
    'settle_time': (0.1, "from a motion's last command to a frame at rest [s]", (0.0, 2.0)),
}

CHOICES = {
    'mode': ('stop_and_go', 'continuous', 'shadow'),
    'time': ('real_time', 'lock_step'),
    'image_transport': ('raw', 'compressed'),
    'decoding': ('', 'sample', 'greedy'),
}


def declare(node, names: Iterable[str] = tuple(PARAMETERS)) -> None:
    """Declare parameters on a node."""
    for name in names:
        default, meaning, span = PARAMETERS[name]
        ranges = [FloatingPointRange(from_value=span[0], to_value=span[1])] if span else []
        node.declare_parameter(name, default, ParameterDescriptor(
            description=meaning, floating_point_range=ranges))


def read(node, names: Iterable[str] = tuple(PARAMETERS)) -> dict:
    """Values by name.

    Raises:
        UserError: a word that is none of the choices, or a threshold that is no probability.
    """
    values = {name: node.get_parameter(name).value for name in names}
    for name, allowed in CHOICES.items():
        if name in values and values[name] not in allowed:
            raise UserError(f'{name} is one of {", ".join(a or "(empty)" for a in allowed)}',
                            values[name], f'set it with -p {name}:=...')
    if -1.0 < values.get('stop_threshold', -1.0) < 0.0:
        raise UserError('stop_threshold lies in [0, 1], or is -1', values['stop_threshold'],
                        'set it with -p stop_threshold:=...')
    return values
