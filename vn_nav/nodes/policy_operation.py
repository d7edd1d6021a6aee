"""How people operate policy_node: enable, stop and reset as services, and its diagnostics."""

from __future__ import annotations

import math
import threading
import time

from rclpy.clock import Clock
from std_srvs.srv import SetBool, Trigger

from vn_nav.errors import UserError
from vn_nav.nodes import navigate_action
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.decision_worker import DecisionWorker
from vn_nav.nodes.diagnosis import Diagnosis
from vn_nav.nodes.policy_inputs import PolicyInputs
from vn_nav.policy.goal_record import Status
from vn_nav.policy.navigator import ENABLED, Navigator, State

WARNINGS_PERIOD_S = 0.9  # to look at the graph takes a while
TIMER_PERIOD_S = 0.25


class Operation:
    """Services, and a timer that watches the command topic and publishes diagnostics.

    Args:
        node: the PolicyNode.
        navigator: what is operated.
        worker: makes the decisions.
        output: owns the command publisher.
        inputs: know what has not come.
        wake: guards the navigator.
        steady: clock of the timer.
        lock_step: odometry is the clock.
        auto_enable: enable motion as soon as it is possible.
        require_odometry: no motion without odometry.
        takes_goals: serve the action `navigate_to_image`, where its type is installed.
    """

    def __init__(self, node, navigator: Navigator, worker: DecisionWorker, output: CommandOutput,
                 inputs: PolicyInputs, wake: threading.Condition, steady: Clock, *,
                 lock_step: bool, auto_enable: bool, require_odometry: bool,
                 takes_goals: bool = True):
        self._node, self._navigator, self._wake = node, navigator, wake
        self._worker, self._output, self._inputs = worker, output, inputs
        self._lock_step, self._auto_enable = lock_step, auto_enable
        self._require_odometry = require_odometry
        self._warnings: list[str] = []
        self._warned_at = 0.0  # steady time [s]
        self._ended = False
        self._diagnosis = Diagnosis(node, output.publisher, navigator.robot.name)
        self._services = [node.create_service(SetBool, '~/enable', self._on_enable),
                          node.create_service(Trigger, '~/stop', self._on_stop),
                          node.create_service(Trigger, '~/reset', self._on_reset)]
        self._action = None
        if (kind := navigate_action.action_type()) is not None and takes_goals:
            self._action = navigate_action.NavigateAction(
                node, kind, navigator, wake, inputs.take_goal, inputs.refuse_goal, self._enable,
                lambda: self._node.is_running, worker.goal_output)
        self._timer = node.create_timer(TIMER_PERIOD_S, self._on_timer, clock=steady)

    def halt(self, reason: str) -> None:
        """Tell the client of an action that the node stops acting."""
        if self._action is not None:
            self._action.halt(reason)

    def end(self) -> None:
        """Take all of it off the graph."""
        self._ended = True
        for service in self._services:
            self._node.destroy_service(service)
        if self._action is not None:
            self._action.destroy()
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._diagnosis.publisher)

    def _on_enable(self, request, response):
        with self._wake:
            if request.data:
                response.success, response.message = self._enable()
            else:
                self._navigator.disable()
                response.success, response.message = True, 'disabled'
            self._worker.publish_arrival()
            self._wake.notify_all()
        self.diagnose()
        return response

    def _enable(self) -> tuple[bool, str]:
        blockers, broken = [], self._node.broken
        if not self._node.is_running:
            blockers.append('the node is not active: activate it first'
                            + (f' (it went inactive: {broken})' if broken else ''))
        if not self._node.has_clock():
            blockers.append('use_sim_time is set and nothing has come on /clock: start the '
                            'simulator, or set use_sim_time to false')
        blockers += self._inputs.unreceived()
        if self._output.odometry is None:
            if self._lock_step:
                blockers.append('no odometry: lock_step answers each message on odom')
            elif self._require_odometry:
                blockers.append(f'no odometry has come on {self._inputs.odometry_topic} '
                                '(require_odometry is set)')
        elif self._output.odometry_lost:
            blockers.append(f'odometry is silent: check {self._inputs.odometry_topic}')
        if others := self.other_publishers():
            blockers.append(f'{others} other publisher(s) on cmd_vel: remap one')
        if self._inputs.camera_fault:
            blockers.append(self._inputs.camera_fault)
        try:
            self._worker.pictures.check()
        except UserError as error:
            blockers.append(str(error))
        return self._navigator.enable(time.monotonic(), tuple(blockers))

    def _on_stop(self, _request, response):
        with self._wake:
            now = time.monotonic()
            self._navigator.goal.cancel(now, '~/stop was called')
            self._navigator.stop('~/stop was called', now)
            self._worker.publish_arrival()
            self._wake.notify_all()
        response.success, response.message = True, 'stopped: ~/reset, then ~/enable to go on'
        return response

    def _on_reset(self, _request, response):
        with self._wake:
            self._navigator.reset()
            self._worker.publish_arrival()
            self._wake.notify_all()
        response.success, response.message = True, 'ready: ~/enable to go on'
        return response

    def _on_timer(self) -> None:
        """Four times a second: intruders on the command topic, self-enabling, diagnostics."""
        with self._wake:
            if self._node.is_running:
                others = self.other_publishers()
                if others and self._navigator.state in ENABLED:
                    self._navigator.stop(f'{others} other publisher(s) on cmd_vel',
                                         time.monotonic())
                elif self._auto_enable and self._navigator.state is State.IDLE and (
                        self._navigator.goal.status is Status.WAITING):  # nobody took it back
                    self._enable()
                self._worker.publish_arrival()
                self._wake.notify_all()
            if self._action is not None:
                self._action.tend()
        self.diagnose()

    def other_publishers(self) -> int:
        """How many others publish commands."""
        return max(0, self._node.count_publishers(self._output.publisher.topic_name) - 1)

    def diagnose(self) -> None:
        """Publish the state once a second, and at once when it changes."""
        if self._ended:
            return
        if time.monotonic() - self._warned_at > WARNINGS_PERIOD_S:
            self._warned_at = time.monotonic()
            self._warnings = self._inputs.warnings()
            if self._node.get_parameter('use_sim_time').value and (
                    self._node.count_publishers(self._node.resolve_topic_name('/clock')) > 1):
                self._warnings.append('/clock has several publishers: time will jump; keep one')
        with self._wake:
            state, reason = self._navigator.state, self._navigator.reason
            if state is State.IDLE and not self._node.is_running:
                reason = 'the node is not active'
            fov, gate, broken = (
                self._worker.pictures.fov, self._navigator.gate, self._node.broken)
            camera = self._worker.pictures.camera
            values = {'decisions': self._navigator.decisions, **self._worker.filter_values(),
                      **self._inputs.values(),
                      'camera_fov_deg': round(math.degrees(fov), 1) if fov else 'unknown',
                      'camera_model': ('unknown' if camera is None else
                                       'pinhole' if camera.is_pinhole else
                                       f'{camera.calibration.model}, rectified'),
                      **{f'dropped: {kind}': n for kind, n in gate.dropped.items()},
                      **({'last_dropped': gate.last} if gate.last else {}),
                      **({'broken': broken} if broken else {})}
        self._diagnosis.publish(state, reason, values, self._warnings,
                                fault=f'inactive: {broken}' if broken else '')
