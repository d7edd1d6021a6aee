"""Checks of what comes on the topics: pictures, rates, losses, clocks, odometry."""

from __future__ import annotations

from collections.abc import Iterator

from vn_nav.bags.doctor.bag_checks import CLOCK_SKEW_NS
from vn_nav.bags.stamped import STAMP_WINDOW_S
from vn_nav.doctor.seen import ERROR, OK, WARNING, Finding, Graph, SeenTopic, Stream
from vn_nav.doctor.topic_checks import DEFAULT_SEGMENT_BYTES, FAST_DDS, set_profile

MAX_LOST_SHARE = 0.01  # of the pictures: more is a finding
LARGE_STREAM_BYTES_PER_S = 10e6  # more is compressed before it goes through a network
MOST_OF_LIMIT = 0.7  # of max_frame_age: with more there is no room for load
# s by which a stamp and a clock differ where one is simulated and the other not: a year
ANOTHER_TIME_S = 3e7
SYNCHRONISE = 'synchronise the clocks of both computers (sudo chronyc makestep)'


def pictures(graph: Graph) -> Iterator[Finding]:
    """Whether the pictures can be read."""
    for contract in ('image_raw', 'image_raw/compressed', 'goal_image'):
        seen = graph.topics.get(contract)
        if seen is None or seen.stream is None or not seen.stream.count:
            continue
        if seen.stream.fault:
            yield Finding('pictures', ERROR, seen.name, f'cannot be read: {seen.stream.fault}',
                          "set the driver's encoding to rgb8 (usb_cam: pixel_format, "
                          'v4l2_camera: output_encoding), or convert it with image_proc')
        elif len(seen.stream.pictures) > 1 and contract != 'goal_image':
            yield Finding('pictures', ERROR, seen.name, 'changes between '
                          f'{", ".join(seen.stream.pictures)}', 'end all but one of its '
                          f'publishers: ros2 topic info -v {seen.name}')
        elif seen.stream.pictures:
            yield Finding('pictures', OK, seen.name, seen.stream.pictures[0])


def rates(graph: Graph) -> Iterator[Finding]:
    """Whether pictures and odometry come often enough for the watchdog."""
    limits = graph.operation.limits
    for seen in _streams(graph):
        stream = seen.stream
        assert stream is not None
        camera = seen is graph.pictures
        limit, name = ((limits.frame_timeout, 'frame_timeout') if camera else
                       (limits.odometry_timeout, 'odometry_timeout'))
        if stream.period is None:
            yield Finding('rate', ERROR, seen.name, f'came once in {graph.seconds:.1f} s',
                          f'ros2 topic hz {seen.name}; raise the rate of its driver')
            continue
        shown = f'{1 / stream.period:.1f} Hz, at worst {stream.worst_gap:.2f} s apart'
        if stream.period > limit:
            yield Finding('rate', ERROR, seen.name, f'{shown}: the robot stands still after '
                          f'{limit:g} s without it', 'raise the rate of its driver, or '
                          + _patience(graph, name, stream))
        elif not camera and stream.period > 2 * STAMP_WINDOW_S:
            yield Finding('rate', WARNING, seen.name, f'{shown}: pictures find no pose within '
                          f'{STAMP_WINDOW_S * 1e3:.0f} ms of their stamp',
                          f'publish it at {1 / STAMP_WINDOW_S:.0f} Hz')
        elif stream.worst_gap > limit:
            yield Finding('rate', WARNING, seen.name, f'{shown}: longer than {name} ({limit:g} '
                          's), so that the robot stops on its way', 'look for load (top), Wi-Fi '
                          'or the driver; or ' + _patience(graph, name, stream))
        else:
            yield Finding('rate', OK, seen.name, shown)


def losses(graph: Graph) -> Iterator[Finding]:
    """Pictures and odometry that were published and did not come."""
    for seen in _streams(graph):
        stream = seen.stream
        assert stream is not None
        sent = stream.count + stream.lost
        if stream.lost <= MAX_LOST_SHARE * sent:
            yield Finding('loss', OK, seen.name, f'{stream.lost} of {sent} lost')
        else:
            yield Finding('loss', WARNING if stream.lost < 0.5 * sent else ERROR, seen.name,
                          f'{stream.lost} of {sent} messages were lost on the way',
                          _cure(graph, seen, stream))


