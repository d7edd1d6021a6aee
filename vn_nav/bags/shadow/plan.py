"""What a policy is shown of a recorded drive that it would have driven: where it has to decide.

A decision is wanted where an action of the robot began, and where an episode ended: the pictures
that training takes from a bag. Two readings of the bag: `make_plan` cuts the drive, `Plan.events`
streams it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_msgs_py.picture_file import DecodedPicture
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive import Report, find_topics
from vn_nav.bags.drive_decoder import read_steps
from vn_nav.bags.goal_cameras import GoalCameras, read_goal_cameras
from vn_nav.bags.roles import COMPRESSED, Topics, full_name
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.bags.shadow.ranges import Ranges, RangesBeside, find_ranges
from vn_nav.bags.stamped import header_stamp
from vn_nav.bags.storage.decoding import Decoder
from vn_nav.bags.storage.stream import Bag, summary
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec

COMMAND_RATES_HZ = 5.0, 20.0  # Hz of commands
RATE_SAMPLE_MESSAGES = 400  # messages from which the rate is measured
MAX_STAMP_NS = (1 << 31) * 10**9  # the largest header stamp
# Between the last picture and the next episode's first one, where a clock went back.
CLOCK_RESET_GAP_NS = 1_000_000
STAMP_RESOLUTION_NS = 1_000  # ns; stamps as float64 s since 1970 are a quarter of that apart


class Decision(NamedTuple):
    """A picture at which the policy decides."""

    time: float  # s, of recording
    episode: int
    done: str | None  # the action before it; None: an episode's first, or none of the robot's
    last: bool  # of its episode
    pose: tuple[float, ...] | None  # x, y [m], yaw [rad] by odometry; None: the bag has none


class Event(NamedTuple):
    """What happens next in the drive: a picture, or a tick: a command is due."""

    log_time: int  # ns, of recording
    stamp: int  # ns, by the clock of the headers; pictures' grow, ticks' do not fall
    data: bytes | None  # CDR as it was; None: a tick without odometry
    picture: bool
    decision: Decision | None
    ranges: Ranges | None = None  # that were measured at the picture of a decision, if asked for

    @property
    def picture_data(self) -> bytes:
        """Of a picture: its message."""
        assert self.data is not None  # only ticks may have none
        return self.data


@dataclasses.dataclass
class Plan:
    """A drive, cut."""

    bag: Path
    topics: Topics  # as they are in the bag
    compressed: bool  # the pictures
    rate: float  # of ticks [Hz]
    decisions: list[Decision]
    goals: Goals
    report: Report
    camera_info: bytes | None  # the first, CDR
    camera: tuple[float, float] | None  # rad of the pictures' shorter side, width over height
    ranges: str = ''  # topic of measured ranges, as in the bag; '': they are not asked for
    depth_info: bytes | None = None  # the first camera_info beside depth pictures, CDR
    unreadable: int = 0  # pictures that could not be decoded, after `events`

    def events(self) -> Iterator[Event | None]:
        """The drive, message by message in the order of recording; None: nothing new.

        A tick is the odometry (or, without one, the command) nearest to each period, within
        episodes. Pictures that cannot be decoded are left out.
        """
        decode, clock, self.unreadable = Decoder(), _Clock(1.0 / self.rate), 0
        decisions = {decision.time: decision for decision in self.decisions}
        ticks = self.topics.odometry or self.topics.command
        driving = unseen = False  # in an episode; its last decision was at no picture
        moving = self.topics.image, ticks
        beside = RangesBeside(self.bag, self.topics, self.ranges) if self.ranges else None
        for message in Bag(self.bag).in_time_order(moving, clocks=moving):
            stamp = decode.header_stamp(message) or 0
            _check_times(self.bag, message.log_time, stamp)
            if message.connection.topic == ticks:
                usable = driving and _is_finite(decode(message))
                due = clock.tick(message.log_time, stamp) if usable else None
                pose = message.data if ticks == self.topics.odometry else None
                yield None if due is None else Event(message.log_time, due, pose, False, None)
                continue
            decision = decisions.pop(message.log_time * 1e-9, None)
            readable = _picture(decode(message), smallest=1) is not None
            self.unreadable += not readable
            if decision is not None and unseen:
                decision = decision._replace(done=None)
            if decision is not None:
                unseen = not readable
            shown = (clock.picture(message.log_time, stamp, decision is not None)
                     if readable and (driving or decision is not None) else None)
            if decision is not None:
                driving = (driving or readable) and not decision.last
            if shown is None:
                yield None
                continue
            own = stamp or message.log_time
            ranges = (None if beside is None or decision is None
                      else beside.at(message.log_time, own))
            yield Event(message.log_time, shown, message.data, True, decision,
                        ranges and ranges._replace(stamp=shown + ranges.stamp - own))


class Goals:
    """A goal picture for each episode, kept on disk.

    Args:
        everywhere: where the bag shows none; None: the episode's last picture.
        cameras: that took goals of the bag, where they are not the robot's.

    Attributes:
        shown: episodes with a goal of the bag.
        hindsight: episodes whose goal is their last picture.
    """

    def __init__(self, everywhere: DecodedPicture | None = None,
                 cameras: GoalCameras | None = None):
        self._file = tempfile.TemporaryFile()
        # By episode: where the picture is, its shape, its field of view.
        self._places: dict[int, tuple[int, tuple[int, ...], float | None]] = {}
        self._everywhere, self._cameras = everywhere, cameras or {}
        self.shown = self.hindsight = 0

    def keep(self, episode: int, goal: object, last: object) -> None:
        """Choose an episode's goal picture.

        Args:
            episode: its number.
            goal: message that the bag shows; None: none.
            last: message of the episode's last picture.
        """
        picture, fov = None if goal is None else _picture(goal), None
        self.shown += picture is not None
        if picture is not None and (camera := self._cameras.get(header_stamp(goal))) is not None:
            picture, fov = camera.rectify(picture), camera.fov
        if picture is None and self._everywhere is None:
            picture = _picture(last)
            self.hindsight += picture is not None
        if picture is not None:
            self._places[episode] = self._file.tell(), picture.shape, fov
            self._file.write(picture.tobytes())

    def picture(self, episode: int) -> DecodedPicture | None:
        """The goal; its field of view is None for the robot's own. None: it cannot be decoded."""
        if episode not in self._places:
            return self._everywhere
        place, shape, fov = self._places[episode]
        end = self._file.tell()
        self._file.seek(place)
        data = self._file.read(math.prod(shape))
        self._file.seek(end)
        return DecodedPicture(np.frombuffer(data, np.uint8).reshape(shape), fov)


