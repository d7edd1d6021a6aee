"""Heads on the policy's maps, features and memory: what auxiliary tasks predict.

They are part of the network and of its checkpoint; their losses are in
`vn_nav.learning.auxiliary`. Shapes as in `vn_nav.policy.encoders`; T steps, B environments,
A actions, H hidden units.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.policy.encoders import apply, orthogonal, uniform_by_fan_in

CLASSES = 3  # of reward prediction: zero, positive, negative
NEAR = 3.0  # m: unit of the goal pose's position inside the network


def grown(side: int, deconvolutions: int) -> int:
    """Side of maps after 4x4/2 transposed convolutions: 9 gives 20, then 42."""
    for _ in range(deconvolutions):
        side = 2 * side + 2
    return side


def dueling(value: Tensor, advantage: Tensor) -> Tensor:
    """Q of the dueling architecture (Wang et al. 2015, equation 9; thesis 4.3.2).

    Args:
        value: [...,1,h,w]; advantage: [...,A,h,w].

    Returns:
        [...,A,h,w], value + advantage - the mean of the advantage over the *actions*.
    """
    return value + advantage - advantage.mean(-3, keepdim=True)


def transposed(layers: nn.ModuleList) -> Iterable[nn.ConvTranspose2d]:
    """The transposed convolutions in a list: torch's type does not say what is in it."""
    return cast(Iterable[nn.ConvTranspose2d], layers)


class PixelControl(nn.Module):
    """Action values of changing each cell of the picture (thesis, 4.3.2 and figure 4.3).

    Linear H->32*h*h, ReLU; for two deconvolutions 32->32 4x4/2, ReLU; two branches 32->1 and
    32->A 4x4/2, joined as Q = V + A - mean over the actions of A (Wang et al. 2016).
    """

    def __init__(self, hidden: int, actions: int, side: int, deconvolutions: int):
        super().__init__()
        self.side = side
        self.expand = nn.Linear(hidden, 32 * side**2)
        self.grow = nn.ModuleList(
            nn.ConvTranspose2d(32, 32, 4, 2) for _ in range(deconvolutions - 1))
        self.value = nn.ConvTranspose2d(32, 1, 4, 2)
        self.advantage = nn.ConvTranspose2d(32, actions, 4, 2)
        uniform_by_fan_in(self)

    def forward(self, hidden: Tensor) -> Tensor:
        """Q [N,A,k,k] float32 from the memory's outputs [N,H]."""
        x = F.relu(apply(self.expand, hidden)).view(-1, 32, self.side, self.side)
        for layer in transposed(self.grow):
            x = F.relu(apply(layer, x))
        # Both branches are one deconvolution: one pass over x.
        assert self.value.bias is not None and self.advantage.bias is not None  # as they are made
        weight = torch.cat([self.value.weight, self.advantage.weight], dim=1).to(x.dtype)
        bias = torch.cat([self.value.bias, self.advantage.bias]).to(x.dtype)
        both = F.conv_transpose2d(x, weight, bias, 2).float()
        return dueling(both[:, :1], both[:, 1:])


class RewardPrediction(nn.Module):
    """Sign of the next reward from the last maps of three frames (thesis, 4.3.1)."""

    def __init__(self, maps: int, frames: int = 3):
        super().__init__()
        self.frames = frames
        self.classify = nn.Linear(frames * maps, CLASSES)
        uniform_by_fan_in(self)

    def forward(self, maps: Tensor) -> Tensor:
        """Logits [B,3] float32 from maps [3,B,C,h,w] of consecutive frames."""
        rows = maps.transpose(0, 1).flatten(1)
        return apply(self.classify, rows).float()


class ImageHead(nn.Module):
    """A picture out of the last maps: depth, colours of labels, or the input (thesis, figure 4.4).

    One deconvolution C->out 4x4/2, or two with `width` maps and ReLU in between; linear output.
    """

    def __init__(self, maps: int, width: int, out: int, deconvolutions: int):
        super().__init__()
        widths = [maps, *[width] * (deconvolutions - 1), out]
        self.grow = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 4, 2) for a, b in zip(widths, widths[1:], strict=False))
        uniform_by_fan_in(self)

    def forward(self, maps: Tensor) -> Tensor:
        """[N,out,k,k] float32 from [N,C,h,w]."""
        *inner, last = transposed(self.grow)
        x = maps
        for layer in inner:
            x = F.relu(apply(layer, x))
        return apply(last, x).float()


class Pose(NamedTuple):
    """Where the goal stands relative to the picture."""

    position: Tensor  # [N,2] x forward, y left [m]
    heading: Tensor  # [N,2] cos, sin of the goal's heading less the robot's
    co_visible: Tensor  # [N] logit: does the picture show some of what the goal picture shows?


class GoalPose(nn.Module):
    """Relative pose of the goal, and whether the two pictures show the same, from the features.

    Not in the thesis: the comparison of picture and goal is what a policy for unseen houses
    lacks, and its labels are free in a simulator or with odometry (docs/results.md).
    """

    def __init__(self, features: int, width: int = 128):
        super().__init__()
        self.hidden = nn.Linear(features, width)
        self.out = nn.Linear(width, 5)
        orthogonal(self)
        nn.init.orthogonal_(self.out.weight, 0.1)

    def forward(self, features: Tensor) -> Pose:
        """Of features [N,F]; float32."""
        out = apply(self.out, F.relu(apply(self.hidden, features))).float()
        return Pose(NEAR * out[:, :2], out[:, 2:4], out[:, 4])


class Scalar(nn.Module):
    """One number from the memory's output: an arrival logit, or a distance."""

    def __init__(self, hidden: int):
        super().__init__()
        self.out = nn.Linear(hidden, 1)
        nn.init.orthogonal_(self.out.weight, 0.1)
        nn.init.zeros_(self.out.bias)

    def forward(self, hidden: Tensor) -> Tensor:
        """[...,H] -> [...] float32."""
        return self.out(hidden.float()).squeeze(-1)
