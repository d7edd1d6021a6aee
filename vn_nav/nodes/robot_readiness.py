"""Whether a robot over topics may move, and waiting until it may."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from geometry_msgs.msg import Twist, TwistStamped

from vn_nav.errors import EnvironmentLost
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.process import Ended
from vn_nav.policy.navigator import STOP_SECONDS, Navigator, State

SIGNAL_PERIOD_S = 0.05  # between looks for a signal
QUIET_S = 1.0  # of waiting that nothing is printed about


class Readiness:
    """Waits for a robot, and enables motion again once the cause of a stop is gone.

    Args:
        node: of the robot.
        navigator: says what stops it.
        output: owns the command publisher.
        wake: guards the navigator, and wakes who waits.
        ended: a signal has come.
        patience: after so long without being ready the training ends [s].
        is_running: whether commands are being published.

    Attributes:
        held: somebody called `~/stop`.
        failure: of a thread; empty: none.
    """

    def __init__(self, node, navigator: Navigator, output: CommandOutput,
                 wake: threading.Condition, ended: Ended, patience: float,
                 is_running: Callable[[], bool]):
        self._node, self._navigator, self._output, self._wake = node, navigator, output, wake
        self._ended, self._patience, self._is_running = ended, patience, is_running
        self.held, self.failure = False, ''
        self._stopped_since: float | None = None

    def fail(self, reason: str) -> None:
        """Something broke that nobody expected: zero, and no more training."""
        with self._wake:
            self.failure = self.failure or reason
            self._navigator.stop(reason, time.monotonic())
            self._wake.notify_all()

    def wait_until(self, ready: Callable[[], bool],
                   describe: Callable[[], str] = lambda: '') -> None:
        """Wait until something holds, and on the way go on from what stopped by itself.

        Args:
            ready: called with `wake` held.
            describe: what is waited for, where it is nothing that stopped the robot.

        Raises:
            EnvironmentLost: a signal, a failure, or `patience` is over.
        """
        begun, shown = time.monotonic(), ''
        with self._wake:
            while True:
                now = time.monotonic()
                self._check(now)
                if ready():
                    break
                why = describe() or self._go_on(now)
                if now - begun > self._patience:
                    self._navigator.stop('the training has no more patience', now)
                    raise EnvironmentLost(
                        f'a robot is ready again within {self._patience:g} s (parameter patience)',
                        f'{self._who()}{why or "no picture after the motion"}',
                        'see to it, and resume the training: what was learned is saved')
                if now - begun > QUIET_S and why and why != shown:
                    shown = why
                    print(f'{self._who()}paused: {why}', flush=True)
                self._wake.wait(SIGNAL_PERIOD_S)
        if shown:
            print(f'{self._who()}goes on after {time.monotonic() - begun:.1f} s', flush=True)

    def _check(self, now: float) -> None:
        if self._ended.is_set():
            self._navigator.stop('a signal', now)
            self._wake.notify_all()
            raise EnvironmentLost('a training goes on until a signal', 'one', 'resume it')
        if self.failure:
            raise EnvironmentLost('the threads of a robot work', f'{self._who()}{self.failure}',
                                  'resume the training: what was learned is saved')

    def _go_on(self, now: float) -> str:
        """Enable motion again as soon as nothing is in the way; returns what is."""
        navigator = self._navigator
        if navigator.state is State.STOPPED:
            self._stopped_since = self._stopped_since or now
            if now - self._stopped_since < STOP_SECONDS or self._blockers():  # zero is repeated
                return navigator.reason
            navigator.reset()
        self._stopped_since = None
        if navigator.state is State.IDLE:
            enabled, refusal = navigator.enable(now, self._blockers())
            return '' if enabled else refusal
        return navigator.reason

    def _blockers(self) -> tuple[str, ...]:
        if not self._is_running():
            return ()
        rules = (
            (self.held, '~/stop was called: call ~/reset'),
            (self.other_publishers(), 'another node publishes on cmd_vel: end it, or remap one'),
            (self._output.silence > self._navigator.limits.odometry_timeout, 'odometry is silent'),
            (not self.listeners(), f'nobody is {self.listener_kind()}'),
        )
        return tuple(rule for broken, rule in rules if broken)

    def _who(self) -> str:
        namespace = self._node.get_namespace().strip('/')
        return f'{namespace}: ' if namespace else ''

    def other_publishers(self) -> int:
        """How many others publish commands."""
        return max(0, self._node.count_publishers(self._output.publisher.topic_name) - 1)

    def listeners(self) -> list:
        """Who else listens for the commands, in the type in which they are sent."""
        mine = f'geometry_msgs/msg/{self._output.publisher.msg_type.__name__}'
        me = (self._node.get_name(), self._node.get_namespace())
        return [info for info in
                self._node.get_subscriptions_info_by_topic(self._output.publisher.topic_name)
                if info.topic_type == mine and (info.node_name, info.node_namespace) != me]

    def listener_kind(self) -> str:
        """Which listener is missing, and the remedy."""
        kind = self._output.publisher.msg_type
        other = TwistStamped if kind is Twist else Twist
        return (f'listening for {kind.__name__} on cmd_vel (for {other.__name__} set '
                f'enable_stamped_cmd_vel to {str(kind is Twist).lower()})')
