"""What `vn_nav bag doctor` looks for in the messages themselves: pictures, lenses, motions."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from vn_msgs_py.images import ImageError, decode_depth, decode_labels, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav.bags.doctor.figures import (
    DRIVER,
    ERROR,
    WARNING,
    Command,
    Findings,
    Motion,
    ReceivedTopic,
)
from vn_nav.calibration import read_calibration
from vn_nav.errors import UserError
from vn_nav.observation import check_camera
from vn_nav.rectification import Camera

PICTURE_PERIOD_NS = 500_000_000  # ns between pictures that are decoded
BLACK_LEVEL = 16  # of 255: no pixel of a picture's thumbnail is brighter
# Of 255: a thumbnail with a smaller standard deviation shows nothing.
FLAT_SIGMA_LEVELS = 1.0
MAX_LISTED_SHAPES = 5  # encodings and sizes of a topic that are listed
FROZEN_TRAVEL_M_RAD = 0.1  # m or rad: after this motion an unchanged picture is a fault


class ContentChecks:
    """Looks into messages that have a role in training.

    Args:
        findings: gets what is wrong.
        fov: field of view that the policy needs [rad]; None: not asked.
        any_lens: whether it also drives by narrower cameras, see `through_lens`.

    Attributes:
        odometry: how far the robot has gone.
        command: how far the commands would have moved it.
    """

    def __init__(self, findings: Findings, fov: float | None, any_lens: bool = False):
        self._add, self._fov, self._any_lens = findings.add, fov, any_lens
        self.odometry, self.command = Motion(), Command()
        self._camera: Camera | None = None
        self._lens: tuple[float, int, int] | None = None  # focal length, width, height [pixels]

    def examine(self, topic: ReceivedTopic, value: Any, at: int) -> None:
        """Look into a message of a topic with a role.

        Args:
            topic: whose message.
            value: the message.
            at: when it was recorded [ns].
        """
        name, role = topic.connection.topic, topic.role
        try:
            if role == 'odometry':
                self.odometry.pose(odometry_to_array(value))
            elif role == 'command':
                self.command.add(twist_to_array(value), at)
            elif role == 'camera_info':
                self._camera_info(name, value, at)
            elif role in ('image', 'depth', 'labels', 'goal'):
                self._picture(topic, value, at)
        except MotionError as error:
            self._add(ERROR, name, 'motion', str(error), at, DRIVER)
        except ImageError as error:
            self._add(WARNING if role in ('depth', 'labels') else ERROR, name, 'picture',
                      str(error), at, 'set an encoding that can be read, and record again')

    def _picture(self, topic: ReceivedTopic, value: Any, at: int) -> None:
        name = topic.connection.topic
        if topic.role == 'image':
            self._frozen(topic, np.asarray(value.data), at)
        raw = not hasattr(value, 'format')
        if raw:
            self._shape(topic, f'{_short(value.encoding)} {value.width} x {value.height}', at)
        if topic.looked is not None and abs(at - topic.looked) < PICTURE_PERIOD_NS:
            return
        topic.looked = at
        if topic.role in ('depth', 'labels'):
            (decode_depth if topic.role == 'depth' else decode_labels)(value)
            return
        picture = decode_rgb(value)
        if not raw:
            self._shape(topic, f'{_short(value.format)} {picture.shape[1]} x '
                        f'{picture.shape[0]}', at)
        if topic.role == 'image' and self._camera is not None and not self._camera.fits(picture):
            self._add(ERROR, name, 'format', f'is {picture.shape[1]} x {picture.shape[0]}, '
                      'another format than that of its camera_info', at,
                      'record the camera_info that belongs to these pictures')
        small = cv2.resize(picture, (16, 16), interpolation=cv2.INTER_AREA)
        if small.max() < BLACK_LEVEL:
            self._add(WARNING, name, 'black', 'is black', at, 'remove the lens cap, switch on the '
                      'light, or leave this part out')
        elif small.std() < FLAT_SIGMA_LEVELS:
            self._add(WARNING, name, 'flat', 'shows one colour', at, 'check exposure and lens, or '
                      'leave this part out')

    def _shape(self, topic: ReceivedTopic, shape: str, at: int) -> None:
        if topic.pictures and shape not in topic.pictures and topic.role != 'goal':
            self._add(ERROR, topic.connection.topic, 'shape', f'changes to {shape}', at,
                      'split the bag where the camera changes')
        if len(topic.pictures) < MAX_LISTED_SHAPES:
            topic.pictures[shape] = None

    def _frozen(self, topic: ReceivedTopic, data: np.ndarray, at: int) -> None:
        """Does the picture stay the same to the last bit while the robot moves?"""
        moved = self.odometry.total if self.odometry.poses else self.command.total
        # A few bytes differ in most pictures.
        same = (topic.before is not None and len(data) == len(topic.before)
                and np.array_equal(data[::997], topic.before[::997])
                and np.array_equal(data, topic.before))
        if not same:
            topic.before, topic.moved_before = data, moved
        elif moved - topic.moved_before > FROZEN_TRAVEL_M_RAD:
            self._add(ERROR, topic.connection.topic, 'frozen', 'stays the same while the robot '
                      'moves', at, 'check the camera and its cable, or leave this part out')

    def _camera_info(self, name: str, info: Any, at: int) -> None:
        lens = float(info.k[0]), int(info.width), int(info.height)
        if self._lens == lens:
            return
        if self._lens is not None:
            self._add(WARNING, name, 'changes', f'changes to a focal length of {lens[0]:g} pixels '
                      f'at {lens[1]} x {lens[2]}', at, 'split the bag where the camera changes')
        self._lens = lens
        if not (math.isfinite(lens[0]) and lens[0] > 0 and lens[1] > 0 and lens[2] > 0):
            self._add(WARNING, name, 'focal', f'has a focal length of {lens[0]:g} pixels at '
                      f'{lens[1]} x {lens[2]}', at, 'calibrate the camera (camera_calibration): '
                      'pictures cannot be cropped for a policy')
            return
        try:
            calibration = read_calibration(info)
            assert calibration is not None  # it has a focal length and a size
            self._camera = Camera(calibration, self._fov or 0.0)
        except UserError as error:
            self._add(ERROR, name, 'lens', f'cannot be used: {error.rule}, not {error.received}',
                      at, error.remedy)
            return
        if self._fov is not None:
            fov = self._camera.fov
            try:
                check_camera(fov, self._camera.aspect, self._fov, any_lens=self._any_lens)
            except UserError as error:
                self._add(ERROR, name, 'narrow', f'is of a camera with '
                          f'{math.degrees(fov):.0f} deg on its shorter side: {error.rule}', at,
                          error.remedy)


def _short(text: str) -> str:
    """What a message says of itself, fit for a terminal."""
    return text[:40] if text.isprintable() else repr(text[:40])
