"""Starts the simulated robot and the policy: `ros2 launch vn_nav sim.launch.py`.

Everything stays on this host: the Fast DDS profile knows shared memory and the loopback interface.
The launch ends when one of the two ends: with exit code 1 when it died.
With namespace:=robot2 beside another robot, each has its own world, with its own clock and frames.
"""

import signal

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    RegisterEventHandler,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, SetRemap
from launch_ros.substitutions import FindPackageShare

BAD_INPUT = 2  # exit code: starting again would not help
PASSED_ON = ('namespace', 'use_sim_time', 'params_file', 'autostart', 'use_respawn', 'log_level')


def generate_launch_description():
    """Describe the bridge, and include the policy as it drives a robot."""
    share = FindPackageShare('vn_nav')
    profile = PathJoinSubstitution([share, 'config', 'fastdds_localhost.xml'])
    arguments = [
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the nodes and their topics'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='true', choices=['true', 'false'],
            description='The policy takes its time from the /clock of the bridge'),
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'policy.yaml']),
            description='YAML file of parameters, keyed /**: or by node'),
        DeclareLaunchArgument(
            'autostart', default_value='true', choices=['true', 'false'],
            description='Configure and activate the policy; driving still waits for ~/enable'),
        DeclareLaunchArgument(
            'use_respawn', default_value='false', choices=['true', 'false'],
            description='Start a node again when it dies; the policy then comes up unconfigured'),
        DeclareLaunchArgument(
            'log_level', default_value='info', description='debug, info, warn, error or fatal'),
    ]
    bridge = Node(
        package='vn_nav',
        executable='sim_bridge_node',
        name='sim_bridge_node',
        namespace=LaunchConfiguration('namespace'),
        # The bridge is the clock, whatever a file shared with the policy says.
        parameters=[LaunchConfiguration('params_file'), {'use_sim_time': False}],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
        respawn=LaunchConfiguration('use_respawn'),
        respawn_delay=2.0,
        output='screen',
    )
    policy = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([share, 'launch', 'drive.launch.py'])),
        launch_arguments={name: LaunchConfiguration(name) for name in PASSED_ON}.items(),
    )
    return LaunchDescription([
        *arguments,
        # Fast DDS 2 (Jazzy) reads the first alone, Fast DDS 3 (Kilted, Lyrical) the second.
        SetEnvironmentVariable('FASTRTPS_DEFAULT_PROFILES_FILE', profile),
        SetEnvironmentVariable('FASTDDS_DEFAULT_PROFILES_FILE', profile),
        # ROS adds no peers and no interfaces of its own to those of the profile.
        SetEnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SYSTEM_DEFAULT'),
        # Absolute names would be those of every robot: into the namespace, for both nodes.
        GroupAction([
            *(SetRemap(src=f'/{name}', dst=name) for name in ('clock', 'tf', 'tf_static')),
            policy,  # first: it checks the params file
            bridge,
        ]),
        RegisterEventHandler(OnProcessExit(target_action=bridge, on_exit=_on_exit)),
    ])


def _on_exit(event, context):
    """End the launch with the bridge, unless it is started again."""
    if context.is_shutdown:
        return []
    if event.returncode in (0, -signal.SIGINT):
        return [Shutdown(reason='sim_bridge_node has ended')]
    if event.returncode != BAD_INPUT and (
            LaunchConfiguration('use_respawn').perform(context) == 'true'):
        return []  # the action does it
    raise RuntimeError(
        f'sim_bridge_node died with exit code {event.returncode}; see its output above')
