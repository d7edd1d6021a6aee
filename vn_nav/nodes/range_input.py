"""Measured ranges for a policy's map: a LaserScan, or depth pictures, from the robot's topics."""

from __future__ import annotations

import collections
import threading
import time
from typing import Any, NamedTuple

import numpy as np
from sensor_msgs.msg import CameraInfo, Image, LaserScan

from vn_msgs_py.images import decode_depth
from vn_msgs_py.topics import topic
from vn_nav.bags.mapping.pose_graph import between
from vn_nav.errors import UserError
from vn_nav.measured_ranges import DepthCamera, RangeSource, Scan, laser_scan
from vn_nav.nodes.command_output import POSE_AGE_S, CommandOutput
from vn_nav.nodes.qos import other_types, profile
from vn_nav.nodes.window import Window
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.navigator import Navigator
from vn_nav.robot import RobotSpec

KEPT = 4  # messages
ALIVE_S = 1.0  # of steady time: longer silent, nobody waits for it
SAME_MOMENT_S = 0.05  # between a scan and a picture in motion, without odometry
WARNING_PERIOD_S = 10.0
WINDOW_S = 5.0


class NamedRanges(NamedTuple):
    """The message of measured ranges that belongs to a picture, as a recording says."""

    stamp: float  # s, its own
    pose: np.ndarray | None  # [3] of odometry when it was measured; None: unknown


