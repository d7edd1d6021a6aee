"""`recorder_node`: topics into a rosbag2 bag, where there is no `ros2 bag`.

Run: `ros2 run vn_nav recorder_node --ros-args -p output:=my_drive`; see docs/bags.md.
"""

from __future__ import annotations

import dataclasses
import datetime
import operator
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from vn_msgs_py.topics import LATCHED, TOPICS, Topic, topic
from vn_nav.bags.storage.writer import MIN_FREE_BYTES, BagWriter, RecordingStopped
from vn_nav.errors import UserError
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import profile, qos
from vn_nav.nodes.taps import Tap, hidden, in_bag, installed, message_class, weakened

# Messages of a topic: pictures are best effort, and a recorder must not drop them.
QUEUE_DEPTH = 256
MESSAGES_PER_TURN = 16  # messages of a topic that are taken before its neighbours have their turn
POLL_PERIOD_S = 0.005  # s between looks at the subscriptions when there was nothing
GRAPH_PERIOD_S = 0.2  # s between looks at who publishes
REPORT_PERIOD_S = 1.0  # s
RECEIVED = 'received: '  # before a topic's name in the status: messages of it
TWIN = {'geometry_msgs/msg/Twist': 'geometry_msgs/msg/TwistStamped'}  # accepted in its place
COMPRESSED = 'image_raw/compressed'  # a bag needs a picture once: only where there is no raw one


# name: (default, meaning, limits), as in `vn_nav.nodes.parameters`.
PARAMETERS = {
    'output': ('', 'folder of the bag; it must not exist; empty: rosbag2_ and the date'),
    'topics': ([entry.name for entry in TOPICS
                if installed(entry.type) and entry.name != COMPRESSED and not entry.debug],
               'topics to record: names of the contract, or name:type; left as it is: also '
               f'{COMPRESSED} where no raw pictures are published'),
    'all': (False, 'record all other published topics as well'),
    'max_bag_size': (0, 'bytes of a file before the next is begun; 0: no limit', (0, 1 << 50)),
    'max_bag_duration': (0.0, 'seconds of a file before the next is begun; 0: no limit',
                         (0.0, 1e9)),
    'min_free_space': (MIN_FREE_BYTES,
                       'bytes of the disk that stay free: below that, recording stops',
                       (0, 1 << 50)),
}


