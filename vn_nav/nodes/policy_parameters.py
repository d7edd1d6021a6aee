"""The parameters of policy_node: type, meaning and limits; declared and read by name."""

from __future__ import annotations

from collections.abc import Iterable

from vn_nav.calibration import RECTIFY
from vn_nav.errors import UserError
from vn_nav.nodes import parameters
from vn_nav.policy.search.views import NONE, VERIFY

# The watchdog's limits in lock-step, of wall time.
LOCK_STEP_LIMIT_S = 2.0

# name: (default, meaning, limits or None), as in `vn_nav.nodes.parameters`.
PARAMETERS = {
    'checkpoint': ('', 'folder of the policy, or of its export; empty: the shipped models/house',
                   None),
    'robot': ('', 'YAML file of the robot; empty: the standard robot', None),
    'mode': ('stop_and_go', 'stop_and_go; continuous: a decision at every frame; shadow: another '
                            'driver has control, see docs/architecture.md',
             ('stop_and_go', 'continuous', 'shadow')),
    'time': ('real_time', 'real_time, or lock_step for the sim bridge in lock_step',
             ('real_time', 'lock_step')),
    'image_transport': ('raw', 'raw, or compressed: image_raw/compressed', ('raw', 'compressed')),
    'rectify': ('auto', 'whether pictures are rectified by camera_info: auto: unless their topic '
                        'is called image_rect; never; always', RECTIFY),
    'camera_fov': (0.0, "declared field of view of the pictures' shorter side [deg], for a "
                        'camera whose camera_info is not calibrated or missing; 0: none',
                   (0.0, 170.0)),
    'enable_stamped_cmd_vel': (False, 'publish TwistStamped instead of Twist', None),
    'tilt_topic': ('', 'std_msgs/Float64MultiArray with the position of a joint that tilts the '
                       'camera [rad, positive down]; empty: the Twist carries the rate of tilting '
                       '(angular.y)', None),
    'autostart': (True, 'configure and activate at the start', None),
    'auto_enable': (False, 'enable motion as soon as it is possible (simulators only)', None),
    'seed': (0, 'of the sampled actions', None),
    'decoding': ('', 'sample or greedy; empty: as the checkpoint was measured',
                 ('', 'sample', 'greedy')),
    'stop_threshold': (-1.0, 'probability of arrival above which the robot stands still and says '
                             'so, 0 to 1 (1: never); -1: as the checkpoint says', (-1.0, 1.0)),
    'verify': (NONE, 'none, or sift: what a policy that searches sees of its goal is verified by '
                     'local features of the full pictures; for cameras, not simulators', VERIFY),
    'keep_map': (False, 'a policy that searches keeps its map from goal to goal, by odometry; '
                        'false: each goal begins with an empty one, as it was measured', None),
    'goal_decisions': (0, 'decisions for a goal, after which it has failed; a policy that '
                          'searches turns back to its best guess in time; 0: any number',
                       (0, 2**31 - 1)),
    'goal_timeout': (0.0, 'time for a goal from ~/enable on, after which it has failed [s]; 0: '
                          'any', (0.0, 86_400.0)),
    'progress_decisions': (0, 'decisions in a row within progress_radius after which a goal has '
                              'failed; 0: never', (0, 2**31 - 1)),
    'progress_radius': (0.5, 'of the circle that counts as one place, by odometry [m]',
                        (0.05, 10.0)),
    'blocked_moves': (0, 'moves in a row that are cut off, by odometry, after which a goal has '
                         'failed; 0: never', (0, 2**31 - 1)),
    'control_rate': (20.0, 'commands per second [Hz]', (5.0, 100.0)),
    'frame_timeout': (0.25, 'time without pictures after which the robot stands still [s]',
                      (0.05, 5.0)),
    'frame_stop_timeout': (1.0, 'time without pictures after which a stop latches [s]',
                           (0.1, 10.0)),
    'max_frame_age': (0.25, 'older frames are dropped [s]', (0.02, 5.0)),
    'max_frame_ahead': (0.05, 'frames stamped later than now are dropped [s]', (0.0, 5.0)),
    'inference_timeout': (0.1, 'later decisions are discarded [s]', (0.005, 2.0)),
    'odometry_timeout': (0.5, 'time without odometry after which the robot stands still; in '
                              'motion it latches a stop [s]', (0.05, 5.0)),
    'require_odometry': (False, 'enable motion only with odometry: without it actions run on '
                                'time alone', None),
    'scan_topic': ('', 'sensor_msgs/LaserScan that the map of a policy which searches takes in '
                       "place of the pictures' ranges; empty: none", None),
    'depth_topic': ('', 'the same of depth pictures, with camera_info beside them; empty: none',
                    None),
    'scan_x': (0.0, 'where that sensor sits on the robot: ahead of its centre [m]', (-2.0, 2.0)),
    'scan_y': (0.0, 'to the left of it [m]', (-2.0, 2.0)),
    'scan_yaw': (0.0, 'its heading [rad], positive to the left', (-3.2, 3.2)),
    'settle_time': (0.1, "from a motion's last command to a frame at rest [s]", (0.0, 2.0)),
}


def declare(node, names: Iterable[str] = tuple(PARAMETERS), **options) -> None:
    """Declare parameters on a node; the options are those of `parameters.declare`."""
    parameters.declare(node, {name: PARAMETERS[name] for name in names}, **options)


def check(name: str, value: object) -> None:
    """Raise a `UserError` for a value that a parameter cannot have."""
    parameters.check(name, PARAMETERS, value)
    if name == 'stop_threshold' and isinstance(value, float) and -1.0 < value < 0.0:
        raise UserError('stop_threshold lies in [0, 1], or is -1', value,
                        'set it with -p stop_threshold:=...')
    if name == 'camera_fov' and isinstance(value, float) and 0.0 < value < 5.0:
        raise UserError('camera_fov lies in [5, 170] deg, or is 0', value,
                        'set it with -p camera_fov:=DEGREES')


def read(node, names: Iterable[str] = tuple(PARAMETERS)) -> dict:
    """Values by name.

    Raises:
        UserError: a value outside its limits, a threshold that is no probability, or two that do
            not go together.
    """
    values = {name: node.get_parameter(name).value for name in names}
    for name, value in values.items():
        check(name, value)
    if values.get('mode') == 'continuous' and values.get('blocked_moves'):
        raise UserError('blocked_moves counts the moves of mode stop_and_go, which end',
                        'mode continuous', 'set progress_decisions in its place')
    return values
