"""Checks of the graph itself: middleware, missing topics, types, quality of service."""

from __future__ import annotations

from collections.abc import Iterator

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, topic
from vn_nav.doctor.seen import (
    ERROR,
    OK,
    OUR_DRIVERS,
    WARNING,
    Endpoint,
    Finding,
    Graph,
    Middleware,
    SeenTopic,
)
from vn_nav.resources import share_file

FAST_DDS = 'rmw_fastrtps_cpp'
# Fast DDS's own shared memory [bytes]: larger messages go in pieces over UDP, or get lost.
DEFAULT_SEGMENT_BYTES = 524_288
PROPOSED_TOPICS = 3  # that are named as possible replacements, at most
COMMANDS = ('cmd_vel', 'shadow/cmd_vel')  # checked by `vn_nav.doctor.drive_checks`


def set_profile(own: Middleware) -> str:
    """The command that gives this package's Fast DDS profile to a process."""
    profile = share_file('config/fastdds_multihost.xml')
    return (f'export {own.profile_variable}={profile} in front of policy_node and of the '
            'camera driver')


def middleware(graph: Graph) -> Iterator[Finding]:
    """Which middleware, and whether large pictures pass."""
    own, check = graph.middleware, 'middleware'
    if own.profile and not own.profile_exists:
        yield Finding(check, ERROR, '', f'the Fast DDS profile {own.profile} does not exist: the '
                      'default is used, silently', set_profile(own))
    elif own.implementation == FAST_DDS and own.ignored_variable:
        yield Finding(check, WARNING, '', f'{own.ignored_variable} is set, which this Fast DDS '
                      f'does not read: its default is used, silently',
                      f'export {own.profile_variable}=${own.ignored_variable}')
    elif own.implementation == FAST_DDS and not own.profile:
        image = graph.pictures
        large = 0 if image is None or image.stream is None else image.stream.bytes
        if large > DEFAULT_SEGMENT_BYTES:
            yield Finding(check, WARNING, '', f'no Fast DDS profile is set, and a picture has '
                          f'{large / 1e6:.1f} MB: more than its default shared memory of '
                          f'{DEFAULT_SEGMENT_BYTES / 1e6:.1f} MB', set_profile(own))
        else:
            yield Finding(check, OK, '', f'{own.implementation} without a profile, and pictures '
                          'that fit its shared memory')
    else:
        yield Finding(check, OK, '', own.implementation
                      + (f' with the profile {own.profile}' if own.profile else ''))
    vendors: dict[str, set[str]] = {}
    for seen in graph.topics.values():
        for end in (*seen.publishers, *seen.subscribers):
            if end.vendor:
                vendors.setdefault(end.vendor, set()).add(end.node)
    if len(vendors) > 1:
        yield Finding(check, WARNING, '', 'several middlewares on one graph: ' + '; '.join(
            f'{vendor}: {", ".join(sorted(nodes)[:3])}' for vendor, nodes in sorted(
                vendors.items())), f'export RMW_IMPLEMENTATION={own.implementation} in front of '
            'every node')


def nobody(graph: Graph) -> Iterator[Finding]:
    """Is anybody there at all?"""
    if not graph.nodes:
        own = graph.middleware
        yield Finding('graph', ERROR, '', f'no other node was found in {graph.seconds:.1f} s on '
                      f'domain {own.domain} ({own.implementation}, discovery range {own.range})',
                      'start the drivers; export the ROS_DOMAIN_ID, RMW_IMPLEMENTATION and '
                      'ROS_AUTOMATIC_DISCOVERY_RANGE that they have')


def missing(graph: Graph) -> Iterator[Finding]:
    """Topics without which nothing moves, or nothing moves well."""
    check = 'topics'
    image = graph.pictures
    if image is not None and not image.publishers:
        other = graph.topics.get('image_raw' if graph.operation.compressed
                                 else 'image_raw/compressed')
        if other is not None and other.publishers:
            yield Finding(check, ERROR, image.name, f'is not published, and {other.name} is',
                          'policy_node --ros-args -p image_transport:='
                          + ('raw' if graph.operation.compressed else 'compressed'))
        else:
            yield Finding(check, ERROR, image.name, 'is not published', _remap(graph, image))
    elif image is not None and graph.operation.compressed and not graph.operation.chosen:
        yield Finding(check, WARNING, image.name, 'is published, and no raw picture',
                      'policy_node --ros-args -p image_transport:=compressed')
    for contract, severity, why in (
            ('odom', ERROR, 'is not published: actions would run on time alone, and a policy that '
             'searches does not drive'),
            ('camera_info', WARNING, 'is not published: pictures cannot be cropped for a policy'),
            ('goal_image', WARNING, 'is not published: the robot waits for a picture')):
        seen = graph.topics.get(contract)
        if seen is not None and not seen.publishers:
            fix = (f'ros2 run vn_nav goal_node --ros-args -p picture:=kitchen.jpg -r goal_image:='
                   f'{seen.name}' if contract == 'goal_image' else _remap(graph, seen))
            yield Finding(check, severity, seen.name, why, fix)
    for seen in filter(None, (image, graph.topics.get('odom'))):
        names = sorted({end.node for end in seen.publishers})
        if len(seen.publishers) > 1:
            yield Finding(check, ERROR, seen.name, f'has {len(seen.publishers)} publishers: '
                          f'{", ".join(names)}', 'end or remap one of them: '
                          f'ros2 node info {names[-1]}')
        if (seen.stream is not None and not seen.stream.count
                and any(end.type == topic(seen.contract).type for end in seen.publishers)):
            yield Finding(check, ERROR, seen.name, f'has a publisher ({", ".join(names)}), and '
                          f'nothing came in {graph.seconds:.1f} s',
                          f'ros2 topic hz {seen.name} beside the driver: without messages check '
                          'the driver, with messages the network (firewall, Wi-Fi, middleware)')


