"""`dashboard_node`: a page in the browser: camera, goal, map, state, places; enable, and stop.

Run: `ros2 run vn_nav dashboard_node`, beside policy_node, and open the address that it prints. It
serves this machine alone unless it is told another host, and then only who has its token. Nothing
on the page comes from elsewhere. It publishes no command: it asks policy_node, and route_node.
"""

from __future__ import annotations

import asyncio
import math
import sys
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from vn_msgs_py.images import ImageError, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array
from vn_nav.bags.stamped import header_stamp
from vn_nav.dashboard.access import access
from vn_nav.dashboard.pictures import jpeg
from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.goal_publisher import GoalPublisher
from vn_nav.nodes.process import Ended, run_node
from vn_nav.nodes.qos import qos, subscribe
from vn_nav.nodes.said import read_said
from vn_nav.nodes.service_call import ServiceCall
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.search.snapshot import snapshot_of
from vn_nav.report.search_map import Window, draw, known_bounds

PARAMETERS = {
    'host': ('127.0.0.1', 'address to serve; 0.0.0.0: every one of this machine, with a token'),
    'port': (8080, 'of it; 0: any that is free', (0, 65535)),
    'token': ('', 'that browsers show; empty: none on this machine alone, else one is drawn'),
    'policy': ('policy_node', "name of the policy's node"),
    'image_transport': ('raw', 'raw, or compressed: image_raw/compressed', ('raw', 'compressed')),
    'camera_rate': (5.0, 'pictures shown per second [Hz]', (0.5, 30.0)),
    'bag': ('', 'a recorded drive, to choose goals from; empty: none'),
}
SERVICES = {'enable': (SetBool, {'data': True}), 'stop': (Trigger, {}), 'reset': (Trigger, {})}
ANSWER_S, AGAIN_S = 3.0, 0.5  # until a service is there and answers; until it is asked again
SILENT_S = 3.0  # without a status of the policy
WATCH_S = 0.2  # between two looks whether somebody watches
CAMERA_PX, MAP_PX = 480, (640, 480)
TRACK_M, MOST_TRACK = 0.1, 5000  # between two places of the track; how many
SHOWN = {'frame_rate_hz': 'camera [Hz]', 'frame_age_ms': 'age of pictures [ms]',
         'inference_ms': 'inference [ms]', 'odometry_rate_hz': 'odometry [Hz]'}


