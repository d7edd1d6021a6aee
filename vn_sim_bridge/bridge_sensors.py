"""What a simulated robot's drivers publish: pictures, scans, odometry, frames.

No ROS is imported here: the publishers come from the bridge, and know their message types.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vn_msgs_py import camera, images, motion
from vn_sim_bridge import bridge_messages
from vn_sim_bridge.bridge_messages import Frames, Transform
from vn_sim_bridge.floor.places import walled
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot
from vn_sim_bridge.simulator import Capabilities
from vn_sim_bridge.simulator import Frames as Pictures

# Topics of sensors that not every simulator has, by the capability that they need.
NEEDS = {'depth/image_raw': 'depth', 'depth/camera_info': 'depth', 'labels/image_raw': 'labels',
         'scan': 'walls'}
TOPICS = ('image_raw', 'image_raw/compressed', 'camera_info', 'depth/image_raw',
          'depth/camera_info', 'labels/image_raw', 'scan', 'odom', 'ground_truth/odom')


def topics(capabilities: Capabilities) -> list[str]:
    """Those of `TOPICS` that a simulator has something to say on."""
    return [name for name in TOPICS if name not in NEEDS or getattr(capabilities, NEEDS[name])]


class Sensors:
    """Publishes what the robot's sensors say.

    Args:
        publishers: of `topics`, and of /tf and /tf_static where there are any.
        robot: whose sensors they are.
        frames: names of its frames.
        period: between two scans [s].
        localised: /tf says where odom lies in the map.
        transform: makes an empty TransformStamped.
    """

    def __init__(self, publishers: Mapping[str, Any], robot: SimulatedRobot, frames: Frames, *,
                 period: float, localised: bool, transform: Callable[[], Any]):
        self._out, self._robot, self._frames = dict(publishers), robot, frames
        self._period, self._localised, self._transform = period, localised, transform
        self._info = camera.fill_camera_info(self._make('camera_info'), *robot.picture_size,
                                             robot.robot.camera_fov)
        self._odometry, self._truth = self._make('odom'), self._make('ground_truth/odom')

    def _make(self, name: str) -> Any:
        return self._out[name].msg_type()

    def _listened(self, name: str) -> bool:
        return name in self._out and self._out[name].get_subscription_count() > 0

    def _publish(self, name: str, message: Any, stamp: Any, frame: str) -> None:
        message.header.stamp, message.header.frame_id = stamp, frame
        self._out[name].publish(message)

    def publish_pictures(self, stamp: Any, seen: Pictures) -> None:
        """Publish what the camera saw at a time, in every form that somebody listens to."""
        frame = self._frames.optical
        self._publish('camera_info', self._info, stamp, frame)
        rgb = np.ascontiguousarray(seen.rgb[0].transpose(1, 2, 0))
        self._publish('image_raw', images.fill_image(self._make('image_raw'), rgb), stamp, frame)
        if self._listened(name := 'image_raw/compressed'):
            self._publish(name, images.fill_compressed(self._make(name), rgb), stamp, frame)
        if self._listened(name := 'depth/camera_info'):
            self._publish(name, self._info, stamp, frame)
        for name, picture, encoding in (('depth/image_raw', seen.depth[0], '32FC1'),
                                        ('labels/image_raw', seen.labels[0],
                                         images.label_encoding(seen.labels))):
            if self._listened(name):
                message = images.fill_image(self._make(name), picture, encoding)
                self._publish(name, message, stamp, frame)

    def publish_scan(self, stamp: Any) -> None:
        """Publish a scan, if somebody listens."""
        if self._listened('scan'):
            message = bridge_messages.fill_scan(
                self._make('scan'), walled(self._robot.place).obstacle_rects, self._robot.pose,
                self._period)
            self._publish('scan', message, stamp, self._frames.lidar)

    def publish_odometry(self, stamp: Any) -> None:
        """Publish odometry, the true pose, and the frames that go with them."""
        robot, frames = self._robot, self._frames
        for name, message, pose, frame in (
                ('ground_truth/odom', self._truth, robot.pose, frames.map),
                ('odom', self._odometry, robot.odometry, frames.odom)):
            x, y, yaw = pose[:3]
            motion.fill_odometry(message, x, y, yaw, robot.velocity)
            if name == 'odom':
                bridge_messages.fill_covariances(message, robot.uncertainty)
            message.child_frame_id = frames.base
            self._publish(name, message, stamp, frame)
        if '/tf' in self._out:
            self._publish_transforms('/tf', stamp, bridge_messages.moving_transforms(
                frames, robot.odometry, camera_height=robot.robot.camera_height,
                pitch=robot.pose[3] + robot.robot.camera_pitch,
                true=robot.pose if self._localised else None))

    def publish_mounts(self, stamp: Any) -> None:
        """Publish where the sensors sit on the robot: once."""
        if '/tf_static' in self._out:
            self._publish_transforms('/tf_static', stamp,
                                     bridge_messages.static_transforms(self._frames))

    def _publish_transforms(self, name: str, stamp: Any, transforms: list[Transform]) -> None:
        message = self._make(name)
        message.transforms = [bridge_messages.fill_transform(self._transform(), transform)
                              for transform in transforms]
        for filled in message.transforms:
            filled.header.stamp = stamp
        self._out[name].publish(message)
