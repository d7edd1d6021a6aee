"""Looks at a live graph for `vn_nav doctor`: who is there, and what comes in a few seconds.

It publishes nothing, unless it is asked to try the base (`vn_nav.nodes.base_check`).
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, RELIABLE, TOPICS, VOLATILE, topic
from vn_nav.bags.roles import Topics
from vn_nav.doctor.drive_checks import is_command_timeout
from vn_nav.doctor.seen import (
    OUR_DRIVERS,
    BaseStop,
    Endpoint,
    Graph,
    Lens,
    Middleware,
    Operation,
    SeenTopic,
)
from vn_nav.errors import UserError
from vn_nav.nodes import policy_parameters
from vn_nav.nodes.base_check import try_base
from vn_nav.nodes.heard import Heard
from vn_nav.nodes.isolation import NEW_PROFILE, OLD_PROFILE
from vn_nav.nodes.qos import profile
from vn_nav.nodes.service_call import ServiceCall
from vn_nav.nodes.taps import message_class
from vn_nav.nodes.visit import visiting
from vn_nav.policy.navigator import Limits

NAME = 'vn_nav_doctor'
STILL_S = 2.0  # without anything new in the graph, before it is decided what to listen to
ALONE_S = 7.0  # while nobody else is there: Fast DDS announces itself anew every 3 s
DISCOVERY_S = 15.0  # at most: in a graph that goes on changing
PARAMETERS_S = 3.0  # for a node's answer about its parameters
QUEUE = 50  # messages that may wait: losses here are not the network's
LISTENED = ('camera_info', 'odom', 'goal_image')  # and the pictures
VENDORS = {(1, 15): 'Fast DDS', (1, 16): 'Cyclone DDS', (1, 1): 'Connext'}  # in an endpoint's id
USED = ('enable_stamped_cmd_vel', 'image_transport', *Limits.__dataclass_fields__)
SETTABLE = (*USED, 'use_sim_time')


@dataclasses.dataclass(frozen=True)
class Look:
    """What to look at.

    Raises:
        UserError: a setting that policy_node does not have, or a value that it refuses.
    """

    seconds: float = 5.0
    namespace: str = ''
    topics: Topics = Topics()
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of policy_node
    base_check: bool = False

    def __post_init__(self):
        for name, value in self.settings.items():
            if name not in SETTABLE:
                raise UserError('--set takes a parameter of policy_node that the doctor uses',
                                name, f'they are {", ".join(SETTABLE)}')
            if name != 'use_sim_time':
                policy_parameters.check(name, value)
            elif not isinstance(value, bool):
                raise UserError('use_sim_time is true or false', value, 'correct it')


def look(options: Look) -> Graph:
    """Join the graph for some seconds, and leave it.

    Raises:
        UserError: the middleware cannot start, or `base_check` where it must not be tried.
    """
    with visiting(NAME, options.namespace) as (node, executor):
        return _Doctor(node, executor, options).look()


class _Doctor:
    """A visit to the graph."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor, options: Look):
        self._node, self._executor, self._options = node, executor, options
        self._heard: dict[str, Heard] = {}  # by name in the contract
        self._time: int | None = None  # of /clock [ns]
        given = dataclasses.asdict(options.topics)
        # A role's default name is the topic's in the contract.
        roles = {name: given[role] for role, name in dataclasses.asdict(Topics()).items()}
        raw = roles['image_raw'].removesuffix('/compressed')
        roles |= {'image_raw': raw, 'image_raw/compressed': raw and f'{raw}/compressed'}
        self._names = {entry.name: self._resolve(roles.get(entry.name, entry.name))
                       for entry in TOPICS if roles.get(entry.name, entry.name)}  # null: none

    def _resolve(self, name: str) -> str:
        return self._node.resolve_topic_name(name)

    def look(self) -> Graph:
        """All of it."""
        self._discover()
        operation = self._operation()
        clock = 'clock' if self._publishers('clock') else '/clock'
        # First, as in policy_node: of what has arrived, the executor serves the oldest
        # subscription first, and so the time before what is stamped with it.
        self._node.create_subscription(Clock, clock, self._on_clock, profile(topic('/clock')))
        self._listen(operation)
        begun = time.monotonic()
        self._spin_for(self._options.seconds)
        seconds = time.monotonic() - begun
        topics = {name: self._seen(name) for name in self._names}
        info = self._heard['camera_info'].last if 'camera_info' in self._heard else None
        nodes = {f'{space.rstrip("/")}/{name}'
                 for name, space in self._node.get_node_names_and_namespaces() if name != NAME}
        named = set(self._names.values())
        timeouts = tuple(self._timeouts(topics)) if 'cmd_vel' in topics else ()
        return Graph(
            seconds, tuple(sorted(nodes)), topics,
            {name: kinds[0] for name, kinds in self._node.get_topic_names_and_types()
             if name not in named},
            _middleware(), operation,
            None if info is None else Lens(info.width, info.height, float(info.k[0])),
            tuple(sorted({end.node for end in self._publishers(clock)})), timeouts,
            self._try_base(topics))

    # Listening.

    def _discover(self) -> None:
        """Wait until who is there, and what they publish, stays as it is.

        Nodes, their names and their topics arrive apart, on a busy machine seconds apart.
        """
        begun = changed = time.monotonic()
        before: Any = None
        while (now := time.monotonic()) < begun + DISCOVERY_S:
            others = {node for node in self._node.get_node_names_and_namespaces()
                      if node[0] != NAME}
            seen = (others, self._node.get_topic_names_and_types(),
                    {name: self._publishers(name) for name in self._names.values()})
            if seen != before:
                before, changed = seen, now
            if now > changed + (STILL_S if others else ALONE_S):
                return
            self._spin_for(0.2)

    def _spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self._spin_until(lambda: time.monotonic() > end)

    def _spin_until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._executor.spin_once(timeout_sec=0.02)

    def _on_clock(self, message: Clock) -> None:
        self._time = message.clock.sec * 10**9 + message.clock.nanosec

    def _listen(self, operation: Operation) -> None:
        pictures = 'image_raw/compressed' if operation.compressed else 'image_raw'
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        for contract in (pictures, *LISTENED):
            if contract not in self._names:
                continue
            entry = topic(contract)
            heard = self._heard[contract] = Heard(contract, lambda: self._time)
            profiles = [dataclasses.replace(entry, reliability=BEST_EFFORT, durability=VOLATILE)]
            if entry.durability == LATCHED:
                profiles.insert(0, entry)  # what was said before
            for each in profiles:
                take: Any = heard.take  # two arguments, which rclpy's types do not know
                self._node.create_subscription(
                    message_class(entry.type), self._names[contract], take,
                    profile(each, depth=QUEUE), event_callbacks=quiet)

    # The graph.

    def _publishers(self, name: str) -> tuple[Endpoint, ...]:
        return self._ends(self._node.get_publishers_info_by_topic(self._resolve(name)))

    def _ends(self, infos) -> tuple[Endpoint, ...]:
        return tuple(_endpoint(info) for info in infos if info.node_name != NAME)

    def _seen(self, contract: str) -> SeenTopic:
        name = self._names[contract]
        heard, publishers = self._heard.get(contract), self._publishers(name)
        return SeenTopic(
            contract, name, publishers,
            self._ends(self._node.get_subscriptions_info_by_topic(name)),
            None if heard is None else heard.stream(len(publishers)))

    # Parameters of others.

    def _operation(self) -> Operation:
        """How policy_node is going to run: as it does, as it was said here, or by default."""
        command = self._names.get('cmd_vel', self._resolve('cmd_vel'))
        runs = next((end.node for end in self._publishers(command)
                     if end.node.rpartition('/')[2] in OUR_DRIVERS), '')
        values: dict[str, Any] = {name: policy_parameters.PARAMETERS[name][0] for name in USED}
        values['use_sim_time'] = None
        chosen = bool(runs) or 'image_transport' in self._options.settings
        if runs:
            values |= {name: value for name, value in self._parameters(runs, SETTABLE).items()
                       if value is not None}
        elif 'image_raw' in self._names:  # nobody has decided: take the pictures that there are
            raw, packed = (self._publishers(self._names[name])
                           for name in ('image_raw', 'image_raw/compressed'))
            if self._options.topics.image.endswith('/compressed') or packed and not raw:
                values['image_transport'] = 'compressed'
        values |= self._options.settings
        return Operation(
            runs, Limits(**{name: values[name] for name in Limits.__dataclass_fields__}),
            values['enable_stamped_cmd_vel'], values['image_transport'] == 'compressed', chosen,
            values['use_sim_time'])

    def _timeouts(self, topics: Mapping[str, SeenTopic]):
        """Parameters of the nodes that take commands: for how long one holds."""
        for node in sorted({end.node for end in topics['cmd_vel'].subscribers}):
            wanted = filter(is_command_timeout, self._list(node))
            for name, value in self._parameters(node, wanted).items():
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    yield node, name, float(value)

    def _list(self, node: str) -> list[str]:
        answer = self._ask(ListParameters, f'{node}/list_parameters', ListParameters.Request())
        return [] if answer is None else list(answer.result.names)

    def _parameters(self, node: str, names) -> dict[str, Any]:
        """Their values by name; None: it has no such parameter, or does not answer."""
        names = list(names)
        answer = self._ask(GetParameters, f'{node}/get_parameters',
                           GetParameters.Request(names=names)) if names else None
        values = [] if answer is None else answer.values
        return {name: _value(value) for name, value in zip(names, values, strict=False)}

    def _ask(self, kind, name: str, request):
        client = self._node.create_client(kind, name)
        end = time.monotonic() + PARAMETERS_S
        self._spin_until(lambda: client.service_is_ready() or time.monotonic() > end)
        answer = None
        if client.service_is_ready():
            call = ServiceCall(client, request, again=1.0)
            end = time.monotonic() + PARAMETERS_S
            answered = False

            def done() -> bool:
                nonlocal answered
                answered = answered or call.is_answered()
                return answered or time.monotonic() > end
            self._spin_until(done)
            answer = call.answer if answered else None
        self._node.destroy_client(client)
        return answer

    def _try_base(self, topics: Mapping[str, SeenTopic]) -> BaseStop | None:
        if not self._options.base_check:
            return None
        command, odometry = topics.get('cmd_vel'), self._heard.get('odom')
        if command is None or odometry is None:
            raise UserError('--base-check needs a command topic and odometry', 'one is null',
                            'name them in --topics')
        return try_base(self._node, command, odometry, self._spin_for)


