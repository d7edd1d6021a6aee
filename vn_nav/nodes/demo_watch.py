"""What `vn_nav demo` sees of its nodes: it enables the policy, and hears how episodes end."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.nodes.qos import qos
from vn_nav.nodes.recorder_node import RECEIVED
from vn_nav.nodes.service_call import ServiceCall

PATIENCE_S = 60.0  # until recorder, bridge and policy have met
# The recorder has met the bridge and the policy once it has received these of both.
MET = ('image_raw', 'odom', 'goal_image', 'episode', 'action_names')


class EndedEpisode(NamedTuple):
    """A row of the demo's live view."""

    number: int
    goal: str
    outcome: str  # 'arrived', 'gave up' or 'stopped elsewhere'
    decisions: int
    metres: float


class DemoWatch:
    """A node beside those of a demo, on their domain; a context manager.

    Args:
        processes: with the recorder `recorder` at work.
        policy: name of the policy's process and node.
        bridge: likewise; both are started while this is open.
        met: recorded topics of both; the policy drives once all have been received.
    """

    def __init__(self, processes: Processes, policy: str, bridge: str,
                 met: Sequence[str] = MET):
        self._met = met
        self._processes, self._policy = processes, policy
        self._children = ('recorder', policy, bridge)
        self._begun: dict[int, dict[str, Any]] = {}
        self._results: dict[int, dict[str, Any]] = {}
        self._received: dict[str, int] = {}  # by the recorder
        self._before: dict[str, int] | None = None  # when this was opened
        self.said = 'nothing'  # the policy's newest status
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO,
                   domain_id=int(processes.environment['ROS_DOMAIN_ID']))
        self._node = Node('vn_nav_demo', context=self._context, start_parameter_services=False,
                          enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_status,
                                       qos('/diagnostics'))
        for name, kept in (('episode', self._begun), ('episode_result', self._results)):
            self._node.create_subscription(String, name, functools.partial(_keep, kept), qos(name))
        self._wait_for(lambda: self._before is not None, 'the recorder has a status')

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f'/{self._policy}':
                self.said = status.message
            counts = {entry.key.removeprefix(RECEIVED): int(entry.value)
                      for entry in status.values if entry.key.startswith(RECEIVED)}
            if status.name == '/recorder_node':
                self._received = counts
                self._before = counts if self._before is None else self._before

    @property
    def episodes(self) -> list[EndedEpisode]:
        """Those that have ended, in their order."""
        return [EndedEpisode(
            number, begun['room'], 'arrived' if result['success'] else
            'gave up' if result['decisions'] >= begun['max_decisions'] else 'stopped elsewhere',
            result['decisions'], result['path_length'])
            for number, result in sorted(self._results.items())
            if (begun := self._begun.get(number)) is not None]

    def spin(self, seconds: float) -> None:
        """Listen for a while.

        Raises:
            ProcessFailure: a child has died.
        """
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)
        for child in self._children:
            if child in self._processes.running:
                self._processes.check(child)

    def enable(self) -> None:
        """Let the policy drive as soon as the recorder hears everything that will be said.

        Raises:
            ProcessFailure: a child has died, or they have not met.
        """
        before = self._before or {}
        self._wait_for(lambda: all(self._received.get(name, 0) > before.get(name, 0)
                                   for name in self._met), 'the recorder hears bridge and policy')
        self._ask_until_done(SetBool, 'enable', SetBool.Request(data=True))

    @property
    def stopped(self) -> bool:
        """The policy has latched a stop: somebody has to look, and let it go on."""
        return self.said.startswith('stopped')

    def resume(self) -> None:
        """Let a policy go on that has latched a stop.

        Raises:
            ProcessFailure: a child has died, or it refuses.
        """
        self.said = 'resumed'  # until its next status
        self._ask_until_done(Trigger, 'reset', Trigger.Request())
        self._ask_until_done(SetBool, 'enable', SetBool.Request(data=True))

    def _ask_until_done(self, kind: Any, name: str, request: Any) -> None:
        """Ask the policy for something until it agrees."""
        client = self._node.create_client(kind, f'/{self._policy}/{name}')
        self._wait_for(client.service_is_ready, f'{client.srv_name} is there')
        until = time.monotonic() + PATIENCE_S
        while True:
            call = ServiceCall(client, request)
            self._wait_for(call.is_answered, f'{client.srv_name} answers')
            if call.answer.success:
                break
            if time.monotonic() > until:
                raise ProcessFailure(f'the policy refuses to {name}: {call.answer.message}')
            self.spin(0.1)
        self._node.destroy_client(client)

    def _wait_for(self, condition, what: str) -> None:
        until = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > until:
                raise ProcessFailure(f'expected within {PATIENCE_S:.0f} s: {what}')
            self.spin(0.02)

    def __enter__(self) -> DemoWatch:
        return self

    def __exit__(self, *_) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


def _keep(kept: dict[int, dict[str, Any]], message: String) -> None:
    facts = json.loads(message.data)
    kept[facts['episode']] = facts
