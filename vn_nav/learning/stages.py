"""A command that takes minutes: its progress bar, and an end between two steps at SIGINT."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from typing import Any

LINE_PERIOD_S = 10.0  # s between two lines where the output is no terminal


class Stages:
    """Shows which stage of a command is under way, and handles SIGINT and SIGTERM.

    Used as a context, in the main thread for the signals. Where it is called with a share, a
    signal that came since raises KeyboardInterrupt: what is changed in between stays whole. A
    second signal does not wait for that.

    Args:
        minutes: that the command is meant to take.
    """

    def __init__(self, minutes: float):
        self._total, self._begun = 60 * minutes, time.monotonic()
        self._bar: Any = None
        self._task: Any = None
        self._stage, self._printed = '', self._begun
        self._before: dict[int, Any] = {}
        self.interrupted = False

    @property
    def seconds(self) -> float:
        """Since the command began."""
        return time.monotonic() - self._begun

    @property
    def left(self) -> float:
        """Seconds of the minutes; below 0 when they are over."""
        return self._total - self.seconds

    def at(self, share: float) -> float:
        """`time.monotonic()` when a share of the minutes is over."""
        return self._begun + share * self._total

    def __enter__(self) -> Stages:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_) -> None:
        self.pause()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self, stage: str, share: float) -> None:
        """Show a stage and the share of it that is done.

        Raises:
            KeyboardInterrupt: a signal came.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        line = f'{self.seconds / 60:.1f} of {self._total / 60:g} min · {stage}'
        if sys.stdout.isatty():
            self._show(line, share)
        elif stage != self._stage or time.monotonic() - self._printed >= LINE_PERIOD_S:
            if stage != self._stage or share < 1:
                print(f'{line} · {min(share, 1):.0%}', flush=True)
            self._printed = time.monotonic()
        self._stage = stage

    def pause(self) -> None:
        """Take the bar away, for somebody who shows one of his own."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _show(self, line: str, share: float) -> None:
        if self._bar is None:
            from rich.progress import BarColumn, Progress, TextColumn
            self._bar = Progress(BarColumn(24), TextColumn('{task.percentage:>3.0f}%'),
                                 TextColumn('{task.description}'), transient=True)
            self._task = self._bar.add_task(line, total=1.0)
            self._bar.start()
        self._bar.update(self._task, completed=min(share, 1.0), description=line)

    def _on_signal(self, number: int, frame: Any) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True
        # Not by print, which may be what was interrupted.
        os.write(2, b'interrupted: it ends after this step; once more ends it at once\n')
