"""Quality of service of every topic, from the contract in `vn_msgs_py.topics`."""

from __future__ import annotations

import dataclasses

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

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


def offered(name: str) -> QoSProfile:
    """What a publisher of this package offers: reliable, also where a listener asks for less.

    Best effort is served by a reliable publisher as well; a listener that insists on reliable (an
    RViz display) would get nothing from a best-effort one.
    """
    return profile(dataclasses.replace(topic(name), reliability=RELIABLE))
