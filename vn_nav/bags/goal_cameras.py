"""Which cameras took the goal pictures of a bag, where they are not the robot's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from vn_nav.bags.roles import Topics
from vn_nav.bags.stamped import header_stamp
from vn_nav.bags.storage.stream import messages
from vn_nav.calibration import read_calibration
from vn_nav.rectification import Camera

GoalCameras = Mapping[tuple[int, int], Camera]  # by the stamp of the goal picture


def read_goal_cameras(bag: str | Path, topics: Topics, target_fov: float) -> GoalCameras:
    """The cameras that a bag describes on `goal_camera_info`, in whatever order with the goals.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: as `find_topics` returns them.
        target_fov: that the policy is trained with [rad].

    Raises:
        UserError: one that is no camera, see `read_calibration`.
    """
    if not (topics.goal and topics.goal_camera_info):
        return {}
    found = {}
    for message in messages(bag, (topics.goal_camera_info,)):
        calibration = read_calibration(message.message)
        if calibration is not None:
            found[header_stamp(message.message)] = Camera(calibration, target_fov)
    return found