class _Clock:
    """Stamps for the node: those of the headers, on where they went back between episodes."""

    def __init__(self, period: float):
        self._period = period * 1e9
        self._shift = 0
        self._picture: int | None = None  # the last ones
        self._tick: int | None = None
        self._log_time = 0  # of the last picture
        self._slot = -1

    def picture(self, log_time: int, stamp: int, wanted: bool) -> int | None:
        """The stamp of a picture; None: it comes again, or too late, and may be left out."""
        stamp = (stamp or log_time) + self._shift
        if self._picture is not None and stamp < self._picture + STAMP_RESOLUTION_NS:
            if not wanted:
                return None
            self._shift += self._picture + CLOCK_RESET_GAP_NS - stamp
            stamp = self._picture + CLOCK_RESET_GAP_NS
        self._picture, self._log_time = stamp, log_time
        return stamp

    def tick(self, log_time: int, stamp: int) -> int | None:
        """The stamp of a tick; None: none is due yet."""
        assert self._picture is not None  # ticks lie within episodes; a picture begins one
        stamp = (stamp + self._shift if stamp
                 else self._picture + max(log_time - self._log_time, 0))
        slot = round(stamp / self._period)
        if slot == self._slot:
            return None
        self._slot = slot
        self._tick = stamp if self._tick is None else max(self._tick, stamp)
        return self._tick


