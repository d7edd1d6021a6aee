"""Pictures of a calibrated camera as a pinhole camera would take them that looks along its axis.

The distortion models are OpenCV's, and so those of image_proc. Maps are computed once for each
size of pictures.
"""

from __future__ import annotations

import dataclasses
import math
import threading

import cv2
import numpy as np

from vn_msgs_py.camera import field_of_view
from vn_msgs_py.image_error import ImageError
from vn_nav.calibration import EQUIDISTANT, IDENTITY, Calibration
from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY, WIDEST, needed_side

SAME_PX = 1.0  # a picture that a pinhole camera's differs from by less is one
NARROWEST_RAD = math.radians(5)
RAYS = 2000  # from the axis to each side, that are looked at for where the picture ends
FOLD_TANGENT = 6.0  # from the axis: more than a corner of a rectified picture has
GRID = 9  # columns of pixels that are compared with a pinhole camera's
GREY_SIDE = 0.1  # of the half that an axis off the middle leaves the smaller, grey at most
SAME_FORMAT = 0.01  # a picture's height may differ by this share from what its width asks for
MOST_GROWN = 2.0  # times the longer side that a rectified picture has at most
KEPT_SIZES = 4  # of pictures, whose maps are kept
OUTSIDE_PX = -10.0  # a column and row where no picture is
FAR_PX = 30_000.0  # maps hold 16 bits


