"""What a robot behind topics receives: pictures, goals, rewards, the ends of episodes."""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import json
import math
import threading
import time
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Bool, Float32, String, UInt8

from vn_msgs_py import images
from vn_nav.bags.stamped import STAMP_WINDOW_S, header_stamp
from vn_nav.calibration import is_rectified, read_calibration
from vn_nav.nodes.command_output import CommandOutput
from vn_nav.nodes.prepared import prepared
from vn_nav.nodes.recorded_topics import RecordedTopics
from vn_nav.observation import needed_side, preprocess, preprocess_map
from vn_nav.policy.frame_gate import shorten
from vn_nav.policy.goal_watch import GoalWatch
from vn_nav.policy.navigator import Navigator
from vn_nav.policy.pose_track import EpisodePose
from vn_nav.rectification import Camera, flatten_goal
from vn_nav.robot import RobotSpec

# What comes with a picture, by the key of `info`: topic and decoder.
MAP_TOPICS = {'depth': ('depth/image_raw', images.decode_depth),
              'segmentation': ('labels/image_raw', images.decode_labels)}


class Seen(NamedTuple):
    """What the robot sees at rest."""

    picture: np.ndarray  # [3,S,S] uint8
    # [3] x, y [m], yaw [rad] by odometry, seen from where the episode began; None: not known
    odometry: np.ndarray | None
    maps: dict[str, np.ndarray]  # [S,S] depth [m], 0 where unknown; segmentation class ids


@dataclasses.dataclass
class Tally:
    """What came on topics since the last decision."""

    reward: float = 0.0
    judged: bool = False  # something came on `reward`
    collided: bool = False
    arrived: bool = False
    end: int = 0


