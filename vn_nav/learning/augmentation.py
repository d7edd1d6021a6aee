"""Pictures changed as other cameras, other light and passers-by would change them.

What a simulator draws is alike in many ways in which photographs are not. Changes that leave
geometry as it is need no label.
"""

from __future__ import annotations

import cv2
import numpy as np

SHARE = 0.4  # of the pictures that are changed
GAMMA = 1.8  # at most, and its inverse at least
CONTRAST = 1.6  # likewise, about the picture's own mean
GAIN = 0.18  # of a colour channel, at most
GREY_SHARE = 0.15  # of the changed pictures that lose all colour
SATURATION = 1.6  # at most, and its inverse at least
BLUR_SHARE, BLUR_PIXELS = 0.4, 1.2  # standard deviation, at most
SHADED_SHARE, SHADED = 0.3, 0.5  # darker towards the corners by this share at most
NOISE = 10.0  # grey levels, standard deviation at most
COVERED_SHARE = 0.2  # something stands before the camera
COVERED = 0.45  # of a side at most


def augment(images: np.ndarray, random: np.random.Generator) -> None:
    """Change some pictures [V,3,S,S] uint8 in place."""
    size = images.shape[-1]
    slope = (np.arange(size) + 0.5) / size * 2 - 1
    off_axis = (slope[:, None] ** 2 + slope[None] ** 2) / 2  # [S,S] 0 to 1
    for k in np.flatnonzero(random.random(len(images)) < SHARE):
        picture = _recoloured(images[k], random)
        if random.random() < SHADED_SHARE:
            picture *= (1 - SHADED * random.random() * off_axis).astype(np.float32)
        if random.random() < COVERED_SHARE:
            _cover(picture, random)
        if random.random() < BLUR_SHARE:
            deviation = 0.3 + (BLUR_PIXELS - 0.3) * random.random()
            for channel in picture:
                cv2.GaussianBlur(channel, (0, 0), deviation, dst=channel)
        noise = random.standard_normal(picture.shape, np.float32)
        noise *= np.float32(NOISE * random.random())
        images[k] = np.clip(picture + noise, 0, 255)


def _recoloured(picture: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """In another exposure, contrast, white balance and saturation: [3,S,S] float32."""
    gamma, contrast, saturation = (
        most ** random.uniform(-1, 1) for most in (GAMMA, CONTRAST, SATURATION))
    curve = 255 * (np.arange(256) / 255) ** gamma
    mean = curve[picture[:, ::4, ::4]].mean()
    curve = mean + contrast * (curve - mean)
    gains = 1 + GAIN * random.uniform(-1, 1, (3, 1))
    curves = np.clip(gains * curve, 0, 255).astype(np.float32)
    changed = np.stack([own[channel] for own, channel in zip(curves, picture, strict=True)])
    grey = changed.mean(0, keepdims=True)
    changed -= grey
    changed *= np.float32(0 if random.random() < GREY_SHARE else saturation)
    changed += grey
    return changed


def _cover(picture: np.ndarray, random: np.random.Generator) -> None:
    """A rectangle of one colour over some of a picture [3,S,S] float32, in place."""
    size = picture.shape[-1]
    height, width = (np.int64(size * COVERED * random.uniform(0.2, 1)) for _ in range(2))
    top, left = random.integers(0, size - height + 1), random.integers(0, size - width + 1)
    picture[:, top:top + height, left:left + width] = random.uniform(0, 255, (3, 1, 1))
