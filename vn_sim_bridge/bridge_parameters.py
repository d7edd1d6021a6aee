"""The parameters of `sim_bridge_node`: names, defaults, meanings, limits."""

from __future__ import annotations

from vn_sim_bridge.navigation.env import STOPS
from vn_sim_bridge.robot.simulated_robot import TICK

DAY = 86_400.0  # s
# name: (default, meaning, limits), as in `vn_nav.nodes.parameters`.
PARAMETERS = {
    'backend': ('house', 'simulator behind the bridge: house', ('house',)),
    'house': (0, 'seed of the house'),
    'rooms': (5, 'number of rooms', (1, 12)),
    'robot': ('', 'YAML file of the robot; empty: the standard robot'),
    'size': (84, 'side of the square camera picture [pixels]', (16, 1024)),
    'noise': (True, 'Gaussian motion noise, which odom does not see'),
    'odometry_drift': (0.0, 'errors of odom: 0 none, 1 as of a good indoor robot, more: worse',
                       (0.0, 1000.0)),
    'randomisation': ('none', 'of light, camera and base: none, standard, rough or a YAML file'),
    'goals': ('', 'folder of goal pictures with their poses (goals.json); empty: the own ones'),
    'seed': (0, 'of starts, goals and noise'),
    'time': ('real_time', 'real_time or lock_step (docs/architecture.md, "Time")',
             ('real_time', 'lock_step')),
    'mode': ('stop_and_go', 'lock_step: stop_and_go shows pictures at rest, continuous always',
             ('stop_and_go', 'continuous')),
    'camera_rate': (10.0, 'pictures and scans per simulated second [Hz]', (1.0, 1 / TICK)),
    'enable_stamped_cmd_vel': (False, 'listen for TwistStamped instead of Twist'),
    'free_driving': (False, 'no goals and no episodes: anybody drives, for instance to map'),
    'episodes': (0, 'episodes to run; 0: without end', (0, 2**31 - 1)),
    'max_decisions': (300, 'limit of an episode', (1, 2**31 - 1)),
    'stop': ('arrival', 'what ends an episode before its limit: arrival, or declared: `arrived`',
             tuple(STOPS)),
    'frame_prefix': ('', 'in front of every frame but map, such as robot2/'),
    'localised': (False, 'say in /tf where odom lies in map; false: SLAM or AMCL does'),
    'start_time': (0.0, 'first stamp [s]; 0: the time of the wall clock, in lock_step of the day',
                   (0.0, 2**31 - DAY)),  # stamps have 32 bits for the seconds
    'exit_when_done': (False, 'exit after the last episode instead of standing still'),
}


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