def make_plan(bag: str | Path, robot: RobotSpec, topics: Topics,
              goal: DecodedPicture | None = None, ranges: str = '') -> Plan:
    """Cut a drive into the actions of a robot.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        robot: its actions.
        topics: names in the bag.
        goal: picture where the bag shows none; None: the last picture of each episode.
        ranges: 'scan' or 'depth': the topic of this role is for the policy's map; '': none is.

    Raises:
        UserError: no readable bag, topics or types that are not there, or nothing to decide at.
    """
    report = Report()
    wanted = dataclasses.replace(topics, depth='', labels='', scan='')
    found = find_topics(bag, wanted)
    measured, depth_info = '', ''
    if ranges:
        kept = dataclasses.replace(wanted, **{ranges: getattr(topics, ranges)})
        measured, depth_info = find_ranges(bag, find_topics(bag, kept), kept, ranges)
    steps, facts, lens = read_steps(bag, Wanted(robot, topics=wanted), report)
    decisions: list[Decision] = []
    goals = Goals(goal, read_goal_cameras(bag, found, robot.camera_fov))
    done = None
    for step in steps:
        frame = step.frame
        _check_times(bag, int(frame.time * 1e9), int(frame.stamp * 1e9))
        first = not decisions or decisions[-1].episode != frame.episode
        decisions.append(Decision(
            frame.time, frame.episode, None if first else done, step.last,
            tuple(frame.pose.tolist()) if found.odometry else None))
        done = None if step.action == NO_ACTION else robot.action_names[step.action]
        if step.last:
            goals.keep(frame.episode, frame.goal, frame.image)
    if len({decision.time for decision in decisions}) < len(decisions):
        raise UserError('the pictures of a drive were recorded at times of their own',
                        f"{bag}: the recorder's clock was set back", 'record each take into a '
                        'bag of its own')
    if not decisions:
        raise UserError('a bag for shadow mode holds pictures with matching poses',
                        f'{bag}: {report.pictures} pictures, {report.without_pose} without a '
                        'pose', 'see `vn_nav bag doctor`')
    camera_info = camera = None
    if lens is not None:
        camera_info, camera = _first(bag, found.camera_info), (lens.fov, lens.aspect)
    return Plan(Path(bag), found, full_name(summary(bag)[found.image].type) == COMPRESSED,
                _rate(bag, found.odometry or found.command), decisions, goals, report,
                camera_info, camera, measured, _first(bag, depth_info) if depth_info else None)


def stamped(data: bytes, stamp: int) -> bytes:
    """A CDR message that begins with a header, with another stamp [ns]."""
    order = '<' if data[1] & 1 else '>'
    return b''.join((data[:4], struct.pack(f'{order}iI', *divmod(stamp, 10**9)), data[12:]))


def _rate(bag: str | Path, topic: str) -> float:
    """Ticks a second that a topic allows."""
    decode = Decoder()
    stamps = [decode.header_stamp(message) or message.log_time
              for message in itertools.islice(
                  Bag(bag).in_time_order((topic,)), RATE_SAMPLE_MESSAGES)]
    gaps = np.diff(stamps)
    gaps = gaps[gaps > 0]
    if not len(gaps):
        return COMMAND_RATES_HZ[1]
    return float(np.clip(1e9 / np.median(gaps), *COMMAND_RATES_HZ))


def _first(bag: str | Path, topic: str) -> bytes:
    return next(Bag(bag).in_time_order((topic,))).data


def _is_finite(message: object) -> bool:
    try:
        (odometry_to_array if hasattr(message, 'pose') else twist_to_array)(message)
    except MotionError:
        return False
    return True


def _check_times(bag: str | Path, *times: int) -> None:
    if not all(0 <= time < MAX_STAMP_NS for time in times):
        raise UserError('a drive is stamped from 1970 to 2038', f'{bag}: {max(times)} ns',
                        'see `vn_nav bag doctor`')


def _picture(message: object, smallest: int | None = None) -> np.ndarray | None:
    try:
        return decode_rgb(message, smallest)
    except ImageError:
        return None