def _cure(graph: Graph, seen: SeenTopic, stream: Stream) -> str:
    own = graph.middleware
    if (stream.bytes > DEFAULT_SEGMENT_BYTES and own.implementation == FAST_DDS
            and not own.profile):
        return set_profile(own)
    if seen.contract == 'image_raw' and (
            stream.bytes * (stream.count + stream.lost) > LARGE_STREAM_BYTES_PER_S
            * graph.seconds):
        return ('over a network use compressed pictures: policy_node --ros-args -p '
                'image_transport:=compressed (the camera driver with image_transport_plugins); or '
                'a smaller picture')
    return ('look for load on both computers (top) and the Wi-Fi (ping); have the publisher offer '
            'best effort: a reliable one that repeats over Wi-Fi falls behind')


def clocks(graph: Graph) -> Iterator[Finding]:
    """Stamps against the clock that the policy will have, and against each other."""
    yield from _time(graph)
    lags = {}
    for seen in _streams(graph):
        stream = seen.stream
        assert stream is not None
        if stream.zero:
            yield Finding('stamps', ERROR, seen.name, f'{stream.zero} of {stream.count} stamps '
                          'are zero', 'have its driver stamp what it publishes; with '
                          'use_sim_time it needs a /clock')
            continue
        if stream.repeated > stream.count // 2:
            yield Finding('stamps', ERROR, seen.name, f'{stream.repeated} of {stream.count} '
                          'stamps are as the one before: such messages are dropped',
                          'restart its driver: ros2 topic echo --field header.stamp '
                          f'{seen.name} has to go on')
            continue
        if stream.repeated or stream.back:
            yield Finding('stamps', WARNING, seen.name, f'{stream.repeated} stamps come twice and '
                          f'{stream.back} go back, of {stream.count}: such messages are dropped',
                          f'end all but one of its publishers: ros2 topic info -v {seen.name}')
        lag = stream.simulated_lag if _simulated(graph) else stream.lag
        if lag is not None:
            lags[seen.name] = lag
            yield from _lag(graph, seen, lag)
    if len(lags) == 2:
        (first, a), (second, b) = lags.items()
        if abs(a - b) > CLOCK_SKEW_NS * 1e-9:
            yield Finding('clock', ERROR, first, f'its stamps and those of {second} differ by '
                          f'{abs(a - b):.2f} s at the same time: poses do not belong to pictures',
                          f'{SYNCHRONISE}, or stamp both on one')


def _time(graph: Graph) -> Iterator[Finding]:
    """Which time is it: /clock or the wall clock?"""
    use = graph.operation.use_sim_time
    if len(graph.clocks) > 1:
        yield Finding('time', ERROR, '/clock', f'has several publishers: '
                      f'{", ".join(graph.clocks)}', 'end all but one, or give each robot a '
                      'namespace and its nodes -r /clock:=clock')
    if graph.clocks and use is None:
        yield Finding('time', OK, '/clock', f'{graph.clocks[0]} publishes simulated time',
                      'start every node with --ros-args -p use_sim_time:=true')
    elif graph.clocks and not use:
        yield Finding('time', WARNING, '/clock', f'{graph.clocks[0]} publishes simulated time, '
                      'and use_sim_time is false',
                      'policy_node --ros-args -p use_sim_time:=true')
    elif use and not graph.clocks:
        yield Finding('time', ERROR, '/clock', 'use_sim_time is true, and nobody publishes /clock',
                      'start the simulator (a bag: ros2 bag play --clock), or policy_node '
                      '--ros-args -p use_sim_time:=false')
    else:
        yield Finding('time', OK, '', 'simulated' if use else 'wall clock')


