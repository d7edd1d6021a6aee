"""What the bridge says of frames, scans and episodes: numbers into messages, no ROS needed."""

from __future__ import annotations

import array
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py import motion
from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.scenes import parse_scene
from vn_sim_bridge.floor.places import with_rooms
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.robot import lidar
from vn_sim_bridge.robot.odometry import Uncertainty
from vn_sim_bridge.robot.simulated_robot import TICK, Decision, Episode, SimulatedRobot

LIDAR_HEIGHT = 0.2  # m above the floor; the scan is the same at any height
# What a flat floor fixes: z [m], roll, pitch [rad]. Small, as of a filter for two dimensions.
FLAT = 1e-8
Numbers = Sequence[float] | np.ndarray


class Frames(NamedTuple):
    """Names of the coordinate frames (REP 105); every robot has its own, and all share the map."""

    map: str
    odom: str
    base: str
    camera: str
    optical: str
    lidar: str

    @classmethod
    def with_prefix(cls, prefix: str) -> Frames:
        """All frames but the map with a prefix."""
        return cls('map', *(prefix + name for name in (
            'odom', 'base_link', 'camera_link', 'camera_optical_frame', 'base_scan')))


class Transform(NamedTuple):
    """Where a frame lies in its parent: metres, and a quaternion x, y, z, w."""

    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def planar(parent: str, child: str, pose: Numbers) -> Transform:
    """A frame at x, y [m], yaw [rad] on the floor of its parent."""
    x, y, yaw = (float(value) for value in pose[:3])
    return Transform(parent, child, (x, y, 0.0), motion.yaw_to_quaternion(yaw))


def odom_in_map(true: Numbers, odometry: Numbers) -> tuple[float, float, float]:
    """Pose x, y, yaw of the odom frame in the map, where the robot is at both poses [>=3]."""
    yaw = float(wrap_angle(true[2] - odometry[2]))
    c, s = math.cos(yaw), math.sin(yaw)
    return (float(true[0] - c * odometry[0] + s * odometry[1]),
            float(true[1] - s * odometry[0] - c * odometry[1]), yaw)


def static_transforms(frames: Frames) -> list[Transform]:
    """What does not move on the robot: the scanner, and the optical axes in the camera (REP 103).

    In an optical frame z points forward, x to the right and y down.
    """
    return [Transform(frames.base, frames.lidar, (0.0, 0.0, LIDAR_HEIGHT), (0.0, 0.0, 0.0, 1.0)),
            Transform(frames.camera, frames.optical, (0.0, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5))]


def moving_transforms(frames: Frames, odometry: Numbers, *, camera_height: float,
                      pitch: float, true: Numbers | None = None) -> list[Transform]:
    """What moves: the base in odom, the camera that tilts, and odom in the map.

    Args:
        odometry: [3] x, y [m], yaw [rad].
        camera_height: above the floor [m]; pitch: of the camera, down [rad].
        true: [>=3] pose in the map; None: somebody else says where odom lies.
    """
    found = [planar(frames.odom, frames.base, odometry),
             Transform(frames.base, frames.camera, (0.0, 0.0, float(camera_height)),
                       (0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2)))]
    if true is not None:
        found.append(planar(frames.map, frames.odom, odom_in_map(true, odometry)))
    return found


def fill_transform(message: Any, transform: Transform) -> Any:
    """Write a transform into a TransformStamped; the stamp stays the caller's."""
    message.header.frame_id, message.child_frame_id = transform.parent, transform.child
    where, turned = message.transform.translation, message.transform.rotation
    where.x, where.y, where.z = transform.translation
    turned.x, turned.y, turned.z, turned.w = transform.rotation
    return message


