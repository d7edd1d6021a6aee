"""What a CameraInfo says of a camera, checked. No ROS: any object with its fields will do."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any

import numpy as np

from vn_msgs_py.camera import field_of_view, fill_camera_info
from vn_nav.errors import UserError

PINHOLE_FOV_RAD = math.radians(5), math.radians(170)  # by the focal length, on the shorter side
MOST_TURNED_RAD = math.radians(20)  # to line up the cameras of a pair
EQUIDISTANT = 'equidistant'
# By name in sensor_msgs/distortion_models, and as some drivers write it: numbers in `d`.
COEFFICIENTS = {'plumb_bob': (4, 5), 'rational_polynomial': (8, 12, 14), EQUIDISTANT: (4,),
                'fisheye': (4,)}
SAME = 1e-3  # share, or number, that measured numbers of one camera differ by
RECTIFY = 'auto', 'never', 'always'  # auto: unless the topic is called image_rect
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A camera; pixels are those of the whole sensor picture, and a centre is an integer."""

    width: int
    height: int
    model: str  # plumb_bob, rational_polynomial or equidistant
    distortion: tuple[float, ...]  # as OpenCV takes it; empty: none
    focal: tuple[float, float]  # pixels, across and down
    centre: tuple[float, float]  # where the optical axis meets the picture, column and row
    rotation: tuple[float, ...]  # [9] row by row, from the camera's frame to the rectified one
    region: tuple[int, int, int, int]  # that pictures show: first column, first row, width, height
    binning: tuple[int, int]  # sensor pixels that a picture's pixel takes, across and down

    def is_near(self, other: Calibration) -> bool:
        """Whether the two describe one camera: a lens that focuses changes a little."""
        return (self._facts() == other._facts() and all(
            np.allclose(mine, its, rtol=SAME, atol=SAME)
            for mine, its in zip(self._measured(), other._measured(), strict=True)))

    def _facts(self) -> tuple:
        return (self.width, self.height, self.model, len(self.distortion), self.region,
                self.binning)

    def _measured(self) -> tuple[tuple[float, ...], ...]:
        return self.distortion, self.focal, self.centre, self.rotation


def read_calibration(info: Any, *, rectified: bool = False) -> Calibration | None:
    """What a CameraInfo says.

    Args:
        info: the message. A `k` with a focal length alone stands for square pixels and an axis
            through the middle.
        rectified: the pictures are rectified already (image_rect): P describes them, not K and D.

    Returns:
        None: the camera is not calibrated (K is zero, or there is no size).

    Raises:
        UserError: it is no camera's, or has a distortion model that is not known.
    """
    width, height = int(info.width), int(info.height)
    k, p = ([float(value) for value in matrix] for matrix in (info.k, info.p))
    if min(width, height) <= 0 or k[0] == 0:
        return None
    if rectified and p[0] != 0:
        focal, centre = (p[0], p[5]), (p[2], p[6])
    else:
        focal, centre = (k[0], k[4]), (k[2], k[5])
    focal = focal[0], focal[1] or focal[0]
    if centre == (0.0, 0.0):
        centre = (width - 1) / 2, (height - 1) / 2
    _check_lens(width, height, focal, centre)
    model, distortion = ('plumb_bob', ()) if rectified else _distortion(info)
    rotation = IDENTITY if rectified else _rotation(info)
    roi = info.roi
    region = int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    if 0 in region[2:]:
        region = 0, 0, width, height
    if region[0] + region[2] > width or region[1] + region[3] > height:
        raise UserError(f'the region of a camera_info lies in its {width} x {height} pixels',
                        region, 'check the camera driver')
    binning = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    return Calibration(width, height, model, distortion, focal, centre, rotation, region, binning)


def assumed_calibration(info: Any, fov: float) -> Calibration | None:
    """A pinhole camera of a field of view [rad], for one whose CameraInfo is not calibrated.

    Returns:
        None: it does not even say its size.
    """
    if min(info.width, info.height) <= 0:
        return None
    ideal = fill_camera_info(types.SimpleNamespace(
        roi=info.roi, binning_x=info.binning_x, binning_y=info.binning_y),
        int(info.width), int(info.height), fov)
    return read_calibration(ideal)


def is_rectified(topic: str) -> bool:
    """Whether a topic has the name of rectified pictures: image_rect, image_rect_color ..."""
    return any(part.startswith('image_rect') for part in topic.split('/'))


def _check_lens(width: int, height: int, focal: tuple[float, float],
                centre: tuple[float, float]) -> None:
    side = min(width, height)
    least, most = PINHOLE_FOV_RAD
    for length in focal:
        fov = field_of_view(side, side, length)
        if not least <= fov <= most:  # a NaN is neither
            raise UserError(
                f'a camera sees {math.degrees(least):.0f} to {math.degrees(most):.0f} deg',
                f'camera_info with {math.degrees(fov):.3g} deg', 'calibrate the camera')
    if not (0 <= centre[0] < width and 0 <= centre[1] < height):
        raise UserError("a camera's axis meets its picture",
                        f'camera_info of {width} x {height} pixels with {centre}',
                        'calibrate the camera')


def _distortion(info: Any) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients; a lens without distortion is a plumb_bob without coefficients."""
    model, d = str(info.distortion_model), tuple(float(value) for value in info.d)
    if not any(d):
        # Zeros of the equidistant model are a fisheye lens all the same.
        if model not in (EQUIDISTANT, 'fisheye') or not d:
            return 'plumb_bob', ()
    counts = COEFFICIENTS.get(model)
    if counts is None:
        raise UserError('distortion_model is plumb_bob, rational_polynomial or equidistant',
                        f'camera_info with {model[:40]!r}',
                        'calibrate with one of them, or remap image_raw to image_rect')
    if len(d) not in counts or not np.isfinite(d).all():
        raise UserError(f'{model} has {" or ".join(map(str, counts))} finite coefficients',
                        f'camera_info with {len(d)}: {d[:5]}', 'calibrate the camera')
    return EQUIDISTANT if model == 'fisheye' else model, d


def _rotation(info: Any) -> tuple[float, ...]:
    r = tuple(float(value) for value in info.r)
    if not any(r):
        return IDENTITY
    matrix = np.array(r).reshape(3, 3)
    if not (np.isfinite(matrix).all() and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3)
            and np.diag(matrix).min() > math.cos(MOST_TURNED_RAD)):
        raise UserError('the matrix r of a camera_info is a rotation of at most '
                        f'{math.degrees(MOST_TURNED_RAD):.0f} deg', r, 'calibrate the camera')
    return r