def _remap(graph: Graph, seen: SeenTopic) -> str:
    kind = topic(seen.contract).type
    there = sorted(name for name, other in graph.others.items() if other == kind)
    if not there:
        return f'start the driver that publishes {kind}'
    return (f'policy_node --ros-args -r {seen.contract}:={there[0]} (of '
            f'{", ".join(there[:PROPOSED_TOPICS])}), and here --topics with that name')


def types(graph: Graph) -> Iterator[Finding]:
    """Whether everybody means the same messages by a name."""
    sound = True
    for seen in graph.topics.values():
        kind = topic(seen.contract).type
        for end in (*seen.publishers, *seen.subscribers):
            if seen.contract in COMMANDS or end.type == kind:
                continue
            sound = False
            does = 'publishes' if end in seen.publishers else 'subscribes to'
            needed = seen.contract in ('image_raw', 'image_raw/compressed', 'camera_info', 'odom',
                                       'goal_image')
            yield Finding('types', ERROR if needed else WARNING, seen.name,
                          f'{end.node} {does} it as {end.type}; the contract has {kind}',
                          f'remap that node: ros2 run ... --ros-args -r {seen.name}:='
                          f'{seen.name}_other, and republish as {kind}')
    if sound:
        yield Finding('types', OK, '', 'every topic of the contract has its type')


def qos(graph: Graph) -> Iterator[Finding]:
    """Who cannot hear whom, and whom this package's nodes hear only by luck."""
    sound = True
    for seen in graph.topics.values():
        for finding in (*_deaf(seen), *_offered(seen)):
            sound = False
            yield finding
    if sound:
        yield Finding('qos', OK, '', 'every listener is matched with every publisher')


def _deaf(seen: SeenTopic) -> Iterator[Finding]:
    """Pairs of a publisher and a node none of whose subscriptions is matched with it."""
    listeners: dict[str, list[Endpoint]] = {}
    publishers = list(seen.publishers)
    entry = topic(seen.contract)
    if seen.contract == 'cmd_vel' and not any(_is_ours(end) for end in publishers):
        # Of the policy_node that is going to run. Types are another check's matter.
        publishers += [Endpoint('policy_node', kind, entry.reliability, entry.durability)
                       for kind in sorted({end.type for end in seen.subscribers})]
    for end in seen.subscribers:
        listeners.setdefault(end.node, []).append(end)
    for publisher in publishers:
        for node, ends in listeners.items():
            same = [end for end in ends if end.type == publisher.type]
            if not same or any(end.hears(publisher) for end in same):
                continue
            ours = _is_ours(publisher) or publisher.node == 'policy_node' or any(map(_is_ours,
                                                                                     ends))
            latched = all(end.durability == LATCHED for end in same) and (
                publisher.durability != LATCHED)
            what = (f'{node} asks for transient local and {publisher.node} offers volatile'
                    if latched else
                    f'{node} asks for reliable and {publisher.node} offers best effort')
            fix = (f'set the durability of the subscription of {node} to volatile' if latched else
                   f'set the reliability of the subscription of {node} to best_effort, or of the '
                   f'publisher {publisher.node} to reliable')
            yield Finding('qos', ERROR if ours or seen.contract == 'cmd_vel' else WARNING,
                          seen.name, f'{what}: not one message passes', _override(
                              fix, seen, 'durability' if latched else 'reliability', node))


def _override(fix: str, seen: SeenTopic, policy: str, node: str) -> str:
    value = 'volatile' if policy == 'durability' else 'best_effort'
    return (f'{fix}; where {node} allows it: --ros-args -p '
            f'qos_overrides.{seen.name}.subscription.{policy}:={value}')


def _offered(seen: SeenTopic) -> Iterator[Finding]:
    """Publishers that offer less than the contract has a listener ask for."""
    entry = topic(seen.contract)
    if seen.contract in COMMANDS:
        return  # ours
    for end in seen.publishers:
        if end.type != entry.type:
            continue
        if entry.reliability != BEST_EFFORT and end.reliability == BEST_EFFORT:
            yield Finding('qos', WARNING, seen.name, f'{end.node} offers best effort where the '
                          'contract has reliable: policy_node hears it, training in lock-step '
                          'does not, and messages may be lost',
                          f'set the reliability of the publisher {end.node} to reliable')
        if entry.durability == LATCHED and end.durability != LATCHED:
            yield Finding('qos', WARNING, seen.name, f'{end.node} offers volatile where the '
                          'contract has transient local: who starts later never hears it',
                          f'set the durability of the publisher {end.node} to transient_local'
                          + (', or use ros2 run vn_nav goal_node' if seen.contract == 'goal_image'
                             else ''))


def _is_ours(end: Endpoint) -> bool:
    return end.node.rpartition('/')[2] in OUR_DRIVERS
