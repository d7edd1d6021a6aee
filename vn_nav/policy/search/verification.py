"""The network's sight of a goal, verified by local features of the full pictures.

Both are evidence. Where two pictures have features enough, these count most: the network has
learned in simulation, and 64 pixels of a photograph tell it little. Where they have not, nothing
changes.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vn_nav.policy.search.local_features import Comparison
from vn_nav.policy.search.searcher import Sight

# Logistic regressions on pairs of simulated pictures, `python bench/local_features.py`.
CO_VISIBLE = 7.58, 1.81, 2.43  # constant, likeness, that there is a motion
ARRIVED = -5.65, 1.04  # constant, log(1 + matches)
ARRIVED_BY_POSE = 4.65, -2.48, -4.24  # where there is a motion: constant, a metre, a radian
FAR, TURNED = 3.0, 1.5  # m, rad: beyond, a motion says no more against an arrival
# Of the network's logit, where there are features: what helps photographs. In simulation, where it
# has learned, it should count more, and there is nothing to verify.
NETWORK, NETWORK_MOST = 0.1, 4.0
SIGMA, SIGMA_SHARE = 0.15, 0.5  # of a position: m, and its share of the distance
UNCERTAIN = 2.0  # times that the network's position is as uncertain, if no motion confirms it


def evidence(found: Comparison) -> tuple[float, float]:
    """Logits of co-visibility and of having arrived, by local features alone."""
    co_visible = CO_VISIBLE[0] + CO_VISIBLE[1] * found.likeness
    arrived = ARRIVED[0] + ARRIVED[1] * math.log1p(found.matches)
    if found.inliers:
        co_visible += CO_VISIBLE[2]
        constant, metre, radian = ARRIVED_BY_POSE
        arrived += (constant + metre * min(float(np.hypot(*found.position)), FAR)
                    + radian * min(abs(found.heading), TURNED))
    return co_visible, arrived


def verified(sight: Sight, found: Comparison) -> Sight:
    """What is seen of a goal, by the network and by local features."""
    if not found.rich:
        return sight
    co_visible, arrived = (
        _probability(own + NETWORK * min(max(_logit(said), -NETWORK_MOST), NETWORK_MOST))
        for own, said in zip(evidence(found), (sight.co_visible, sight.arrived), strict=True))
    if not found.inliers:
        return dataclasses.replace(sight, co_visible=co_visible, arrived=arrived,
                                   sigma=UNCERTAIN * sight.sigma)
    return dataclasses.replace(
        sight, co_visible=co_visible, arrived=arrived, position=found.position,
        sigma=SIGMA + SIGMA_SHARE * float(np.hypot(*found.position)),
        heading=np.array([math.cos(found.heading), math.sin(found.heading)]))


def _logit(probability: float) -> float:
    return math.log(max(probability, 1e-9) / max(1 - probability, 1e-9))


def _probability(logit: float) -> float:
    return 1 / (1 + math.exp(-min(max(logit, -30.0), 30.0)))
