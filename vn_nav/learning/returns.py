"""Returns and advantages."""

from __future__ import annotations

import torch
from torch import Tensor


def generalised_advantages(reward: Tensor, value: Tensor, terminated: Tensor, truncated: Tensor,
                           *, gamma: float, lam: float) -> Tensor:
    """Generalised advantage estimation (Schulman et al. 2016, equation 16) over ended episodes.

    A terminated episode is worth nothing after its end; a truncated one is worth the value of the
    state that was cut off, which under NEXT_STEP autoreset stands in the next row. Neither leaks
    into the next episode. Rows that are no frames get numbers without meaning: mask them.

    Args:
        reward: [T,B], after the action of the row.
        value: [T+1,B], of the row's observation; the last row bootstraps.
        terminated, truncated: [T,B] bool, after the action of the row.
        gamma: discount; lam: 0 is one-step, 1 is Monte Carlo.

    Returns:
        Advantages [T,B]; returns are advantages + value[:-1].
    """
    going_on = (~(terminated | truncated)).to(value.dtype)
    delta = reward + gamma * value[1:] * (~terminated).to(value.dtype) - value[:-1]
    advantage = torch.empty_like(delta)
    following = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        following = delta[t] + gamma * lam * going_on[t] * following
        advantage[t] = following
    return advantage


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x over the rows where the boolean mask holds; 0 where it holds nowhere."""
    # where, not multiplication: a masked row may hold NaN.
    return torch.where(mask, x, 0.0).sum() / mask.sum().clamp(min=1)


def normalise(advantage: Tensor, mask: Tensor) -> Tensor:
    """Shift and scale to mean 0 and deviation 1 over the rows where the mask holds."""
    mean = masked_mean(advantage, mask)
    deviation = masked_mean((advantage - mean) ** 2, mask).sqrt()
    return (advantage - mean) / (deviation + 1e-8)