class DashboardNode(Node):
    """Hears what the page shows, and asks what it wants done; a `dashboard.server.Robot`.

    Attributes:
        watched: somebody looks: pictures and maps are subscribed to.
        recorded: goals of the bag, if there is one.
    """

    def __init__(self, values: dict[str, Any] | None = None):
        super().__init__('dashboard_node')
        value = values or parameters.declare(self, PARAMETERS, read_only=True,
                                             others=policy_parameters.PARAMETERS)
        self.value = value
        self.access = access(value['host'], value['token'])
        self.watched, self.recorded = False, None
        if value['bag']:
            from vn_nav.dashboard.recorded_goals import read_goals
            self.get_logger().info(f'reads {value["bag"]}')
            self.recorded = read_goals(Path(value['bag']))
        policy = value['policy']
        self._policy = f'{self.get_namespace().rstrip("/")}/{policy}'
        self._status: tuple[float, Any] | None = None  # steady time, and DiagnosticStatus
        self._goal_status: dict[str, Any] = {}
        self._feedback: dict[str, Any] = {}
        self._route: dict[str, Any] | None = None  # what route_node says; None: there is none
        self._picture: tuple[int, Any] | None = None
        self._goal_image: tuple[int, Any] | None = None
        self._map: Any = None
        self._guesses: Any = None
        self._track: list[np.ndarray] = []
        self._drawn: tuple[tuple, int] = ((), 0)  # what the newest map shows, and its number
        self._watching: list[Subscription] = []
        self._goals = GoalPublisher(self)
        self._place = self.create_publisher(String, 'route_goal', qos('route_goal'))
        self._stops = 0  # that were asked for
        self._asked = {name: self.create_client(kind, f'{policy}/{name}')
                       for name, (kind, _) in SERVICES.items()}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_status,
                                 qos('/diagnostics'))
        self.create_subscription(String, 'goal_status', self._on_goal_status, qos('goal_status'))
        self.create_subscription(String, 'goal_feedback', self._on_feedback, qos('goal_feedback'))
        self._hears_route = self.create_subscription(String, 'route_status', self._on_route,
                                                     qos('route_status'))
        for name, kind, callback in (('odom', Odometry, self._on_odometry),
                                     ('goal_image', Image, self._on_goal)):
            subscribe(self, kind, name, callback)
        self.create_timer(WATCH_S, self._watch)

    # What comes in, on the executor's thread.

    def _watch(self) -> None:
        """Pictures and maps cost their publishers something: only while somebody looks."""
        if self.watched and not self._watching:
            compressed = self.value['image_transport'] == 'compressed'
            self._watching = subscribe(self, CompressedImage if compressed else Image,
                                       'image_raw/compressed' if compressed else 'image_raw',
                                       self._on_picture)
            for name, kind, callback in (('map', OccupancyGrid, self._on_map),
                                         ('hypotheses', PoseArray, self._on_guesses)):
                self._watching.append(self.create_subscription(
                    kind, f'{self.value["policy"]}/{name}', callback, qos(f'policy_node/{name}')))
        elif not self.watched and self._watching:
            for subscription in self._watching:
                self.destroy_subscription(subscription)
            self._watching = []
        if self._route is not None and not self.count_publishers(self._hears_route.topic_name):
            self._route = None

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._policy:
                self._status = time.monotonic(), status

    def _on_goal_status(self, message: String) -> None:
        said = read_said(self, 'goal_status', message, 'goal', 'status', 'error_msg')
        if said is None:
            return
        if said['goal'] != self._goal_status.get('goal'):
            self._feedback, self._track = {}, self._track[-1:]
        self._goal_status = said

    def _on_feedback(self, message: String) -> None:
        said = read_said(self, 'goal_feedback', message, 'decisions', 'arrival',
                         'distance_remaining')
        self._feedback = said or self._feedback

    def _on_route(self, message: String) -> None:
        said = read_said(self, 'route_status', message, 'status', 'error_msg', 'place', 'places',
                         'shown', 'here')
        self._route = said or self._route

    def _on_picture(self, message: Any) -> None:
        self._picture = (0 if self._picture is None else self._picture[0]) + 1, message

    def _on_goal(self, message: Image) -> None:
        before = self._goal_image
        if before is None or before[1].header.stamp != message.header.stamp:
            self._goal_image = (0 if before is None else before[0]) + 1, message

    def _on_map(self, message: OccupancyGrid) -> None:
        self._map = message

    def _on_guesses(self, message: PoseArray) -> None:
        self._guesses = message

    def _on_odometry(self, message: Odometry) -> None:
        try:
            pose = odometry_to_array(message)[:3]
        except MotionError:
            return
        track = self._track
        if len(track) > 1 and math.dist(track[-1][:2], track[-2][:2]) < TRACK_M:
            track = track[:-1]
        self._track = [*track[-MOST_TRACK:], pose]

    # What the page shows and does, on other threads.

    def state(self) -> dict[str, Any]:
        """See `dashboard.server.Robot`."""
        status, goal, feedback = self._status, self._goal_status, self._feedback
        known = {} if status is None else {v.key: v.value for v in status[1].values}
        if status is None or time.monotonic() - status[0] > SILENT_S:
            state, message, level = 'no policy', f'{self._policy} says nothing', 2
        else:
            state, message = known.get('state', 'unknown'), status[1].message
            level = int.from_bytes(status[1].level, 'little')
            message = message.removeprefix(state).lstrip(': ;')
        return {
            'state': state, 'message': message, 'level': level,
            'goal': {'number': goal.get('goal'), 'status': goal.get('status', ''),
                     'error_msg': goal.get('error_msg', ''),
                     'decisions': feedback.get('decisions', 0),
                     'arrival': feedback.get('arrival'),
                     'distance': feedback.get('distance_remaining')},
            'route': self._route,
            'values': {title: known[key] for key, title in SHOWN.items() if key in known}}

    def camera(self) -> tuple[int, bytes] | None:
        """See `dashboard.server.Robot`."""
        return _jpeg(self._picture)

    def goal(self) -> tuple[int, bytes] | None:
        """See `dashboard.server.Robot`."""
        return _jpeg(self._goal_image)

    def map(self) -> tuple[int, bytes] | None:
        """See `dashboard.server.Robot`."""
        message, guesses, track = self._map, self._guesses, self._track
        if message is None or not track or not message.info.width:
            return None
        shows = (header_stamp(message), None if guesses is None else header_stamp(guesses),
                 *np.round(track[-1], 1))
        if shows != self._drawn[0]:
            self._drawn = shows, self._drawn[1] + 1
        seen, frame = snapshot_of(message, guesses, track[-1])
        if not seen.cells.size:
            return None
        view = Window.about(known_bounds(seen, frame), *MAP_PX)
        picture = draw(seen, view, frame, track=np.array(track))
        return self._drawn[1], cv2.imencode('.png', picture[..., ::-1])[1].tobytes()

    def ask(self, name: str) -> tuple[bool, str]:
        """See `dashboard.server.Robot`."""
        kind, fields = SERVICES[name]
        client, until = self._asked[name], time.monotonic() + ANSWER_S
        call = ServiceCall(client, kind.Request(**fields), again=AGAIN_S)
        self._stops += name == 'stop'
        stops = self._stops
        while time.monotonic() < until:
            if name != 'stop' and self._stops != stops:  # it is not asked again after a stop
                return False, f'{name}: a stop was asked for meanwhile'
            if client.service_is_ready() and call.is_answered():
                return call.answer.success, call.answer.message or f'{name}: done'
            time.sleep(0.01)
        return False, (f'{self._policy} does not answer to {name}' + (
            ": use the robot's own stop" if name == 'stop' else ''))

    def drive_to(self, place: str) -> tuple[bool, str]:
        """See `dashboard.server.Robot`."""
        if self._route is None or not self._place.get_subscription_count():
            return False, ('no route_node listens: ros2 run vn_nav route_node --ros-args '
                           '-p route:=FOLDER')
        if place not in self._route['places']:
            return False, f'the route has no place of the name {shorten(place)!r}'
        self._place.publish(String(data=place))
        return True, f'asked to drive to {place}'

    def show_file(self, path: Path) -> str:
        """See `dashboard.server.Robot`."""
        return self._show(*read_goal_picture(path))

    def show_recorded(self, number: int) -> str:
        """See `dashboard.server.Robot`."""
        assert self.recorded is not None  # the server has looked
        return self._show(self.recorded.goals[number].picture, None)

    def _show(self, picture: np.ndarray, fov: float | None) -> str:
        return f'goal shown: {self._goals.show(picture, fov)}'


