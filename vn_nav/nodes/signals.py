"""What a node does at a signal, from its first import to the end of its process. No ROS here.

A node has four times. While it imports, nothing exists yet: a signal ends the process at once.
While it works, a signal is noted, and the work ends soon. Compiling cannot be interrupted halfway
(an exception from a signal handler is lost in LLVM's callbacks): a signal releases the node and
ends the process. While the process ends, further signals are ignored: a terminal and `ros2 launch`
may both send one, and the interpreter takes its handlers away before it is gone.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP)


def ending_signals() -> list[signal.Signals]:
    """The signals that end a node; not SIGHUP where `nohup` has it ignored."""
    return [number for number in SIGNALS
            if not (number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN)]


def exit_at_once() -> None:
    """From now on a signal ends the process with exit code 0: there is nothing to stop yet."""
    for number in ending_signals():
        signal.signal(number, lambda *_: os._exit(0))


def ignore() -> None:
    """From now on signals do nothing: the process ends anyway."""
    for number in ending_signals():
        signal.signal(number, signal.SIG_IGN)


class _TimerEvent(ctypes.Structure):
    """`struct sigevent` of glibc with a function to call, timer_create(2); 64 bytes."""

    _fields_ = [('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('attributes', ctypes.c_void_p),
                ('rest', ctypes.c_char * 32)]


SIGEV_THREAD = 2


@contextlib.contextmanager
def leaving_within(seconds: int, code: int) -> Iterator[None]:
    """End the process with `code` where the body is not done in time, whatever it is doing.

    The timer is C's: a body that is stuck in C holds the interpreter's lock, and then neither a
    thread nor a signal handler of Python runs. Where the C library has no such timer, the body
    has no limit.
    """
    libc = ctypes.CDLL(None)
    timer = ctypes.c_void_p()
    try:
        event = _TimerEvent(value=code, notify=SIGEV_THREAD,
                            function=ctypes.cast(libc._exit, ctypes.c_void_p))
        armed = not libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event),
                                      ctypes.byref(timer))
    except AttributeError:
        armed = False
    if armed:  # struct itimerspec: no period, then the time until it ends [s, ns]
        libc.timer_settime(timer, 0, (ctypes.c_long * 4)(0, 0, seconds, 0), None)
    try:
        yield
    finally:
        if armed:
            libc.timer_delete(timer)


class Ended:
    """Becomes true at SIGINT, SIGTERM, SIGQUIT or SIGHUP.

    Not a `threading.Event`: a signal handler runs in the middle of what the main thread does, and
    `Event.set` there waits for ever for the lock that an interrupted `Event.wait` holds.
    """

    def __init__(self):
        self._ended = False
        self._let_go: Callable[[], None] | None = None
        self._before = {number: signal.signal(number, self._on_signal)
                        for number in ending_signals()}

    def _on_signal(self, *_):
        self._ended = True
        if self._let_go is not None:
            self._leave(self._let_go)

    @staticmethod
    def _leave(let_go: Callable[[], None]) -> NoReturn:
        try:
            let_go()
        finally:
            os._exit(0)

    def is_set(self) -> bool:
        """A signal has come."""
        return self._ended

    @contextlib.contextmanager
    def leaving(self, let_go: Callable[[], None]) -> Iterator[None]:
        """A signal calls `let_go` and ends the process with exit code 0, wherever the body is.

        Also a signal that came before. For slow work that has nothing to lose.
        """
        self._let_go = let_go
        try:
            if self._ended:
                self._leave(let_go)
            yield
        finally:
            self._let_go = None

    def restore(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
