"""What the networks of `search` say of a picture: how far the place is free, where the goal is.

Angles in radians, positive to the left; lengths in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

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
SPREAD = torch.from_numpy(np.stack([np.outer(_RADII, np.cos(_TURNS)), np.outer(
    _RADII, np.sin(_TURNS))], axis=-1).reshape(-1, 2) / math.sqrt(3)).float()


class Look(NamedTuple):
    """What is seen in N pictures; float32."""

    ranges: Tensor  # [N,COLUMNS,BINS] log-probabilities of the horizontal range to the first
    # obstacle along each column's bearing
    position: Tensor  # [N,2] of the goal in the robot's frame, x forward, y left [m]
    position_sigma: Tensor  # [N] m, along any axis
    heading: Tensor  # [N,2] cos, sin of the goal's heading less the robot's
    heading_sigma: Tensor  # [N] rad
    co_visible: Tensor  # [N] logit: the picture shows some of what the goal picture shows
    arrived: Tensor  # [N] logit: the robot stands where the goal picture was taken


def column_bearings(fov: float) -> np.ndarray:
    """Bearings [COLUMNS] of the columns' centres [rad], of a pinhole camera that looks ahead.

    Args:
        fov: horizontal field of view [rad].
    """
    across = 1 - 2 * (np.arange(COLUMNS) + 0.5) / COLUMNS
    return np.arctan(math.tan(fov / 2) * across)


def arrival_by_pose(position: Tensor, position_sigma: Tensor, heading: Tensor,
                    heading_sigma: Tensor) -> Tensor:
    """Probability [N] that the goal stands within the arrival radius and heading, see `Look`.

    Given that it is in view; as the crow flies, where the rule of arrival is by driving distance.
    """
    spots = position.unsqueeze(1) + position_sigma[:, None, None] * SPREAD
    near = (spots.square().sum(2) <= ARRIVAL_RADIUS**2).float().mean(1)
    off = torch.atan2(heading[:, 1], heading[:, 0])
    high, low = ((bound - off) / heading_sigma for bound in (ARRIVAL_HEADING, -ARRIVAL_HEADING))
    return near * (torch.special.ndtr(high) - torch.special.ndtr(low))


def range_classes(ranges: np.ndarray) -> np.ndarray:
    """Bins, int64, of ranges [...] m; -1 where the range is not known (NaN)."""
    return np.where(np.isnan(ranges), -1, np.searchsorted(RANGE_EDGES, ranges)).astype(np.int64)


def median_ranges(log_probabilities: Tensor) -> Tensor:
    """Medians [...] m of distributions [...,BINS] over the bins, between edges in the log."""
    cumulative = log_probabilities.exp().cumsum(-1)
    index = (cumulative < 0.5).sum(-1).clamp(max=BINS - 1)
    above = cumulative.gather(-1, index.unsqueeze(-1)).squeeze(-1)
    own = log_probabilities.exp().gather(-1, index.unsqueeze(-1)).squeeze(-1)
    within = 1 - (above - 0.5) / own.clamp(min=1e-6)  # share of the bin below the median
    low = math.log(NEAREST) + (index - 1) * math.log(_STEP)
    return torch.exp(low + within.clamp(0, 1) * math.log(_STEP))
