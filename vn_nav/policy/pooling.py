"""Means over the parts of a side, as `torch.nn.functional.adaptive_avg_pool2d` divides it."""

from __future__ import annotations

import numpy as np


def averages(side: int, parts: int) -> np.ndarray:
    """[parts,side] float32: the share of each of `side` places in each part's mean."""
    shares = np.zeros((parts, side), np.float32)
    for part in range(parts):
        shares[part, part * side // parts:-(-(part + 1) * side // parts)] = 1
    return shares / shares.sum(axis=1, keepdims=True)
