"""What is wrong with a recorded drive, before it is used for training: one pass over the bag."""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vn_msgs_py.camera import field_of_view
from vn_msgs_py.images import ImageError, decode_depth, decode_labels, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav.bags.doctor.figures import (
    ERROR,
    SET_BACK_NS,
    WARNING,
    Command,
    Diagnosis,
    Finding,
    HeardTopic,
    Motion,
    Neighbours,
)
from vn_nav.bags.roles import TYPES, Topics, fits, full_name, proposal, remedy, replaced
from vn_nav.bags.stamped import EPISODE_GAP_S, STAMP_WINDOW_S
from vn_nav.bags.storage.decoding import Decoder, Ros1
from vn_nav.bags.storage.stream import UNLISTED, Bag, BagError, Connection, Message
from vn_nav.errors import UserError
from vn_nav.observation import crop_fraction

PICTURE_PERIOD_NS = 500_000_000  # ns between pictures that are decoded
BLACK_LEVEL = 16  # of 255: no pixel of a picture's thumbnail is brighter
# Of 255: a thumbnail with a smaller standard deviation shows nothing.
FLAT_SIGMA_LEVELS = 1.0
MIN_TRAVEL_M_RAD = 0.05  # m and rad: a robot that moves less stands still
FROZEN_TRAVEL_M_RAD = 0.1  # m or rad: after this motion an unchanged picture is a fault
CLOCK_JUMP_NS = 1_000_000_000  # ns by which clocks may disagree from one message to the next
CLOCK_SKEW_NS = 500_000_000  # ns by which two sensors' stamps may lag behind differently
# Three years: stamps farther from the recorder's time are simulated time.
SIMULATED_OFFSET_NS = 10**17
MAX_SHARE_WITHOUT_POSE = 0.05  # share of pictures that may be without a matching pose
MAX_LISTED_DAMAGE = 5  # places of damage that are listed
STAMPED = ('image', 'depth', 'labels', 'odometry')  # roles that are put together by their stamps
CLOCK = 'rosgraph_msgs/msg/Clock'
RECOVER = 'save what is whole with `vn_nav bag recover`'
DRIVER = 'check the driver, and record again'


