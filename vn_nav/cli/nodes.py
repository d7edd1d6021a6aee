"""Entry points of the nodes. They handle signals before the seconds of imports begin."""

from __future__ import annotations

import importlib

from vn_nav.nodes import signals


def _start(module: str) -> int:
    """Import a node's module and run its `main`; the exit code."""
    signals.exit_at_once()
    return importlib.import_module(module).main()


def dashboard_node() -> int:
    """A page in the browser, to watch and to drive by."""
    return _start('vn_nav.nodes.dashboard_node')


def goal_node() -> int:
    """Show the robot a picture from a file."""
    return _start('vn_nav.nodes.goal_node')


def policy_node() -> int:
    """Drive a robot to the place of a picture."""
    return _start('vn_nav.nodes.policy_node')


def recorder_node() -> int:
    """Record a bag."""
    return _start('vn_nav.nodes.recorder_node')


def route_node() -> int:
    """Drive along a remembered route."""
    return _start('vn_nav.nodes.route_node')


def sim_bridge_node() -> int:
    """Simulate a robot in a house."""
    return _start('vn_sim_bridge.bridge_node')


def teleop_node() -> int:
    """Drive by keyboard or joystick."""
    return _start('vn_nav.nodes.teleop_node')
