"""Local features of full pictures: what two have in common, and how their cameras stand.

RootSIFT (Lowe 2004; Arandjelovic and Zisserman 2012), mutual best matches with the ratio test, and
the essential matrix by MAGSAC++ (Barath et al. 2020) with the camera's focal length. For cameras
that give real pictures: their texture is worth more than the 64 pixels that the networks see.
Angles in radians, positive to the left; lengths in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from vn_nav.observation import OUTSIDE_GREY, fov_across

SIDE = 400  # pixels of the longer side, at most: finer, there is more noise than place
MOST = 800  # features of a picture, the strongest
CONTRAST = 0.01  # of a feature; OpenCV's own 0.04 leaves plain walls without any
RICH = 80  # features from which on their absence in another picture tells something
RATIO, CLEAR = 0.85, 0.8  # of the distances to the best and the next match: to try, to count
SOFT = 0.04  # by which the cosine of a match falls short of 1 for it to be 1 / e as close
# Of the closeness, where the next match is as near; ratio short of 1 from which on it is whole.
AMBIGUOUS, UNAMBIGUOUS = 0.5, 0.15
LEAST, AGREE = 8, 12  # matches to look for a motion in, and those that make one
PIXELS, SURE, ROUNDS = 1.5, 0.999, 500  # of the search for it
NEARLY_NOTHING = 1e-4  # likeness of pictures without a match
EDGE = 8  # pixels beside where a camera does not reach
DEPTH, FARTHEST = 2.5, 4.0  # m: of matched points as a rule; a motion between pictures, at most


class Features(NamedTuple):
    """Of one picture; F features."""

    rays: np.ndarray  # [F,2] float32 right and down of a point, as shares of its distance ahead
    descriptors: np.ndarray  # [F,128] float32 of length 1
    pixel: float  # what one pixel is in `rays`


class Comparison(NamedTuple):
    """What two pictures share, and the second camera as the robot at the first sees it."""

    rich: bool  # both have features enough for a lack of matches to mean something
    likeness: float  # log of the closeness of mutual best matches, over all features
    matches: int  # clear ones
    inliers: int  # that agree with one motion
    position: np.ndarray  # [2] x forward, y left; only the bearing is well known. nan: no motion
    heading: float  # rad, of the second less the first; nan: no motion


NOTHING = Comparison(False, math.log(NEARLY_NOTHING), 0, 0, np.full(2, np.nan), math.nan)


def extract(picture: np.ndarray, fov: float, most: int = MOST) -> Features:
    """Features of a picture.

    Args:
        picture: [H,W,3] uint8 RGB. Where it is of `OUTSIDE_GREY` there are none.
        fov: field of view of its shorter side [rad], of a pinhole camera.
        most: features, at most.
    """
    height, width = picture.shape[:2]
    share = min(SIDE / max(height, width), 1.0)
    if share < 1:
        picture = cv2.resize(picture, (round(share * width), round(share * height)),
                             interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    pixel = 2 * math.tan(fov_across(fov, width / height) / 2) / width
    reached, corner = _reached(picture), np.zeros(2, np.float32)
    if reached is not None:  # nothing is computed of margins
        rows, columns = (np.flatnonzero(reached.any(axis)) for axis in (1, 0))
        if not len(rows):
            return _nothing(pixel)
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        grey, reached = np.ascontiguousarray(grey[part]), np.ascontiguousarray(reached[part])
        corner[:] = columns[0], rows[0]
    detector = cv2.SIFT.create(most, 3, CONTRAST)
    points, found = detector.detectAndCompute(grey, reached)
    if not points:
        return _nothing(pixel)
    # OpenCV returns more than were asked for where the last ones are as strong as one another.
    order = np.argsort([-point.response for point in points], kind='stable')[:most]
    at = corner + np.array([points[k].pt for k in order], np.float32)
    middle = np.array([width - 1, height - 1], np.float32) / 2
    shares = found[order] / np.maximum(found[order].sum(1, keepdims=True), 1e-6)
    return Features((at - middle) * np.float32(pixel), np.sqrt(shares), pixel)


def _nothing(pixel: float) -> Features:
    return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), pixel)


def _reached(picture: np.ndarray) -> np.ndarray | None:
    """Where a camera reaches, [H,W] uint8; None: everywhere."""
    outside = (picture == OUTSIDE_GREY).all(2).astype(np.uint8)
    if outside.mean() < 0.01:
        return None
    # Single pixels of that grey are of the place.
    outside = cv2.morphologyEx(outside, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return 1 - cv2.dilate(outside, np.ones((2 * EDGE + 1, 2 * EDGE + 1), np.uint8))


def compare(one: Features, other: Features, pitch: float = 0.0) -> Comparison:
    """What two pictures have in common.

    Args:
        one: of the robot's picture; other: of the goal's.
        pitch: down, of both cameras [rad].
    """
    counts = len(one.rays), len(other.rays)
    if min(counts) < LEAST:
        return NOTHING
    rows, columns, cosine, ratio = _match(one.descriptors, other.descriptors)
    clear = np.clip((1 - ratio) / UNAMBIGUOUS, AMBIGUOUS, 1.0)
    likeness = float(clear @ np.exp((cosine - 1) / SOFT)) / math.sqrt(counts[0] * counts[1])
    found = NOTHING._replace(rich=min(counts) >= RICH,
                             likeness=math.log(likeness + NEARLY_NOTHING),
                             matches=int((ratio < CLEAR).sum()))
    tried = ratio < RATIO
    if tried.sum() < LEAST:
        return found
    motion = _motion(one.rays[rows[tried]], other.rays[columns[tried]],
                     math.sqrt(one.pixel * other.pixel))
    if motion is None:
        return found
    turn, centre, inliers = motion
    c, s = math.cos(pitch), math.sin(pitch)
    axes = np.array([[0, -s, c], [-1, 0, 0], [0, -c, -s]])  # right, down, ahead to the robot's
    turn, centre = axes @ turn @ axes.T, axes @ centre
    return found._replace(inliers=inliers, position=centre[:2],
                          heading=math.atan2(turn[1, 0], turn[0, 0]))


def _match(one: np.ndarray, other: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mutual best matches: rows, columns, cosines, and ratios of their distance to the next's."""
    alike = one @ other.T
    every = np.arange(len(alike))
    best = alike.argmax(1)
    rows = every[alike.argmax(0)[best] == every]
    columns = best[rows]
    cosine = alike[rows, columns]
    alike[every, best] = -1.0
    # Mutual ones are the best of their columns as well, and gone from there.
    following = np.maximum(alike.max(1)[rows], alike.max(0)[columns])
    ratio = np.sqrt(np.maximum(1 - cosine, 0) / np.maximum(1 - following, 1e-9))
    return rows, columns, cosine, ratio