class RangeInput:
    """Keeps the newest messages, and finds the one that belongs to a picture.

    A message that is no scan is refused with a warning: as good as none.

    Args:
        node: that subscribes.
        navigator: knows since when the robot rests.
        output: knows the odometry.
        wake: guards the navigator; who waits for ranges is woken.
        source: of which one topic is named.
        robot: with the height and the pitch of a depth camera.

    Attributes:
        subscriptions: what was made.
        used: decisions whose map took measured ranges; missed: the others.
    """

    def __init__(self, node, navigator: Navigator, output: CommandOutput,
                 wake: threading.Condition, source: RangeSource, robot: RobotSpec):
        self._node, self._navigator, self._output, self._wake = node, navigator, output, wake
        self._source, self._robot = source, robot
        self._info: CameraInfo | None = None
        self._messages: collections.deque[tuple[float, Any]] = collections.deque(maxlen=KEPT)
        self._heard = Window(WINDOW_S)
        self._received = -np.inf  # steady time
        self._refusal = ''  # of the newest message that was wanted
        self.used = self.missed = 0
        if source.scan:
            self._kind, name, quality = LaserScan, source.scan, 'scan'
        else:
            self._kind, name, quality = Image, source.depth, 'depth/image_raw'
        self.subscriptions = [node.create_subscription(self._kind, name, self._on_message,
                                                       profile(topic(quality)))]
        if source.depth:
            # Its kernel is compiled before the first decision, which has 0.1 s.
            DepthCamera.of_square(8, 1.5, 1.0).scan(np.zeros((8, 8), np.float32))
            info = f'{source.depth.rpartition("/")[0]}/camera_info'.removeprefix(
                '' if source.depth.startswith('/') else '/')
            self.subscriptions.append(node.create_subscription(
                CameraInfo, info, self._on_info, profile(topic('depth/camera_info'))))
        self.topic = self.subscriptions[0].topic_name

    def _on_message(self, message) -> None:
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        with self._wake:
            self._received = time.monotonic()
            self._heard.add(self._received)
            self._messages.append((stamp, message))
            self._wake.notify_all()

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    @property
    def is_alive(self) -> bool:
        """Something has come lately."""
        return time.monotonic() - self._received < ALIVE_S

    def has(self, stamp: float) -> bool:
        """Whether there is a message that belongs to a picture of this stamp; `wake` is held."""
        return self._best(stamp) is not None

    def has_exactly(self, stamp: float) -> bool:
        """Whether the message of a stamp is there; `wake` is held."""
        return self._message(stamp) is not None

    def _message(self, stamp: float) -> Any:
        return next((message for own, message in self._messages if own == stamp), None)

    def _best(self, stamp: float) -> tuple[float, Any] | None:
        """The message nearest to a picture: of the same rest, or of about the same moment."""
        near = [one for one in self._messages
                if abs(one[0] - stamp) <= self._navigator.limits.max_frame_age
                and self._navigator.is_since_rest(one[0])]
        return min(near, key=lambda one: abs(one[0] - stamp), default=None)

    def scan_at(self, stamp: float) -> Scan | None:
        """The scan that belongs to a picture, as seen from where the robot was at its stamp.

        Args:
            stamp: of the picture [s].

        Returns:
            None: there is none, it is too old, or it is refused.
        """
        with self._wake:
            best, then, now = self._best(stamp), None, None
            if best is not None and self._navigator.continuous:
                then, now = (self._output.track.at(at, POSE_AGE_S) for at in (best[0], stamp))
        if best is None:
            return self._counted(None)
        if not self._navigator.continuous:  # at rest
            return self._counted(self._read(best[1]))
        return self._in_motion(*best, then, stamp, now)

    def scan_of(self, named: NamedRanges | None, stamp: float, pose: np.ndarray | None
                ) -> Scan | None:
        """As `scan_at`, of the message that a recording says belongs to the picture.

        Args:
            named: the message; None: there is none.
            stamp: of the picture [s]; pose: [3] of odometry there; None: unknown.
        """
        with self._wake:
            message = None if named is None else self._message(named.stamp)
        if named is None or message is None:
            return self._counted(None)
        return self._in_motion(named.stamp, message, named.pose, stamp, pose)

    def _in_motion(self, measured: float, message: Any, then: np.ndarray | None, stamp: float,
                   now: np.ndarray | None) -> Scan | None:
        """A message of one stamp as seen at another; poses [3] of odometry, None: unknown."""
        known = then is not None and now is not None
        if not known and abs(measured - stamp) > SAME_MOMENT_S:
            return self._counted(None)
        scan = self._counted(self._read(message))
        return scan if scan is None or then is None or now is None else (
            scan.seen_from(between(now, then)))

    def _counted(self, scan: Scan | None) -> Scan | None:
        self.used += scan is not None
        self.missed += scan is None
        return scan

    def _read(self, message) -> Scan | None:
        try:
            scan = self._scan(message) if self._kind is LaserScan else self._depth(message)
        except Exception as error:  # whatever somebody publishes there
            self._refusal = f'{self.topic} refused: {shorten(str(error) or repr(error))}'
            self._node.get_logger().warning(self._refusal, throttle_duration_sec=WARNING_PERIOD_S)
            return None
        self._refusal = ''
        return None if np.isnan(scan.ranges).all() else scan

    def _scan(self, message: LaserScan) -> Scan:
        return laser_scan(np.array(message.ranges, np.float32), message.angle_min,
                          message.angle_increment, message.range_min, message.range_max,
                          self._source.mount)

    def _depth(self, message: Image) -> Scan:
        info = self._info
        if info is None:
            raise UserError('a depth picture has a camera_info beside it', 'none',
                            'check the driver of the camera')
        if (info.width, info.height) != (message.width, message.height):
            raise UserError('camera_info has the size of the depth picture',
                            (info.width, info.height), 'check the driver of the camera')
        if not (np.isfinite(info.k).all() and info.k[0] > 0 and info.k[4] > 0):
            raise UserError('camera_info has focal lengths', (float(info.k[0]), float(info.k[4])),
                            'calibrate the camera')
        # In its pixels the first centre is 0.
        camera = DepthCamera((info.k[0], info.k[4]), (info.k[2] + 0.5, info.k[5] + 0.5),
                             self._robot.camera_height, self._robot.camera_pitch,
                             self._source.mount)
        return camera.scan(decode_depth(message))

    # For the diagnostics.

    def warnings(self) -> list[str]:
        """What is wrong with the ranges; the robot drives by its pictures then."""
        found = [f'{node} publishes {self.topic} as {other}, and this node subscribes to '
                 f'{self._kind.__name__}: remap it, or republish it'
                 for node, other in other_types(self._node, self.topic, self._kind)]
        if not self.is_alive and not found:
            found.append(f'no ranges on {self.topic}: the map takes those of the pictures')
        return found + [self._refusal] * bool(self._refusal)

    def values(self) -> dict[str, str | int]:
        """Rate and use."""
        return {'ranges_rate_hz': f'{self._heard.rate(time.monotonic()):.1f}',
                'ranges_used': self.used, 'ranges_missed': self.missed}
