"""What keeps ROS on this host, by the environment; imports no ROS itself."""

from __future__ import annotations

import os

from vn_nav.resources import share_file

# They would open other ways out, or take the profile's place.
OTHER_WAYS = ('FASTDDS_BUILTIN_TRANSPORTS', 'RMW_FASTRTPS_USE_QOS_FROM_XML',
              'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
# Fast DDS 2 (Jazzy) reads the first alone, Fast DDS 3 (Kilted, Lyrical) the second.
OLD_PROFILE, NEW_PROFILE = PROFILE_VARIABLES = (
    'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')


def profile_environment() -> dict[str, str]:
    """The variables that give a process the profile of one host: whole pictures pass."""
    return dict.fromkeys(PROFILE_VARIABLES, str(share_file('config/fastdds_localhost.xml')))


def stay_on_this_host() -> None:
    """Let this process and its children speak through shared memory and 127.0.0.1 alone.

    Before ROS is imported: its libraries look at the environment when they are loaded.
    """
    for name in OTHER_WAYS:
        os.environ.pop(name, None)
    os.environ |= profile_environment() | {
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',  # the profile speaks to Fast DDS alone
        'SKIP_DEFAULT_XML_FILE': '1',  # of the working directory
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',  # as the profile says
    }
