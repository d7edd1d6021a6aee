"""The robot's place in a shadow: what the policy node is shown, and what it says to it."""

from __future__ import annotations

import collections
import dataclasses
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, LaserScan
from std_msgs.msg import Bool, Int8, String
from std_srvs.srv import SetBool

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import twist_to_array
from vn_msgs_py.topics import Topic, topic
from vn_nav.bags.shadow.plan import STAMP_RESOLUTION_NS, Decision, Event, Plan, stamped
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.errors import UserError
from vn_nav.nodes.policy_node import SHADOW_LIMIT_S
from vn_nav.nodes.process import Ended
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.nodes.qos import qos
from vn_nav.nodes.service_call import ServiceCall
from vn_nav.nodes.shadow_domain import Domain

GRAPH_PERIOD_S = 0.25  # s between looks at who is there
ANSWER_TIMEOUT_S = 120.0  # s for an answer: a busy machine starts the node slowly
DIAGNOSTICS_TIMEOUT_S = 5.0  # s for diagnostics after the last decision
REPEAT_PERIOD_S = 0.3  # s without a picture, or an answer to it, after which it is shown again
ARMING_NS = 10_000_000_000, 1_000_000  # ns before the drive, and between the pictures there
# What the policy publishes, by the names that the node gives it.
SUBSCRIBED = {'shadow/cmd_vel': Twist, 'action': Int8, 'action_names': String, 'arrived': Bool,
              'diagnostics': DiagnosticArray}
# What it is shown, besides the pictures.
PUBLISHED = {'camera_info': CameraInfo, 'goal_camera_info': CameraInfo,
             'odom': Odometry, 'goal_image': Image, 'clock': Clock,
             'executed_action': String}
# Of a policy that searches.
MAPS = {'policy_node/map': OccupancyGrid, 'policy_node/hypotheses': PoseArray}
ABSOLUTE = ('clock', 'diagnostics')  # in the contract; here they are in the namespace as well


SCAN, DEPTH, DEPTH_INFO = 'scan', 'depth/image_raw', 'depth/camera_info'


class _Interrupted(Exception):
    """A signal has come."""


def shadow_topics(searches: bool) -> list[Topic]:
    """What the second bag holds. Below /shadow: playing it moves no robot either.

    Args:
        searches: the policy has a map.
    """
    return [dataclasses.replace(topic(_contract(name)), name=in_bag(name))
            for name in (*SUBSCRIBED, *(MAPS if searches else ()), 'goal_image',
                         'executed_action')]


def in_bag(name: str) -> str:
    """The name of a topic in the second bag."""
    return f'/shadow/{name.removeprefix("shadow/")}'


def _range_topics(plan: Plan) -> dict[str, type]:
    """What measured ranges come on, if they are asked for."""
    if not plan.ranges:
        return {}
    return {SCAN: LaserScan} if plan.depth_info is None else {DEPTH: Image, DEPTH_INFO: CameraInfo}


def range_parameters(plan: Plan, mount: tuple[float, float, float]) -> dict[str, str | float]:
    """Parameters of the node for measured ranges; mount: of the sensor, see `shadow.drive`."""
    if not plan.ranges:
        return {}
    where = dict(zip(('scan_x', 'scan_y', 'scan_yaw'), map(float, mount), strict=True))
    return where | ({'scan_topic': SCAN} if plan.depth_info is None else {'depth_topic': DEPTH})


def _contract(name: str) -> str:
    return f'/{name}' if name in ABSOLUTE else name