class Camera:
    """A calibrated camera.

    Args:
        calibration: of it.
        target_fov: that a policy needs [rad]. Rectified pictures show `WIDEST` each way, or this
            if it is more: a pinhole picture of a fisheye lens has no end.

    Attributes:
        calibration: the same.
        fov: field of view of the rectified pictures' shorter side [rad].
        aspect: their width over their height.
        is_pinhole: the camera's pictures need no rectification.

    Raises:
        UserError: the calibration leaves nothing to be seen.
    """

    def __init__(self, calibration: Calibration, target_fov: float = 0.0):
        self.calibration = calibration
        self._maps: dict[tuple[int, int, bool], tuple[np.ndarray, np.ndarray]] = {}
        self._lock = threading.Lock()
        self._fold = self._fold_radius()
        widest = math.tan(max(WIDEST, target_fov) / 2)
        width, height = map(float, calibration.region[2:])
        self.is_pinhole = self._is_pinhole()
        if self.is_pinhole:
            # As the focal length says, to the last digit: simulators and real cameras are one.
            focal = calibration.focal[0]
            self._cut = max(width, height) / 2 / focal > widest
            if self._cut:
                width, height = (min(side, 2 * widest * focal) for side in (width, height))
            self._half = np.array([width, height]) / 2 / focal
            self.fov = field_of_view(width, height, focal)
        else:
            self._half, self._cut = self._extents(widest), False
            self.fov = 2 * math.atan(min(self._half))
        if self.fov < NARROWEST_RAD:
            raise UserError(
                f'a camera sees at least {math.degrees(NARROWEST_RAD):.0f} deg along its axis',
                f'camera_info with {math.degrees(self.fov):.2g} deg', 'calibrate the camera')
        self.aspect = float(self._half[0] / self._half[1])

    def fits(self, picture: np.ndarray) -> bool:
        """Whether a picture [H,W,...] has the format that the calibration is for."""
        height, width = picture.shape[:2]
        binning = self.calibration.binning
        _, _, full_width, full_height = self.calibration.region
        wanted = width * (full_height / binning[1]) / (full_width / binning[0])
        return abs(height - wanted) <= 1 + SAME_FORMAT * wanted

    def needed_side(self, size: int, target_fov: float) -> int:
        """Pixels that the shorter side of its pictures needs so that nothing is enlarged."""
        _, _, width, height = self.calibration.region
        shown = 2 * min(self._half) * self.calibration.focal[0]  # sensor pixels
        return math.ceil(needed_side(size, self.fov, target_fov) * max(
            min(width, height) / shown, 1.0))

    def rectify(self, picture: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        """The picture that a pinhole camera would have taken.

        Args:
            picture: [H,W,C] or [H,W], in the calibration's size or a smaller one.
            nearest: take the nearest pixel, as for depth and labels, which are never averaged.

        Returns:
            The same type, of `fov` and `aspect`. Where the lens does not reach it is grey
            (`OUTSIDE_GREY`); with `nearest` NaN, or 0.

        Raises:
            ImageError: its format is another than the calibration's.
        """
        if not self.fits(picture):
            height, width = picture.shape[:2]
            _, _, full_width, full_height = self.calibration.region
            raise ImageError(f"camera_info has the pictures' format, {full_width} x {full_height}",
                             f'a picture of {width} x {height}',
                             'publish the camera_info of this picture, or calibrate the camera')
        if self.is_pinhole:
            return self._middle(picture) if self._cut else picture
        key = (*picture.shape[:2], nearest)
        with self._lock:  # bags are decoded in several threads
            if key not in self._maps:
                while len(self._maps) >= KEPT_SIZES:
                    del self._maps[next(iter(self._maps))]
                self._maps[key] = self._make_maps(*key)
            maps = self._maps[key]
        outside = OUTSIDE_GREY if not nearest else (
            math.nan if picture.dtype.kind == 'f' else 0)
        return cv2.remap(picture, *maps,
                         cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_CONSTANT, borderValue=(outside,) * 4)

    def _middle(self, picture: np.ndarray) -> np.ndarray:
        """A picture of a very wide pinhole camera, cut."""
        height, width = picture.shape[:2]
        focal = self.calibration.focal[0] * width / self.calibration.region[2]
        left, top = (max(round(length / 2 - half * focal), 0)
                     for length, half in zip((width, height), self._half, strict=True))
        return picture[top:height - top, left:width - left]

    def _make_maps(self, height: int, width: int, nearest: bool) -> tuple[np.ndarray, np.ndarray]:
        """For `cv2.remap`: where each pixel of the rectified picture lies in one of this size."""
        left, top, full_width, full_height = self.calibration.region
        across, down = width / full_width, height / full_height
        # At the axis neither larger nor smaller.
        focal = min(math.sqrt(across * down * math.prod(self.calibration.focal)),
                    MOST_GROWN * max(width, height) / 2 / max(self._half))
        size = tuple(max(round(2 * half * focal), 1) for half in self._half)
        columns, rows = self._where(size, focal)
        columns, rows = (columns - left + 0.5) * across - 0.5, (rows - top + 0.5) * down - 0.5
        nowhere = ~((np.abs(columns) < FAR_PX) & (np.abs(rows) < FAR_PX))
        columns[nowhere] = rows[nowhere] = OUTSIDE_PX
        if nearest:
            columns, rows = np.rint(columns), np.rint(rows)
        return cv2.convertMaps(columns, rows, cv2.CV_16SC2, nninterpolation=nearest)

    def _is_pinhole(self) -> bool:
        """Whether no pixel lies elsewhere than in a pinhole camera's picture."""
        camera = self.calibration
        if camera.model == EQUIDISTANT or camera.binning[0] != camera.binning[1]:
            return False
        left, top, width, height = camera.region
        size = GRID, max(round(GRID * height / width), 2)
        columns, rows = self._where(size, camera.focal[0] * (GRID - 1) / (width - 1))
        step = (width - 1) / (GRID - 1)
        off = np.abs([columns - left - (width - 1) / 2 - step * _steps(size[0]),
                      rows - top - (height - 1) / 2 - step * _steps(size[1])[:, None]])
        return bool(off.max() < SAME_PX)  # NaN is not

    def _extents(self, widest: float) -> np.ndarray:
        """How far a rectified picture reaches from the axis, right and down, as tangents [2]."""
        left, top, width, height = self.calibration.region
        found = []
        for size in ((2 * RAYS + 1, 1), (1, 2 * RAYS + 1)):
            columns, rows = (part.ravel() for part in self._where(size, RAYS / widest))
            seen = ((np.abs(columns - left - (width - 1) / 2) <= width / 2)
                    & (np.abs(rows - top - (height - 1) / 2) <= height / 2))
            both = [int(np.append(seen[step], False).argmin()) for step in (
                slice(RAYS, None), slice(RAYS, None, -1))]
            # An axis off the middle leaves one side less. A policy's view is centred on the axis:
            # a little of it may be grey, so that a lens that is just wide enough stays so.
            reach = (np.array(both) - 1) * widest / RAYS
            found.append(max(min(reach.mean(), reach.min() / (1 - GREY_SIDE)), 0.0))
        return np.array(found)

    def _where(self, size: tuple[int, int], focal: float) -> tuple[np.ndarray, np.ndarray]:
        """Sensor pixels that a pinhole camera's pixels show.

        Args:
            size: width and height of its picture, whose middle is on the axis.
            focal: its focal length [pixels].

        Returns:
            Columns and rows, [height,width] float32 each. NaN beyond the angle where the lens's
            polynomial turns back: it speaks of another ray's pixel there.
        """
        camera = self.calibration
        matrix = np.array([[camera.focal[0], 0, camera.centre[0]],
                           [0, camera.focal[1], camera.centre[1]], [0, 0, 1]])
        columns, rows = _sensor_pixels(camera, matrix, size, focal)
        if self._fold < math.inf:
            x, y = np.meshgrid(*(_steps(length) / focal for length in size))
            rays = np.stack([x, y, np.ones_like(x)], -1) @ np.array(camera.rotation).reshape(3, 3)
            beyond = np.hypot(rays[..., 0], rays[..., 1]) >= self._fold * rays[..., 2]
            columns[beyond] = rows[beyond] = math.nan
        return columns, rows

    def _fold_radius(self) -> float:
        """The tangent up to which the picture of a ray moves outwards as the ray does."""
        if not self.calibration.distortion:
            return math.inf
        radial = list(self.calibration.distortion)
        if self.calibration.model != EQUIDISTANT:
            radial[2:4] = 0.0, 0.0  # the tangential part
        lens = dataclasses.replace(self.calibration, distortion=tuple(radial), rotation=IDENTITY)
        columns, _ = _sensor_pixels(lens, np.eye(3), (2 * RAYS + 1, 1), RAYS / FOLD_TANGENT)
        with np.errstate(invalid='ignore'):
            falls = ~(np.diff(columns[0, RAYS:]) > 0)  # what is not finite does
        return float(falls.argmax()) * FOLD_TANGENT / RAYS if falls.any() else math.inf


def flatten_goal(picture: np.ndarray, camera: Camera | None, other: Camera | None = None
                 ) -> tuple[np.ndarray, float | None]:
    """A goal picture as a pinhole camera would take it.

    Args:
        picture: [H,W,3] uint8 RGB.
        camera: the robot's; None: unknown.
        other: that took the picture; None: nobody says.

    Returns:
        The picture, and the field of view of its shorter side [rad]; None: unknown.
    """
    if other is not None:
        return other.rectify(picture), other.fov
    if camera is None:
        return picture, None
    # One of another format is of a camera that nobody describes: as wide as the robot's.
    return camera.rectify(picture) if camera.fits(picture) else picture, camera.fov


def _steps(length: int) -> np.ndarray:
    """Pixels [length] right of, or below, the middle of so many."""
    return np.arange(length) - (length - 1) / 2


def _sensor_pixels(lens: Calibration, matrix: np.ndarray, size: tuple[int, int], focal: float
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, see `Camera._where`, by a lens and a camera matrix [3,3]."""
    pinhole = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    rotation, d = np.array(lens.rotation).reshape(3, 3), np.array(lens.distortion)
    make = (cv2.fisheye.initUndistortRectifyMap if lens.model == EQUIDISTANT
            else cv2.initUndistortRectifyMap)
    return make(matrix, d if len(d) else np.zeros(4), rotation, pinhole, size, cv2.CV_32FC1)