def goal_in_map(message: Any, frames: Frames, true: Numbers, odometry: Numbers
                ) -> tuple[float, float, float]:
    """A goal as x, y [m], yaw [rad] in the map, from a PoseStamped.

    Args:
        true, odometry: [>=3] where the robot is, in the map and in odom.

    Raises:
        UserError: a frame that is neither the map (or empty) nor odom; no finite pose.
    """
    frame = message.header.frame_id.lstrip('/')
    if frame not in ('', frames.map, frames.odom):
        raise UserError(f'goal_pose is in the frame {frames.map} or {frames.odom}', frame,
                        'transform it before you publish it')
    q, at = message.pose.orientation, message.pose.position
    try:
        yaw = motion.quaternion_to_yaw(q.x, q.y, q.z, q.w)
    except motion.MotionError as error:
        raise UserError('goal_pose has an orientation', (q.x, q.y, q.z, q.w),
                        'publish a quaternion of length 1') from error
    if not all(map(math.isfinite, (at.x, at.y))):
        raise UserError('goal_pose is finite', (at.x, at.y), 'correct its publisher')
    if frame != frames.odom:
        return at.x, at.y, yaw
    x, y, turn = odom_in_map(true, odometry)
    c, s = math.cos(turn), math.sin(turn)
    return x + c * at.x - s * at.y, y + s * at.x + c * at.y, float(wrap_angle(yaw + turn))


def fill_covariances(message: Any, uncertainty: Uncertainty) -> Any:
    """Write the covariances of pose and velocity into an Odometry."""
    for part, values in ((message.pose, uncertainty.pose), (message.twist, uncertainty.twist)):
        whole = FLAT * np.eye(6)  # x, y, z, roll, pitch, yaw
        whole[np.ix_((0, 1, 5), (0, 1, 5))] = values
        part.covariance = whole.reshape(-1)
    return message


def fill_scan(message: Any, rects: np.ndarray, pose: np.ndarray, period: float) -> Any:
    """Write a scan (`lidar.scan`) into a LaserScan; the header stays the caller's.

    Args:
        rects: [M,4] of the obstacles; pose: [>=3] of the scanner in the map.
        period: between two scans [s].
    """
    angles = lidar.scan_angles()
    message.angle_min, message.angle_max = float(angles[0]), float(angles[-1])
    message.angle_increment = 2 * math.pi / lidar.RAYS
    message.time_increment, message.scan_time = 0.0, period  # all rays at one moment
    message.range_min, message.range_max = lidar.NEAREST, lidar.FARTHEST
    # array.array is what rclpy keeps as it is.
    message.ranges = array.array('f', lidar.scan(rects, pose).tobytes())
    return message


def scene_facts(robot: SimulatedRobot) -> dict:
    """What a viewer or a report needs to draw the place: the topic `scene`."""
    simulator, place = robot.simulator, robot.place
    return {
        'scene': place.name,
        'simulator': parse_scene(place.name).simulator,
        'world_version': simulator.version,
        **({'rooms': len(with_rooms(place).rooms)} if simulator.capabilities.rooms else {}),
        **(place.plan() or {}),
        'goals': [{'room': field.goal.room, 'pose': list(field.goal.pose)}
                  for field in robot.fields],
        'arrival': {'radius': tasks.ARRIVAL_RADIUS,
                    'heading_deg': math.degrees(tasks.ARRIVAL_HEADING)},
        'camera_fov_deg': math.degrees(robot.robot.camera_fov),
        'stop': robot.stop_rule,
        'max_decisions': robot.max_decisions,
        'tick': TICK,
    }


def episode_facts(robot: SimulatedRobot, stamp: float) -> dict:
    """What the topic `episode` says at a beginning, with its simulated time [s]."""
    episode = robot.episode
    assert episode is not None  # one has just begun
    return {'episode': episode.index, 'goal': episode.goal, 'room': robot.goal.room,
            'goal_pose': list(robot.goal.pose), 'start': list(episode.start),
            'start_distance': episode.start_distance, 'stamp': stamp,
            'max_decisions': robot.max_decisions}


def result_facts(episode: Episode, decision: Decision) -> dict:
    """What the topic `episode_result` says of an episode that a decision has ended."""
    return {'episode': episode.index, 'success': decision.success,
            'decisions': episode.decisions, 'collisions': episode.collisions,
            'path_length': episode.path_length, 'distance': decision.distance,
            'heading_error_deg': math.degrees(decision.heading_error)}
