"""Convolutional encoders of picture and goal: from uint8 pixels to maps and features.

All of them see a goal once, however many frames share it: `encode_goals` runs for each distinct
goal, and what it returns is added to the frames' own share of the layer where both meet. A
convolution over stacked channels is the sum of two convolutions, so the output is that of the
plain network.

Shapes: N frames, G distinct goals, S side of the square pictures [pixels], C maps of side h,
F features. Weights are float32; everything is computed in the `dtype` that is asked for.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.policy.pooling import averages

LARGE_LAYOUT_PX = 128  # pixels: from here on the thesis network has its layout for 174 x 174


def apply(layer: nn.Conv2d | nn.Linear | nn.ConvTranspose2d, x: Tensor) -> Tensor:
    """A layer in the type of its input."""
    weight, bias = layer.weight.to(x.dtype), bias_of(layer, x.dtype)
    if isinstance(layer, nn.Linear):
        return F.linear(x, weight, bias)
    if isinstance(layer, nn.ConvTranspose2d):
        return F.conv_transpose2d(x, weight, bias, layer.stride)
    return F.conv2d(x, weight, bias, layer.stride, layer.padding)


def bias_of(layer: nn.Conv2d | nn.Linear | nn.ConvTranspose2d, dtype: torch.dtype
            ) -> Tensor | None:
    """A layer's bias, if it has one, in some type."""
    return None if layer.bias is None else layer.bias.to(dtype)


def add_goals(frames: Tensor, goals: Tensor, goal_index: Tensor | None) -> Tensor:
    """Frames [N,...] + goals [G,...][goal_index]; without an index goal n belongs to frame n.

    As a product with the one-hot matrix [N,G]: one pass forward, and backward one product in
    place of a slow scatter over the frames that share a goal.
    """
    if goal_index is None:
        return frames + goals
    one_hot = (goal_index.unsqueeze(1) == torch.arange(len(goals), device=frames.device))
    rows, goal_rows = frames.flatten(1), goals.flatten(1)
    return torch.addmm(rows, one_hot.to(rows.dtype), goal_rows).view(frames.shape)


