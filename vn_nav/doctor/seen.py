"""What `vn_nav doctor` has seen of a graph, as plain data: no ROS. Times are in seconds."""

from __future__ import annotations

import dataclasses

from vn_msgs_py.topics import BEST_EFFORT, LATCHED
from vn_nav.policy.navigator import Limits

OK, WARNING, ERROR = 'ok', 'warning', 'error'
ORDER = (ERROR, WARNING, OK)  # the worst first
OUR_DRIVERS = ('policy_node', 'training_node')  # nodes of this package that command a base


@dataclasses.dataclass(frozen=True)
class Finding:
    """One check, and what came of it."""

    check: str  # its name, as in docs/doctor.md
    severity: str  # ERROR: the robot stands still or drives wrongly; WARNING: it may; OK
    topic: str  # '': none in particular
    seen: str
    fix: str = ''  # what to type; empty: nothing


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """Somebody who publishes a topic, or subscribes to it."""

    node: str  # with its namespace
    type: str
    reliability: str  # RELIABLE or BEST_EFFORT of `vn_msgs_py.topics`
    durability: str  # VOLATILE or LATCHED
    vendor: str = ''  # of its middleware; empty: not known

    def hears(self, publisher: Endpoint) -> bool:
        """Whether this subscription is matched with a publisher, as DDS decides it."""
        return not (self.type != publisher.type
                    or (self.reliability != BEST_EFFORT and publisher.reliability == BEST_EFFORT)
                    or (self.durability == LATCHED and publisher.durability != LATCHED))


@dataclasses.dataclass(frozen=True)
class Stream:
    """What came on a topic while the doctor listened."""

    count: int = 0
    period: float | None = None  # between messages, median; None: fewer than two came
    worst_gap: float = 0.0
    lost: int = 0  # by the publishers' numbers
    bytes: int = 0  # of the largest picture
    lag: float | None = None  # from the stamp to reception by the wall clock, median; None: none
    simulated_lag: float | None = None  # the same by /clock
    zero: int = 0  # stamps of zero
    repeated: int = 0  # stamps as the one before
    back: int = 0  # stamps that go back
    fault: str = ''  # why a message cannot be read
    pictures: tuple[str, ...] = ()  # encodings and sizes
    frames: tuple[tuple[str, str], ...] = ()  # frame_id and child_frame_id of odometry


@dataclasses.dataclass(frozen=True)
class SeenTopic:
    """A topic of the contract on this graph."""

    contract: str  # its name in `vn_msgs_py.topics`
    name: str  # resolved
    publishers: tuple[Endpoint, ...] = ()
    subscribers: tuple[Endpoint, ...] = ()
    stream: Stream | None = None  # None: it was not listened to


@dataclasses.dataclass(frozen=True)
class Lens:
    """What camera_info says."""

    width: int
    height: int
    focal: float  # pixels


@dataclasses.dataclass(frozen=True)
class Middleware:
    """How this process speaks, which others have to share."""

    implementation: str  # as rclpy names it
    profile: str = ''  # file of Fast DDS profiles; empty: none is set
    profile_exists: bool = True
    domain: str = '0'
    range: str = 'SUBNET'  # of discovery
    profile_variable: str = 'FASTRTPS_DEFAULT_PROFILES_FILE'  # that this Fast DDS reads
    ignored_variable: str = ''  # the other one, which is set where that is not


@dataclasses.dataclass(frozen=True)
class Operation:
    """The parameters of policy_node that decide what fits."""

    node: str = ''  # full name of the one that runs; empty: none
    limits: Limits = Limits()
    stamped: bool = False  # enable_stamped_cmd_vel
    compressed: bool = False  # image_transport
    chosen: bool = True  # somebody said so; False: it is what is published
    use_sim_time: bool | None = None  # None: not decided yet


@dataclasses.dataclass(frozen=True)
class BaseStop:
    """What a base did after its last command."""

    turned: float  # rad while it was commanded
    seconds: float | None  # until it stood still; None: it did not


@dataclasses.dataclass(frozen=True)
class Graph:
    """All of it."""

    seconds: float  # it was listened for
    nodes: tuple[str, ...]  # of others, with their namespaces
    topics: dict[str, SeenTopic]  # by their names in the contract
    others: dict[str, str]  # types of the topics that are not of the contract, by name
    middleware: Middleware
    operation: Operation = Operation()
    lens: Lens | None = None
    clocks: tuple[str, ...] = ()  # nodes that publish /clock
    timeouts: tuple[tuple[str, str, float], ...] = ()  # node, parameter, value of the base's side
    base_stop: BaseStop | None = None  # None: it was not tried

    @property
    def pictures(self) -> SeenTopic | None:
        """The topic of the pictures that the policy takes."""
        return self.topics.get('image_raw/compressed' if self.operation.compressed
                               else 'image_raw')
