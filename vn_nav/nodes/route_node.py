"""`route_node`: drives a policy along a remembered route, to a place by its name.

Run: `ros2 run vn_nav route_node --ros-args -p route:=FOLDER`, beside policy_node with the same
checkpoint, and say where to: `vn_nav goal kitchen`. It shows policy_node one picture of the route
after the other, enables motion, and says on `route_status` how that goes. It publishes no command;
policy_node's ~/stop and ~/enable end a way along a route as they end any goal.
"""

from __future__ import annotations

import collections
import enum
import json
import sys
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from vn_nav.errors import UserError
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.camera_pictures import pictures_of
from vn_nav.nodes.goal_publisher import GoalPublisher
from vn_nav.nodes.process import Ended, run_node, spin
from vn_nav.nodes.qos import qos, subscribe
from vn_nav.nodes.said import read_said
from vn_nav.nodes.service_call import ServiceCall
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_record import Code
from vn_nav.policy.navigator import RESET_FIRST
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.routes.follower import RouteFollower
from vn_nav.routes.recognition import RouteEyes, Sighting
from vn_nav.routes.route import read_route

_SHARED = ('image_transport', 'rectify', 'camera_fov')
PARAMETERS = {
    'route': ('', 'folder of numbered pictures, of `vn_nav route` or a topomap of ViNT or NoMaD'),
    'place': ('', 'where to drive at once: a name or the number of a picture; empty: nowhere'),
    'max_decisions': (1000, 'of a way, after which it has failed; 0: any number', (0, 2**31 - 1)),
    'checkpoint': ('', 'of a policy that searches, as policy_node has it; empty: models/search'),
    'policy': ('policy_node', "name of the policy's node"),
    **{name: policy_parameters.PARAMETERS[name] for name in _SHARED},
}
# Why a picture was not reached; another one may be. Other failures are of the robot.
OF_THE_GOAL = Code.BUDGET, Code.NO_PROGRESS, Code.BLOCKED, Code.GOAL_REFUSED
PATIENCE_S = 10.0  # for a picture, and until motion can be enabled
GOAL_KEYS = 'goal', 'stamp', 'status', 'error_code', 'error_msg', 'decisions'
TEND_S = 0.1
AGAIN_S = 0.5  # until motion is asked for again
LEAVE_S = 1.0  # for the policy to hear at the end that it stops


class RouteStatus(enum.Enum):
    """Of the newest way along the route."""

    NONE = 'none'
    LOCATING = 'locating'  # waits for a picture
    ACTIVE = 'active'
    SUCCEEDED = 'succeeded'
    FAILED = 'failed'
    CANCELLED = 'cancelled'  # by a person, or by another goal


UNDER_WAY = (RouteStatus.LOCATING, RouteStatus.ACTIVE)