def _motion(first: np.ndarray, second: np.ndarray, pixel: float
            ) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Second camera as the first sees it: axes [3,3], centre [3] m, and how many agree.

    Args:
        first, second: [M,2] rays of the same points; pixel: see `Features`.
    """
    first, second = first.astype(float), second.astype(float)
    same = np.eye(3)
    essential, mask = cv2.findEssentialMat(first, second, same, cv2.USAC_MAGSAC, SURE,
                                           PIXELS * pixel, ROUNDS)
    if essential is None or essential.shape != (3, 3) or mask.sum() < AGREE:
        return None
    agree = mask.ravel() > 0
    turn, off = _rotation(first[agree], second[agree])
    if np.median(off) < PIXELS * pixel:  # where a camera only turns, there is no baseline to see
        return turn, np.zeros(3), int((off < 2 * PIXELS * pixel).sum())
    # Far points have hardly any parallax; the distance [baselines] beyond which they are dropped.
    _, turn, way, mask, points = cv2.recoverPose(essential, first, second, same,
                                                 distanceThresh=1000.0, mask=mask)
    good = mask.ravel() > 0
    inliers = int(good.sum())
    if inliers < AGREE:
        return None
    depths = points[2, good] / points[3, good]  # in baselines
    # How far points are indoors says how long the baseline is.
    length = DEPTH / max(float(np.median(depths)), 1e-3)
    centre = -turn.T @ way.ravel() * min(length, FARTHEST)
    return turn.T, centre, inliers


def _rotation(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes [3,3] of a second camera that only turned, and how far off [M] rad its rays are."""
    one, other = (np.column_stack([part, np.ones(len(part))]) for part in (first, second))
    one, other = (part / np.linalg.norm(part, axis=1, keepdims=True) for part in (one, other))
    left, _, right = np.linalg.svd(one.T @ other)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return turn, np.linalg.norm(one @ turn - other, axis=1)
