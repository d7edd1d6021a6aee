"""Quality of service of every topic, from the contract in `vn_msgs_py.topics`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, RELIABLE, Topic, topic


def qos(name: str, *, depth: int | None = None) -> QoSProfile:
    """The profile of a topic of the contract.

    Args:
        name: relative name as in the contract.
        depth: another queue length, for a recorder that must not lose pictures.
    """
    return profile(topic(name), depth=depth)


def profile(entry: Topic, *, depth: int | None = None) -> QoSProfile:
    """The profile of any topic; depth: as of `qos`."""
    return QoSProfile(
        depth=depth or entry.depth,
        reliability=(ReliabilityPolicy.BEST_EFFORT if entry.reliability == BEST_EFFORT
                     else ReliabilityPolicy.RELIABLE),
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if entry.durability == LATCHED
                    else DurabilityPolicy.VOLATILE))


def subscribe(node, kind: type, name: str, callback: Callable[[Any], None]) -> list[Subscription]:
    """Subscribe with a QoS that is compatible with every publisher of the topic.

    A sensor is asked for with best effort, which every publisher offers. A latched topic needs
    one subscription for each kind of publisher: what was said before (reliable and transient
    local), what is said reliably, and the rest. The same message may then come up to three times.

    Returns:
        The subscriptions.
    """
    asked = profile(topic(name))
    asked.reliability = ReliabilityPolicy.BEST_EFFORT
    asked.durability = DurabilityPolicy.VOLATILE
    profiles = [asked]
    if topic(name).durability == LATCHED:
        reliable = profile(topic(name))
        reliable.durability = DurabilityPolicy.VOLATILE
        profiles = [profile(topic(name)), reliable, asked]
    # What one of them does not hear another does: no warnings about it.
    quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
    return [node.create_subscription(kind, name, callback, each, event_callbacks=quiet)
            for each in profiles]


def other_types(node, name: str, kind: type) -> list[tuple[str, str]]:
    """Who publishes a topic in another type than `kind`: pairs (node, type). Nobody hears them.

    Args:
        node: that looks.
        name: resolved.
        kind: of the messages that are wanted.
    """
    wanted = f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
    return [(info.node_name, info.topic_type)
            for info in node.get_publishers_info_by_topic(name) if info.topic_type != wanted]


def offered(name: str) -> QoSProfile:
    """What a publisher of this package offers: reliable, also where a listener asks for less.

    Best effort is served by a reliable publisher as well; a listener that insists on reliable (an
    RViz display) would get nothing from a best-effort one.
    """
    return profile(dataclasses.replace(topic(name), reliability=RELIABLE))