class Stage:
    """This process in the place of the robot, and the recorder of what the policy says.

    Args:
        plan: the drive.
        domain: where the policy node is.
        bag: for what it says.
        processes: with the child `policy`.
        ended: says that a signal has come.
        searches: the policy has a map, which it publishes after each decision.
    """

    def __init__(self, plan: Plan, domain: Domain, bag: BagWriter, processes: Processes,
                 ended: Ended, *, searches: bool = False):
        self._plan, self._domain, self._bag = plan, domain, bag
        self._processes, self._ended = processes, ended
        self.latencies: list[float] = []
        self._node = node = domain.node
        image, kind = (('image_raw/compressed', CompressedImage) if plan.compressed
                       else ('image_raw', Image))
        self._out = {name: node.create_publisher(kind, name, qos(_contract(name)))
                     for name, kind in (PUBLISHED | {image: kind} | _range_topics(plan)).items()}
        self._image = self._out[image]
        self._enabler = node.create_client(SetBool, 'policy_node/enable')
        callbacks = {
            'shadow/cmd_vel': self._on_command, 'action': self._on_action,
            'action_names': self._on_names, 'arrived': self._on_arrived,
            'diagnostics': self._on_diagnostics,
            **dict.fromkeys(MAPS, self._on_map)}
        for name, kind in (SUBSCRIBED | (MAPS if searches else {})).items():
            node.create_subscription(kind, name, self._recording(name, kind, callbacks[name]),
                                     qos(_contract(name), depth=100), raw=True)
        self._log_time = 0  # ns, by which the second bag has what is said now
        self._now = 0  # ns, of the node's clock
        self._look_at = 0.0
        self._names: list[str] = []
        self._commands: list[np.ndarray] = []  # that were not waited for yet
        self._rests = True  # says the last command
        self._choice: str | None = None  # what the policy has said of the picture
        self._statements = 0  # on `arrived`
        self._has_arrived = False
        self._diagnosis: dict[str, str] = {}
        self._episode: int | None = None
        self._pose = serialize_message(Odometry())  # where there is no odometry: it stands
        self._pose_stamp = 0
        self._picture: bytes | None = None
        self._picture_stamp = 0
        self._shown_at = 0.0
        self._ranges: bytes | None = None  # beside the picture
        self._maps: collections.Counter[int] = collections.Counter()  # by stamp [ns]
        self._maps_each = len(MAPS) if searches else 0  # of a decision

    # What the policy says.

    def _recording(self, name: str, kind: type, handle: Callable) -> Callable[[bytes], None]:
        def take(data: bytes) -> None:
            self._bag.write(in_bag(name), data, self._log_time)
            handle(deserialize_message(data, kind))
        return take

    def _on_command(self, message: Twist) -> None:
        self._commands.append(twist_to_array(message))

    def _on_action(self, message: Int8) -> None:
        self._choice = self._names[message.data]

    def _on_names(self, message: String) -> None:
        self._names = json.loads(message.data)

    def _on_arrived(self, message: Bool) -> None:
        self._statements += 1
        self._has_arrived = message.data
        if message.data:
            self._choice = 'arrived'

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._diagnosis = {pair.key: pair.value for pair in message.status[0].values}

    def _on_map(self, message: OccupancyGrid | PoseArray) -> None:
        stamp = message.header.stamp
        self._maps[stamp.sec * 10**9 + stamp.nanosec] += 1

    # What it is shown.

    def play(self) -> bool:
        """Show the drive, from its beginning to its end; False: a signal has ended it."""
        try:
            for event in self._plan.events():
                self._check()
                if event is not None:
                    self._take(event)
                if self._picture and time.monotonic() - self._shown_at > REPEAT_PERIOD_S:
                    self._show(self._picture, 0)  # the node's watchdog looks at the wall clock
            self._wait_for_last_counts()
        except _Interrupted:
            return False
        return True

    def _wait_for_last_counts(self) -> None:
        """Diagnostics come once a second: those after the last decision belong in the bag."""
        end = time.monotonic() + DIAGNOSTICS_TIMEOUT_S
        while self._counted() < len(self.latencies) and time.monotonic() < end:
            self._check()
            self._domain.executor.spin_once(timeout_sec=0.05)

    def _counted(self) -> int:
        """Decisions in the newest diagnostics, by what counts them."""
        said = self._diagnosis
        if self._plan.ranges:
            return int(said.get('ranges_used', 0)) + int(said.get('ranges_missed', 0))
        return int(said.get('filter_decisions', len(self.latencies)))

    def _take(self, event: Event) -> None:
        self._log_time = max(self._log_time, event.log_time)
        if event.decision is not None:
            self._decide(event, event.decision)
        elif event.picture:
            self._show(event.picture_data, event.stamp)
        else:
            self._pose = event.data or self._pose
            self._tick(event.stamp)

    def _decide(self, event: Event, decision: Decision) -> None:
        """Show a picture and receive what the policy would do there."""
        if decision.episode != self._episode:
            self._begin(event, decision.episode)
        elif self._has_arrived:
            self._look_again()
        stamp = max(event.stamp, self._picture_stamp + STAMP_RESOLUTION_NS)
        said: dict[str, Any] = {'stamp': divmod(stamp, 10**9), 'action': decision.done,
                                'odometry': decision.pose}
        if self._plan.ranges:
            near = event.ranges
            said['ranges'] = None if near is None else {
                'stamp': divmod(near.stamp, 10**9), 'odometry': near.pose}
            self._ranges = None if near is None else stamped(near.data, near.stamp)
        executed = String(data=json.dumps(said))
        self._out['executed_action'].publish(executed)
        self._bag.write(in_bag('executed_action'), serialize_message(executed), self._log_time)
        self._choice, begun = None, time.monotonic()
        self._show(event.picture_data, stamp)
        self._until(lambda: self._choice is not None, 'a decision', resend=True)
        self.latencies.append(time.monotonic() - begun)
        self._until(lambda: self._maps[stamp] >= self._maps_each, 'the map')
        self._maps.clear()
        self._ranges = None
        if self.latencies[-1] > SHADOW_LIMIT_S:  # the node has discarded it
            raise UserError(f'a decision takes less than {SHADOW_LIMIT_S:g} s',
                            f'{self.latencies[-1]:.1f} s',
                            'try again when the machine is less busy')
        if self._rests and not self._has_arrived:
            self._take_command()  # the first of a motion comes by itself
        else:
            self._tick(stamp)

    def _begin(self, event: Event, episode: int) -> None:
        """Show the goal of an episode."""
        picture = self._plan.goals.picture(episode)
        if picture is None:
            raise UserError('an episode has a goal picture that can be decoded',
                            f'episode {episode}', 'give one with --goal')
        if self._episode is None:
            self._until(self._is_matched, 'the policy node to appear')
            self._until(lambda: self._statements and self._names, 'the policy node to be active')
        elif self._has_arrived:
            self._look_again()
        goal = fill_image(Image(), picture.picture)
        goal.header.stamp.sec, goal.header.stamp.nanosec = divmod(
            event.stamp - 2 * STAMP_RESOLUTION_NS, 10**9)
        if picture.fov is not None:
            self._out['goal_camera_info'].publish(fill_camera_info(
                CameraInfo(header=goal.header), goal.width, goal.height, picture.fov))
        said = self._statements
        self._out['goal_image'].publish(goal)
        self._bag.write(in_bag('goal_image'), serialize_message(goal), self._log_time)
        self._until(lambda: self._statements > said, 'an answer to the goal picture')
        if self._episode is None:
            self._arm(event)
        self._tick(event.stamp)  # a new goal holds the node until the next command
        self._episode = episode

    def _is_matched(self) -> bool:
        return self._enabler.service_is_ready() and all(
            publisher.get_subscription_count() for publisher in self._out.values())

    def _arm(self, event: Event) -> None:
        """Show healthy pictures until the node may be enabled."""
        (before, step), end = ARMING_NS, time.monotonic() + ANSWER_TIMEOUT_S
        stamp, ask_at, answer = event.stamp - before, 0.0, 'nothing'
        # Once, and long before the node may move: whatever comes after that is answered.
        self._out['odom'].publish(stamped(self._pose, event.stamp))
        while True:
            stamp += step
            self._image.publish(stamped(event.picture_data, stamp))
            if self._plan.camera_info is not None:
                self._out['camera_info'].publish(stamped(self._plan.camera_info, event.stamp))
            if self._plan.depth_info is not None:
                self._out[DEPTH_INFO].publish(stamped(self._plan.depth_info, event.stamp))
            self._domain.executor.spin_once(timeout_sec=0.03)
            self._check()
            camera = self._diagnosis.get('camera_fov_deg', 'unknown') != 'unknown'
            if time.monotonic() > ask_at and (camera or self._plan.camera_info is None):
                granted, answer = self._enable()
                if granted:
                    return
                ask_at = time.monotonic() + GRAPH_PERIOD_S
            if time.monotonic() > end:
                raise UserError('the policy node can be enabled', answer,
                                'see the reasons in its diagnostics')

    def _look_again(self) -> None:
        """After a statement of arrival: on with the same goal, with an empty memory."""
        said = self._statements
        granted, answer = self._enable()
        if not granted:
            raise UserError('the policy node can be enabled again', answer,
                            'try again when the machine is less busy')
        self._until(lambda: self._statements > said, 'the end of the declared stop')

    def _enable(self) -> tuple[bool, str]:
        call = ServiceCall(self._enabler, SetBool.Request(data=True))
        self._until(call.is_answered, 'an answer of ~/enable')
        return call.answer.success, call.answer.message

    def _show(self, data: bytes, stamp: int) -> None:
        self._picture_stamp = max(stamp, self._picture_stamp + STAMP_RESOLUTION_NS)
        self._picture = stamped(data, self._picture_stamp)
        self._set_clock(self._picture_stamp)
        self._publish_picture()

    def _publish_picture(self) -> None:
        """The picture, and what was measured with it."""
        if self._ranges is not None:
            self._out[SCAN if self._plan.depth_info is None else DEPTH].publish(self._ranges)
        self._image.publish(self._picture)
        self._shown_at = time.monotonic()

    def _tick(self, stamp: int) -> None:
        """Odometry, which the node answers with a command."""
        self._pose_stamp = max(self._pose_stamp, stamp)
        self._check_unasked()
        self._set_clock(self._pose_stamp)
        self._out['odom'].publish(stamped(self._pose, self._pose_stamp))
        self._take_command()

    def _set_clock(self, stamp: int) -> None:
        if stamp > self._now:
            self._now = stamp
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(stamp, 10**9)
            self._out['clock'].publish(clock)

    def _take_command(self) -> None:
        self._until(lambda: self._commands, 'a command')
        self._rests = not self._commands.pop(0).any()
        self._check_unasked()

    def _check_unasked(self) -> None:
        if self._commands:
            raise UserError('the policy node answers with one command',
                            f'{len(self._commands)} more', 'report this')

    # Waiting.

    def _until(self, condition: Callable, what: str, *, resend: bool = False) -> None:
        """Serve what comes in until a condition holds."""
        end = time.monotonic() + ANSWER_TIMEOUT_S
        while not condition():
            self._check()
            if time.monotonic() > end:
                raise UserError(f'the policy node answers within {ANSWER_TIMEOUT_S:g} s',
                                f'waited for {what}; it says {self._state()}',
                                'try again when the machine is less busy')
            if resend and time.monotonic() - self._shown_at > REPEAT_PERIOD_S:
                self._publish_picture()  # pictures may be lost; it knows one that it has
            self._domain.executor.spin_once(timeout_sec=0.05)

    def _check(self) -> None:
        """Whether it may go on: nobody else is there, the node lives, and no signal has come."""
        if self._ended.is_set():
            raise _Interrupted
        now = time.monotonic()
        if now < self._look_at:
            return
        self._look_at = now + GRAPH_PERIOD_S
        self._processes.check('policy')
        if self._processes.running['policy'].poll() is not None:
            raise ProcessFailure('the policy node has ended')
        if strangers := self._domain.strangers():
            raise UserError('shadow mode has its ROS domain for itself',
                            f'domain {self._domain.number}: {", ".join(strangers)}',
                            'end it, or run again: another domain is taken')
        if self._diagnosis.get('state') == 'stopped':
            raise UserError('the policy node goes on to the end of the drive', self._state(),
                            'try again when the machine is less busy')

    def _state(self) -> str:
        return ': '.join(filter(None, (self._diagnosis.get(key, '') for key in (
            'state', 'reason')))) or 'nothing'
