"""The ideal camera behind a picture, as CameraInfo describes it."""

from __future__ import annotations

import math
from typing import Any


def intrinsics(width: int, height: int, fov: float) -> tuple[list[float], list[float]]:
    """The matrices k [9] and p [12], row by row, of a camera without distortion.

    A pixel's centre has integer coordinates (as in OpenCV and image_geometry), so the optical axis
    meets a picture of 84 pixels at 41.5.

    Args:
        width, height: of the picture [pixels].
        fov: of the shorter side [rad].
    """
    focal = min(width, height) / 2 / math.tan(fov / 2)
    x, y = (width - 1) / 2, (height - 1) / 2
    return ([focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0],
            [focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0])


def field_of_view(width: float, height: float, focal: float) -> float:
    """Of the shorter side [rad], of a camera with a focal length [pixels]; see `intrinsics`."""
    return 2 * math.atan(min(width, height) / 2 / focal)


def fill_camera_info(message: Any, width: int, height: int, fov: float) -> Any:
    """Describe a camera as of `intrinsics` in a CameraInfo; header and region stay the caller's.

    Returns:
        The message.
    """
    message.width, message.height, message.distortion_model = width, height, 'plumb_bob'
    message.d = [0.0] * 5
    message.k, message.p = intrinsics(width, height, fov)
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return message