def _lag(graph: Graph, seen: SeenTopic, lag: float) -> Iterator[Finding]:
    limits, camera = graph.operation.limits, seen is graph.pictures
    simulated = _simulated(graph)
    clock = '/clock' if simulated else "this computer's clock"
    shown = f'stamps lie {_seconds(lag)} {"behind" if lag >= 0 else "ahead of"} {clock}'
    if abs(lag) > ANOTHER_TIME_S:
        yield Finding('clock', ERROR, seen.name, f'{shown}: they are of another time',
                      f'set use_sim_time to {str(not simulated).lower()} for policy_node, or give '
                      'its driver the same use_sim_time')
        return
    # Odometry is not judged by its age, but pictures take their poses from it.
    too_old, too_new = lag > limits.max_frame_age, lag < -limits.max_frame_ahead
    if camera and MOST_OF_LIMIT * limits.max_frame_age < lag <= limits.max_frame_age:
        yield Finding('clock', WARNING, seen.name, f'{shown}, the limit is '
                      f'{limits.max_frame_age:g} s: on a busy computer frames are dropped',
                      f'policy_node --ros-args -p max_frame_age:={_above(lag)}')
        return
    if not (too_old or too_new):
        yield Finding('clock', OK, seen.name, shown)
        return
    name, limit = (('max_frame_age', limits.max_frame_age) if too_old else
                   ('max_frame_ahead', limits.max_frame_ahead))
    yield Finding('clock', ERROR if camera else WARNING, seen.name, f'{shown}, the limit is '
                  f'{limit:g} s' + (': all frames are dropped' if camera else ''),
                  SYNCHRONISE + (f'; if it has to be so: policy_node --ros-args '
                                 f'-p {name}:={_above(abs(lag))}' if abs(lag) < 4 else
                                 f'; restart its driver: ros2 topic echo --field header.stamp '
                                 f'{seen.name}'))


def odometry(graph: Graph) -> Iterator[Finding]:
    """Frames and numbers of odometry."""
    seen = graph.topics.get('odom')
    if seen is None or seen.stream is None or not seen.stream.count:
        return
    if seen.stream.fault:
        yield Finding('odometry', ERROR, seen.name, seen.stream.fault, 'restart the base driver')
        return
    frames = seen.stream.frames
    if len(frames) > 1:
        yield Finding('odometry', ERROR, seen.name, 'has several frames: ' + ', '.join(
            f'{frame} to {child}' for frame, child in frames), 'end all but one of its '
            f'publishers: ros2 topic info -v {seen.name}')
        return
    frame, child = frames[0]
    empty = [name for name, value in (('frame_id', frame), ('child_frame_id', child)) if not value]
    if empty:
        yield Finding('odometry', WARNING, seen.name, f'{" and ".join(empty)} empty: other nodes '
                      'cannot place it', "set the driver's odom_frame_id to odom and "
                      'base_frame_id to base_link')
    elif frame == child:
        yield Finding('odometry', ERROR, seen.name, f'is from {frame} to itself',
                      "set the driver's odom_frame_id to odom and base_frame_id to base_link")
    elif frame.rpartition('/')[2] == 'map':
        yield Finding('odometry', WARNING, seen.name, 'is in map: a localisation that corrects '
                      'itself jumps, and a jump ends an action',
                      'policy_node --ros-args -r odom:=/odom, the wheel odometry')
    else:
        yield Finding('odometry', OK, seen.name, f'{frame} to {child}')


def _streams(graph: Graph) -> list[SeenTopic]:
    """Pictures and odometry, where something came."""
    return [seen for seen in (graph.pictures, graph.topics.get('odom'))
            if seen is not None and seen.stream is not None and seen.stream.count]


def _simulated(graph: Graph) -> bool:
    use = graph.operation.use_sim_time
    return bool(graph.clocks) if use is None else use


def _patience(graph: Graph, name: str, stream: Stream) -> str:
    """The command that has policy_node wait longer; the latched stop stays behind the hold."""
    value, stop = _above(stream.worst_gap), graph.operation.limits.frame_stop_timeout
    latched = (f' -p frame_stop_timeout:={2 * value:g}'
               if name == 'frame_timeout' and value >= stop else '')
    return f'policy_node --ros-args -p {name}:={value:g}{latched}'


def _above(seconds: float) -> float:
    """A parameter's value with some room above what was measured."""
    return round(1.5 * seconds + 0.05, 2)


def _seconds(value: float) -> str:
    value = abs(value)
    return f'{value:.3f} s' if value < 10 else f'{value:.4g} s'
