"""`/diagnostics` of policy_node: its state, the reason, who misunderstands its commands."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy

from vn_nav.nodes.qos import qos
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.navigator import State

MAX_WARNINGS = 5
LEVELS = {State.STOPPED: DiagnosticStatus.ERROR, State.HOLD: DiagnosticStatus.WARN,
          State.FAILED: DiagnosticStatus.WARN}


class Diagnosis:
    """Publishes once a second, and at once when something changes.

    Args:
        node: whose state it is.
        command: its command publisher.
        hardware: name of the robot.
    """

    def __init__(self, node, command, hardware: str):
        self.node, self.command, self.hardware = node, command, hardware
        self.publisher = node.create_publisher(DiagnosticArray, '/diagnostics',
                                               qos('/diagnostics'))
        self._last: tuple | None = None
        self._published = 0.0

    def publish(self, state: State, reason: str, values: dict,
                warnings: Sequence[str] = (), *, fault: str = '') -> None:
        """Say where the node stands; the same again within a second is not said.

        Args:
            state, reason: of the navigator.
            values: by key.
            warnings: what is wrong though it may drive; the first is part of the message.
            fault: why the node is out of action, if it is.
        """
        warnings = [shorten(warning) for warning in warnings[:MAX_WARNINGS]]
        # Numbers change all the time: it is the same reason, and the same warning.
        why, *summaries = (re.sub(r'[0-9.]+', '#', text) for text in (reason, *warnings))
        changed = self._last != (state, why, fault, *summaries)
        if not changed and time.monotonic() - self._published < 0.95:
            return
        if changed and state is State.STOPPED:
            self.node.get_logger().error(f'stopped: {reason}; ~/reset, then ~/enable to go on')
        for warning, short in zip(warnings, summaries, strict=True):
            if self._last is None or short not in self._last:
                self.node.get_logger().warning(warning, throttle_duration_sec=5.0)
        self._last, self._published = (state, why, fault, *summaries), time.monotonic()
        level, summary = LEVELS.get(state, DiagnosticStatus.OK), state.value
        if reason:
            summary += f' ({reason})' if state is State.ARRIVED else f': {reason}'
        if warnings:
            level = max(level, DiagnosticStatus.WARN)
            summary += f'; {warnings[0]}'
        if fault:
            level, summary = DiagnosticStatus.ERROR, fault
        if mismatch := self._mismatched_listeners():
            level, summary = DiagnosticStatus.ERROR, mismatch
        values = {'state': state.value, 'reason': reason,
                  'listeners_on_cmd_vel': self.command.get_subscription_count(), **values}
        message = DiagnosticArray(status=[DiagnosticStatus(
            level=level, name=self.node.get_fully_qualified_name(), hardware_id=self.hardware,
            message=summary,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.publisher.publish(message)

    def _mismatched_listeners(self) -> str:
        """Twist meets TwistStamped, or a wish for history: the robot stands still, silently."""
        mine = f'geometry_msgs/msg/{self.command.msg_type.__name__}'
        for info in self.node.get_subscriptions_info_by_topic(self.command.topic_name):
            if info.topic_type != mine:
                other = mine == 'geometry_msgs/msg/Twist'
                return (f'{info.node_name} subscribes to {info.topic_type} where this node sends '
                        f'{mine}: set enable_stamped_cmd_vel to {str(other).lower()}')
            if info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                return (f'{info.node_name} requests transient local commands, which are not '
                        'latched here: set its durability to volatile')
        return ''
