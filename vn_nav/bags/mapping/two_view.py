"""How two pictures of one place lie to each other: features, and planar motion from their matches.

The robot drives on a floor and its camera is level but for a known pitch, so three numbers relate
two pictures: where the second robot stands, seen by the first, and where it looks. A point of the
first picture is a direction and a depth, which a depth picture gives, or else only what is common
indoors: then the length of a motion is hardly known, its direction and the heading are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numba
import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.robot import RobotSpec

MAX_FEATURES = 250  # of a picture at most
MAX_MATCH_RATIO = 0.85  # of the distances to the best and the second best match
MATCH_SIGMA_PX = 0.6  # px, standard deviation of a match
FOCAL_SIGMA_SHARE = 0.03  # share by which the focal length may be wrong
# Of the logarithm of distances ahead indoors [m]: mean and standard deviation.
LOG_DEPTH_MEAN_SIGMA = (math.log(1.8), 0.7)
# Share by which a motion may be too long or short, because all depths of a picture may be: without
# and with a depth picture.
SCALE_SIGMA_SHARE, DEPTH_SCALE_SIGMA_SHARE = 0.4, 0.05
# The search: steps of the heading, bearings in a circle, and how far a match may lie off.
HEADING_STEP_RAD, BEARINGS, MAX_MATCH_ERROR_PX = math.radians(2), 24, 2.5  # rad, 1, px
MAX_MOTION_DEPTH_SHARE = 2.0  # motion as a share of a point's depth, at most
MIN_PUTATIVE_MATCHES = 8  # matches to look for a motion in
MAX_MATCH_CHI2 = 9.21  # chi^2 of a match, 2 degrees of freedom, 99 %
# Of the kernel, step by step.
KERNEL_WIDTHS_CHI2 = MAX_MATCH_CHI2 * np.maximum(1.0, 6.0 / 1.6**np.arange(12))


class Features(NamedTuple):
    """Of one picture; F features."""

    slope: np.ndarray  # [F,2] float64 left and up of a point, as a share of its distance ahead
    descriptor: np.ndarray  # [F,128] float32 of length 1
    depth: np.ndarray  # [F,2] float64 logarithm of the distance ahead [m], standard deviation
    scale: float  # share by which all distances may be wrong, a standard deviation


class Motion(NamedTuple):
    """A second robot as the first one sees it."""

    motion: np.ndarray  # [3] x, y [m], yaw [rad]
    covariance: np.ndarray  # [3,3], the scale left out
    matches: int  # that agree with it
    tried: int  # the wrong ones included


class Camera:
    """Finds features of square pictures [3,S,S] uint8 of a robot."""

    def __init__(self, robot: RobotSpec, size: int):
        self._focal = size / 2 / math.tan(robot.camera_fov / 2)  # pixels
        self._middle = (size - 1) / 2
        self._pitch = robot.camera_pitch
        # OpenCV's annotations lack the name that every release has.
        self._sift = cv2.SIFT_create(  # type: ignore[attr-defined]
            nfeatures=MAX_FEATURES, contrastThreshold=0.02)

    def look(self, picture: np.ndarray, depth: np.ndarray | None = None) -> Features:
        """Features of a picture.

        Args:
            picture: [3,S,S] uint8 RGB.
            depth: [D,D] m along the optical axis, 0 where unknown.
        """
        grey = cv2.cvtColor(np.ascontiguousarray(picture.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
        points, found = self._sift.detectAndCompute(grey, None)
        scale = SCALE_SIGMA_SHARE if depth is None else DEPTH_SCALE_SIGMA_SHARE
        if not points:
            return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 2)),
                            scale)
        at = np.array([point.pt for point in points])
        left, up = ((self._middle - at) / self._focal).T
        c, s = math.cos(self._pitch), math.sin(self._pitch)
        ahead = c + s * up
        known = np.tile(LOG_DEPTH_MEAN_SIGMA, (len(at), 1))
        if depth is not None:
            cell = ((at + 0.5) * (len(depth) / (2 * self._middle + 1))).astype(int)
            cell = np.clip(cell, 0, len(depth) - 1)
            metres = depth[cell[:, 1], cell[:, 0]] * ahead
            seen = metres > 0.1
            known[seen, 0] = np.log(metres[seen])
            known[seen, 1] = 0.03 + 0.03 / metres[seen]
        # Square roots of shares (Arandjelovic and Zisserman, 2012).
        found = np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6))
        slope = np.stack([left / ahead, (c * up - s) / ahead], axis=1)
        return Features(slope, found.astype(np.float32), known, scale)

    def relate(self, one: Features, other: Features, expected: np.ndarray,
               place: float, heading: float) -> Motion | None:
        """The motion between two pictures; None: they have too little in common.

        Args:
            one, other: features of the two.
            expected: [3] what the motion should be.
            place, heading: by how much it may be another [m], [rad]; standard deviations.
        """
        pairs = match(one.descriptor, other.descriptor)
        if len(pairs) < MIN_PUTATIVE_MATCHES:
            return None
        return relate(one.slope[pairs[:, 0]], other.slope[pairs[:, 1]], one.depth[pairs[:, 0]],
                      self._focal, expected, place, heading)


def relate(first: np.ndarray, second: np.ndarray, depth: np.ndarray, focal: float,
           expected: np.ndarray, place: float, heading: float) -> Motion:
    """The motion with which most matches agree.

    Several motions may fit a single wall, or a pattern that repeats: of those, the search takes
    the one that is expected. The motion itself, and its covariance, are of the matches alone.

    Args:
        first, second: [M,2] slopes of the same points in the two pictures, as in `Features`.
        depth: [M,2] of the points as the first robot sees them.
        focal: length [pixels], for the noise.
        expected, place, heading: as in `Camera.relate`.
    """
    reach = 3 * heading + HEADING_STEP_RAD
    yaws = expected[2] + np.arange(-reach, reach + HEADING_STEP_RAD, HEADING_STEP_RAD)
    motion = _search(first, second, depth, yaws, BEARINGS, MAX_MATCH_ERROR_PX / focal, expected,
                     place, heading)
    now = depth.copy()
    chi, normal, occam = np.zeros(len(first)), np.zeros((3, 4)), np.zeros((3, 4))
    for wide in KERNEL_WIDTHS_CHI2:  # Gauss and Newton; matches weigh by a kernel that narrows
        _equations(first, second, depth, now, (MATCH_SIGMA_PX / focal)**2, motion, wide, chi,
                   normal, occam)
        information = normal[:, :3] + 1e-6 * np.eye(3)
        step = np.linalg.solve(information + occam[:, :3], normal[:, 3] + occam[:, 3])
        motion += step * min(1.0, 0.5 / max(np.abs(step).max(), 1e-9))
    motion[2] = wrap_angle(motion[2])
    covariance = np.linalg.inv(information)
    covariance[2, 2] += (FOCAL_SIGMA_SHARE * motion[2])**2
    return Motion(motion, covariance, int((chi < MAX_MATCH_CHI2).sum()), len(first))


def match(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs [M,2] of descriptors that are each other's best, and clearly better than the next."""
    if len(one) < 2 or len(other) < 2:
        return np.zeros((0, 2), np.int64)
    alike = one @ other.T
    best = alike.argmax(axis=1)
    row = np.arange(len(one))
    mutual = alike.argmax(axis=0)[best] == row
    highest = alike[row, best]
    alike[row, best] = -1.0
    # Distances of vectors of length 1.
    clear = 1 - highest < MAX_MATCH_RATIO**2 * (1 - alike.max(axis=1))
    kept = np.flatnonzero(mutual & clear)
    return np.stack([kept, best[kept]], axis=1)


