"""Pictures of a robot's camera, and of its goals, as its policy takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vn_msgs_py import images
from vn_nav.calibration import assumed_calibration, is_rectified, read_calibration
from vn_nav.errors import UserError
from vn_nav.observation import needed_side
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.local_features import SIDE
from vn_nav.policy.search.views import SIFT, View
from vn_nav.rectification import Camera, flatten_goal

# A square picture [3,S,S], its zoom, and all of it where the policy verifies.
Prepared = tuple[np.ndarray, float, View | None]


class CameraPictures:
    """Decodes and rectifies, and cuts or pads what is left to the policy's view.

    Args:
        runtime: of the policy.
        assumed_fov: of the shorter side [rad], of a camera that does not say; None: the policy's.
        rectified: the pictures are rectified already, see `vn_nav.calibration.RECTIFY`.

    Attributes:
        camera: the robot's, as far as it is known.
    """

    def __init__(self, runtime: PolicyRuntime, assumed_fov: float | None = None,
                 rectified: bool = False):
        self._runtime, self._assumed_fov, self._rectified = runtime, assumed_fov, rectified
        self.camera: Camera | None = None

    @property
    def fov(self) -> float | None:
        """Field of view of the camera's shorter side [rad], as far as it is known."""
        return self._assumed_fov if self.camera is None else self.camera.fov

    @property
    def aspect(self) -> float:
        """Width of the camera's pictures over their height."""
        return 1.0 if self.camera is None else self.camera.aspect

    def read_camera(self, message) -> Camera | None:
        """The camera that a CameraInfo describes; None: it is the one that is known.

        Raises:
            UserError: see `read_calibration`; or it is not calibrated, and nothing is assumed.
        """
        calibration = read_calibration(message, rectified=self._rectified)
        if calibration is None and self._assumed_fov is not None:
            calibration = assumed_calibration(message, self._assumed_fov)
        if calibration is None:
            raise UserError('camera_info has the focal length of the camera',
                            'zeros: it is not calibrated',
                            'calibrate it (camera_calibration), or declare what it sees with '
                            '-p camera_fov:=DEGREES')
        if self.camera is not None and self.camera.calibration.is_near(calibration):
            return None
        return Camera(calibration, self._runtime.camera_fov)

    def read_goal_camera(self, message) -> Camera | None:
        """The camera that took a goal picture; None: it is not calibrated.

        Raises:
            UserError: see `read_calibration`.
        """
        calibration = read_calibration(message)
        return None if calibration is None else Camera(calibration, self._runtime.camera_fov)

    def check(self) -> None:
        """Raise UserError where the camera sees less than the policy needs."""
        if self.fov is not None:
            self._runtime.check_camera(self.fov, self.aspect)

    def of(self, message) -> Prepared:
        """A picture of the camera."""
        camera, fov = self.camera, self.fov
        picture = self._decode(message, camera)
        return self._show(picture if camera is None else camera.rectify(picture), fov)

    def goal(self, message, other: Camera | None = None) -> Prepared:
        """A goal picture, cut or padded to what the robot's camera shows the policy.

        Args:
            message: the picture; other: camera that took it; None: nobody says.
        """
        camera = self.camera
        picture, fov = flatten_goal(self._decode(message, other or camera), camera, other)
        zoom = None if other is None else self._runtime.zoom_of(self.fov, self.aspect)
        return self._show(picture, fov or self._assumed_fov, zoom)

    def file(self, picture: np.ndarray, fov: float | None) -> np.ndarray:
        """As `goal`, [3,S,S], of a picture [H,W,3] and its field of view; None: the robot's."""
        if fov is None:
            return self._runtime.prepare(picture, self.fov)[0]
        return self._runtime.prepare(picture, fov, self._runtime.zoom_of(self.fov, self.aspect))[0]

    def _decode(self, message, camera: Camera | None) -> np.ndarray:
        size, target = self._runtime.size, self._runtime.camera_fov
        smallest = (needed_side(size, self.fov, target) if camera is None
                    else camera.needed_side(size, target))
        return images.decode_rgb(message, max(smallest, SIDE) if self._runtime.verify == SIFT
                                 else smallest)

    def _show(self, picture: np.ndarray, fov: float | None, zoom: float | None = None) -> Prepared:
        view = (View(picture, fov or self._runtime.camera_fov) if self._runtime.verify == SIFT
                else None)
        return *self._runtime.prepare(picture, fov, zoom), view


def pictures_of(node, runtime: PolicyRuntime, value: Mapping[str, Any]) -> CameraPictures:
    """By a node's parameters camera_fov [deg], rectify and image_transport."""
    topic = node.resolve_topic_name(
        'image_raw/compressed' if value['image_transport'] == 'compressed' else 'image_raw')
    rectified = is_rectified(topic) if value['rectify'] == 'auto' else value['rectify'] == 'never'
    return CameraPictures(runtime, math.radians(value['camera_fov']) or None, rectified)
