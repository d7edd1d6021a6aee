"""Engines of DeepMind Lab, a process each: asked side by side, started again when lost."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.errors import EnvironmentLost, UserError

FOLDER = Path(__file__).resolve().parent
PATIENCE = 60.0  # s for an answer; then an engine counts as hung
OPENING = 300.0  # s for a level to open: compiling its map takes seconds, on a busy machine more
TRIES = 3  # starts in a row that may fail
FORGET = 5.0  # s that a worker may take to end by itself


class Lost(Exception):
    """An engine has crashed or hangs; the text says what it last wrote."""


class Engine:
    """One worker process. `ask` and `answer` go in pairs, so that many may work side by side."""

    def __init__(self, python: Path, memory: int, size: int, temporary: Path):
        self.log = temporary / 'log'
        with self.log.open('wb') as log:
            self.process = subprocess.Popen(
                [str(python), '-W', 'ignore', '-I', str(FOLDER / 'worker.py'), str(memory),
                 str(size)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                pass_fds=(memory,), cwd=temporary,
                env={'PATH': os.defpath, 'LANG': 'C.UTF-8', 'HOME': str(temporary),
                     'TMPDIR': str(temporary), 'OMP_NUM_THREADS': '1'})
        self._rest = b''

    def ask(self, **request: Any) -> None:
        """Send a request.

        Raises:
            Lost: it has crashed.
        """
        assert self.process.stdin is not None  # a pipe
        try:
            self.process.stdin.write(json.dumps(request).encode() + b'\n')
            self.process.stdin.flush()
        except OSError as error:
            raise Lost(self._last_words()) from error

    def answer(self, patience: float) -> dict:
        """What it says to the request.

        Raises:
            Lost: it has crashed, or says nothing for `patience` [s].
            ValueError: it cannot do what it was asked for.
        """
        assert self.process.stdout is not None  # a pipe
        descriptor, end = self.process.stdout.fileno(), time.monotonic() + patience
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        while b'\n' not in self._rest:
            if not poll.poll(max(end - time.monotonic(), 0) * 1000):
                raise Lost(f'no answer for {patience:g} s')
            part = os.read(descriptor, 1 << 16)
            if not part:
                raise Lost(self._last_words())
            self._rest += part
        line, _, self._rest = self._rest.partition(b'\n')
        found = json.loads(line)
        if 'error' in found:
            raise ValueError(found['error'])
        return found

    def _last_words(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(FORGET)
        lines = self.log.read_bytes()[-2000:].decode(errors='replace').strip().splitlines()
        return f'it ended with {self.process.poll()}: {lines[-1] if lines else "no word"}'

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


class Engines:
    """N engines, and one memory that they draw into.

    Args:
        python: the interpreter that has the engine.
        count: engines, N.
        rows: pictures in the memory.
        size: their sides [pixels], a multiple of 4.
        opening: what opens engine n: its index -> the requests.
    """

    def __init__(self, python: Path, count: int, rows: int, size: int, opening):
        self.python, self.count, self.size, self.opening = python, count, size, opening
        self.patience = PATIENCE
        self.broken = np.zeros(count, bool)  # since somebody asked
        self.restarts = 0
        self._folder: Path | None = Path(tempfile.mkdtemp(prefix='vn_nav_dmlab_'))
        self._memory = os.memfd_create('vn_nav_dmlab')
        os.ftruncate(self._memory, rows * size * size * 4)
        self.pictures = np.frombuffer(mmap.mmap(self._memory, 0), np.uint8).reshape(
            rows, size, size, 4)
        self.engines: list[Engine | None] = [None] * count
        self._failed = np.zeros(count, int)

    def ask(self, requests: dict[int, dict]) -> dict[int, dict]:
        """Answers of some engines, each to its request; all work at the same time.

        One that crashes or hangs is started again and asked again, once it stands where
        `opening` puts it; `broken` then says so.

        Raises:
            EnvironmentLost: an engine cannot be started again.
        """
        found: dict[int, dict] = {}
        waiting = dict(requests)
        while waiting:
            asked = []
            for n, request in list(waiting.items()):
                try:
                    self._started(n).ask(**request)
                    asked.append(n)
                except Lost as error:
                    self._lose(n, error)
            for n in asked:
                try:
                    found[n] = self._started(n).answer(self.patience)
                    self._failed[n] = 0
                    del waiting[n]
                except Lost as error:
                    self._lose(n, error)
                except ValueError as error:
                    raise EnvironmentLost('DeepMind Lab does what it is asked for', str(error),
                                          'report it with the scene') from error
        return found

    def start(self, numbers: Sequence[int]) -> None:
        """Start some engines, or open other levels in those that run.

        Raises:
            UserError: one does not start.
        """
        waiting, failed = list(numbers), dict.fromkeys(numbers, 0)
        while waiting:
            lost: dict[int, Lost] = {}
            told = {n: self._begin(n, lost) for n in waiting}  # all at the same time
            for n, count in told.items():
                try:
                    for _ in range(count if n not in lost else 0):
                        self._engine(n).answer(OPENING)
                except Lost as error:
                    lost[n] = error
                except ValueError as error:
                    for each in waiting:
                        self._discard(each)
                    raise _unable(str(error)) from error
            for n, loss in lost.items():
                self._discard(n)
                self.broken[n] = True
                failed[n] += 1
                if failed[n] >= TRIES:
                    raise _unable(str(loss)) from loss
            waiting = list(lost)

    def _begin(self, n: int, lost: dict[int, Lost]) -> int:
        """Let an engine open its level: how many answers will come."""
        if self.engines[n] is None:
            assert self._folder is not None  # not closed
            own = self._folder / str(n)
            shutil.rmtree(own, ignore_errors=True)
            own.mkdir()
            self.engines[n] = Engine(self.python, self._memory, self.size, own)
        requests = self.opening(n)
        try:
            for request in requests:
                self._engine(n).ask(**request)
        except Lost as error:
            lost[n] = error
        return len(requests)

    def _engine(self, n: int) -> Engine:
        engine = self.engines[n]
        assert engine is not None  # it has been started
        return engine

    def _started(self, n: int) -> Engine:
        if self.engines[n] is None:
            self.start([n])
        return self._engine(n)

    def _lose(self, n: int, error: Lost) -> None:
        """Start an engine again that has crashed or hangs."""
        self.broken[n] = True
        self.restarts += 1
        self._failed[n] += 1
        self._discard(n)
        said = str(error)
        try:
            if self._failed[n] <= TRIES:
                self.start([n])
                return
        except UserError as again:
            said = str(again.received)
        raise EnvironmentLost('an engine of DeepMind Lab that was lost starts again, and answers',
                              f'several failures in a row, the last: {said}',
                              'what was learned is kept; resume it') from error

    def _discard(self, n: int) -> None:
        engine, self.engines[n] = self.engines[n], None
        if engine is not None:
            engine.end()

    def close(self) -> None:
        """End all processes; a second time it does nothing."""
        for n in range(self.count):
            self._discard(n)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            os.close(self._memory)
            self._folder = None


def _unable(said: str) -> UserError:
    return UserError('the engine of DeepMind Lab starts', said,
                     'vn_nav simulators install dmlab; apt install libsdl2-2.0-0 libosmesa6')
