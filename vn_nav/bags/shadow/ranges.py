"""Which recorded scan, or depth picture, belongs to a picture of a drive that a policy is shown.

As in the policy node it is the nearest one in time. It may have been recorded after the picture:
the bag is read a second time beside the pictures.
"""

from __future__ import annotations

import collections
import contextlib
from pathlib import Path
from typing import NamedTuple

from vn_msgs_py.motion import MotionError
from vn_nav.bags.poses import OdometryPoses
from vn_nav.bags.roles import CAMERA_INFO, Topics, full_name
from vn_nav.bags.stamped import PAIRING_TIMEOUT_S, Stamped
from vn_nav.bags.storage.decoding import Decoder
from vn_nav.bags.storage.stream import Bag, summary
from vn_nav.errors import UserError

MAX_AGE_S = 0.25  # s between a picture and its ranges, as `max_frame_age` of the policy node


class Ranges(NamedTuple):
    """What was measured at a picture."""

    stamp: int  # ns, by the clock of the picture's stamp
    data: bytes  # CDR of a LaserScan, or of a depth picture
    pose: tuple[float, ...] | None  # x, y [m], yaw [rad] by odometry, there; None: unknown


def find_ranges(bag: str | Path, found: Topics, asked: Topics, role: str) -> tuple[str, str]:
    """Names in the bag of the topic of a role, and of the camera_info beside depth pictures ('').

    Args:
        bag: a rosbag2 folder or an MCAP file.
        found: as `find_topics` returns them; asked: what it was asked for.
        role: 'scan' or 'depth'.

    Raises:
        UserError: the bag has none.
    """
    recorded = summary(bag)
    name, info = getattr(found, role), ''
    if not name:
        raise UserError(f'{role}_topic is a topic of the bag', f'{getattr(asked, role)}: '
                        f'{bag} has {", ".join(sorted(recorded))}',
                        'name one of them, or leave it out: the map takes what the pictures show')
    if role == 'depth':
        info = f'{name.rpartition("/")[0]}/camera_info'.removeprefix(
            '' if name.startswith('/') else '/')
        if info not in recorded or full_name(recorded[info].type) != CAMERA_INFO:
            raise UserError('depth pictures have a camera_info beside them',
                            f'{bag} has no {CAMERA_INFO} on {info}', 'record it as well')
    return name, info


class RangesBeside:
    """The ranges beside the pictures of a drive.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: as they are in the bag.
        name: of the topic of ranges there.
    """

    def __init__(self, bag: Path, topics: Topics, name: str):
        self._topics, self._name = topics, name
        self._decode, self._poses = Decoder(), OdometryPoses()
        self._ranges = Stamped(MAX_AGE_S)
        moving = topics.image, topics.odometry or topics.command
        self._messages = Bag(bag).in_time_order({name, *moving}, clocks=moving)
        self._read: collections.deque[int] = collections.deque()  # pictures, by time of recording
        self._newest = 0  # ns, of recording

    def at(self, log_time: int, stamp: int) -> Ranges | None:
        """What was measured at a picture; pictures are asked for in the order of the drive.

        Args:
            log_time: of its recording [ns]; stamp: its own [ns].

        Returns:
            None: nothing within `MAX_AGE_S`.
        """
        while log_time not in self._read and self._advance():
            pass
        while self._read and self._read[0] != log_time:
            self._read.popleft()
        # A recorder writes what belongs together within that time, or its clock was set back.
        while (abs(self._newest - log_time) <= PAIRING_TIMEOUT_S * 1e9
               and not self._is_settled(log_time, stamp) and self._advance()):
            pass
        near = self._ranges.nearest(stamp * 1e-9, log_time * 1e-9)
        if near is None:
            return None
        own_stamp, data = near
        pose = self._poses.pose(own_stamp * 1e-9, log_time * 1e-9)
        return Ranges(own_stamp, data, None if pose is None else tuple(pose.tolist()))

    def _is_settled(self, log_time: int, stamp: int) -> bool:
        """Nothing that is still to be read could be nearer, or says where the robot was then."""
        if not self._ranges.reaches(stamp * 1e-9):
            return False
        found = self._ranges.around(stamp * 1e-9, log_time * 1e-9)
        return found is None or not self._topics.odometry or self._poses.knows(found[1].stamp)

    def _advance(self) -> bool:
        """Read a message; False: there is none left."""
        message = next(self._messages, None)
        if message is None:
            return False
        topic, self._newest = message.connection.topic, message.log_time
        time = message.log_time * 1e-9
        if topic == self._name:
            stamp = self._decode.header_stamp(message) or message.log_time
            self._ranges.add(stamp * 1e-9, time, (stamp, message.data))
        elif topic == self._topics.image:
            self._read.append(message.log_time)
        elif topic == self._topics.odometry:
            with contextlib.suppress(MotionError):
                self._poses.add(self._decode(message), time)
        return True
