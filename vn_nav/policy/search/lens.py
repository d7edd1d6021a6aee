"""Lenses narrower, or wider, than the one that the networks of `search` know.

The networks speak of the squeezed place of `vn_nav.lens`, whatever the lens, and learn it through
many lenses; here it is turned into metres.
"""

from __future__ import annotations

import math

import numpy as np

from vn_nav.lens import SAME, bearings_through
from vn_nav.policy.search.look import BINS, COLUMNS, RANGE_EDGES, Look, arrival_by_pose

_LOG_STEP = math.log(RANGE_EDGES[1] / RANGE_EDGES[0])


def in_metres(look: Look, bearings: np.ndarray, zoom: float) -> Look:
    """What the networks say, of the place as it is.

    Whether the robot has arrived follows from the pose: the head knows it of the known lens alone.

    Args:
        look: of N pictures through one lens.
        bearings: [C] rad of the columns in the known lens.
        zoom: of the lens.
    """
    if abs(zoom - 1) < SAME:
        return look
    position, sigma, heading, heading_sigma = pose_in_metres(
        look.position, look.position_sigma, look.heading, look.heading_sigma, zoom)
    arrived = np.clip(arrival_by_pose(position, sigma, heading, heading_sigma)
                      / (1 + np.exp(-look.co_visible)), 1e-6, 1 - 1e-6)
    return Look(ranges_in_metres(look.ranges, bearings, zoom), position, sigma, heading,
                heading_sigma, look.co_visible,
                np.log(arrived / (1 - arrived)).astype(np.float32))


def ranges_in_metres(ranges: np.ndarray, bearings: np.ndarray, zoom: float) -> np.ndarray:
    """The same for log-probabilities [N,COLUMNS,BINS] of ranges alone; see `in_metres`."""
    if abs(zoom - 1) < SAME:
        return ranges
    stretch = zoom * np.cos(bearings) / np.cos(bearings_through(bearings, zoom))
    return _shifted(ranges, np.log(stretch))


def pose_in_metres(position: np.ndarray, sigma: np.ndarray, heading: np.ndarray,
                   heading_sigma: np.ndarray, zoom: float
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same of the place as it is: position [N,2], its spread [N], heading [N,2], its [N].

    Args:
        position, sigma, heading, heading_sigma: see `Look`, as the networks say.
        zoom: of the lens.
    """
    cosine, sine = heading[:, 0], heading[:, 1] / zoom
    length = np.maximum(np.hypot(cosine, sine), 1e-6)
    # d(true) / d(squeezed) of the angle; the spread grows to that of the worse axis.
    return (position * np.array([zoom, 1.0], np.float32), sigma * max(zoom, 1.0),
            np.stack([cosine, sine], axis=1) / length[:, None],
            heading_sigma / zoom / np.square(length))


def _shifted(log_probabilities: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Distributions [N,COLUMNS,BINS] of ranges whose logarithm is so much greater, [COLUMNS]."""
    below = np.exp(log_probabilities).cumsum(axis=-1)  # up to each bin's far edge; the last: none
    place = np.arange(BINS - 1) - logs[:, None] / _LOG_STEP  # [COLUMNS,BINS-1] where to read
    low = np.floor(place).astype(np.int64)
    share = place - low
    # The first bin reaches down to nothing, the last one up to anything.
    ends = np.concatenate([np.zeros_like(below[..., :1]), below[..., :-1]], axis=-1)
    shape = (len(below), COLUMNS, BINS - 1)
    at, after = (np.broadcast_to(np.clip(low + step, 0, BINS - 1), shape) for step in (1, 2))
    read = (np.take_along_axis(ends, at, -1) * (1 - share)
            + np.take_along_axis(ends, after, -1) * share)
    one = np.ones_like(read[..., :1])
    probabilities = np.diff(np.concatenate([0 * one, read, one], axis=-1), axis=-1)
    return np.log(np.maximum(probabilities, 1e-7)).astype(np.float32)
