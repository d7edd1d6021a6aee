"""How well the networks of `search` see, in figures: errors, ROC, calibration."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.learning.auxiliary import POSE_OVERLAP
from vn_nav.learning.sight_losses import WEIGHTS, range_loss, recognise, recognition_losses
from vn_nav.policy.search.eyes import Placed
from vn_nav.policy.search.look import Recognition, arrival_by_pose, median_ranges
from vn_nav.policy.search.network import SearchPolicy, agreed, mirrored

BATCH = 128  # views
# The hard ring: nearly there, or there but askew.
RING_RADIUS, RING_TURN, RING_SIDE = 1.5, math.radians(60), math.radians(45)
FIFTH = 0.2  # of a range
BINS = 10  # of a calibration
HALF_RADIUS = 1.678347  # half of the density exp(-r) in the plane lies within this r
BANDS = {'quarter': (0.25, 0.5), 'half': (0.5, 1.01)}  # shares of the goal picture in view
FAR = 1.5  # m: goals beyond are those that a search finds first
FIGURES = ('loss', *(f'{part}_loss' for part in WEIGHTS), 'bearing_deg', 'far_bearing_deg',
           'far_position_m', *(f'position_m_{band}' for band in BANDS), 'heading_deg',
           'co_visible_auc', 'arrived_auc', 'arrived_ring_auc', 'pose_ring_auc',
           'co_visible_calibration', 'arrived_calibration', 'position_coverage',
           'range_error', 'range_within_fifth')


class Judged(NamedTuple):
    """What was said of K pairs and V views, and what is true."""

    position_error: np.ndarray  # [K] m
    position_scale: np.ndarray  # [K] m, as said, see `vn_nav.policy.search.look.Recognition`
    bearing_error: np.ndarray  # [K] rad
    heading_error: np.ndarray  # [K] rad
    co_visible: np.ndarray  # [K] probability
    arrived: np.ndarray  # [K] probability
    arrived_by_pose: np.ndarray  # [K] probability, by pose and co-visibility alone
    overlap: np.ndarray  # [K] true share of the goal picture in view; negative: unknown
    distance: np.ndarray  # [K] m, true
    turn: np.ndarray  # [K] rad, true, 0 to pi
    there: np.ndarray  # [K] bool, truly arrived
    range_ratio: np.ndarray  # [V,COLUMNS] median of the range over the true one; NaN: unknown
    losses: dict[str, float]

    @property
    def sees(self) -> np.ndarray:
        """[K] bool: whether the pictures overlap."""
        return self.overlap >= POSE_OVERLAP

    @property
    def ring(self) -> np.ndarray:
        """[K] bool: the hard ring around arrivals."""
        beside = ((self.distance >= ARRIVAL_RADIUS) & (self.distance <= RING_RADIUS)
                  & (self.turn <= RING_SIDE))
        askew = ((self.distance <= ARRIVAL_RADIUS) & (self.turn >= ARRIVAL_HEADING)
                 & (self.turn <= RING_TURN))
        return (beside | askew) & ~self.there


@torch.no_grad()
def judge(network: SearchPolicy, batch: dict[str, np.ndarray], mirror: bool = True) -> Judged:
    """What a network says of pairs, in float32; a view belongs to pairs of its group alone.

    As on a robot of the pictures and of their mirror images together; without `mirror` of the
    pictures alone.
    """
    before, network.compute_dtype = network.compute_dtype, torch.float32
    said, ranges = [], []
    image, first, second = (batch[name] for name in ('image', 'first', 'second'))
    size = int(abs(second - first).max()) + 1  # views of a group, at most
    step = max(BATCH // size, 1) * size
    for begin in range(0, len(image), step):
        views = torch.from_numpy(image[begin:begin + step])
        own = (first >= begin) & (first < begin + step)
        pairs = first[own] - begin, second[own] - begin
        seen = recognise(network, views, *pairs)
        if mirror:
            seen = agreed(seen, mirrored(recognise(network, views.flip(-1), *pairs)))
        said.append(seen)
        ranges.append(network.see_ranges(views) if mirror
                      else network.ranges(views, torch.float32))
    network.compute_dtype = before
    seen = Recognition(*(torch.cat(parts) for parts in zip(*said, strict=True)))
    log_ranges = torch.cat(ranges)
    parts = {**recognition_losses(seen, batch), 'ranges': range_loss(log_ranges, batch['ranges'])}
    placed = Placed.of(Recognition(*(part.numpy() for part in seen)))
    by_pose = torch.sigmoid(seen.co_visible).numpy() * arrival_by_pose(*placed[:4])
    truth = batch['goal_pose']
    position, heading = seen.position.numpy(), seen.heading.numpy()
    return Judged(
        np.hypot(*(position - truth[:, :2]).T), seen.log_scale.exp().numpy(),
        angle_between(position, truth[:, :2]), angle_between(heading, truth[:, 2:]),
        torch.sigmoid(seen.co_visible).numpy(), torch.sigmoid(seen.arrived).numpy(),
        by_pose,
        batch['overlap'], np.hypot(truth[:, 0], truth[:, 1]),
        np.abs(np.arctan2(truth[:, 3], truth[:, 2])), batch['arrived'],
        median_ranges(log_ranges.numpy()) / batch['ranges'],
        {name: float(value) for name, value in parts.items()})


def figures(judged: Judged) -> dict[str, float]:
    """`FIGURES`; NaN where nothing was there to judge by."""
    sees, ring, known = judged.sees, judged.ring, judged.overlap >= 0
    near = judged.there | ring
    far = sees & (judged.distance > 0.3)  # nearer, a bearing means nothing
    bands = {f'position_m_{name}': _median(judged.position_error[in_band(judged.overlap, band)])
             for name, band in BANDS.items()}
    beyond = sees & (judged.distance > FAR)
    off = np.abs(judged.range_ratio[np.isfinite(judged.range_ratio)] - 1)
    return {
        'loss': sum(WEIGHTS[name] * value for name, value in judged.losses.items()),
        **{f'{name}_loss': value for name, value in judged.losses.items()},
        'bearing_deg': math.degrees(_median(judged.bearing_error[far])),
        'far_bearing_deg': math.degrees(_median(judged.bearing_error[beyond])),
        'far_position_m': _median(judged.position_error[beyond]), **bands,
        'heading_deg': math.degrees(_median(judged.heading_error[sees])),
        'co_visible_auc': auc(judged.co_visible[known], sees[known]),
        'arrived_auc': auc(judged.arrived, judged.there),
        'arrived_ring_auc': auc(judged.arrived[near], judged.there[near]),
        'pose_ring_auc': auc(judged.arrived_by_pose[near], judged.there[near]),
        'co_visible_calibration': calibration_error(judged.co_visible[known], sees[known]),
        'arrived_calibration': calibration_error(judged.arrived, judged.there),
        # Of the goals in view, the share that lies in the circle which should hold half of them.
        'position_coverage': _mean((judged.position_error
                                    <= HALF_RADIUS * judged.position_scale)[sees]),
        'range_error': _median(off), 'range_within_fifth': _mean(off <= FIFTH),
    }


def in_band(overlap: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """Which overlaps lie in [low, high)."""
    return (overlap >= band[0]) & (overlap < band[1])


def roc(score: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """False and true positive rates, and thresholds, from the strictest to the laxest.

    A score of the threshold or above counts as positive; equal scores are one step.
    """
    order = np.argsort(-score, kind='stable')
    score, true = score[order], true[order].astype(bool)
    last = np.append(np.nonzero(np.diff(score))[0], len(score) - 1)
    hits = np.cumsum(true)[last]
    false = last + 1 - hits
    with np.errstate(invalid='ignore'):
        return (np.append(0, false / max(false[-1], 1)), np.append(0, hits / max(hits[-1], 1)),
                np.append(np.inf, score[last]))


def auc(score: np.ndarray, true: np.ndarray) -> float:
    """Area under the ROC: how likely a positive scores above a negative; NaN without either."""
    if not true.any() or true.all():
        return math.nan
    false_rate, true_rate, _ = roc(score, true)
    return float((np.diff(false_rate) * (true_rate[1:] + true_rate[:-1]) / 2).sum())


def calibration(probability: np.ndarray, true: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean probability, share that is true and count of each of `BINS` that is not empty."""
    own = np.minimum((probability * BINS).astype(int), BINS - 1)
    count = np.bincount(own, minlength=BINS)
    some = count > 0
    said, held = (np.bincount(own, values, BINS)[some] / count[some]
                  for values in (probability, true.astype(float)))
    return said, held, count[some]


def calibration_error(probability: np.ndarray, true: np.ndarray) -> float:
    """Mean gap between what is said and what holds, weighted by how often it is said."""
    if not len(probability):
        return math.nan
    said, held, count = calibration(probability, true)
    return float((np.abs(said - held) * count).sum() / count.sum())


def angle_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Unsigned angle [rad] between plane vectors [N,2]."""
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return np.abs(np.arctan2(cross, (one * other).sum(1)))


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan
