"""The parameters of `sim_bridge_node`: names, defaults, meanings, and which values go together."""

from __future__ import annotations

import math

from vn_nav.errors import UserError
from vn_sim_bridge.env import STOPS
from vn_sim_bridge.simulated_robot import TICK

# name: (default, meaning); the types of the defaults are the types of the parameters.
PARAMETERS = {
    'backend': ('house', 'simulator behind the bridge: house'),
    'house': (0, 'seed of the house'),
    'rooms': (5, 'number of rooms, 1 to 12'),
    'robot': ('', 'YAML file of the robot; empty: the standard robot'),
    'size': (84, 'side of the square camera picture [pixels]'),
    'noise': (True, 'Gaussian motion noise, which odom does not see'),
    'odometry_drift': (0.0, 'errors of odom: 0 none, 1 as of a good indoor robot, more: worse'),
    'randomisation': ('none', 'of light, camera and base: none, standard, rough or a YAML file'),
    'goals': ('', 'folder of goal pictures with their poses (goals.json); empty: the own ones'),
    'seed': (0, 'of starts, goals and noise'),
    'time': ('real_time', 'real_time or lock_step (docs/architecture.md, "Time")'),
    'mode': ('stop_and_go', 'lock_step: stop_and_go shows pictures at rest, continuous always'),
    'camera_rate': (10.0, 'pictures and scans per simulated second [Hz]'),
    'enable_stamped_cmd_vel': (False, 'listen for TwistStamped instead of Twist'),
    'free_driving': (False, 'no goals and no episodes: anybody drives, for instance to map'),
    'episodes': (0, 'episodes to run; 0: without end'),
    'max_decisions': (300, 'limit of an episode'),
    'stop': ('arrival', 'what ends an episode before its limit: arrival, or declared: `arrived`'),
    'frame_prefix': ('', 'in front of every frame but map, such as robot2/'),
    'localised': (False, 'say in /tf where odom lies in map; false: SLAM or AMCL does'),
    'start_time': (0.0, 'first stamp [s]; 0: the time of the wall clock, in lock_step of the day'),
    'exit_when_done': (False, 'exit after the last episode instead of standing still'),
}
DAY = 86_400.0  # s


def check(values: dict) -> None:
    """Refuse values that no bridge can have.

    Raises:
        UserError: names the first of them.
    """
    rules = (
        ('backend', values['backend'] == 'house', 'the backend is one of: house'),
        ('time', values['time'] in ('real_time', 'lock_step'),
         'time is real_time or lock_step'),
        ('mode', values['mode'] in ('stop_and_go', 'continuous'),
         'mode is stop_and_go or continuous'),
        ('camera_rate', 1.0 <= values['camera_rate'] <= 1 / TICK,
         f'camera_rate lies between 1 and {1 / TICK:.0f} Hz'),
        ('odometry_drift', 0 <= values['odometry_drift'] < math.inf,
         'odometry_drift is 0 (none) or more'),
        ('size', 16 <= values['size'] <= 1024, 'size lies between 16 and 1024 pixels'),
        ('max_decisions', values['max_decisions'] >= 1, 'max_decisions is at least 1'),
        ('stop', values['stop'] in STOPS, f'stop is {" or ".join(STOPS)}'),
        # Stamps have 32 bits for the seconds.
        ('start_time', 0 <= values['start_time'] < 2**31 - DAY, 'start_time is 0 (of the wall '
         'clock) or a positive number of seconds that a stamp can hold'),
        ('episodes', values['episodes'] >= 0, 'episodes is 0 (without end) or more'),
    )
    for name, kept, rule in rules:
        if not kept:
            raise UserError(rule, values[name], f'set {name} with -p {name}:=...')


def first_stamp(start_time: float, *, lock_step: bool, wall: float) -> float:
    """The simulated time at which the bridge begins [s].

    A bridge that is started again must not show its first goal with the stamp of the last run's:
    the policy would take it for the goal it knows. In real time the wall clock is also what other
    nodes' stamps are compared with. In lock-step, where time runs as it likes, the time of the day
    is far from any real stamp, so that tools still see that it is simulated.

    Args:
        start_time: the parameter; 0: chosen here.
        wall: the wall clock [s].
    """
    if start_time > 0:
        return start_time
    # Whole milliseconds; zero would mean "no time yet".
    return max(1.0, round(wall % DAY if lock_step else wall, 3))
