"""What the networks of `search` say of a picture: how far the place is free, where the goal is.

Angles in radians, positive to the left; lengths in metres.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS

COLUMNS = 32  # bearings, evenly spaced in picture columns, left to right
BINS = 24  # of the range; the first is nearer than the first edge, the last farther than the last
NEAREST, FARTHEST = 0.15, 8.0  # m: the outermost edges
RANGE_EDGES = np.geomspace(NEAREST, FARTHEST, BINS - 1)  # [BINS-1] m
_STEP = (FARTHEST / NEAREST) ** (1 / (BINS - 2))
RANGE_CENTRES = np.geomspace(NEAREST, FARTHEST * _STEP, BINS) / math.sqrt(_STEP)  # [BINS] m
# Offsets [P,2] with equal shares of a density exp(-r) in the plane, in deviations along an axis.
_RADII = np.linspace(0, 20, 4001)
_RADII = np.interp((np.arange(24) + 0.5) / 24, 1 - (1 + _RADII) * np.exp(-_RADII), _RADII)
_TURNS = 2 * math.pi * (np.arange(24) + 0.5) / 24
SPREAD = np.stack([np.outer(_RADII, np.cos(_TURNS)), np.outer(
    _RADII, np.sin(_TURNS))], axis=-1).reshape(-1, 2) / math.sqrt(3)
LOG_CONCENTRATIONS = -3.0, 6.0  # of a heading: from all but uniform to 3 degrees
PER_AXIS = math.sqrt(3.0)  # deviation along an axis, in scales of the position's distribution


Array = Any  # of float32: NumPy's, or torch's where a network says it


class Look(NamedTuple):
    """What is seen in N pictures."""

    ranges: Array  # [N,COLUMNS,BINS] log-probabilities of the horizontal range to the first
    # obstacle along each column's bearing
    position: Array  # [N,2] of the goal in the robot's frame, x forward, y left [m]
    position_sigma: Array  # [N] m, along any axis
    heading: Array  # [N,2] cos, sin of the goal's heading less the robot's
    heading_sigma: Array  # [N] rad
    co_visible: Array  # [N] logit: the picture shows some of what the goal picture shows
    arrived: Array  # [N] logit: the robot stands where the goal picture was taken


class Recognition(NamedTuple):
    """Where the goal of N pairs stands, as distributions.

    The position's density falls as exp(-distance / scale) about its centre, in the plane; the
    heading's is von Mises'.
    """

    position: Array  # [N,2] x forward, y left [m]
    log_scale: Array  # [N] of the position [log m]
    heading: Array  # [N,2] cos, sin of the goal's heading less the robot's
    log_concentration: Array  # [N] of the heading
    co_visible: Array  # [N] logit
    arrived: Array  # [N] logit


def column_bearings(fov: float) -> np.ndarray:
    """Bearings [COLUMNS] of the columns' centres [rad], of a pinhole camera that looks ahead.

    Args:
        fov: horizontal field of view [rad].
    """
    across = 1 - 2 * (np.arange(COLUMNS) + 0.5) / COLUMNS
    return np.arctan(math.tan(fov / 2) * across)


def goal_ranges(goal_maps: np.ndarray) -> np.ndarray:
    """Log-probabilities [G,COLUMNS,BINS] of the ranges in goals.

    Args:
        goal_maps: [G,...] float32 of `SearchPolicy.encode_goals`, which end with them.
    """
    return goal_maps[:, -COLUMNS * BINS:].reshape(-1, COLUMNS, BINS)


def heading_deviation(log_concentration: np.ndarray) -> np.ndarray:
    """Circular standard deviation [rad] of von Mises distributions, to 1e-5 of it."""
    return np.interp(log_concentration, _CONCENTRATIONS, _DEVIATIONS).astype(np.float32)


def _deviations(log_concentrations: np.ndarray) -> np.ndarray:
    """sqrt(-2 log A), A the mean of cos under exp(k cos): over a grid that resolves the peak."""
    cosines = np.cos(np.linspace(0, math.pi, 2001))
    density = np.exp(np.exp(log_concentrations)[:, None] * (cosines - 1))
    density[:, [0, -1]] /= 2  # the trapezoidal rule
    return np.sqrt(-2 * np.log(density @ cosines / density.sum(axis=1)))


_CONCENTRATIONS = np.linspace(*LOG_CONCENTRATIONS, 2001)
_DEVIATIONS = _deviations(_CONCENTRATIONS)
_erf = np.vectorize(math.erf, otypes=[float])


def arrival_by_pose(position: np.ndarray, position_sigma: np.ndarray, heading: np.ndarray,
                    heading_sigma: np.ndarray) -> np.ndarray:
    """Probability [N] that the goal stands within the arrival radius and heading, see `Look`.

    Given that it is in view; as the crow flies, where the rule of arrival is by driving distance.
    """
    spots = position[:, None] + position_sigma[:, None, None] * SPREAD
    near = (np.square(spots).sum(axis=2) <= ARRIVAL_RADIUS**2).mean(axis=1)
    off = np.arctan2(heading[:, 1], heading[:, 0])
    high, low = (_erf((bound - off) / heading_sigma / math.sqrt(2))
                 for bound in (ARRIVAL_HEADING, -ARRIVAL_HEADING))
    return near * (high - low) / 2


def range_classes(ranges: np.ndarray) -> np.ndarray:
    """Bins, int64, of ranges [...] m; -1 where the range is not known (NaN)."""
    return np.where(np.isnan(ranges), -1, np.searchsorted(RANGE_EDGES, ranges)).astype(np.int64)


def median_ranges(log_probabilities: np.ndarray) -> np.ndarray:
    """Medians [...] m of distributions [...,BINS] over the bins, between edges in the log."""
    probabilities = np.exp(log_probabilities)
    cumulative = probabilities.cumsum(axis=-1)
    index = np.minimum((cumulative < 0.5).sum(axis=-1), BINS - 1)
    above, own = (np.take_along_axis(part, index[..., None], -1)[..., 0]
                  for part in (cumulative, probabilities))
    within = 1 - (above - 0.5) / np.maximum(own, 1e-6)  # share of the bin below the median
    low = math.log(NEAREST) + (index - 1) * math.log(_STEP)
    return np.exp(low + np.clip(within, 0, 1) * math.log(_STEP))
