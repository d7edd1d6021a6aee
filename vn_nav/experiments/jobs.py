"""Commands side by side, each on one core, until all have ended or somebody stops them."""

from __future__ import annotations

import dataclasses
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from vn_nav.errors import UserError

POLL = 1.0  # s
PATIENCE = 60.0  # s that a command which was asked to stop may take to save


@dataclasses.dataclass(frozen=True)
class Job:
    """Commands of `vn_nav`, one after the other; `before` is called first, `after` at the end.

    At the end: when all have succeeded.
    """

    name: str
    commands: Sequence[Sequence[str]]
    log: Path
    after: Callable[[], object] = lambda: None
    before: Callable[[], object] = lambda: None


@dataclasses.dataclass
class _Running:
    job: Job
    process: subprocess.Popen
    done: int = 0  # commands


def run(jobs: Sequence[Job], cores: Sequence[int], say: Callable[[str], None]) -> None:
    """Run jobs, as many at a time as there are cores.

    A signal that ends this process is passed on: trainings save, and go on next time.

    Args:
        jobs: what is to be done.
        cores: numbers of processors; each has one job at a time, with one thread.
        say: receives a line when a job begins or ends.

    Raises:
        UserError: a command failed. The others are stopped; they have saved.
    """
    waiting = list(jobs)
    running: dict[int, _Running] = {}
    try:
        while waiting or running:
            for core in cores:
                own = running.get(core)
                if own is not None and own.process.poll() is not None:
                    if own.process.returncode:
                        raise UserError(
                            f'every command of {own.job.name} succeeds',
                            f'exit code {own.process.returncode} of '
                            f'{shlex.join(own.job.commands[own.done])[:300]}',
                            f'see {own.job.log}; what has ended is kept')
                    own.done += 1
                    if own.done < len(own.job.commands):
                        own.process = _start(own.job, own.done, core)
                        continue
                    del running[core]
                    own.job.after()
                    say(f'{own.job.name}: done')
                if core not in running and waiting:
                    job = waiting.pop(0)
                    say(f'{job.name}: begins on core {core}')
                    job.before()
                    running[core] = _Running(job, _start(job, 0, core))
            time.sleep(POLL)
    finally:
        _stop([own.process for own in running.values()])


def _start(job: Job, number: int, core: int) -> subprocess.Popen:
    """A command on one core."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, '-m', 'vn_nav.cli', *job.commands[number]]
    mine = os.sched_getaffinity(0)
    with open(job.log, 'a') as log:
        log.write(f'$ vn_nav {shlex.join(job.commands[number])}\n')
        log.flush()
        os.sched_setaffinity(0, {core})  # children inherit it
        try:
            return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT,
                                    stdin=subprocess.DEVNULL, start_new_session=True,
                                    env=os.environ | {'OMP_NUM_THREADS': '1'})
        finally:
            os.sched_setaffinity(0, mine)


def _stop(processes: Sequence[subprocess.Popen]) -> None:
    """Ask processes to save and end; kill those that do not."""
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + PATIENCE
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
