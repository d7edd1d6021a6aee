"""Losses of the networks of `search` on picture pairs.

A batch is what `vn_sim_bridge.datasets.view_pairs.PairSampler.draw_groups` returns with bearings:
V views, K pairs of them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from vn_nav.learning.auxiliary import POSE_OVERLAP
from vn_nav.learning.returns import masked_mean
from vn_nav.lens import SAME
from vn_nav.policy.search.look import Recognition, range_classes
from vn_nav.policy.search.network import SearchPolicy

# A range is learned from one view in so many: pairs are harder to learn than ranges.
RANGE_EVERY = 2
SOFT_M = 0.01  # within this a position is as good as right: keeps the gradient finite
WEIGHTS = {'position': 1.0, 'heading': 1.0, 'co_visible': 1.0, 'arrived': 1.0, 'ranges': 1.0}


def losses(network: SearchPolicy, batch: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """Mean losses by part, of `WEIGHTS`."""
    image = torch.from_numpy(batch['image'])
    found = recognition_losses(recognise(network, image, batch['first'], batch['second']), batch)
    some = slice(0, -(-len(image) // RANGE_EVERY))
    ranges = network.ranges(image[some], network.compute_dtype)
    return {**found, 'ranges': range_loss(ranges, batch['ranges'][some])}


def recognise(network: SearchPolicy, image: Tensor, first: np.ndarray, second: np.ndarray
              ) -> Recognition:
    """What is said of pairs [K] of views [V,3,S,S]; the second is the goal. Each is seen once."""
    goals = network.encoder.encode_goals(image, network.compute_dtype)
    seen = network.encoder.see(image, network.compute_dtype)
    own, other = torch.from_numpy(first), torch.from_numpy(second)
    return network.recogniser(network.encoder.meet(
        seen.index_select(0, own), goals.index_select(0, other), None)[1])


def recognition_losses(said: Recognition, batch: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """Negative log-likelihoods: of the pose where the pictures overlap, of co-visibility, arrival.

    The position's is halved, and the distance by which its centre is off [m] added.
    An overlap below 0 is unknown, and teaches arrival alone. Through another lens than the known
    one arrival follows from the pose (`vn_nav.policy.search.lens`), and its head learns nothing.
    """
    truth, overlap = torch.from_numpy(batch['goal_pose']), torch.from_numpy(batch['overlap'])
    sees, known = overlap >= POSE_OVERLAP, overlap >= 0
    gap = torch.sqrt((said.position - truth[:, :2]).square().sum(1) + SOFT_M**2)
    # By its likelihood alone a far goal, whose spread is wide, teaches next to nothing: its error
    # grew while that of near ones fell. The plain distance weighs all alike.
    position = 0.5 * (gap * torch.exp(-said.log_scale) + 2 * said.log_scale) + gap
    kappa = said.log_concentration.exp()
    off = 1 - (said.heading * truth[:, 2:]).sum(1)  # 1 - cosine of the error
    heading = kappa * off + torch.log(torch.special.i0e(kappa))
    own_lens = (torch.from_numpy(batch['zoom']) - 1).abs() < SAME
    there = F.binary_cross_entropy_with_logits(
        said.arrived, torch.from_numpy(batch['arrived']).float(), reduction='none')
    shown = F.binary_cross_entropy_with_logits(said.co_visible, sees.float(), reduction='none')
    return {
        'position': masked_mean(position, sees), 'heading': masked_mean(heading, sees),
        'co_visible': masked_mean(shown, known), 'arrived': masked_mean(there, own_lens),
    }


def range_loss(log_probabilities: Tensor, ranges: np.ndarray) -> Tensor:
    """Cross-entropy over the bins, [N,COLUMNS,BINS] against [N,COLUMNS] m; NaN teaches nothing."""
    classes = torch.from_numpy(range_classes(ranges))
    known = classes >= 0
    said = log_probabilities.gather(2, classes.clamp(min=0).unsqueeze(2)).squeeze(2)
    return masked_mean(-said, known)
