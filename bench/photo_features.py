"""Local features of photographs, matched: a peer of what the networks of search say."""

from __future__ import annotations

import cv2
import numpy as np
from photo_sequence import Sequence

FEATURES = ('sift',)
MOST = 600  # features of a photograph
RATIO = 0.85  # of the distances of the best and the second-best match
LEAST = 8  # matches that make an essential matrix
PIXELS, SURE, ROUNDS = 1.5, 0.999, 300  # of the search for it
Found = tuple[np.ndarray, np.ndarray]  # [M,2] places in pixels, [M,128] descriptors of length 1


def inliers(name: str, sequence: Sequence, chosen: np.ndarray) -> np.ndarray:
    """How many matches of each two photographs agree with one motion of the camera, [K,K].

    Args:
        name: of `FEATURES`: RootSIFT, mutual best matches that pass the ratio test.
        sequence: the photographs; chosen: [K] which.
    """
    assert name in FEATURES
    detector = cv2.SIFT.create(MOST)
    every = [_detect(detector, sequence.images[k]) for k in chosen]
    found = np.zeros((len(chosen),) * 2)
    for i, one in enumerate(every):
        for j in range(i):
            found[i, j] = found[j, i] = _agree(one, every[j], sequence.intrinsics)
    return found


def _detect(detector: cv2.SIFT, photograph: np.ndarray) -> Found:
    grey = cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY)
    points, descriptors = detector.detectAndCompute(grey, np.empty(0))
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    whole = np.maximum(descriptors.sum(1, keepdims=True), 1e-6)
    return np.array([point.pt for point in points]), np.sqrt(descriptors / whole)


def _agree(one: Found, other: Found, intrinsics: np.ndarray) -> int:
    """Inliers of the essential matrix that also lie before both cameras."""
    if min(len(one[0]), len(other[0])) < LEAST:
        return 0
    alike = one[1] @ other[1].T
    best, back = alike.argmax(1), alike.argmax(0)
    gaps = np.sqrt(np.maximum(2 - 2 * np.partition(alike, -2, 1)[:, -2:], 0))
    good = (back[best] == np.arange(len(best))) & (gaps[:, 1] < RATIO * gaps[:, 0])
    if good.sum() < LEAST:
        return 0
    here, there = one[0][good], other[0][best[good]]
    essential, mask = cv2.findEssentialMat(here, there, intrinsics, cv2.RANSAC, SURE, PIXELS,
                                           ROUNDS)
    if essential is None or essential.shape != (3, 3):
        return 0
    return int(cv2.recoverPose(essential, here, there, intrinsics, mask=mask)[0])
