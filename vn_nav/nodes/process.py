"""The life of a node's process: signals, one-line errors, exit codes."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from vn_nav.errors import UserError


def run_node(name: str, make: Callable[[], Node], work: Callable[[Node, threading.Event], None],
             args: list[str] | None = None) -> int:
    """Make a node, work until a signal, destroy it.

    Args:
        name: of the program, in front of its error line.
        make: builds the node; its `destroy_node` lets go of everything.
        work: returns when its event is set (SIGINT, SIGTERM) or when it is done.
        args: command line; None: the process's own.

    Returns:
        0; or 2 after a `UserError`, which is one line on standard error.
    """
    # rclpy's own handlers would close the context before the last message is out.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
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


def spin(node: Node, ended: threading.Event) -> None:
    """Serve callbacks until the event is set."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.2)
