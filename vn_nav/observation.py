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
# rad, across: of a camera that `through_lens` admits.
NARROWEST, WIDEST = math.radians(50), math.radians(120)
SAME_LENS = 1.02  # tangents that differ by a smaller factor are one


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
    _check_picture(image)
    side = min(image.shape[:2])
    if fov is not None and target_fov is not None:
        side = round(side * crop_fraction(fov, target_fov))
    return _square(image, side, size)


def through_lens(image: np.ndarray, size: int, *, fov: float, target_fov: float,
                 zoom: float | None = None) -> tuple[np.ndarray, float]:
    """As `preprocess`, for a network that can be told how a lens magnifies.

    The square is as wide as the picture where the camera is narrower than the network's, and shows
    `target_fov` where it is wider. It is grey where the camera does not reach.

    Args:
        image, size, fov, target_fov: see `preprocess`.
        zoom: that the square has to have, as one of another camera has it; None: any.

    Returns:
        [3,size,size] uint8 RGB, and how many times it is magnified against the network's lens.

    Raises:
        UserError: a wrong shape or type, or a camera beyond `NARROWEST` or `WIDEST`.
    """
    _check_picture(image)
    height, width = image.shape[:2]
    across = fov_across(fov, width / height)
    check_lens(across)
    share = math.tan(target_fov / 2) / math.tan(across / 2)  # picture widths that are wanted
    if zoom is not None:
        return _square(image, round(width * share / zoom), size), zoom
    if share > SAME_LENS:
        return _square(image, width, size), share
    return _square(image, round(width * min(share, 1.0)), size), 1.0


def _check_picture(image: np.ndarray) -> None:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UserError('a picture is uint8 [H,W,3]', f'{image.dtype} {image.shape}',
                        'decode it with vn_msgs_py.images first')


def _square(image: np.ndarray, side: int, size: int) -> np.ndarray:
    """The middle `side` pixels of a picture [H,W,3] as [3,size,size], grey beyond its edges."""
    lacking = [max(side - length, 0) for length in image.shape[:2]]
    if any(lacking):
        (above, left), (below, right) = ([part // 2 for part in lacking],
                                         [part - part // 2 for part in lacking])
        image = cv2.copyMakeBorder(image, above, below, left, right, cv2.BORDER_CONSTANT,
                                   value=(OUTSIDE_GREY,) * 3)
    height, width = image.shape[:2]
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
    """Pixels that a picture's shorter side needs so that nothing here enlarges it."""
    if fov is None or target_fov is None:
        return size
    return math.ceil(size / min(math.tan(target_fov / 2) / math.tan(fov / 2), 1.0))


def fov_across(fov: float, aspect: float) -> float:
    """Horizontal field of view [rad] of a pinhole camera.

    Args:
        fov: of the picture's shorter side [rad].
        aspect: width of the picture over its height.
    """
    return 2 * math.atan(math.tan(fov / 2) * max(aspect, 1.0))


def check_lens(across: float) -> None:
    """Whether `through_lens` admits a camera of a horizontal field of view [rad].

    Raises:
        UserError: it is too narrow or too wide.
    """
    if not NARROWEST - 1e-6 <= across <= WIDEST + 1e-6:
        raise UserError(
            f'a camera for this policy sees {math.degrees(NARROWEST):.0f} to '
            f'{math.degrees(WIDEST):.0f} deg horizontally', f'{math.degrees(across):.0f} deg',
            'use another lens, or crop a wide picture and publish its own camera_info')


def check_camera(fov: float, aspect: float, target_fov: float, *, any_lens: bool) -> None:
    """Whether a policy can drive by a camera.

    Args:
        fov: of the picture's shorter side [rad]; aspect: its width over its height.
        target_fov: that the policy was trained with [rad].
        any_lens: it can be told how a lens magnifies, see `through_lens`.

    Raises:
        UserError: the camera sees too little or, with `any_lens`, too much.
    """
    if any_lens:
        check_lens(fov_across(fov, aspect))
    else:
        crop_fraction(fov, target_fov)


def crop_fraction(fov: float, target_fov: float) -> float:
    """Share of a picture's side that shows `target_fov`, for a pinhole camera with `fov` [rad].

    Raises:
        UserError: the camera is narrower than the network needs (by more than 2 %).
    """
    fraction = math.tan(target_fov / 2) / math.tan(fov / 2)
    if fraction > SAME_LENS:
        raise UserError(
            f'the camera sees at least the {math.degrees(target_fov):.0f} deg that the policy was '
            'trained with', f'{math.degrees(fov):.0f} deg on its shorter side',
            'use a wider lens, or train a policy for this camera (camera_fov of the robot)')
    return min(fraction, 1.0)
