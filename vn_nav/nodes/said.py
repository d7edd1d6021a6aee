"""Reads what nodes say as JSON in a String. Whatever somebody writes there, no callback fails."""

from __future__ import annotations

import json
from typing import Any

from std_msgs.msg import String

from vn_nav.policy.frame_gate import shorten


def read_said(node, topic: str, message: String, *keys: str) -> dict[str, Any] | None:
    """The object in a message; None, with an error in the log: it is none, or lacks a key.

    Args:
        node: that logs.
        topic: for the log.
        message: as it came.
        keys: that it has.
    """
    try:
        said = json.loads(message.data)
    except ValueError:
        said = None
    if isinstance(said, dict) and said.keys() >= set(keys):
        return said
    node.get_logger().error(
        f'{topic} is JSON with {", ".join(keys)}; received {shorten(repr(message.data))}; '
        'see who else publishes it', throttle_duration_sec=10.0)
    return None
