"""Twist, TwistStamped and Odometry to arrays and back. Velocities are (vx, vy, wz, tilt rate)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

MAX_POSITION_M = 1e8  # m: UTM coordinates are within; a pose beyond is a driver's fault
MAX_SPEED_M_RAD_PER_S = 1e3  # m/s, rad/s


class MotionError(ValueError):
    """A motion message that must not move a robot: states rule, value and remedy."""

    def __init__(self, rule: str, received: object, remedy: str):
        super().__init__(f'{rule}; received {received!r}; {remedy}')


def twist_to_array(message: Any) -> np.ndarray:
    """Twist or TwistStamped to [4] float64: vx, vy [m/s], wz, tilt rate (`angular.y`) [rad/s].

    Raises:
        MotionError: NaN or infinity anywhere.
    """
    twist = getattr(message, 'twist', message)
    velocity = np.array([twist.linear.x, twist.linear.y, twist.angular.z, twist.angular.y])
    rest = (twist.linear.z, twist.angular.x)
    if not (np.isfinite(velocity).all() and all(map(math.isfinite, rest))):
        raise MotionError('a velocity is finite', (*velocity.tolist(), *rest),
                          'check the publisher of cmd_vel')
    return velocity


def fill_twist(message: Any, velocity: np.ndarray) -> Any:
    """Write [4] vx, vy, wz, tilt rate into a Twist or TwistStamped; returns the message.

    Raises:
        MotionError: NaN or infinity, which no base must see.
    """
    vx, vy, wz, tilt = (float(value) for value in velocity)
    if not all(map(math.isfinite, (vx, vy, wz, tilt))):
        raise MotionError('a velocity is finite', (vx, vy, wz, tilt), 'send zero instead')
    twist = getattr(message, 'twist', message)
    twist.linear.x, twist.linear.y, twist.linear.z = vx, vy, 0.0
    twist.angular.x, twist.angular.y, twist.angular.z = 0.0, tilt, wz
    return message


def odometry_to_array(message: Any) -> np.ndarray:
    """Odometry to [7] float64: x, y [m], yaw [rad], vx, vy [m/s], wz [rad/s], stamp [s].

    Raises:
        MotionError: NaN or infinity, a number beyond what any robot does, or a quaternion that
            is none.
    """
    pose, twist = message.pose.pose, message.twist.twist
    q = pose.orientation
    values = np.array([pose.position.x, pose.position.y,
                       quaternion_to_yaw(q.x, q.y, q.z, q.w),
                       twist.linear.x, twist.linear.y, twist.angular.z,
                       message.header.stamp.sec + message.header.stamp.nanosec * 1e-9])
    if not np.isfinite(values).all():
        raise MotionError('odometry is finite', values.tolist(), 'check the base driver')
    position, speed = np.abs(values[:2]).max(), np.abs(values[3:6]).max()
    if position > MAX_POSITION_M or speed > MAX_SPEED_M_RAD_PER_S:
        raise MotionError(f'a pose lies within {MAX_POSITION_M:g} m, and no robot is faster than '
                          f'{MAX_SPEED_M_RAD_PER_S:g} m/s', values.tolist(),
                          'check the base driver')
    return values


def fill_odometry(message: Any, x: float, y: float, yaw: float, velocity: np.ndarray) -> Any:
    """Write pose and body velocity [4] into an Odometry; header and frames stay the caller's."""
    pose = message.pose.pose
    pose.position.x, pose.position.y = float(x), float(y)
    (pose.orientation.x, pose.orientation.y, pose.orientation.z,
     pose.orientation.w) = yaw_to_quaternion(float(yaw))
    fill_twist(message.twist, velocity)
    return message


def yaw_to_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """A turn about z as (x, y, z, w)."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def quaternion_to_yaw(x: float, y: float, z: float, w: float) -> float:
    """Yaw of an orientation [rad].

    Raises:
        MotionError: the quaternion's length is not 1 (within 1 %).
    """
    length = x * x + y * y + z * z + w * w
    if not abs(length - 1.0) < 0.02:  # also catches NaN
        raise MotionError('a quaternion has length 1', (x, y, z, w), 'normalise it')
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
