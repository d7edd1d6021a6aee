"""Observations, and the only resize and crop between a picture and the network.

NumPy and OpenCV alone: the simulator, the bag reader and the live camera share this code, so that
one frame gives one tensor whichever way it came. Normalisation is the network's first layer.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from vn_nav.errors import UserError

OUTSIDE_GREY = 120  # grey level of a square picture where the camera's own does not reach


class Observation(NamedTuple):
    """What the network may see (and nothing else). Leading dimensions are [T,B] or [B]."""

    image: Any  # [...,3,H,W] uint8 RGB
    goals: Any  # [G,3,H,W] uint8, the distinct goals of this batch; None: a task without
    goal_index: Any  # [...] int64 into goals: each goal is kept, and encoded, once
    last_action: Any  # [...] int64, -1 at an episode's start
    last_reward: Any  # [...] float32, the sparse task reward only
    # Beyond these, for the architecture icra2017: `scene` [...] int64, the number of the scene,
    # and `features` [...,F] float32, the picture's frozen features.
    extras: dict[str, Any] | None = None


def preprocess(image: np.ndarray, size: int, *, fov: float | None = None,
               target_fov: float | None = None) -> np.ndarray:
    """Centre-crop an RGB picture to a square and resize it to the network's input.

    Args:
        image: [H,W,3] uint8 RGB.
        size: side of the square output [pixels].
        fov: field of view of the picture's shorter side [rad], if the camera's is known.
        target_fov: field of view that the network was trained with [rad]. A wider camera is
            cropped to it; a picture of equal size and field of view passes unchanged.

    Returns:
        [3,size,size] uint8 RGB, contiguous.

    Raises:
        UserError: a wrong shape or type, or a camera narrower than the network's by over 2 %.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UserError('a picture is uint8 [H,W,3]', f'{image.dtype} {image.shape}',
                        'decode it with vn_msgs_py.images first')
    height, width = image.shape[:2]
    side = min(height, width)
    if fov is not None and target_fov is not None:
        side = round(side * crop_fraction(fov, target_fov))
    top, left = (height - side) // 2, (width - side) // 2
    square = image[top:top + side, left:left + side]
    if side != size:
        # Area averaging when shrinking: no aliasing; bilinear when enlarging.
        interpolation = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
        square = cv2.resize(square, (size, size), interpolation=interpolation)
    return np.ascontiguousarray(square.transpose(2, 0, 1))


def preprocess_map(values: np.ndarray, size: int, *, fov: float | None = None,
                   target_fov: float | None = None) -> np.ndarray:
    """The same square of a depth or label picture [H,W], as [size,size] of its type.

    Never averaged: a mean of class ids or across an edge is nothing that is there. The pixel
    nearest to each centre is taken.
    """
    side = min(values.shape)
    if fov is not None and target_fov is not None:
        side = round(side * crop_fraction(fov, target_fov))
    top, left = (values.shape[0] - side) // 2, (values.shape[1] - side) // 2
    nearest = ((np.arange(size) + 0.5) * side / size).astype(np.int64)
    return np.ascontiguousarray(values[top + nearest[:, None], left + nearest])


def needed_side(size: int, fov: float | None = None, target_fov: float | None = None) -> int:
    """Pixels that a picture's shorter side needs so that `preprocess` never enlarges it."""
    if fov is None or target_fov is None:
        return size
    return math.ceil(size / crop_fraction(fov, target_fov))


def crop_fraction(fov: float, target_fov: float) -> float:
    """Share of a picture's side that shows `target_fov`, for a pinhole camera with `fov` [rad].

    Raises:
        UserError: the camera is narrower than the network needs (by more than 2 %).
    """
    fraction = math.tan(target_fov / 2) / math.tan(fov / 2)
    if fraction > 1.02:
        raise UserError(
            f'the camera sees at least the {math.degrees(target_fov):.0f} deg that the policy was '
            'trained with', f'{math.degrees(fov):.0f} deg on its shorter side',
            'use a wider lens, or train a policy for this camera (camera_fov of the robot)')
    return min(fraction, 1.0)
