"""Nodes of this package as child processes, each with a log file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from vn_nav.nodes.isolation import profile_environment


class ProcessFailure(Exception):
    """A child process died or stalled."""


class Processes:
    """Children, each with a log file; all are gone at the end."""

    def __init__(self, logs: Path):
        self.logs = logs
        self.running: dict[str, subprocess.Popen] = {}
        self.killed: list[str] = []  # children that did not end when they were asked to
        logs.mkdir(parents=True, exist_ok=True)
        self.environment = os.environ | profile_environment() | {
            # Others on this host do not meet this robot.
            'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID', str(40 + os.getpid() % 60)),
            'OMP_NUM_THREADS': '1', 'PYTHONUNBUFFERED': '1',
        }

    def start(self, name: str, module: str, parameters: dict, rules: tuple[str, ...] = ()
              ) -> None:
        """Start a node of this package with parameters and remapping rules."""
        command = [sys.executable, '-m', module, '--ros-args']
        for key, value in parameters.items():
            command += ['-p', f'{key}:={json.dumps(value)}']
        for rule in rules:
            command += ['-r', rule]
        log = open(self.logs / f'{name}.log', 'w')
        self.running[name] = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            env=self.environment, start_new_session=True)
        log.close()

    def log(self, name: str) -> str:
        """What a child has printed so far."""
        return (self.logs / f'{name}.log').read_text(errors='replace')

    def check(self, name: str) -> None:
        """Fail when a child has ended by itself."""
        code = self.running[name].poll()
        if code not in (None, 0):
            lines = self.log(name).strip().splitlines() or ['nothing']
            raise ProcessFailure(f'{name} ended with code {code}; its last line: {lines[-1]}')

    def stop(self, name: str) -> None:
        """SIGINT, and SIGKILL after 10 s, to the child and whatever it started."""
        process = self.running.pop(name, None)
        if process is None:
            return
        for number, patience in ((signal.SIGINT, 10), (signal.SIGKILL, 10)):
            if process.poll() is None:
                if number == signal.SIGKILL:
                    self.killed.append(name)
                os.killpg(process.pid, number)
                try:
                    process.wait(patience)
                except subprocess.TimeoutExpired:
                    continue

    def stop_all(self) -> None:
        """Stop every child, the recorder last so that it hears the others end."""
        for name in sorted(self.running, key=lambda n: n == 'recorder'):
            self.stop(name)
