"""What is wrong with a recorded drive, before it is used for training: one pass over the bag."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from vn_nav.bags.doctor.bag_checks import CLOCK_JUMP_NS, STAMPED, BagChecks
from vn_nav.bags.doctor.content_checks import ContentChecks
from vn_nav.bags.doctor.figures import (
    DRIVER,
    ERROR,
    SET_BACK_NS,
    WARNING,
    Diagnosis,
    Finding,
    Findings,
    Neighbours,
    ReceivedTopic,
)
from vn_nav.bags.roles import Topics, fits, full_name
from vn_nav.bags.stamped import STAMP_WINDOW_S
from vn_nav.bags.storage.decoding import Decoder, Ros1
from vn_nav.bags.storage.stream import Bag, BagError, Connection, Message


class _Doctor:
    """One pass over a bag.

    Args:
        topics: the names of the roles.
        fov: field of view that the policy needs [rad]; None: not asked.
        any_lens: see `ContentChecks`.
    """

    def __init__(self, topics: Topics, fov: float | None, any_lens: bool):
        self._roles = {name.strip('/'): role for role, name in dataclasses.asdict(topics).items()}
        for role in ('goal', 'image'):
            self._roles.setdefault(f'{getattr(topics, role).strip("/")}/compressed', role)
        self._names, self._decode = topics, Decoder()
        self.topics: dict[str, ReceivedTopic] = {}
        self.findings = Findings()
        self._add = self.findings.add
        self.start: int | None = None
        self.end = 0
        self._contents = ContentChecks(self.findings, fov, any_lens)
        self._poses = Neighbours(1e9 * STAMP_WINDOW_S)

    def add(self, message: Message) -> None:
        connection, at = message.connection, message.log_time
        self.start = at if self.start is None else min(self.start, at)
        self.findings.start = self.start
        self.end = max(self.end, at)
        topic = self.topics.get(connection.topic)
        if topic is None:
            topic = self.topics[connection.topic] = self._meet(connection)
        elif connection != topic.connection and full_name(connection.type) != full_name(
                topic.connection.type):
            self._add(ERROR, connection.topic, 'types', f'is {topic.connection.type} and '
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
                self._contents.examine(topic, self._decode(message), at)
        except BagError as error:
            self._add(ERROR if topic.role else WARNING, connection.topic, 'message', error.fault,
                      at, DRIVER)

    def _meet(self, connection: Connection) -> ReceivedTopic:
        """Begin with a topic: is it what its name says, and can it be read?"""
        topic = ReceivedTopic(connection, self._roles.get(connection.topic.strip('/')))
        if topic.role and not fits(topic.role, connection.type):
            topic.usable = False
            return topic
        try:
            self._decode.learn(connection)
        except Ros1 as error:
            self._add(ERROR, '', 'ros1', f'is {error.fault}', None, error.remedy)
            topic.usable = False
        except BagError as error:
            self._add(ERROR if topic.role else WARNING, connection.topic, 'definition',
                      error.fault, None, error.remedy)
            topic.usable = False
        return topic

    def _stamp(self, topic: ReceivedTopic, stamp: int, passed: int, at: int) -> None:
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
            self._add(WARNING, topic.connection.topic, 'unordered', 'has stamps that go back', at,
                      DRIVER + ': such messages are left out')
        elif step == 0:
            self._add(WARNING, topic.connection.topic, 'repeated', 'has the same stamp twice', at,
                      DRIVER + ': such messages are left out')
        # A message that comes late makes the recorder's clock run ahead, not this one.
        if topic.jump is None and step - passed > CLOCK_JUMP_NS:
            topic.jump = step - passed, at

    def conclude(self, bag: Bag) -> list[Finding]:
        """All findings, the worst first, with those that only the whole bag shows."""
        BagChecks(self.findings, self.topics, self._names, self._contents, self._poses).run(bag)
        return self.findings.sorted()


def diagnose(path: str | Path, *, topics: Topics | None = None, fov: float | None = None,
             any_lens: bool = False, listen: Callable[[Message], None] | None = None
             ) -> Diagnosis:
    """Read a bag once and say what is wrong with it.

    Args:
        path: a rosbag2 folder or an MCAP file, damaged or not.
        topics: the names of camera, odometry and so on in the bag.
        fov: field of view that the policy needs [rad]; None: cameras are not compared with it.
        any_lens: whether the policy also drives by narrower cameras.
        listen: is called with every message, in the order of the files.

    Raises:
        BagError: it is no bag.
    """
    bag, doctor = Bag(path, strict=False), _Doctor(topics or Topics(), fov, any_lens)
    for message in bag.messages():
        doctor.add(message)
        if listen is not None:
            listen(message)
    findings = doctor.conclude(bag)
    seconds = 0.0 if doctor.start is None else (doctor.end - doctor.start) * 1e-9
    figures = sorted((topic.figures() for topic in doctor.topics.values()), key=lambda t: t.topic)
    return Diagnosis(str(path), seconds, figures, findings, bag.notes)
