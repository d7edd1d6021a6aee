"""The life of a node's process: signals, one-line errors, exit codes."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from vn_nav.errors import UserError


class Ended:
    """Becomes true at SIGINT or SIGTERM.

    Not a `threading.Event`: a signal handler runs in the middle of what the main thread does, and
    `Event.set` there waits for ever for the lock that an interrupted `Event.wait` holds.
    """

    def __init__(self):
        self._ended = False
        self._before = {number: signal.signal(number, self._on_signal)
                        for number in (signal.SIGINT, signal.SIGTERM)}

    def _on_signal(self, *_):
        self._ended = True

    def is_set(self) -> bool:
        """A signal has come."""
        return self._ended

    def restore(self) -> None:
        """Leave the signals to whoever heard them before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


def run_node(name: str, make: Callable[[], Node], work: Callable[[Node, Ended], None],
             args: list[str] | None = None) -> int:
    """Make a node, work until a signal, destroy it.

    Args:
        name: of the program, in front of its error line.
        make: builds the node; its `destroy_node` lets go of everything.
        work: returns when it is done, or soon after a signal.
        args: command line; None: the process's own.

    Returns:
        0; or 2 after a `UserError`, which is one line on standard error.
    """
    # rclpy's own handlers would close the context before the last message is out.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    ended = Ended()
    node = None
    try:
        node = make()
        work(node, ended)
    except UserError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def spin(node: Node, ended: Ended) -> None:
    """Serve callbacks until a signal comes."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.2)
