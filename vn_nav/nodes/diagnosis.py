"""`/diagnostics` of policy_node: its state, the reason, who misunderstands its commands."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from vn_nav.nodes.qos import qos
from vn_nav.policy.navigator import State

LEVELS = {State.STOPPED: DiagnosticStatus.ERROR, State.HOLD: DiagnosticStatus.WARN}


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

    def publish(self, state: State, reason: str, values: dict) -> None:
        """Say where the node stands; the same again within a second is not said."""
        changed = self._last != (state, reason)
        if not changed and time.monotonic() - self._published < 0.95:
            return
        if changed and state is State.STOPPED:
            self.node.get_logger().error(f'stopped: {reason}; ~/reset, then ~/enable to go on')
        self._last, self._published = (state, reason), time.monotonic()
        level, words = LEVELS.get(state, DiagnosticStatus.OK), state.value
        if reason:
            words += f' ({reason})' if state is State.ARRIVED else f': {reason}'
        if mismatch := self._mismatched_listeners():
            level, words = DiagnosticStatus.ERROR, mismatch
        values = {'state': state.value, 'reason': reason,
                  'listeners_on_cmd_vel': self.command.get_subscription_count(), **values}
        message = DiagnosticArray(status=[DiagnosticStatus(
            level=level, name=self.node.get_fully_qualified_name(), hardware_id=self.hardware,
            message=words,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.publisher.publish(message)

    def _mismatched_listeners(self) -> str:
        """Twist meets TwistStamped: the robot would stand still without a word."""
        mine = f'geometry_msgs/msg/{self.command.msg_type.__name__}'
        for info in self.node.get_subscriptions_info_by_topic(self.command.topic_name):
            if info.topic_type != mine:
                other = mine == 'geometry_msgs/msg/Twist'
                return (f'{info.node_name} listens for {info.topic_type} where this node sends '
                        f'{mine}: set enable_stamped_cmd_vel to {str(other).lower()}')
        return ''