class _Doctor:
    """One pass over a bag.

    Args:
        topics: the names of the roles.
        fov: field of view that the policy needs [rad]; None: not asked.
    """

    def __init__(self, topics: Topics, fov: float | None):
        self._roles = {name.strip('/'): role for role, name in dataclasses.asdict(topics).items()}
        for role in ('goal', 'image'):
            self._roles.setdefault(f'{getattr(topics, role).strip("/")}/compressed', role)
        self._names, self._fov, self._decode = topics, fov, Decoder()
        self.topics: dict[str, HeardTopic] = {}
        self._findings: dict[tuple, Finding] = {}
        self.start: int | None = None
        self.end = 0
        self._odometry, self._command = Motion(), Command()
        self._poses = Neighbours(1e9 * STAMP_WINDOW_S)
        self._info: Any = None
        self._last: Message | None = None

    def find(self, severity: str, topic: str, key: str, what: str, at: int | None,
             remedy: str, count: int = 1) -> None:
        """Note a finding; of the same `key` only the first is told, and how many there are."""
        finding = self._findings.get((topic, key))
        if finding is None:
            when = None if at is None else (at - (self.start or at)) * 1e-9
            self._findings[topic, key] = Finding(severity, topic, what, when, remedy, count)
        else:
            finding.count += count

    def hear(self, message: Message) -> None:
        connection, at = message.connection, message.log_time
        self.start = at if self.start is None else min(self.start, at)
        self.end = max(self.end, at)
        topic = self.topics.get(connection.topic)
        if topic is None:
            topic = self.topics[connection.topic] = self._meet(connection)
        elif connection != topic.connection and full_name(connection.type) != full_name(
                topic.connection.type):
            self.find(ERROR, connection.topic, 'types', f'is {topic.connection.type} and '
                      f'{connection.type}', at, 'record it from one publisher')
            return
        topic.count += 1
        topic.bytes += len(message.data)
        passed = topic.logged.add(at, at)
        if passed <= -SET_BACK_NS:
            topic.recorder_back.add(passed, at)
        if not topic.usable:
            return
        try:
            stamp = self._decode.header_stamp(message)
            if stamp is not None:
                self._stamp(topic, stamp, passed, at)
            if topic.role is not None:
                self._examine(topic, message, at)
        except BagError as error:
            self.find(ERROR if topic.role else WARNING, connection.topic, 'message', error.fault,
                      at, DRIVER)

    def _meet(self, connection: Connection) -> HeardTopic:
        """Begin with a topic: is it what its name says, and can it be read?"""
        topic = HeardTopic(connection, self._roles.get(connection.topic.strip('/')))
        if topic.role and not fits(topic.role, connection.type):
            topic.usable = False
            return topic
        try:
            self._decode.learn(connection)
        except Ros1 as error:
            self.find(ERROR, '', 'ros1', f'is {error.fault}', None, error.remedy)
            topic.usable = False
        except BagError as error:
            self.find(ERROR if topic.role else WARNING, connection.topic, 'definition',
                      error.fault, None, error.remedy)
            topic.usable = False
        return topic

    def _stamp(self, topic: HeardTopic, stamp: int, passed: int, at: int) -> None:
        """Note a header stamp of a message that was recorded `passed` ns after the one before."""
        first = topic.stamps.last is None
        topic.lag.add(at - stamp)
        step = topic.stamps.add(stamp, at)
        if topic.role == 'image':
            self._poses.picture(stamp)
        elif topic.role == 'odometry':
            self._poses.pose(stamp)
        if first or topic.role not in STAMPED:
            return
        if step <= -SET_BACK_NS:
            topic.set_back.add(step, at)
        elif step < 0:
            self.find(WARNING, topic.connection.topic, 'unordered', 'has stamps that go back', at,
                      DRIVER + ': such messages are left out')
        elif step == 0:
            self.find(WARNING, topic.connection.topic, 'repeated', 'has the same stamp twice', at,
                      DRIVER + ': such messages are left out')
        # A message that comes late makes the recorder's clock run ahead, not this one.
        if topic.jump is None and step - passed > CLOCK_JUMP_NS:
            topic.jump = step - passed, at

    def _examine(self, topic: HeardTopic, message: Message, at: int) -> None:
        """Look into a message that has a role in training."""
        name, role = topic.connection.topic, topic.role
        value = self._decode(message)
        try:
            if role == 'odometry':
                self._odometry.pose(odometry_to_array(value))
            elif role == 'command':
                self._command.hear(twist_to_array(value), at)
            elif role == 'camera_info':
                self._camera_info(name, value, at)
            elif role in ('image', 'depth', 'labels', 'goal'):
                self._picture(topic, value, at)
        except MotionError as error:
            self.find(ERROR, name, 'motion', str(error), at, DRIVER)
        except ImageError as error:
            self.find(WARNING if role in ('depth', 'labels') else ERROR, name, 'picture',
                      str(error), at, 'set an encoding that can be read, and record again')

    def _picture(self, topic: HeardTopic, value: Any, at: int) -> None:
        name = topic.connection.topic
        if topic.role == 'image':
            self._frozen(topic, np.asarray(value.data), at)
        raw = not hasattr(value, 'format')
        if raw:
            self._shape(topic, f'{_short(value.encoding)} {value.width} x {value.height}', at)
        if topic.looked is not None and abs(at - topic.looked) < PICTURE_PERIOD_NS:
            return
        topic.looked = at
        if topic.role in ('depth', 'labels'):
            (decode_depth if topic.role == 'depth' else decode_labels)(value)
            return
        picture = decode_rgb(value)
        if not raw:
            self._shape(topic, f'{_short(value.format)} {picture.shape[1]} x '
                        f'{picture.shape[0]}', at)
        small = cv2.resize(picture, (16, 16), interpolation=cv2.INTER_AREA)
        if small.max() < BLACK_LEVEL:
            self.find(WARNING, name, 'black', 'is black', at, 'remove the lens cap, switch on the '
                      'light, or leave this part out')
        elif small.std() < FLAT_SIGMA_LEVELS:
            self.find(WARNING, name, 'flat', 'shows one colour', at, 'check exposure and lens, or '
                      'leave this part out')

    def _shape(self, topic: HeardTopic, shape: str, at: int) -> None:
        if topic.pictures and shape not in topic.pictures and topic.role != 'goal':
            self.find(ERROR, topic.connection.topic, 'shape', f'changes to {shape}', at,
                      'split the bag where the camera changes')
        if len(topic.pictures) < MAX_LISTED_DAMAGE:
            topic.pictures[shape] = None

    def _frozen(self, topic: HeardTopic, data: np.ndarray, at: int) -> None:
        """Does the picture stay the same to the last bit while the robot moves?"""
        moved = self._odometry.total if self._odometry.heard else self._command.total
        # A few bytes tell most pictures apart.
        same = (topic.before is not None and len(data) == len(topic.before)
                and np.array_equal(data[::997], topic.before[::997])
                and np.array_equal(data, topic.before))
        if not same:
            topic.before, topic.moved_before = data, moved
        elif moved - topic.moved_before > FROZEN_TRAVEL_M_RAD:
            self.find(ERROR, topic.connection.topic, 'frozen', 'stays the same while the robot '
                      'moves', at, 'check the camera and its cable, or leave this part out')

    def _camera_info(self, name: str, info: Any, at: int) -> None:
        lens = float(info.k[0]), int(info.width), int(info.height)
        if self._info == lens:
            return
        if self._info is not None:
            self.find(WARNING, name, 'changes', f'changes to a focal length of {lens[0]:g} pixels '
                      f'at {lens[1]} x {lens[2]}', at, 'split the bag where the camera changes')
        self._info = lens
        if not (math.isfinite(lens[0]) and lens[0] > 0 and lens[1] > 0 and lens[2] > 0):
            self.find(WARNING, name, 'focal', f'has a focal length of {lens[0]:g} pixels at '
                      f'{lens[1]} x {lens[2]}', at, 'calibrate the camera (camera_calibration): '
                      'pictures cannot be cropped for a policy')
        elif self._fov is not None:
            fov = field_of_view(*lens[1:], lens[0])
            try:
                crop_fraction(fov, self._fov)
            except UserError as error:
                self.find(ERROR, name, 'narrow', f'is of a camera with '
                          f'{math.degrees(fov):.0f} deg on its shorter side, and the policy needs '
                          f'{math.degrees(self._fov):.0f}', at, error.remedy)

    def conclude(self, bag: Bag) -> list[Finding]:
        """What only the whole bag tells; all findings, the worst first."""
        self._damage(bag)
        roles = collections.defaultdict(list)
        for topic in self.topics.values():
            if topic.role is not None:
                roles[topic.role].append(topic)
        self._missing(roles)
        lags = {topic.connection.topic: lag for role in STAMPED for topic in roles[role]
                if topic.stamps.last and (lag := topic.lag.median()) is not None}
        simulated = bool(lags) and min(map(abs, lags.values())) > SIMULATED_OFFSET_NS or any(
            full_name(topic.connection.type) == CLOCK for topic in self.topics.values())
        for topic in (t for role in STAMPED for t in roles[role]):
            self._gaps(topic, simulated)
            if topic.stamps.last is not None and topic.stamps.last == 0 and topic.count > 1:
                self.find(ERROR, topic.connection.topic, 'none', 'has stamps of zero', None,
                          'have its driver stamp what it publishes')
        self._set_back(roles)
        if lags and not simulated:  # simulated time runs as it likes
            self._clocks(roles, lags)
        self._standing(roles)
        order = {ERROR: 0, WARNING: 1}
        return sorted(self._findings.values(), key=lambda f: (
            order[f.severity], -1.0 if f.when is None else f.when))

    def _damage(self, bag: Bag) -> None:
        for number, loss in enumerate(bag.losses):
            at = loss.before if loss.before is not None else loss.after
            key = f'damage {number}' if number < MAX_LISTED_DAMAGE else 'damage'
            what = f'{loss.path}, byte {loss.offset}: {loss.reason}'
            if number >= MAX_LISTED_DAMAGE:
                what = f'further occurrences: {what}'
            self.find(WARNING if loss.reason == UNLISTED else ERROR, '', key, what, at, RECOVER)
        if bag.path.is_dir() and not (bag.path / 'metadata.yaml').is_file():
            self.find(WARNING, '', 'metadata', 'has no metadata.yaml', None, 'other programs need '
                      'it: ' + RECOVER)

    def _missing(self, roles: dict[str, list[HeardTopic]]) -> None:
        free = {t.connection.topic: t.connection.type for t in self.topics.values()
                if t.role is None}
        kinds = {role: same[0].connection.type for role, same in roles.items() if same}
        for role, topic in ((role, t) for role, same in roles.items() for t in same):
            if not fits(role, topic.connection.type):
                self.find(ERROR, topic.connection.topic, 'type', 'is '
                          f'{topic.connection.type or "of no type"}, not '
                          f'{" or ".join(TYPES[role])}', None,
                          remedy(role, free, replaced(role, kinds)))

        def candidates(role: str) -> str:
            return proposal(role, free) or 'record it'

        if not roles['image']:
            self.find(ERROR, '', 'image', f'has no camera picture ({self._names.image})', None,
                      candidates('image'))
        if not (roles['odometry'] or roles['command']):
            self.find(ERROR, '', 'odometry', f'has neither odometry ({self._names.odometry}) nor '
                      f'commands ({self._names.command})', None, candidates('odometry'))
        elif not roles['odometry']:
            self.find(WARNING, '', 'odometry', f'has no odometry ({self._names.odometry}): '
                      'poses are integrated from commands and drift', None, candidates('odometry'))
        if roles['image'] and not roles['camera_info']:
            self.find(WARNING, '', 'camera_info', 'has no camera calibration '
                      f'({self._names.camera_info})', None, candidates('camera_info'))

    def _gaps(self, topic: HeardTopic, simulated: bool) -> None:
        times = topic.stamps if topic.stamps.last else topic.logged
        name, median = topic.connection.topic, times.gaps.median()
        if topic.role in ('image', 'odometry') and times.worst > EPISODE_GAP_S * 1e9:
            self.find(WARNING, name, 'gap', f'pauses for up to {times.worst * 1e-9:.1f} s',
                      times.worst_at, 'episodes end there' + (
                          ': have the simulator publish it more often' if simulated else
                          '; record with a faster disk or network'))
        if (topic.role == 'odometry' and median is not None and median > 2e9 * STAMP_WINDOW_S
                and self._poses.alone > MAX_SHARE_WITHOUT_POSE * self._poses.pictures):
            share = self._poses.alone / self._poses.pictures
            self.find(ERROR, name, 'rate', f'comes at {1e9 / median:.1f} Hz: {share:.0%} of the '
                      f'pictures have no pose within {STAMP_WINDOW_S * 1e3:.0f} ms', None,
                      f'publish it at {1 / STAMP_WINDOW_S:.0f} Hz')

    def _set_back(self, roles: dict[str, list[HeardTopic]]) -> None:
        """Clocks that were set back: of the stamps, and of the recorder."""
        for what, chosen, of in (
                ('is stamped', STAMPED, lambda topic: topic.set_back),
                ('was recorded', (*STAMPED, 'command'), lambda topic: topic.recorder_back)):
            moving = [t for role in ('image', 'odometry' if roles['odometry'] else 'command')
                      for t in roles[role] if role in chosen]
            alike = all(of(topic).count for topic in moving)
            for topic in self.topics.values():
                back = of(topic)
                if topic.role not in chosen or not back.count:
                    continue
                serious = not alike and topic in moving
                self.find(ERROR if serious else WARNING, topic.connection.topic, what,
                          f'{what} by a clock that was set back by {-back.first * 1e-9:.1f} s',
                          back.at, 'pictures and poses do not match after it: '
                          'synchronise the clocks (chrony), and record again' if serious else
                          'a simulator was reset, or these are two takes: an episode ends there',
                          back.count)

    def _clocks(self, roles: dict[str, list[HeardTopic]], lags: dict[str, float]) -> None:
        """Stamps against the recorder's clock, and of one sensor against another's."""
        for topic in (t for role in STAMPED for t in roles[role]):
            if topic.jump is None:
                continue
            jump, at = topic.jump
            self.find(ERROR, topic.connection.topic, 'jump', 'is stamped by a clock that jumps by '
                      f'{jump * 1e-9:.1f} s', at, 'synchronise the clocks (chrony) before '
                      'recording; split the bag here')
        for name, lag in lags.items():
            if abs(lag) > CLOCK_JUMP_NS:
                self.find(WARNING, name, 'skew', f'is stamped {lag * 1e-9:.1f} s before it is '
                          'recorded', None, 'synchronise the clocks (chrony)')
        late, early = max(lags, key=lags.__getitem__), min(lags, key=lags.__getitem__)
        if lags[late] - lags[early] > CLOCK_SKEW_NS:
            self.find(ERROR, late, 'skew to others', 'is stamped '
                      f'{(lags[late] - lags[early]) * 1e-9:.1f} s earlier than {early} at the '
                      'same time', None, 'synchronise the clocks (chrony), or stamp both on one '
                      'computer')

    def _standing(self, roles: dict[str, list[HeardTopic]]) -> None:
        commanded = self._command.total > MIN_TRAVEL_M_RAD
        if self._odometry.heard and self._odometry.reach < MIN_TRAVEL_M_RAD:
            self.find(ERROR, roles['odometry'][0].connection.topic, 'still',
                      'never moves' + ', although the commands are not zero' * commanded, None,
                      'check the wheel encoders' if commanded else 'drive while recording')
        elif not roles['odometry'] and roles['command'] and not commanded:
            self.find(ERROR, roles['command'][0].connection.topic, 'still', 'never moves the '
                      'robot', None, 'drive while recording')


def _short(words: str) -> str:
    """What a message says of itself, fit for a terminal."""
    return words[:40] if words.isprintable() else repr(words[:40])


def diagnose(path: str | Path, *, topics: Topics | None = None, fov: float | None = None,
             listen: Callable[[Message], None] | None = None) -> Diagnosis:
    """Read a bag once and say what is wrong with it.

    Args:
        path: a rosbag2 folder or an MCAP file, damaged or not.
        topics: the names of camera, odometry and so on in the bag.
        fov: field of view that the policy needs [rad]; None: cameras are not compared with it.
        listen: is called with every message, in the order of the files.

    Raises:
        BagError: it is no bag.
    """
    bag, doctor = Bag(path, strict=False), _Doctor(topics or Topics(), fov)
    for message in bag.messages():
        doctor.hear(message)
        if listen is not None:
            listen(message)
    findings = doctor.conclude(bag)
    seconds = 0.0 if doctor.start is None else (doctor.end - doctor.start) * 1e-9
    figures = sorted((topic.figures() for topic in doctor.topics.values()), key=lambda t: t.topic)
    return Diagnosis(str(path), seconds, figures, findings, bag.notes)
