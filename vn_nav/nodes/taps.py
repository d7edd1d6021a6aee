"""Topics that recorder_node listens to: their types, their quality of service, their names."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription

from vn_msgs_py.topics import BEST_EFFORT, VOLATILE, Topic
from vn_nav.bags.storage.definitions import definition
from vn_nav.bags.storage.losses import Losses
from vn_nav.errors import UserError


def installed(kind: str) -> bool:
    """Whether a type's message package is there (tf2_msgs is in no wheel)."""
    return importlib.util.find_spec(kind.partition('/')[0]) is not None


@dataclasses.dataclass
class Tap:
    """A subscription whose messages are written."""

    topic: Topic  # as it is subscribed to, and named in the bag
    name: str  # resolved
    message: type
    subscription: Subscription
    losses: Losses = dataclasses.field(default_factory=Losses)
    publishers: int = 1
    received: int = 0
    lost: int = 0
    numbered: bool = True  # the middleware says the publishers' numbers


def message_class(kind: str) -> type:
    """The class of a type that is installed and whose definition is known.

    Raises:
        UserError: it is not.
    """
    definition(kind)
    package, _, name = kind.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise UserError('a recorded type is of a message package that is installed', kind,
                        'install or source its package, or leave the topic out') from error


def weakened(entry: Topic, offers: list) -> Topic:
    """The topic with the strongest QoS, not above its own, that every publisher satisfies."""
    weak = any(offer.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for offer in offers)
    fleeting = any(offer.qos_profile.durability == DurabilityPolicy.VOLATILE for offer in offers)
    return dataclasses.replace(
        entry, reliability=BEST_EFFORT if weak else entry.reliability,
        durability=VOLATILE if fleeting else entry.durability)


def in_bag(name: str) -> str:
    """The name of a topic in a bag."""
    return name if name.startswith('/') else f'/{name}'


def hidden(name: str) -> bool:
    """Whether ROS lists a topic only when asked for hidden ones."""
    return any(part.startswith('_') for part in name.split('/'))