class Senses:
    """Subscriptions of one robot; callbacks keep the newest of each, and count what came.

    Args:
        node: that subscribes.
        topics: its subscriptions.
        navigator: judges stamps and goals.
        output: takes odometry, and knows which belongs to a picture.
        wake: guards everything below, and wakes all threads.
        robot: whose camera the pictures are cropped to.
        size: side of the pictures [pixels].
        lock_step: stamps are the simulator's ticks, and nothing is late.
        compressed: pictures come on image_raw/compressed.

    Attributes:
        goal: the goal picture in force [3,S,S]; None: none yet.
        goals: number of goals that were taken.
        scene: what a simulator publishes of itself; empty: none does.
        label_names: behind the class ids of labels; empty: none are published.
        camera: that takes the pictures; None: unknown.
        frame: stamp [s] and picture, the newest of the present goal.
        tally: what came since the last decision.
    """

    def __init__(self, node: Node, topics: RecordedTopics, navigator: Navigator,
                 output: CommandOutput, wake: threading.Condition, robot: RobotSpec, size: int, *,
                 lock_step: bool, compressed: bool):
        self._node, self._topics, self._navigator, self._wake = node, topics, navigator, wake
        self._output, self._episode_pose = output, EpisodePose()
        self._robot, self._size, self._lock_step = robot, size, lock_step
        self._goal_watch = GoalWatch(trust_stamps=lock_step)
        self._knows_pose = False  # once
        self._maps: dict[str, collections.deque] = {}  # (stamp, message) by key
        # Of goal pictures that another camera took: the newest, and its stamp.
        self._goal_camera: tuple[tuple[int, int], Camera] | None = None
        self._goal_message: Image | None = None  # in force
        self.goal: np.ndarray | None = None
        self.goals = 0
        self.scene: dict = {}
        self.label_names: tuple[str, ...] = ()
        self.camera: Camera | None = None
        self.frame: tuple[float, np.ndarray] | None = None
        self.tally = Tally()
        # Outcomes come first: of what has arrived, the executor serves the oldest subscription
        # first, and so the outcome of a decision before the picture that follows it.
        topics.subscribe(Float32, 'reward', self._on_reward, history=False)
        topics.subscribe(Bool, 'collision', self._on_collision, history=False)
        topics.subscribe(Bool, 'arrived', self._on_arrived, history=False)
        topics.subscribe(UInt8, 'episode_end', self._on_episode_end, history=False)
        topics.subscribe(String, 'scene', self._on_scene)
        topics.subscribe(String, 'labels/names', self._on_label_names)
        topics.subscribe(Image, 'goal_image', self._on_goal, anybody=True)
        topics.subscribe(CameraInfo, 'goal_camera_info', self._on_goal_camera_info, anybody=True)
        # In lock-step no odometry may be missed, and the simulator is reliable.
        topics.subscribe(Odometry, 'odom', output.take_odometry, anybody=not lock_step)
        topics.subscribe(CameraInfo, 'camera_info', self._on_camera_info)
        picture = (CompressedImage, 'image_raw/compressed') if compressed else (Image, 'image_raw')
        self._is_rectified = is_rectified(node.resolve_topic_name(picture[1]))
        topics.subscribe(*picture, self._on_image)

    def listen(self, keys: tuple[str, ...]) -> None:
        """Have the maps of these keys of `MAP_TOPICS` with every picture."""
        for key in keys:
            self._maps[key] = collections.deque(maxlen=16)

            def keep(message, rows=self._maps[key]) -> None:
                with self._wake:
                    rows.append((_seconds(message.header.stamp), message))
                    self._wake.notify_all()
            self._topics.subscribe(Image, MAP_TOPICS[key][0], keep)

    def offers(self) -> set[str]:
        """The keys of `MAP_TOPICS` that somebody publishes."""
        return {key for key, (name, _) in MAP_TOPICS.items() if self._node.count_publishers(name)}

    # Callbacks, on the executor's thread.

    def _on_image(self, message) -> None:
        received = time.monotonic()
        stamp = _seconds(message.header.stamp)
        with self._wake:
            # In lock-step stamps are the simulator's ticks and nothing is late.
            if not self._navigator.admit(stamp, None if self._lock_step else self._now()):
                return
        picture = prepared(self._prepare, message, self._wake,
                           lambda why: self._navigator.bad_frame(why, time.monotonic()))
        if picture is None:
            return
        with self._wake:
            self._navigator.good_frame(received)
            self.frame = (stamp, picture)
            self._wake.notify_all()

    def _on_goal(self, message: Image) -> None:
        stamp = message.header.stamp
        content = hashlib.blake2b(message.data, digest_size=16).digest()
        with self._wake:
            if not self._goal_watch.is_new((stamp.sec, stamp.nanosec), content, time.monotonic()):
                return
            self._navigator.new_goal()
            self._goal_message = message
        picture = prepared(self._prepare_goal, message, self._wake, self._refuse_goal)
        if picture is None:
            return
        with self._wake:
            self._take_goal(picture, message)

    def _take_goal(self, picture: np.ndarray, message: Image) -> None:
        # Pictures up to then belong to the episode before.
        self._navigator.accept_goal(_seconds(message.header.stamp) if self._lock_step else
                                    self._now() + self._navigator.limits.settle_time)
        self.goal, self.frame = picture, None
        self.goals += 1
        self._wake.notify_all()

    def _refuse_goal(self, why: str) -> None:
        self._node.get_logger().error(f'goal_image refused: {shorten(why)}')
        self._navigator.refuse_goal(why)

    def _on_reward(self, message: Float32) -> None:
        if not math.isfinite(message.data):
            self._node.get_logger().error(f'a reward is finite; received {message.data}')
            return
        with self._wake:
            self.tally.reward += message.data
            self.tally.judged = True
            self._wake.notify_all()

    def _on_collision(self, message: Bool) -> None:
        with self._wake:
            self.tally.collided |= message.data

    def _on_arrived(self, message: Bool) -> None:
        with self._wake:
            self.tally.arrived |= message.data

    def _on_episode_end(self, message: UInt8) -> None:
        with self._wake:
            self.tally.end = message.data

    def _on_scene(self, message: String) -> None:
        try:
            scene = json.loads(message.data)
        except ValueError:  # another kind of scene
            return
        if isinstance(scene, dict):
            self.scene = scene

    def _on_label_names(self, message: String) -> None:
        try:
            names = json.loads(message.data)
        except ValueError:
            return
        if isinstance(names, list) and all(isinstance(name, str) for name in names):
            with self._wake:
                self.label_names = tuple(names)
                self._wake.notify_all()

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            calibration = read_calibration(message, rectified=self._is_rectified)
            if calibration is not None and (
                    self.camera is None or not self.camera.calibration.is_near(calibration)):
                self.camera = Camera(calibration, self._robot.camera_fov)
        except Exception as error:  # whatever somebody publishes there
            self._node.get_logger().error(shorten(str(error) or repr(error)),
                                          throttle_duration_sec=10.0)

    def _on_goal_camera_info(self, message: CameraInfo) -> None:
        try:
            calibration = read_calibration(message)
            if calibration is None:
                return
            camera = Camera(calibration, self._robot.camera_fov)
        except Exception as error:  # as above
            self._node.get_logger().error(
                f'goal_camera_info refused: {shorten(str(error) or repr(error))}',
                throttle_duration_sec=10.0)
            return
        stamp, goal = header_stamp(message), self._goal_message
        self._goal_camera = stamp, camera
        # Topics are not in order: the picture may have come first.
        if goal is not None and header_stamp(goal) == stamp:
            picture = prepared(self._prepare_goal, goal, self._wake, self._refuse_goal)
            with self._wake:
                if picture is not None and self._navigator.goal_ready:
                    self.goal = picture
                elif picture is not None:  # by the robot's camera it was refused
                    self._take_goal(picture, goal)

    def sees(self) -> bool:
        """Whether there is a picture to decide on, and what belongs to it."""
        return (self.frame is not None and self._navigator.wants(self.frame[0])
                and all(_nearest(rows, self.frame[0]) for rows in self._maps.values()))

    def look(self, *, begins: bool = False) -> Seen:
        """The newest picture, and what belongs to it.

        Args:
            begins: an episode begins with it.
        """
        assert self.frame is not None  # `sees` said so
        stamp, picture = self.frame
        if begins:
            self._episode_pose.begin()
        pose = self._output.pose_at(stamp)
        self._knows_pose |= pose is not None
        odometry = self._episode_pose.follow(pose, self._output.track.breaks)
        maps = {}
        for key, rows in self._maps.items():
            decoded = MAP_TOPICS[key][1](_nearest(rows, stamp))
            if self.camera is not None and self.camera.fits(decoded):
                decoded = self.camera.rectify(decoded, nearest=True)
            maps[key] = np.nan_to_num(preprocess_map(decoded, self._size, **self._lens()))
        return Seen(picture, odometry if self._knows_pose else None, maps)

    def _prepare(self, message) -> np.ndarray:
        camera = self.camera
        if camera is None:
            return preprocess(images.decode_rgb(message, needed_side(self._size)), self._size)
        smallest = camera.needed_side(self._size, self._robot.camera_fov)
        picture = camera.rectify(images.decode_rgb(message, smallest))
        return preprocess(picture, self._size, **self._lens())

    def _prepare_goal(self, message: Image) -> np.ndarray:
        stamp, other = self._goal_camera or (None, None)
        picture, fov = flatten_goal(images.decode_rgb(message), self.camera,
                                    other if stamp == header_stamp(message) else None)
        return preprocess(picture, self._size, fov=fov, target_fov=self._robot.camera_fov)

    def _lens(self) -> dict[str, float]:
        return {} if self.camera is None else {
            'fov': self.camera.fov, 'target_fov': self._robot.camera_fov}

    def _now(self) -> float:
        return self._node.get_clock().now().nanoseconds * 1e-9


def _seconds(stamp) -> float:
    return stamp.sec + stamp.nanosec * 1e-9


def _nearest(rows: collections.deque, stamp: float) -> Any:
    """The message nearest to a stamp, within `STAMP_WINDOW_S`; None: there is none."""
    near = min(rows, key=lambda row: abs(row[0] - stamp), default=None)
    return near[1] if near is not None and abs(near[0] - stamp) <= STAMP_WINDOW_S else None
