"""A ROS domain without other participants: where the commands of a shadow end."""

from __future__ import annotations

import fcntl
import os
import secrets
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from vn_nav.errors import UserError

DOMAINS = range(215, 233)  # beyond those that people choose; they leave Linux's ports alone
DISCOVERY_S = 3.0  # s in which others on a domain are discovered, also on a busy machine


class Domain:
    """A ROS domain without other participants, with a node of ours there; a context manager."""

    number: int
    _lock: IO[Any] | None  # of the file that keeps other shadows away

    def __init__(self, domains: Iterable[int]):
        self.namespace = f'/vn_nav_shadow_{os.getpid()}_{secrets.token_hex(4)}'
        taken = []
        for self.number in domains:
            self._lock = _lock(self.number)
            if self._lock is None:
                taken.append(f'{self.number}: another shadow')
                continue
            self._join()
            end = time.monotonic() + DISCOVERY_S
            while time.monotonic() < end and not self.strangers():
                self.executor.spin_once(timeout_sec=0.05)
            if not (strangers := self.strangers()):
                return
            taken.append(f'{self.number}: {", ".join(strangers)}')
            self.close()
        raise UserError('shadow mode needs a ROS domain without other participants',
                        '; '.join(taken), 'end some of them')

    def _join(self) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=self.number,
                   signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node('shadow', namespace=self.namespace, context=self._context,
                         start_parameter_services=False, enable_rosout=False)
        self.executor = SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)

    def strangers(self) -> list[str]:
        """Whoever else is on the domain, or listens to the commands."""
        nodes = {f'{space.rstrip("/")}/{name}'
                 for name, space in self.node.get_node_names_and_namespaces()
                 if space != self.namespace}
        commands = f'{self.namespace}/shadow/cmd_vel'
        listeners = {f'{info.node_name}, which listens to {commands}'
                     for info in self.node.get_subscriptions_info_by_topic(commands)
                     if info.node_name != self.node.get_name()}
        return sorted(nodes | listeners)

    def close(self) -> None:
        """Leave the domain to others."""
        self.executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        if self._lock is not None:
            self._lock.close()

    def __enter__(self) -> Domain:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _lock(number: int) -> IO | None:
    """Keep other shadows of this host away from a domain; None: one is there."""
    try:
        file = open(Path(tempfile.gettempdir(), f'vn_nav_shadow_domain_{number}.lock'), 'a')
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # taken, or the file is another user's
        return None
    return file