@numba.njit(cache=True)
def _search(first, second, depth, yaws, bearings, off, expected, place, turn):
    """The motion [3] with which most matches agree, from all headings and bearings.

    Each match says how far the motion went, as a share of its depth.
    """
    best, heading, bearing = -1e9, 0.0, 0.0
    for yaw in yaws:
        for step in range(bearings):
            angle = 2 * math.pi * step / bearings
            # Matches, less by how far the motion leaves aside what is expected.
            along = expected[0] * math.cos(angle) + expected[1] * math.sin(angle)
            across = expected[0]**2 + expected[1]**2 - max(along, 0.0)**2
            score = -0.5 * (across / place**2 + ((yaw - expected[2]) / turn)**2)
            for k in range(len(first)):
                _, wrong = _way(first[k], second[k], yaw, angle, off)
                if wrong < 1.0:
                    score += 1.0 - wrong
            if score > best:
                best, heading, bearing = score, yaw, angle
    metres, count = np.zeros(len(first)), 0
    for k in range(len(first)):
        way, wrong = _way(first[k], second[k], heading, bearing, off)
        if wrong < 1.0:
            metres[count] = way * math.exp(depth[k, 0])
            count += 1
    length = np.median(metres[:count]) if count else 0.0
    return np.array([length * math.cos(bearing), length * math.sin(bearing), heading])


