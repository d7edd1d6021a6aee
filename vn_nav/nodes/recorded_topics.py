"""Topics that a training subscribes to and publishes; each message is recorded as it was sent."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.serialization import serialize_message

from vn_msgs_py.topics import VOLATILE, topic
from vn_nav.bags.storage.writer import BagWriter, RecordingStopped
from vn_nav.nodes.qos import profile, qos, subscribe


class RecordedTopics:
    """Subscriptions of a node, and a bag of what came on them.

    Args:
        node: that subscribes and publishes.
        bag: folder to record into; None: nowhere.
    """

    def __init__(self, node: Node, bag: Path | None):
        self._node = node
        self._writer = BagWriter(bag) if bag is not None else None

    def subscribe(self, kind: type, name: str, handle: Callable[[Any], None], *,
                  history: bool = True, anybody: bool = False) -> None:
        """Subscribe to a topic of the contract.

        Args:
            kind: of the messages.
            name: of the topic.
            handle: called with each.
            history: also what was published before, where the topic keeps it.
            anybody: receive from any publisher, whatever its quality of service.
        """
        entry = topic(name)
        record = self.recording(name)
        if self._writer is not None:
            self._writer.add(entry)

        last = None

        def callback(message, info) -> None:
            nonlocal last
            this = (info['source_timestamp'], info.get('publication_sequence_number'))
            if anybody and this == last:  # received by another subscription of the topic
                return
            last = this
            record(message, info)
            handle(message)
        # rclpy also calls with what it knows of a message; its annotations have it without.
        receive: Callable[..., None] = callback
        if anybody:
            subscribe(self._node, kind, name, receive)
        else:
            self._node.create_subscription(kind, name, receive, profile(
                entry if history else dataclasses.replace(entry, durability=VOLATILE)))

    def recording(self, name: str) -> Callable[..., None]:
        """A callback (message, info) that records a topic."""
        def record(message, info) -> None:
            self._record(name, message, info['source_timestamp'],
                         info.get('publication_sequence_number') or 0)
        return record

    def _record(self, name: str, message: Any, stamp: int = 0, number: int = 0) -> None:
        """Into the bag, if there is one; a disk that is full ends the recording alone."""
        if self._writer is None:
            return
        try:
            self._writer.write(name, serialize_message(message), stamp or time.time_ns(),
                               number)
        except RecordingStopped as error:
            self._writer = None
            self._node.get_logger().error(f'recording stopped: {error}')

    def publish(self, publisher, name: str, message: Any) -> None:
        """Publish, and record it."""
        publisher.publish(message)
        if self._writer is not None:
            self._writer.add(topic(name))
        self._record(name, message)

    def record_own(self, publisher, name: str) -> None:
        """Record what the node itself publishes, as everybody receives it."""
        if self._writer is None:
            return
        kind = publisher.msg_type
        self._writer.add(dataclasses.replace(
            topic(name), type=f'geometry_msgs/msg/{kind.__name__}'))
        self._node.create_subscription(kind, name, self.recording(name), qos(name))

    def close(self) -> None:
        """End the bag."""
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                writer.close()
            except RecordingStopped as error:
                self._node.get_logger().error(f'recording stopped: {error}')
