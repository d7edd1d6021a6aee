"""Starts the policy on a robot: `ros2 launch vn_nav drive.launch.py`.

The robot's own drivers publish the pictures and read the velocity commands (README, "Topics").
Topics are relative: a namespace moves them all, and remappings meet other names. The launch ends
when the node ends: with exit code 1 when it died.
"""

import os
import signal

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    Shutdown,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# Fast DDS 2 (Jazzy) reads the first alone, Fast DDS 3 (Kilted, Lyrical) the second.
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
BAD_INPUT = 2  # exit code: starting again would not help
RESPAWN_DELAY = 2.0  # s


def generate_launch_description():
    """Describe the arguments, the environment and the node."""
    config = PathJoinSubstitution([FindPackageShare('vn_nav'), 'config'])
    usual = PathJoinSubstitution([config, 'fastdds_multihost.xml'])
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the node and its topics'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=['true', 'false'],
            description='Take the time from /clock'),
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([config, 'policy.yaml']),
            description='YAML file of parameters, keyed /**:'),
        DeclareLaunchArgument(
            'autostart', default_value='true', choices=['true', 'false'],
            description='Configure and activate the node; driving still waits for ~/enable'),
        DeclareLaunchArgument(
            'use_respawn', default_value='false', choices=['true', 'false'],
            description='Start the node again when it dies; it then comes up unconfigured'),
        DeclareLaunchArgument(
            'log_level', default_value='info', description='debug, info, warn, error or fatal'),
        # The camera driver needs a profile like this one too, or frames are lost. A user's own
        # profile, and that of sim.launch.py, stay.
        *(SetEnvironmentVariable(name, EnvironmentVariable(
            name, default_value=[EnvironmentVariable(other, default_value=usual)]))
          for name, other in (PROFILES, PROFILES[::-1])),
        OpaqueFunction(function=_start),
    ])


KEPT = ('namespace', 'params_file', 'use_sim_time', 'log_level', 'use_respawn')


def _start(context):
    """Start the node; without its parameters it would be another one."""
    path = LaunchConfiguration('params_file').perform(context)
    if not os.path.isfile(path):
        raise RuntimeError(f'params_file is a file that exists; received {path!r}; correct it')
    # The node configures and activates itself, once: what an operator does later with
    # `ros2 lifecycle set` is not followed by anything behind his back.
    return _policy(ParameterValue(LaunchConfiguration('autostart'), value_type=bool),
                   {name: LaunchConfiguration(name).perform(context) for name in KEPT},
                   context.launch_configurations.get('ros_remaps', []))


def _policy(autostart, kept, remaps):
    """Return the node, and what follows its end.

    What surrounds it is given as values: when it is started again, the group and the includes
    around it, with their namespace and remappings, are over.
    """
    def on_exit(event, context):
        return _on_exit(event, context, kept, remaps)
    policy = Node(
        package='vn_nav',
        executable='policy_node',
        name='policy_node',
        namespace=kept['namespace'],
        remappings=list(remaps),
        parameters=[
            kept['params_file'],
            {'use_sim_time': kept['use_sim_time'] == 'true', 'autostart': autostart},
        ],
        arguments=['--ros-args', '--log-level', kept['log_level']],
        output='screen',
    )
    return [RegisterEventHandler(OnProcessExit(target_action=policy, on_exit=on_exit)), policy]


def _on_exit(event, context, kept, remaps):
    """End the launch with the node, or start it again."""
    if context.is_shutdown:
        return []
    if event.returncode in (0, -signal.SIGINT):
        return [Shutdown(reason='policy_node has ended')]
    if event.returncode != BAD_INPUT and kept['use_respawn'] == 'true':
        # Unconfigured: after a crash somebody looks before the robot moves.
        return [TimerAction(period=RESPAWN_DELAY, actions=_policy(False, kept, remaps))]
    raise RuntimeError(f'policy_node died with exit code {event.returncode}; see its output above')