class RecorderNode(Node):
    """Writes messages as they were serialised. It ends at a signal only: a robot drives on."""

    def __init__(self):
        super().__init__('recorder_node')

        value = parameters.declare(self, PARAMETERS, read_only=True,
                                   others=policy_parameters.PARAMETERS)
        output = value['output'] or f'rosbag2_{datetime.datetime.now():%Y_%m_%d-%H_%M_%S}'
        self.everything = value['all']
        self.compressed_instead = value['topics'] == PARAMETERS['topics'][0]
        self.awaited: dict[str, str] = {}  # type by resolved name
        self.refused: set[str] = set()  # resolved names
        entries = [entry for entry in map(self._wanted, value['topics']) if entry is not None]
        for entry in entries:
            message_class(entry.type)
        self.writer = BagWriter(output, max_bytes=value['max_bag_size'],
                                max_seconds=value['max_bag_duration'],
                                min_free=value['min_free_space'])
        self.diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics',
                                                 qos('/diagnostics'))
        self.stopped = self.closed = False
        self.warned: set[str] = set()  # what is logged once
        self.known_publishers: set[str] = set()  # nodes that publish what is recorded
        self.lost_said = 0
        self.look_at = self.report_at = time.monotonic()
        self.taps: dict[str, Tap] = {}  # by resolved name
        for entry in entries:
            self._listen(entry)
        self.get_logger().info(f'recording {len(entries)} topics'
                               f'{" and all other published topics" if self.everything else ""} '
                               f'into {output}')

    def drain(self) -> bool:
        """Hand everything that has arrived to the writer; whether there was something.

        Taken straight from the subscriptions: an executor wakes up once a message, which a
        simulator in lock-step outruns, and what then overflows is lost.
        """
        taken_messages = []
        for tap in self.taps.values():
            handle = tap.subscription.handle
            with handle:
                for _ in range(MESSAGES_PER_TURN):
                    if (taken := handle.take_message(tap.message, True)) is None:
                        break
                    taken_messages.append((self._note(tap, taken[1]), tap, taken))
        # By the publisher's time: topics are taken in turn, which would put them out of order.
        taken_messages.sort(key=operator.itemgetter(0))
        try:
            for stamp, tap, (data, info) in taken_messages:
                self.writer.write(tap.topic.name, data, stamp,
                                  info.get('publication_sequence_number') or 0)
        except RecordingStopped as error:
            self._stop(error)
        return bool(taken_messages)

    def tend(self) -> None:
        """Look for publishers, and say what was lost, each when it is due."""
        now = time.monotonic()
        if now >= self.look_at and not self.stopped:
            self.look_at = now + GRAPH_PERIOD_S
            self._look()
        if now >= self.report_at:
            self.report_at = now + REPORT_PERIOD_S
            self._report()

    def close(self) -> None:
        """Finish the bag and say what is in it."""
        if self.closed:
            return
        self.closed = True
        try:
            self.writer.close()
        except RecordingStopped as error:
            self._stop(error)
        written = self.writer.written
        for tap in self.taps.values():
            if tap.received or tap.lost:
                kept = written[in_bag(tap.topic.name)]
                lost = f'{tap.lost} lost' if tap.numbered else 'lost: unknown'
                self.get_logger().info(f'{in_bag(tap.topic.name)}: {tap.received} received, '
                                       f'{kept} written, {lost}')
        self.get_logger().info(f'{written.total()} messages recorded')

    def destroy_node(self) -> None:
        """Finish the bag first."""
        self.close()
        super().destroy_node()

    def _wanted(self, entry: str) -> Topic | None:
        """What an entry of the parameter `topics` asks for; None: something to wait for."""
        name, _, kind = entry.partition(':')
        if kind.count('/') == 1:
            kind = kind.replace('/', '/msg/')
        try:
            known = topic(name)
            return dataclasses.replace(known, type=kind) if kind else known
        except KeyError as error:
            if not kind:
                raise UserError('recorded topics are of the contract, or name:type',
                                error.args[0], 'choose from vn_msgs_py.topics, or say for '
                                'instance /scan:sensor_msgs/msg/LaserScan') from error
        message_class(kind)
        self.awaited[self.resolve_topic_name(name)] = kind
        return None

    def _listen(self, entry: Topic) -> None:
        """Subscribe to a topic and have it written."""
        self.writer.add(entry)
        message = message_class(entry.type)
        subscription = self.create_subscription(
            message, entry.name, lambda _: None,
            profile(entry, depth=max(QUEUE_DEPTH, entry.depth)), raw=True)
        name = self.resolve_topic_name(entry.name)
        before = self.taps.get(name)
        self.taps[name] = Tap(entry, name, message, subscription)
        if before is not None:
            self.taps[name].received, self.taps[name].lost = before.received, before.lost

    def _note(self, tap: Tap, info: dict) -> int:
        """Count a message; when it was published [ns]."""
        tap.received += 1
        number = info.get('publication_sequence_number')
        if number is None:
            tap.numbered = False
        else:
            tap.lost += tap.losses.add(number, tap.publishers)
        return info['source_timestamp'] or info['received_timestamp'] or time.time_ns()

    def _look(self) -> None:
        """Follow the publishers: their types, their quality of service, new topics."""
        for tap in list(self.taps.values()):
            self._follow(tap)
        if self.compressed_instead and self._offers(self.resolve_topic_name(COMPRESSED)) and not (
                self._offers(self.resolve_topic_name('image_raw'))):
            self.compressed_instead = False
            self._listen(topic(COMPRESSED))
        if self.everything:
            for name, kinds in self.get_topic_names_and_types():
                if not (name in self.taps or name in self.refused or hidden(name)):
                    self.awaited.setdefault(name, kinds[0])
        for name, kind in list(self.awaited.items()):
            offers = self._offers(name)
            if not any(offer.topic_type == kind for offer in offers):
                if offers:
                    self._warn_once(f'{name} is published as {offers[0].topic_type}, not {kind}: '
                                    'it is not recorded')
                continue
            del self.awaited[name]
            try:
                if any(in_bag(tap.topic.name) == name for tap in self.taps.values()):
                    raise UserError('a bag has one topic of a name', name, 'record it elsewhere')
                self._listen(weakened(Topic(name, kind, '', '', durability=LATCHED), offers))
            except UserError as error:
                self.refused.add(name)
                self.get_logger().warning(f'{name} is not recorded: {error}')

    def _follow(self, tap: Tap) -> None:
        """Subscribe anew where a topic is published as another type, or with a weaker QoS."""
        offers = self._offers(tap.name)
        mine = [offer for offer in offers if offer.topic_type == tap.topic.type]
        for name in sorted({f'{offer.node_namespace.rstrip("/")}/{offer.node_name}'
                            for offer in mine} - self.known_publishers):
            self.known_publishers.add(name)
            self.get_logger().info(f'receives from {name}')
        tap.publishers = max(len(mine), 1)
        entry = tap.topic
        if foreign := sorted({offer.topic_type for offer in offers} - {entry.type}):
            if TWIN.get(entry.type) in foreign and not mine and not tap.received:
                entry = dataclasses.replace(entry, type=TWIN[entry.type])
                mine = [offer for offer in offers if offer.topic_type == entry.type]
            else:
                self._warn_once(f'{tap.name} is also published as {", ".join(foreign)}: only '
                                f'{entry.type} is recorded')
        entry = weakened(entry, mine)
        if entry != tap.topic:
            self.get_logger().info(f'{tap.name} is published as {entry.type}, {entry.reliability}'
                                   f', {entry.durability}: subscribing to that')
            self.destroy_subscription(tap.subscription)  # two types at once are refused
            self._listen(entry)

    def _offers(self, name: str) -> list:
        """Who else publishes on a topic."""
        me = (self.get_name(), self.get_namespace())
        return [info for info in self.get_publishers_info_by_topic(name)
                if (info.node_name, info.node_namespace) != me]

    def _report(self) -> None:
        """Say once a second what has come, what was lost since, and that recording has stopped."""
        if self.writer.stopped and not self.stopped:
            self._stop(RecordingStopped(self.writer.folder, self.writer.stopped))
        if self.stopped:
            self._diagnose(DiagnosticStatus.ERROR, f'recording stopped: {self.writer.stopped}')
            return
        lost = sum(tap.lost for tap in self.taps.values())
        if lost > self.lost_said:
            counts = ', '.join(f'{in_bag(tap.topic.name)} {tap.lost} of {tap.lost + tap.received}'
                               for tap in self.taps.values() if tap.lost)
            self.get_logger().warning(f'{lost - self.lost_said} messages lost in the last second; '
                                      f'so far {counts}')
            self._diagnose(DiagnosticStatus.WARN, f'messages lost so far: {counts}')
        else:
            self._diagnose(DiagnosticStatus.OK, 'recording')
        self.lost_said = lost

    def _stop(self, error: RecordingStopped) -> None:
        """Listen no more; say so once."""
        if self.stopped:
            return
        self.stopped = True
        self.get_logger().error(f'recording stopped: {error}')
        for tap in self.taps.values():
            self.destroy_subscription(tap.subscription)
        self._diagnose(DiagnosticStatus.ERROR, f'recording stopped: {self.writer.stopped}')

    def _diagnose(self, level: bytes, summary: str) -> None:
        message = DiagnosticArray(status=[DiagnosticStatus(
            level=level, name=self.get_fully_qualified_name(), message=summary,
            values=[KeyValue(key=f'{RECEIVED}{tap.topic.name}', value=str(tap.received))
                    for tap in self.taps.values() if tap.received])])
        message.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(message)

    def _warn_once(self, warning: str) -> None:
        if warning not in self.warned:
            self.warned.add(warning)
            self.get_logger().warning(warning)


def record(node: RecorderNode, ended: Ended) -> None:
    """Write until a signal comes."""
    while not ended.is_set():
        busy = not node.stopped and node.drain()
        node.tend()
        if not busy:
            time.sleep(POLL_PERIOD_S)
    last = time.monotonic() + 1.0  # s for what has arrived by now
    while not node.stopped and node.drain() and time.monotonic() < last:
        pass


def main(args=None) -> int:
    """Entry point: a signal finishes the bag."""
    return run_node('recorder_node', lambda _: RecorderNode(), record, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
