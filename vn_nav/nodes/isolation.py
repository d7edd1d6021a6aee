"""What keeps ROS on this host, by the environment; imports no ROS itself."""

from __future__ import annotations

import os

from vn_nav.resources import share_file

# They would open other ways out, or take the profile's place.
OTHER_WAYS = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS',
              'RMW_FASTRTPS_USE_QOS_FROM_XML', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY',
              'ROS_STATIC_PEERS')


def stay_on_this_host() -> None:
    """Let this process and its children speak through shared memory and 127.0.0.1 alone.

    Before ROS is imported: its libraries look at the environment when they are loaded.
    """
    for name in OTHER_WAYS:
        os.environ.pop(name, None)
    os.environ |= {
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',  # the profile speaks to Fast DDS alone
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(share_file('config/fastdds_localhost.xml')),
        'SKIP_DEFAULT_XML_FILE': '1',  # of the working directory
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',  # as the profile says
    }