def uniform_by_fan_in(module: nn.Module) -> None:
    """Weights U(-1/sqrt(fan_in), 1/sqrt(fan_in)), biases 0 (the published code's rule).

    For transposed convolutions fan_in is out_channels * k * k, as torch counts it.
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear, nn.ConvTranspose2d)):
            bound = 1 / math.sqrt(layer.weight[0].numel())
            nn.init.uniform_(layer.weight, -bound, bound)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def orthogonal(module: nn.Module) -> None:
    """Orthogonal weights with the gain of ReLU, biases 0."""
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear, nn.ConvTranspose2d)):
            nn.init.orthogonal_(layer.weight, 2**0.5)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


class Pixels(nn.Module):
    """First convolution on normalised pixels; mean and deviation are folded into it.

    Args:
        channels: of the pictures; out: maps; kernel, stride: of the convolution.
        mean, std: grey levels. Whole pixels less a whole mean stay exact in bfloat16.
    """

    def __init__(self, channels: int, out: int, kernel: int, stride: int, mean: float, std: float):
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride)
        self.mean, self.std = mean, std

    def forward(self, pictures: Tensor, dtype: torch.dtype, part: slice = slice(None),
                bias: bool = True) -> Tensor:
        """[N,c,S,S] uint8 -> [N,out,h,w], by the input channels `part` of the filters."""
        pixels = pictures.to(dtype).contiguous(memory_format=torch.channels_last)
        if self.mean:
            pixels = pixels.sub_(self.mean)
        weight = (self.conv.weight[:, part] / self.std).to(dtype)
        return F.conv2d(pixels, weight, bias_of(self.conv, dtype) if bias else None,
                        self.conv.stride)


class Fused(nn.Module):
    """Early fusion: picture and goal stacked to six channels before the first convolution.

    Convolutions 8x8/4, 4x4/2, 3x3/1, each of the first two followed by `blocks` residual blocks
    (He et al. 2016: two 3x3 convolutions each), and a linear layer; ReLU after each. 84 pixels
    give maps of side 20, 9, 7.

    Args:
        size: S; channels: of the three convolutions; features: F.
        blocks: residual blocks a stage. mean, std: see `Pixels`. frames: pictures in a stack.
    """

    def __init__(self, size: int, channels: tuple[int, int, int], features: int, blocks: int,
                 mean: float, std: float, frames: int = 1):
        super().__init__()
        self.planes = 3 * frames
        first, second, third = channels
        self.first = Pixels(2 * self.planes, first, 8, 4, mean, std)
        self.stage1 = nn.ModuleList(ResidualBlock(first) for _ in range(blocks))
        self.conv2 = nn.Conv2d(first, second, 4, 2)
        self.stage2 = nn.ModuleList(ResidualBlock(second) for _ in range(blocks))
        self.conv3 = nn.Conv2d(second, third, 3, 1)
        side = ((size - 8) // 4 + 1 - 4) // 2 + 1 - 2
        self.maps = (third, side)
        self.trunk = nn.Linear(third * side**2, features)
        self.features = features
        orthogonal(self)
        identities(self)
        channels_last(self)

    def encode_goals(self, goals: Tensor, dtype: torch.dtype) -> Tensor:
        """The goals' share of the first convolution, [G,C,h,w]."""
        return self.first(goals, dtype, slice(self.planes, None), bias=False)

    def forward(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None,
                dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Maps [N,C,h,w] and features [N,F]."""
        return self.meet(self.see(image, dtype), goal_maps, goal_index)

    def see(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """The pictures' share of the first convolution, [N,C,h,w]."""
        return self.first(image, dtype, slice(0, self.planes))

    def meet(self, seen: Tensor, goal_maps: Tensor, goal_index: Tensor | None
             ) -> tuple[Tensor, Tensor]:
        """Maps and features, as `forward`, of what `see` returned."""
        x = add_goals(seen.permute(0, 2, 3, 1), goal_maps.permute(0, 2, 3, 1), goal_index)
        x = F.relu(x).permute(0, 3, 1, 2)
        for block in self.stage1:
            x = block(x)
        x = F.relu(apply(self.conv2, x))
        for block in self.stage2:
            x = block(x)
        x = F.relu(apply(self.conv3, x))
        # Flattened as the maps lie in memory, [row, column, channel].
        return x, F.relu(apply(self.trunk, x.permute(0, 2, 3, 1).flatten(1)))


class ResidualBlock(nn.Module):
    """x -> relu(x + conv(relu(conv(x)))), 3x3, as many channels out as in."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[N,C,h,w] -> the same shape."""
        return F.relu(x + apply(self.conv2, F.relu(apply(self.conv1, x))))


def identities(module: nn.Module) -> None:
    """Let the residual blocks begin as the identity."""
    for block in module.modules():
        if isinstance(block, ResidualBlock):
            nn.init.zeros_(block.conv2.weight)


def channels_last(module: nn.Module) -> None:
    """Let the weights of convolutions lie in memory as the pictures do."""
    # torch's own annotations of `to` lack the argument.
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def averaged(maps: Tensor, rows: int, columns: int) -> Tensor:
    """Maps [N,C,h,w] averaged to [N,C,rows,columns], as `F.adaptive_avg_pool2d`.

    By products, which ONNX has for any sizes.
    """
    down, across = (torch.from_numpy(averages(side, parts)).to(maps) for side, parts in zip(
        maps.shape[2:], (rows, columns), strict=True))
    return down @ maps @ across.T


def directions(maps: Tensor) -> Tensor:
    """Maps [N,C,h,w] of length 1 along C; the lengths in float32, for bfloat16 is too coarse."""
    return F.normalize(maps.float(), dim=1).to(maps.dtype)


class Matching(nn.Module):
    """Shared convolutions, then which place of the picture looks like which place of the goal.

    Both pictures pass convolutions 8x8/4 and 3x3/2 (padded). The correlation volume (all cosine
    similarities of a place of the picture and one of the goal; Rocco et al., arXiv 1703.05593)
    joins the picture's maps, one channel a place of the goal; a 1x1 convolution, `blocks`
    residual blocks, of one at least, and a linear layer read it. 64 pixels give maps of side 8.

    Stacking the pictures compares places that lie nearby in both; this one any two: it learns
    goal poses from far fewer pairs (docs/results.md).

    Args:
        as of `Fused`; blocks: after the pictures have met.
    """

    SCALE = 3.0  # of similarities in [-1, 1], among maps of about that size

    def __init__(self, size: int, channels: tuple[int, int, int], features: int, blocks: int,
                 mean: float, std: float, frames: int = 1):
        super().__init__()
        first, second, third = channels
        self.first = Pixels(3 * frames, first, 8, 4, mean, std)
        self.conv2 = nn.Conv2d(first, second, 3, 2, 1)
        side = ((size - 8) // 4 + 2) // 2
        self.query = nn.Conv2d(second, second, 1)
        self.key = nn.Conv2d(second, second, 1)
        self.fuse = nn.Conv2d(second + side**2, third, 1)
        self.stage = nn.ModuleList(ResidualBlock(third) for _ in range(max(blocks, 1)))
        self.maps = (third, side)
        self.trunk = nn.Linear(third * side**2, features)
        self.features = features
        orthogonal(self)
        identities(self)
        channels_last(self)

    def see(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """Maps of a picture alone, [N,C,h,w]."""
        return F.relu(apply(self.conv2, F.relu(self.first(image, dtype))))

    def encode_goals(self, goals: Tensor, dtype: torch.dtype) -> Tensor:
        """What places of the goals look like, [G,C,h,w] of length 1 along C."""
        return directions(apply(self.key, self.see(goals, dtype)))

    def forward(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None,
                dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Maps [N,C,h,w] and features [N,F]."""
        return self.meet(self.see(image, dtype), goal_maps, goal_index)

    def meet(self, seen: Tensor, goal_maps: Tensor, goal_index: Tensor | None
             ) -> tuple[Tensor, Tensor]:
        """Maps and features, as `forward`, of what `see` returned."""
        if goal_index is not None:
            goal_maps = goal_maps.index_select(0, goal_index)
        query = directions(apply(self.query, seen))
        # [N,places,C] x [N,C,places of the goal]: the maps lie in memory as the left one.
        volume = self.SCALE * torch.bmm(
            query.permute(0, 2, 3, 1).flatten(1, 2), goal_maps.flatten(2))
        rows = torch.cat([seen.permute(0, 2, 3, 1), volume.unflatten(1, seen.shape[2:])], dim=3)
        x = F.relu(apply(self.fuse, rows.permute(0, 3, 1, 2)))
        for block in self.stage:
            x = block(x)
        return x, F.relu(apply(self.trunk, x.permute(0, 2, 3, 1).flatten(1)))


class TwoStreams(nn.Module):
    """The thesis's base (figure 4.2): shared convolutions on picture and goal, then one trunk.

    84 x 84: shared 3->16 8x8/4; trunk 32->32 4x4/2, 32->32 1x1, linear 2592->512. From
    `LARGE_LAYOUT_PX` on, as for 174 x 174: shared 3->32 7x7/4, 32->32 4x4/2; trunk 64->64 4x4/2,
    64->32 1x1, linear 2592->512. ReLU after each. The last maps have 32 channels and, at both
    sizes, side 9.
    """

    features = 512

    def __init__(self, size: int, mean: float, std: float, frames: int = 1):
        super().__init__()
        if size < LARGE_LAYOUT_PX:
            stream = 16
            self.first = Pixels(3 * frames, 16, 8, 4, mean, std)
            self.second = None
            side, width = (size - 8) // 4 + 1, 32
        else:
            stream = 32
            self.first = Pixels(3 * frames, 32, 7, 4, mean, std)
            self.second = nn.Conv2d(32, 32, 4, 2)
            side, width = ((size - 7) // 4 + 1 - 4) // 2 + 1, 64
        self.stream = stream
        self.fuse = nn.Conv2d(2 * stream, width, 4, 2)
        self.mix = nn.Conv2d(width, 32, 1)
        side = (side - 4) // 2 + 1
        self.maps = (32, side)
        self.trunk = nn.Linear(32 * side**2, self.features)
        uniform_by_fan_in(self)

    def _stream(self, pictures: Tensor, dtype: torch.dtype) -> Tensor:
        x = F.relu(self.first(pictures, dtype))
        return x if self.second is None else F.relu(apply(self.second, x))

    def encode_goals(self, goals: Tensor, dtype: torch.dtype) -> Tensor:
        """The goals' share of the fusing convolution, [G,C,h,w]."""
        weight = self.fuse.weight[:, self.stream:].to(dtype)
        return F.conv2d(self._stream(goals, dtype), weight, None, self.fuse.stride)

    def forward(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None,
                dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Maps [N,32,9,9] and features [N,512]."""
        weight = self.fuse.weight[:, :self.stream].to(dtype)
        x = F.conv2d(self._stream(image, dtype), weight, bias_of(self.fuse, dtype),
                     self.fuse.stride)
        x = add_goals(x.permute(0, 2, 3, 1), goal_maps.permute(0, 2, 3, 1), goal_index)
        x = F.relu(apply(self.mix, F.relu(x).permute(0, 3, 1, 2)))
        return x, F.relu(apply(self.trunk, x.flatten(1)))


class OneStream(nn.Module):
    """UNREAL's base (Jaderberg et al. 2016) for tasks without a goal picture.

    3->16 8x8/4, 16->32 4x4/2, linear 2592->256 at 84 x 84; ReLU after each.
    """

    features = 256

    def __init__(self, size: int, mean: float, std: float, frames: int = 1):
        super().__init__()
        self.first = Pixels(3 * frames, 16, 8, 4, mean, std)
        self.conv2 = nn.Conv2d(16, 32, 4, 2)
        side = ((size - 8) // 4 + 1 - 4) // 2 + 1
        self.maps = (32, side)
        self.trunk = nn.Linear(32 * side**2, self.features)
        uniform_by_fan_in(self)

    def encode_goals(self, goals: Tensor, dtype: torch.dtype) -> Tensor:
        """Nothing: goals are not looked at."""
        return torch.zeros(len(goals), 0, dtype=dtype, device=goals.device)

    def forward(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None,
                dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Maps [N,32,9,9] and features [N,256]."""
        x = F.relu(apply(self.conv2, F.relu(self.first(image, dtype))))
        return x, F.relu(apply(self.trunk, x.flatten(1)))


Encoder = Fused | Matching | TwoStreams | OneStream  # that learn with the policy
