"""Checks of the way from the policy's commands to the wheels."""

from __future__ import annotations

from collections.abc import Iterator

from vn_nav.doctor.seen import ERROR, OK, OUR_DRIVERS, WARNING, Endpoint, Finding, Graph

LONGEST_STOP_S = 1.0  # from the last command to rest, of a base that stops by itself
MIN_TURN_RAD = 0.05  # that a base which hears commands has turned in the trial
TWIST, STAMPED = 'geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped'
# In the name of a parameter that says for how long a command holds.
OF_COMMANDS = ('cmd', 'command', 'vel', 'twist', 'watchdog')
SET_TIMEOUT = ('set the time-out of the base driver to 0.5 s (diff_drive_controller: '
               'cmd_vel_timeout, velocity_smoother: velocity_timeout, twist_mux: timeout)')


def command(graph: Graph) -> Iterator[Finding]:
    """Who else commands the base, and whether it understands us."""
    seen = graph.topics.get('cmd_vel')
    if seen is None:
        return
    ours = [end for end in seen.publishers if _is_ours(end)]
    others = [end.node for end in seen.publishers if not _is_ours(end)]
    if others or len(ours) > 1:
        names = sorted({*others, *(end.node for end in ours[1:])})
        yield Finding('command', ERROR, seen.name, f'{", ".join(names)} publish'
                      f'{"es" if len(names) == 1 else ""} commands too: policy_node refuses to '
                      'drive beside another', f'end it (ros2 node info {names[0]}), or '
                      f'policy_node --ros-args -r cmd_vel:={seen.name}_policy as an input of '
                      'twist_mux')
    if not seen.subscribers:
        yield Finding('command', ERROR, seen.name, 'nobody subscribes to it: the base hears '
                      'nothing', 'start the base driver, or policy_node --ros-args -r '
                      'cmd_vel:=/the/topic/of/the/base and here --topics with command: that name')
        return
    mine = STAMPED if graph.operation.stamped else TWIST
    wrong = [end for end in seen.subscribers if end.type != mine]
    right = [end for end in seen.subscribers if end.type == mine]
    for end in wrong:
        if end.type in (TWIST, STAMPED):
            yield Finding('command', ERROR, seen.name, f'{end.node} subscribes to {end.type} '
                          f'where policy_node sends {mine}', 'policy_node --ros-args -p '
                          f'enable_stamped_cmd_vel:={str(end.type == STAMPED).lower()}'
                          + (f' (but {right[0].node} wants {mine})' if right else ''))
        else:
            yield Finding('command', ERROR, seen.name, f'{end.node} subscribes to {end.type}, '
                          'which is no command', f'remap it away from {seen.name}')
    if right and not wrong and not others:
        yield Finding('command', OK, seen.name, f'{", ".join(end.node for end in right)} '
                      f'listen{"s" if len(right) == 1 else ""} to {mine}')


def is_command_timeout(name: str) -> bool:
    """Whether a parameter says for how long a node follows a command.

    As `cmd_vel_timeout`, `velocity_timeout`, and twist_mux's `topics.policy.timeout`; not its
    `locks.pause.timeout`, whose 0 means that nobody has to repeat it: with a time-out there a
    silent lock holds the robot for ever. Not `source_timeout`, `transform_timeout` and the like.
    """
    *groups, last = name.split('.')
    return 'locks' not in groups and (last == 'timeout' or 'timeout' in last and any(
        word in last for word in OF_COMMANDS))


def base_timeout(graph: Graph) -> Iterator[Finding]:
    """What stops the base where the policy's process is gone."""
    seen = graph.topics.get('cmd_vel')
    if seen is None or not seen.subscribers:
        return
    if graph.base_stop is not None:
        yield _tried(graph, seen.name)
        return
    for node, name, value in graph.timeouts:
        if value <= 0:
            yield Finding('base time-out', ERROR, seen.name, f'{node} has {name} = {value:g}: it '
                          'repeats the last command for ever',
                          f'ros2 param set {node} {name} 0.5')
        elif value > LONGEST_STOP_S:
            yield Finding('base time-out', WARNING, seen.name, f'{node} has {name} = {value:g} s',
                          f'ros2 param set {node} {name} 0.5')
        else:
            yield Finding('base time-out', OK, seen.name, f'{node} has {name} = {value:g} s')
    if not graph.timeouts:
        nodes = ', '.join(sorted({end.node for end in seen.subscribers}))
        yield Finding('base time-out', WARNING, seen.name, f'{nodes} shows no parameter of a '
                      'time-out: unknown whether the base stops without commands',
                      'vn_nav doctor --base-check, with free space around the robot: it turns a '
                      'little, falls silent, and measures')


def _tried(graph: Graph, name: str) -> Finding:
    stop = graph.base_stop
    assert stop is not None
    if abs(stop.turned) < MIN_TURN_RAD:
        return Finding('base time-out', ERROR, name, 'the base did not turn when it was commanded',
                       'switch its motors on, release the emergency stop, and check the chain of '
                       f'nodes: ros2 topic info -v {name}')
    if stop.turned < 0:
        return Finding('base time-out', ERROR, name, 'the base turned to the right by odometry '
                       'when it was commanded to the left', 'correct the signs of the base driver '
                       '(REP 103: positive is left)')
    if stop.seconds is None:
        return Finding('base time-out', ERROR, name, 'the base went on turning without commands '
                       'until it was sent zero', SET_TIMEOUT)
    shown = f'the base stood still {stop.seconds:.1f} s after the last command'
    if stop.seconds > LONGEST_STOP_S:
        return Finding('base time-out', WARNING, name, shown, SET_TIMEOUT)
    return Finding('base time-out', OK, name, shown)


def _is_ours(end: Endpoint) -> bool:
    return end.node.rpartition('/')[2] in OUR_DRIVERS
