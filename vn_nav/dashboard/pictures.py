"""Pictures as a browser takes them."""

from __future__ import annotations

import cv2
import numpy as np


def jpeg(rgb: np.ndarray, side: int | None = None, quality: int = 80) -> bytes:
    """A picture [H,W,3] uint8 as JPEG, its shorter side at most `side` pixels."""
    if side is not None and (least := min(rgb.shape[:2])) > side:
        scale = side / least
        rgb = cv2.resize(rgb, (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale)),
                         interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode('.jpg', cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR),
                              [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done  # nothing that a picture of this kind could do wrong
    return data.tobytes()
