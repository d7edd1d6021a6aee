"""The parameters of `sim_bridge_node`: names, defaults, meanings, limits."""

from __future__ import annotations

from vn_nav.errors import UserError
from vn_nav.scenes import ROOMS, house_scene, scene_name
from vn_sim_bridge.navigation.env_config import STOPS
from vn_sim_bridge.robot.simulated_robot import TICK

DAY = 86_400.0  # s
# name: (default, meaning, limits), as in `vn_nav.nodes.parameters`.
PARAMETERS = {
    'scene': ('', 'where: house:7, house:7?rooms=3, bag:my_drive (vn_nav simulators); empty: see '
              'house'),
    'backend': ('house', 'of the scene that house and rooms name: house', ('house',)),
    'house': (0, 'seed of a house, in place of scene'),
    'rooms': (ROOMS, 'number of its rooms', (1, 12)),
    'robot': ('', "YAML file of the robot; empty: the scene's own, or the standard robot"),
    'size': (84, 'shorter side of the camera picture [pixels]', (16, 1024)),
    'aspect': (1.0, 'its width over its height, such as 1.3333; 1: a square', (0.25, 4.0)),
    'noise': (True, 'Gaussian motion noise, which odom does not see'),
    'odometry_drift': (0.0, 'errors of odom: 0 none, 1 as of a good indoor robot, more: worse',
                       (0.0, 1000.0)),
    'randomisation': ('none', 'of light, camera and base: none, standard, rough, harsh or a YAML '
                              'file'),
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


def scene_of(values: dict) -> str:
    """The scene that the parameters name.

    Raises:
        UserError: `scene` together with `house` or `rooms`, or no scene's name.
    """
    if not values['scene']:
        return house_scene(values['house'], values['rooms'])
    for name in ('house', 'rooms'):
        if values[name] != PARAMETERS[name][0]:
            raise UserError('a scene is named by scene, or by house and rooms',
                            f'scene:={values["scene"]} and {name}:={values[name]}',
                            'leave one of them out')
    return scene_name(values['scene'])
