"""Lenses narrower, or wider, than the one that the networks of `search` know.

The networks speak of the squeezed place of `vn_nav.lens`, whatever the lens, and learn it through
many lenses; here it is turned into metres.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

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
    arrived = arrival_by_pose(position, sigma, heading, heading_sigma) * torch.sigmoid(
        look.co_visible)
    return Look(ranges_in_metres(look.ranges, bearings, zoom), position, sigma, heading,
                heading_sigma, look.co_visible, torch.logit(arrived, 1e-6))


def ranges_in_metres(ranges: Tensor, bearings: np.ndarray, zoom: float) -> Tensor:
    """The same for log-probabilities [N,COLUMNS,BINS] of ranges alone; see `in_metres`."""
    if abs(zoom - 1) < SAME:
        return ranges
    stretch = zoom * np.cos(bearings) / np.cos(bearings_through(bearings, zoom))
    return _shifted(ranges, torch.from_numpy(np.log(stretch)).float())


def pose_in_metres(position: Tensor, sigma: Tensor, heading: Tensor, heading_sigma: Tensor,
                   zoom: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same of the place as it is: position [N,2], its spread [N], heading [N,2], its [N].

    Args:
        position, sigma, heading, heading_sigma: see `Look`, as the networks say.
        zoom: of the lens.
    """
    cosine, sine = heading[:, 0], heading[:, 1] / zoom
    length = torch.sqrt(cosine.square() + sine.square()).clamp(min=1e-6)
    # d(true) / d(squeezed) of the angle; the spread grows to that of the worse axis.
    return (position * torch.tensor([zoom, 1.0]), sigma * max(zoom, 1.0),
            torch.stack([cosine, sine], 1) / length[:, None],
            heading_sigma / zoom / length.square())


def _shifted(log_probabilities: Tensor, logs: Tensor) -> Tensor:
    """Distributions [N,COLUMNS,BINS] of ranges whose logarithm is so much greater, [COLUMNS]."""
    below = log_probabilities.exp().cumsum(-1)  # up to each bin's far edge; the last has none
    place = torch.arange(BINS - 1) - logs[:, None] / _LOG_STEP  # [COLUMNS,BINS-1] where to read
    low = place.floor().long()
    share = (place - low).float()
    # The first bin reaches down to nothing, the last one up to anything.
    ends = torch.cat([torch.zeros_like(below[..., :1]), below[..., :-1]], -1)
    at = (low + 1).clamp(0, BINS - 1).expand(len(below), COLUMNS, BINS - 1)
    after = (low + 2).clamp(0, BINS - 1).expand(len(below), COLUMNS, BINS - 1)
    read = ends.gather(-1, at) * (1 - share) + ends.gather(-1, after) * share
    one = torch.ones_like(read[..., :1])
    probabilities = torch.diff(torch.cat([0 * one, read, one], -1), dim=-1)
    return probabilities.clamp(min=1e-7).log()