def _jpeg(numbered: tuple[int, Any] | None) -> tuple[int, bytes] | None:
    """A picture for the browser; None: there is none, or it cannot be decoded."""
    if numbered is None:
        return None
    try:
        return numbered[0], jpeg(decode_rgb(numbered[1], CAMERA_PX), CAMERA_PX)
    except ImageError:
        return None


def work(node: DashboardNode, ended: Ended) -> None:
    """Serve the page, and the graph beside it, until a signal."""
    from vn_nav.dashboard.server import application, serve
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    failed: list[BaseException] = []
    done = threading.Event()

    def hear() -> None:
        try:
            while not done.is_set():
                executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            pass
        except BaseException as error:
            failed.append(error)

    class Over:
        """A signal, or the graph's thread has failed."""

        @staticmethod
        def is_set() -> bool:
            return ended.is_set() or bool(failed)

    def ready(port: int) -> None:
        host, token = node.value['host'], node.access.token
        shown = f'http://{f"[{host}]" if ":" in host else host}:{port}/'
        node.get_logger().info(f'open {shown}{f"?token={token}" if token else ""}')

    thread = threading.Thread(target=hear, daemon=True)
    thread.start()
    try:
        asyncio.run(serve(application(node, node.access, camera_rate=node.value['camera_rate']),
                          node.value['host'], node.value['port'], Over, ready))
    finally:
        done.set()
        thread.join(2.0)
        executor.shutdown(timeout_sec=0.5)
    if failed:
        raise failed[0]


def main(args=None) -> int:
    """Entry point: until a signal; exit code 2 and one line for what it cannot serve."""
    try:
        import aiohttp  # noqa: F401
    except ModuleNotFoundError as error:
        missing = UserError('the dashboard is served by aiohttp', str(error),
                            'pip install aiohttp, or apt install python3-aiohttp')
        print(f'dashboard_node: {missing}', file=sys.stderr)
        return 2
    return run_node('dashboard_node', lambda _: DashboardNode(), work, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
