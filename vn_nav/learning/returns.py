"""Returns, advantages and the off-policy targets of replayed windows."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

_count: Callable[[Tensor], Tensor] | None = None  # see `counted_together`


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


def n_step_returns(reward: Tensor, bootstrap_values: Tensor, terminated: Tensor,
                   truncated: Tensor, valid: Tensor, *, gamma: float,
                   truncation_is_terminal: bool = False) -> Tensor:
    """Discounted returns to the end of the episode or rollout (Mnih et al. 2016, algorithm S3).

    A return ends after a terminated step, which nothing follows; before a row that is no frame
    (the true last observation of an episode, or padding), with that row's value; and at the
    rollout's end, with the last row's value. On valid rows of a collected rollout it equals
    `generalised_advantages` with lam = 1 plus the value.

    Args:
        reward: [T,B], after the action of the row.
        bootstrap_values: [T+1,B], of the row's observation.
        terminated, truncated, valid: [T,B] bool.
        gamma: discount.
        truncation_is_terminal: the published code's behaviour: a time-out is worth nothing.

    Returns:
        [T,B]; rows that are no frames get numbers without meaning: mask them.
    """
    over = terminated | truncated if truncation_is_terminal else terminated
    ends = terminated | truncated
    ends[:-1] |= ~valid[1:]
    returns = torch.empty_like(reward)
    following = bootstrap_values[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(ends[t], bootstrap_values[t + 1], following)
        # where, not multiplication: what follows an end may be NaN.
        following = reward[t] + gamma * torch.where(over[t], 0.0, following)
        returns[t] = following
    return returns


def n_step_q(reward: Tensor, bootstrap: Tensor, terminated: Tensor, valid: Tensor, *,
             gamma: float) -> Tensor:
    """N-step Q targets of pixel control, per cell (thesis 4.3.2).

    For windows inside one episode, as `Replay.windows` gives them: the rows that are not valid
    are padding at the end, and the bootstrap reaches past them.

    Args:
        reward: [T,B,h,w] pixel change.
        bootstrap: [B,h,w], the maximum over actions of Q at each window's last observation
            (row T, or the first padded row, which shows the same).
        terminated: [T,B] bool; with truncated steps in it, time-outs are worth nothing either.
        valid: [T,B] bool.
        gamma: discount, 0.9 in the thesis.

    Returns:
        [T,B,h,w]; padded rows get numbers without meaning: mask them.
    """
    targets = torch.empty_like(reward)
    following = bootstrap
    for t in reversed(range(len(reward))):
        over, real = terminated[t, :, None, None], valid[t, :, None, None]
        step = reward[t] + gamma * torch.where(over, 0.0, following)
        following = torch.where(real, step, following)
        targets[t] = following
    return targets


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x over the rows where the boolean mask holds; 0 where it holds nowhere."""
    count = mask.sum()
    count = count.clamp(min=1) if _count is None else _count(count)
    # where, not multiplication: a masked row may hold NaN.
    return torch.where(mask, x, 0.0).sum() / count


@contextlib.contextmanager
def counted_together(count: Callable[[Tensor], Tensor]) -> Iterator[None]:
    """Let masked means divide by another count than their own, as several processes need it.

    Args:
        count: from a number of rows of this process to the one to divide by, positive.
    """
    global _count
    before, _count = _count, count
    try:
        yield
    finally:
        _count = before


def normalise(advantage: Tensor, mask: Tensor) -> Tensor:
    """Shift and scale to mean 0 and deviation 1 over the rows where the mask holds."""
    mean = masked_mean(advantage, mask)
    deviation = masked_mean((advantage - mean) ** 2, mask).sqrt()
    return (advantage - mean) / (deviation + 1e-8)
