"""The threads of an active node."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

Loop = Callable[[Callable[[], bool]], None]  # returns soon after what it is given turns false


class WorkThreads:
    """Threads that are started and end together. A failure of one is reported, never lost.

    Args:
        loops: by name.
        on_failure: called on the failing thread with this object, its name and the exception.
    """

    def __init__(self, loops: Mapping[str, Loop],
                 on_failure: Callable[[WorkThreads, str, Exception], None]):
        self._on_failure = on_failure
        self._ended = False
        self._threads = {name: threading.Thread(target=self._guard, args=(name, loop), name=name,
                                                daemon=True) for name, loop in loops.items()}

    def start(self) -> WorkThreads:
        """Start them, once."""
        for thread in self._threads.values():
            thread.start()
        return self

    def is_running(self) -> bool:
        """They have not been asked to end."""
        return not self._ended

    def end(self) -> None:
        """Ask them to end; wake them afterwards."""
        self._ended = True

    def join(self, name: str, timeout: float | None = None) -> bool:
        """Wait for one of them [s]; whether it has ended."""
        self._threads[name].join(timeout)
        return not self._threads[name].is_alive()

    def _guard(self, name: str, loop: Loop) -> None:
        try:
            loop(self.is_running)
        except Exception as error:  # whatever it was
            self._on_failure(self, name, error)
