"""Starts the policy on a robot: `ros2 launch vn_nav drive.launch.py`.

The robot's own drivers publish the pictures and read the velocity commands (README, "Topics").
Topics are relative: a namespace moves them all, and remappings meet other names.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition


def generate_launch_description():
    """Describe the arguments, the environment, the node and its way to the active state."""
    config = PathJoinSubstitution([FindPackageShare('vn_nav'), 'config'])
    arguments = [
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
        DeclareLaunchArgument(
            'fastdds_profile',
            default_value=PathJoinSubstitution([config, 'fastdds_multihost.xml']),
            description='Fast DDS profile; the camera driver needs it too, or frames are lost'),
    ]
    policy = LifecycleNode(
        package='vn_nav',
        executable='policy_node',
        name='policy_node',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('params_file'),
            # The events below bring the node up; its own autostart would do it a second time.
            {'use_sim_time': ParameterValue(
                LaunchConfiguration('use_sim_time'), value_type=bool), 'autostart': False},
        ],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
        respawn=LaunchConfiguration('use_respawn'),
        respawn_delay=2.0,
        output='screen',
    )
    # Registered before the node starts, so that no transition is missed. A node that respawns is
    # not configured again: after a crash somebody looks before the robot moves.
    autostart = IfCondition(LaunchConfiguration('autostart'))
    activate_when_configured = RegisterEventHandler(
        OnStateTransition(
            target_lifecycle_node=policy,
            start_state='configuring',
            goal_state='inactive',
            entities=[_request(policy, Transition.TRANSITION_ACTIVATE)],
        ),
        condition=autostart,
    )
    return LaunchDescription([
        *arguments,
        SetEnvironmentVariable(
            'FASTRTPS_DEFAULT_PROFILES_FILE', LaunchConfiguration('fastdds_profile')),
        activate_when_configured,
        policy,
        _request(policy, Transition.TRANSITION_CONFIGURE, condition=autostart),
    ])


def _request(node, transition, **options):
    return EmitEvent(
        event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition),
        **options)
