"""The life of a node's process: arguments, signals, one-line errors, exit codes."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from vn_nav.errors import UserError
from vn_nav.nodes import signals
from vn_nav.nodes.parameters import help_lines
from vn_nav.nodes.shared_memory import remove_dead_segments
from vn_nav.nodes.signals import Ended

__all__ = ['Ended', 'compiling', 'run_node', 'spin']

# What ROS raises for arguments that it refuses, while it starts or makes a node.
_ros: Any = rclpy._rclpy_pybind11  # type: ignore[attr-defined]  # compiled, without types
REFUSED = (NameValidationException, ParameterException,
           _ros.RCLError, _ros.RCLInvalidROSArgsError, _ros.UnknownROSArgsError)
# For the middleware to leave the graph. Fast DDS does it in milliseconds; where another
# participant leaves at the same moment, once in some hundred times never: set_listener of its
# DomainParticipant spins on a lock that the discovery's callback waits for (Fast DDS, issue 6513).
TEARDOWN_S = 3
AnyNode = TypeVar('AnyNode', bound=Node)
USAGE = """usage: ros2 run vn_nav {name} [--ros-args [-p name:=value] [--params-file file]
       [-r topic:=other] [-r __ns:=/namespace] [--log-level debug|info|warn|error|fatal]]

{about}

parameters (default; limits):
{lines}"""
REMEDIES = {  # by the text in front of what is refused
    '--params-file': 'give a params file that exists, as config/policy.yaml is one',
    '--log-level': 'the levels are debug, info, warn, error and fatal',
    'parameter override': 'write -p name:=value',
    'remap rule': 'write -r topic:=other, -r __ns:=/namespace or -r __node:=name',
}


def run_node(name: str, make: Callable[[Ended], AnyNode],
             work: Callable[[AnyNode, Ended], None],
             args: list[str] | None = None, *, about: str = '',
             parameters: Mapping[str, tuple] | None = None) -> int:
    """Make a node, work until a signal, destroy it. Afterwards the process has to end.

    With the process's own command line the process ends here, once the node has let go of
    everything: taking Python apart would cost seconds, and wait for a decision that does not end.

    Args:
        name: of the program, in front of its error line.
        make: builds the node. A method `close` of its own lets go of all but the graph;
            `destroy_node` calls it first, and it may be called twice.
        work: returns when it is done, or soon after a signal.
        args: command line without the program; None: the process's own.
        about, parameters: what `--help` says: a text, and the table of `vn_nav.nodes.parameters`.

    Returns:
        0; or 2 after a `UserError`, or arguments that ROS refuses, in one line on standard error.
    """
    arguments = sys.argv[1:] if args is None else list(args)
    if {'-h', '--help'} & set(itertools.takewhile(lambda part: part != '--ros-args', arguments)):
        print(USAGE.format(name=name, about=about.strip(),
                           lines='\n'.join(help_lines(parameters or {}))))
        return 0
    ended, node, code = Ended(), None, 0
    try:
        with _refusals():
            with _silent():
                own = remove_ros_args([name, *arguments])[1:]
                if own:
                    raise UserError('arguments of a node stand after --ros-args', ' '.join(own),
                                    'see --help')
                remove_dead_segments()
                # rclpy's own handlers would close the context before the last message is out.
                rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
            node = make(ended)
        work(node, ended)
    except UserError as error:
        with contextlib.suppress(OSError):  # the terminal may be gone
            print(f'{name}: {error}', file=sys.stderr)
        code = 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            if args is None and hasattr(node, 'close'):
                node.close()
            with signals.leaving_within(TEARDOWN_S, code) if args is None else (
                    contextlib.nullcontext()):
                node.destroy_node()
        rclpy.try_shutdown()
        signals.ignore()  # the process ends anyway
        _flush()
    if args is None:
        os._exit(code)
    return code


def spin(node: Node, ended: Ended) -> None:
    """Serve callbacks until a signal comes."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.2)


@contextlib.contextmanager
def compiling(node: Node, ended: Ended, work: str, period: float = 5.0) -> Iterator[None]:
    """Slow work before a node can do anything: every few seconds it says that it goes on.

    A signal ends the process at once, with exit code 0.
    """
    begun, done = time.monotonic(), threading.Event()

    def say():
        while not done.wait(period):
            node.get_logger().info(f'{work}: {time.monotonic() - begun:.0f} s so far')

    def let_go():
        with signals.leaving_within(TEARDOWN_S, 0):
            Node.destroy_node(node)
        rclpy.try_shutdown()
    thread = threading.Thread(target=say, daemon=True)
    thread.start()
    try:
        with ended.leaving(let_go):
            yield
    finally:
        done.set()
        thread.join()
    if (seconds := time.monotonic() - begun) >= period:
        node.get_logger().info(f'{work}: done after {seconds:.0f} s')


@contextlib.contextmanager
def _refusals() -> Iterator[None]:
    """Turn what ROS says of arguments into one line."""
    try:
        yield
    except REFUSED as error:
        # "Failed to parse ROS arguments: Couldn't ..., at /some/file.c:1": without its places.
        message = ' '.join(re.sub(r', at /\S+:\d+', '', str(error)).split())
        message = message.removeprefix('Failed to parse ROS arguments: ')
        remedy = next((own for text, own in REMEDIES.items() if text in message), 'see --help')
        raise UserError('arguments follow the ROS syntax', message, remedy) from error


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep what ROS's C code writes on standard error, and drop it where the body fails.

    It says on several lines what the exception says as well.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        except BaseException:
            file.truncate(0)
            raise
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            with contextlib.suppress(OSError):
                os.write(2, file.read())


def _flush() -> None:
    """Write out what is buffered; where the terminal is gone, its end is not an error of ours."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, stream.fileno())
            os.close(nothing)