class RouteNode(Node):
    """See the module's docstring; which picture comes next says `vn_nav.routes.follower`."""

    def __init__(self):
        super().__init__('route_node')
        value = parameters.declare(self, PARAMETERS, read_only=True,
                                   others=policy_parameters.PARAMETERS)
        if not value['route']:
            raise UserError('route_node has a route', 'none',
                            'give its folder with -p route:=FOLDER')
        self._route = read_route(value['route'])
        for k in range(len(self._route)):
            self._route.picture(k)  # it can be read
        if value['place']:
            self._route.index(value['place'])
        self._runtime = PolicyRuntime(value['checkpoint'] or share_file('models/search'))
        if self._runtime.search is None:
            raise UserError('a route is driven along by the eyes of a policy that searches',
                            f'{value["checkpoint"]}, which does not search',
                            'give checkpoint:=models/search, here and to policy_node')
        self._most, self._decisions = value['max_decisions'], 0
        self._pictures = pictures_of(self, self._runtime, value)
        self._eyes: RouteEyes | None = None  # of the camera as it is known
        self._camera: Any = None  # message: the newest picture
        self._camera_at = 0.0  # steady time [s]
        self._follower: RouteFollower | None = None
        self._target = -1
        self._status, self._message, self._said = RouteStatus.NONE, '', ''
        self._policy_seen = time.monotonic()  # steady time of the newest look that found it [s]
        self._since = 0.0  # steady time of this status, or of the newest picture shown [s]
        self._number: int | None = None  # of policy_node's newest goal; None: it said nothing yet
        self._ours: tuple[int, int] | None = None  # stamp of the picture shown
        # Picture and stamp that policy_node says it is driving to.
        self._driven: tuple[int, tuple[int, int]] | None = None
        self._shown: collections.deque[tuple[int, int]] = collections.deque(maxlen=10)  # of late
        self._enables: ServiceCall | None = None
        self._goals = GoalPublisher(self)
        self._enable = self.create_client(SetBool, f'{value["policy"]}/enable')
        self._out = self.create_publisher(String, 'route_status', qos('route_status'))
        self.create_subscription(String, 'route_goal', self._on_place, qos('route_goal'))
        self._hears_goal = self.create_subscription(
            String, 'goal_status', self._on_goal_status, qos('goal_status'))
        self.create_subscription(String, 'goal_feedback', self._on_feedback, qos('goal_feedback'))
        compressed = value['image_transport'] == 'compressed'
        subscribe(self, CompressedImage if compressed else Image,
                  'image_raw/compressed' if compressed else 'image_raw', self._on_picture)
        subscribe(self, CameraInfo, 'camera_info', self._on_camera_info)
        self.create_timer(TEND_S, self._tend)
        self._say()
        self.get_logger().info(f'{len(self._route)} pictures; places: {self._route.named()}')
        if value['place']:
            self._set_out(value['place'])

    # What comes in.

    def _on_picture(self, message) -> None:
        self._camera, self._camera_at = message, time.monotonic()

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            camera = self._pictures.read_camera(message)
        except Exception as error:  # whatever somebody publishes there; policy_node says it, too
            self.get_logger().error(shorten(str(error) or repr(error)),
                                    throttle_duration_sec=10.0)
            return
        if camera is not None:
            self._pictures.camera, self._eyes = camera, None

    def _on_place(self, message: String) -> None:
        if message.data:
            self._set_out(message.data)
        elif self._status in UNDER_WAY:
            self._cancel('route_goal was empty')

    def _on_goal_status(self, message: String) -> None:
        said = read_said(self, 'goal_status', message, *GOAL_KEYS)
        if said is None:
            return
        before, self._number = self._number, said['goal']
        if self._driven is not None and (
                said['status'] != 'active' or tuple(said['stamp']) != self._driven[1]):
            self._driven = None
        if self._status is not RouteStatus.ACTIVE:
            return
        stamp = tuple(said['stamp'])
        if stamp == self._ours:
            self._take(said)
        elif before is not None and said['goal'] < before:
            self._cancel('policy_node began anew', RouteStatus.FAILED)
        elif before is not None and said['goal'] > before and stamp not in self._shown:
            self._end(RouteStatus.CANCELLED, 'another goal came')

    def _take(self, said: dict) -> None:
        """How it stands with the picture shown."""
        assert self._follower is not None  # there is a way
        status, why = said['status'], said['error_msg']
        if status == 'active':
            assert self._ours is not None  # it is of that picture
            self._enables, self._driven = None, (self._follower.shown, self._ours)
        elif status == 'waiting' and self._enables is None:
            self._end(RouteStatus.CANCELLED, 'motion was disabled')
        elif status == 'succeeded' and self._follower.shown == self._target:
            self._end(RouteStatus.SUCCEEDED)
        elif status == 'succeeded':
            self._go_on(self._follower.arrived)
        elif status == 'failed' and said['error_code'] in OF_THE_GOAL:
            self._go_on(self._follower.failed, why)
        elif status == 'failed':
            self._end(RouteStatus.FAILED, why)
        elif status == 'cancelled':
            self._end(RouteStatus.CANCELLED, why)

    def _on_feedback(self, message: String) -> None:
        said = read_said(self, 'goal_feedback', message, *GOAL_KEYS, 'distance_remaining')
        if said is None:
            return
        if self._status is RouteStatus.ACTIVE and tuple(said['stamp']) == self._ours and (
                said['status'] == 'active' and self._follower is not None):
            follower = self._follower
            self._decisions += 1
            if 0 < self._most <= self._decisions:
                self._cancel(f'{self._decisions} decisions are used up', RouteStatus.FAILED)
                return
            found = self._seeing(lambda look: follower.decided(
                said['decisions'], said['distance_remaining'], look))
            if found is not None:
                self._show(found)
            self._say()

    # What is done.

    def _set_out(self, place: str) -> None:
        """Another way along the route."""
        self._said = ''  # whoever asks gets an answer
        try:
            target = self._route.index(place)
        except UserError as error:
            self.get_logger().error(str(error))
            self._cancel(str(error), RouteStatus.FAILED)
            return
        self._target, self._follower, self._ours = target, RouteFollower(
            len(self._route), target), None
        self._decisions = 0
        self._status, self._message, self._since = RouteStatus.LOCATING, '', time.monotonic()
        self._say()

    def _tend(self) -> None:
        """Begin once there is a picture; enable motion, once: later a person may disable it."""
        now = time.monotonic()
        late = now - self._since > PATIENCE_S
        if self._status is RouteStatus.LOCATING:
            if self._camera_at > self._since and self._number is not None:
                assert self._follower is not None  # it has set out
                self._status, self._enables = RouteStatus.ACTIVE, self._allow()
                self._go_on(self._follower.begin)
            elif late:
                self._cancel('no goal_status of policy_node' if self._number is None
                             else 'no picture of the camera', RouteStatus.FAILED)
        elif self._status is RouteStatus.ACTIVE and self._is_policy_gone(now):
            self._cancel('policy_node is gone', RouteStatus.FAILED)
        elif self._status is RouteStatus.ACTIVE and self._enables is not None:
            answered = self._enable.service_is_ready() and self._enables.is_answered()
            if answered and not self._enables.answer.success:
                self._message = self._enables.answer.message
                late = late or RESET_FIRST in self._message  # a person's to do
                self._enables = self._allow()  # frames have to be healthy for a second
            if late:
                self._cancel(f'motion was not enabled: '
                             f'{self._message or "policy_node does not answer"}',
                             RouteStatus.FAILED)

    def _is_policy_gone(self, now: float) -> bool:
        """Nobody has published goal_status for a while."""
        if self.count_publishers(self._hears_goal.topic_name):
            self._policy_seen = now
        return now - self._policy_seen > PATIENCE_S

    def _allow(self) -> ServiceCall:
        return ServiceCall(self._enable, SetBool.Request(data=True), again=AGAIN_S)

    def _go_on(self, step, why: str = '') -> None:
        """Show what the follower says comes next."""
        found = self._seeing(step)
        if found is None:
            self._end(RouteStatus.FAILED, why)
        else:
            self._show(found)
        self._say()

    def _seeing(self, step):
        """Let the follower look at the newest picture, which is decoded once."""
        seen: list[np.ndarray] = []

        def look(rows: np.ndarray) -> Sighting:
            try:
                if self._eyes is None:
                    self._eyes = self._new_eyes()
                if not seen:
                    seen.append(self._pictures.of(self._camera)[0])
            except Exception as error:  # pictures come from anywhere
                self.get_logger().error(f'image_raw: {shorten(str(error) or repr(error))}',
                                        throttle_duration_sec=10.0)
                return Sighting(np.zeros(len(rows)), np.full(len(rows), np.inf))
            return self._eyes.look(seen[0], rows)
        return step(look)

    def _new_eyes(self) -> RouteEyes:
        """The route as the camera would show it."""
        assert self._runtime.search is not None  # looked at in __init__
        own = self._pictures
        return RouteEyes(self._runtime.search.eyes,
                         np.stack([own.file(*self._route.picture(k))
                                   for k in range(len(self._route))]),
                         self._runtime.zoom_of(own.fov, own.aspect))

    def _show(self, index: int) -> None:
        """Show policy_node a picture of the route."""
        self._since, self._message = time.monotonic(), ''
        if self._driven is not None and self._driven[0] == index:
            # It is on its way there, by the way before. Shown again and again it would be taken
            # for a picture that somebody publishes at a rate.
            self._ours, self._enables = self._driven[1], None
            return
        try:
            self._goals.show(*self._route.picture(index))
        except UserError as error:
            self._cancel(str(error), RouteStatus.FAILED)
            return
        self._ours = self._goals.stamp
        self._shown.append(self._ours)

    def _cancel(self, why: str, status: RouteStatus = RouteStatus.CANCELLED) -> None:
        """End a way, if there is one, and have the robot stand still."""
        drives = self._status in UNDER_WAY
        self._end(status, why)
        if drives and self._enable.service_is_ready():
            self._enable.call_async(SetBool.Request(data=False))

    def _end(self, status: RouteStatus, message: str = '') -> None:
        self._status, self._message, self._enables, self._driven = status, message, None, None
        self._say()

    def _say(self) -> None:
        """Publish how the way goes, when that has changed."""
        follower = self._follower
        said = json.dumps({
            'status': self._status.value, 'error_msg': self._message,
            'place': '' if follower is None else self._route.name(self._target),
            'shown': None if follower is None or self._ours is None else (
                self._route.numbers[follower.shown]),
            'here': None if follower is None or follower.here is None else (
                self._route.numbers[follower.here]),
            'pictures_shown': 0 if follower is None else follower.passed + 1,
            'places': self._route.places})
        if said != self._said:
            self._said = said
            self._out.publish(String(data=said))

    def leave(self) -> None:
        """The process ends: a robot under way along the route stands still."""
        if self._status not in UNDER_WAY:
            return
        self._end(RouteStatus.CANCELLED, 'route_node ended')
        if self._enable.service_is_ready():
            call = ServiceCall(self._enable, SetBool.Request(data=False))
            until = time.monotonic() + LEAVE_S
            while not call.is_answered() and time.monotonic() < until:
                rclpy.spin_once(self, timeout_sec=0.05)


def work(node: RouteNode, ended: Ended) -> None:
    """Until a signal."""
    try:
        spin(node, ended)
    finally:
        node.leave()


def main(args=None) -> int:
    """Entry point: until a signal; exit code 2 and one line for a route that cannot be driven."""
    return run_node('route_node', lambda _: RouteNode(), work, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
