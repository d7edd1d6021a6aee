"""`recorder_node`: topics of the contract into a rosbag2 bag, where there is no `ros2 bag`.

Run: `ros2 run vn_nav recorder_node --ros-args -p output:=my_drive`.
"""

from __future__ import annotations

import datetime
import importlib
import sys
import time

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from vn_msgs_py.topics import TOPICS, topic
from vn_nav.bags.recorder import BagWriter
from vn_nav.errors import UserError
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import qos

QUEUE = 256  # messages a topic: pictures are best effort, and a recorder must not drop them
POLL = 0.002  # s between looks at the subscriptions


class RecorderNode(Node):
    """Writes what it hears, as it was serialised."""

    def __init__(self):
        super().__init__('recorder_node')

        def parameter(name, default, meaning):
            return self.declare_parameter(
                name, default, ParameterDescriptor(description=meaning, read_only=True)).value

        default = f'rosbag2_{datetime.datetime.now():%Y_%m_%d-%H_%M_%S}'
        output = parameter('output', default, 'folder of the bag; it must not exist')
        names = parameter('topics', [entry.name for entry in TOPICS],
                          'topics of the contract to record')
        try:
            entries = [topic(name) for name in names]
        except KeyError as error:
            raise UserError('recorded topics are of the contract', error.args[0],
                            'choose from vn_msgs_py.topics') from error
        self.writer = BagWriter(output, entries)
        self.count = 0
        self.taps = []
        for entry in entries:
            package, _, kind = entry.type.split('/')
            message = getattr(importlib.import_module(f'{package}.msg'), kind)
            subscription = self.create_subscription(
                message, entry.name, lambda _: None,
                qos(entry.name, depth=max(QUEUE, entry.depth)), raw=True)
            self.taps.append((entry.name, message, subscription.handle))
        self.get_logger().info(f'recording {len(entries)} topics into {output}')

    def drain(self) -> None:
        """Write everything that has arrived.

        Taken straight from the subscriptions: an executor wakes up once a message, which a
        simulator in lock-step outruns, and what then overflows is lost.
        """
        for name, message, handle in self.taps:
            with handle:
                while (taken := handle.take_message(message, True)) is not None:
                    data, info = taken
                    # The publisher's time: topics are taken in turn, so the time of reception
                    # would put them out of order.
                    self.writer.write(name, data, info['source_timestamp'])
                    self.count += 1

    def destroy_node(self) -> None:
        """Finish the bag."""
        self.writer.close()
        self.get_logger().info(f'{self.count} messages recorded')
        super().destroy_node()


def record(node: RecorderNode, ended: Ended) -> None:
    """Write until a signal comes."""
    while not ended.is_set():
        node.drain()
        time.sleep(POLL)
    node.drain()


def main(args=None) -> int:
    """Entry point: SIGINT and SIGTERM finish the bag."""
    return run_node('recorder_node', RecorderNode, record, args)


if __name__ == '__main__':
    sys.exit(main())