@numba.njit(cache=True)
def _way(first, second, yaw, bearing, off):
    """How far a motion went by one match, as a share of the point's depth; how wrong that is."""
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = -math.cos(bearing - yaw), -math.sin(bearing - yaw)
    x, y = c + s * first[0], c * first[0] - s
    # Off along and across the picture: p + q * way.
    p0, q0 = y - second[0] * x, dy - second[0] * dx
    p1, q1 = first[1] - second[1] * x, -second[1] * dx
    way = min(max(-(p0 * q0 + p1 * q1) / (q0 * q0 + q1 * q1 + 1e-9), 0.0), MAX_MOTION_DEPTH_SHARE)
    ahead = x + way * dx
    if ahead < 0.05:
        return way, 2.0
    return way, ((p0 + way * q0)**2 + (p1 + way * q1)**2) / (ahead * off)**2


@numba.njit(cache=True)
def _equations(first, second, depth, now, noise, motion, wide, chi, normal, occam):
    """Normal equations [3,4] of the motion, with the depths [M] solved for and put out.

    A motion lets unknown depths explain noise. What the likelihood of the motion alone has against
    that, the logarithm of how far each match may then lie off, is `occam` [3,4]; it fades where a
    match shows its depth by itself.
    """
    normal[:] = 0.0
    occam[:] = 0.0
    c, s = math.cos(motion[2]), math.sin(motion[2])
    dx, dy = -(c * motion[0] + s * motion[1]), -(c * motion[1] - s * motion[0])
    m = np.empty((3, 2))
    for k in range(len(first)):
        x0, y0 = c + s * first[k, 0], c * first[k, 0] - s
        trust, log = 1.0 / depth[k, 1]**2, now[k, 0]
        w = x = a = b = e0 = e1 = j0 = j1 = h = pull = 0.0
        for turn in range(4):
            if turn > 0:
                log = min(max(log + min(max(pull / h, -0.7), 0.7), -2.0), 4.0)
            w = math.exp(-log)
            x = max(x0 + w * dx, 0.05)
            a, b = (y0 + w * dy) / x, first[k, 1] / x
            e0, e1 = second[k, 0] - a, second[k, 1] - b
            j0, j1 = -w * (dy - a * dx) / x, w * b * dx / x  # by the logarithm of the depth
            h = (j0 * j0 + j1 * j1) / noise + trust
            pull = (j0 * e0 + j1 * e1) / noise + trust * (depth[k, 0] - log)
        chi[k] = (e0 * e0 + e1 * e1) / noise + trust * (depth[k, 0] - log)**2
        now[k, 0], now[k, 1] = log, math.sqrt(1 / h)
        robust = (wide / (wide + chi[k]))**2
        # Of the place in the second picture, by x, y and yaw of the motion.
        m[0, 0], m[0, 1] = w * (s + a * c) / x, w * b * c / x
        m[1, 0], m[1, 1] = w * (a * s - c) / x, w * b * s / x
        m[2, 0], m[2, 1] = -1 - a * a, -b * a
        vague = robust * trust / (noise * h * h)
        for p in range(3):
            lever = (m[p, 0] * j0 + m[p, 1] * j1) / noise
            normal[p, 3] += robust * ((m[p, 0] * e0 + m[p, 1] * e1) / noise - lever * pull / h)
            occam[p, 3] += (p < 2) * vague * (m[p, 0] * j0 + m[p, 1] * j1)
            for q in range(3):
                other = (m[q, 0] * j0 + m[q, 1] * j1) / noise
                both = m[p, 0] * m[q, 0] + m[p, 1] * m[q, 1]
                normal[p, q] += robust * (both / noise - lever * other / h)
                occam[p, q] += (p < 2) * (q < 2) * vague * both