def _endpoint(info) -> Endpoint:
    quality, identity = info.qos_profile, tuple(info.endpoint_gid[:2])
    return Endpoint(
        f'{info.node_namespace.rstrip("/")}/{info.node_name}', info.topic_type,
        BEST_EFFORT if quality.reliability == ReliabilityPolicy.BEST_EFFORT else RELIABLE,
        LATCHED if quality.durability == DurabilityPolicy.TRANSIENT_LOCAL else VOLATILE,
        VENDORS.get(identity, ''))


def _value(value) -> Any:
    fields = {ParameterType.PARAMETER_BOOL: 'bool_value',
              ParameterType.PARAMETER_INTEGER: 'integer_value',
              ParameterType.PARAMETER_DOUBLE: 'double_value',
              ParameterType.PARAMETER_STRING: 'string_value'}
    return getattr(value, fields[value.type]) if value.type in fields else None


def _middleware() -> Middleware:
    given = os.environ.get
    read, other = (OLD_PROFILE, NEW_PROFILE) if _is_fast_dds_2() else (NEW_PROFILE, OLD_PROFILE)
    file = given(read, '')
    return Middleware(rclpy.get_rmw_implementation_identifier(), file,
                      not file or Path(file).is_file(), given('ROS_DOMAIN_ID') or '0',
                      given('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'SUBNET', read,
                      other if given(other) and not file else '')


def _is_fast_dds_2() -> bool:
    """By the library that this process has loaded: its name changed with Fast DDS 3."""
    try:
        loaded = Path('/proc/self/maps').read_text()
    except OSError:
        return True
    return '/libfastdds' not in loaded
