"""The networks of `search`: one that recognises the goal, one that sees how far the place is free.

Shapes: N pictures, G distinct goals, S side of the square pictures [pixels], F features.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.encoders import Matching, Pixels, apply, averaged, channels_last, orthogonal
from vn_nav.policy.heads import NEAR
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Latents, Policy, PolicyOutput
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.search.look import (
    BINS,
    COLUMNS,
    LOG_CONCENTRATIONS,
    PER_AXIS,
    Look,
    Recognition,
    heading_deviation,
)
from vn_nav.policy.search.rules import Rules
from vn_nav.policy.search.taught import TaughtPlace

LOG_SCALES = -3.5, 2.0  # of the position, log of metres: 0.03 to 7.4 m


class Recogniser(nn.Module):
    """Says `Recognition` by the features of a compared pair."""

    OUTPUTS = 8

    def __init__(self, features: int, width: int = 256):
        super().__init__()
        self.hidden = nn.Linear(features, width)
        self.out = nn.Linear(width, self.OUTPUTS)
        orthogonal(self)
        nn.init.orthogonal_(self.out.weight, 0.1)

    def forward(self, features: Tensor) -> Recognition:
        """Of features [N,F]."""
        out = apply(self.out, F.relu(apply(self.hidden, features))).float()
        # In the order of `vn_nav.policy.heads.GoalPose` first, whose weights may begin this.
        return Recognition(NEAR * out[:, :2], out[:, 5].clamp(*LOG_SCALES),
                           F.normalize(out[:, 2:4], dim=1, eps=1e-6),
                           (1 + out[:, 6]).clamp(*LOG_CONCENTRATIONS), out[:, 4], out[:, 7] - 1)


class Ranges(nn.Module):
    """Range of the first obstacle along `COLUMNS` bearings, from a picture alone.

    Convolutions 5x5, then 3x3 three times, halve the rows each time; only the first halves the
    columns, so that 64 pixels leave 4 rows of 32 columns. One over all four rows and five columns,
    and a 1x1 convolution, read them.
    """

    ROWS = 4

    def __init__(self, mean: float, std: float, channels: tuple[int, ...] = (16, 32, 48, 64),
                 width: int = 128):
        super().__init__()
        self.first = Pixels(3, channels[0], 6, 2, mean, std)
        self.narrow = nn.ModuleList(
            nn.Conv2d(a, b, 3, (2, 1), 1) for a, b in zip(channels, channels[1:], strict=False))
        self.read = nn.Conv2d(channels[-1], width, (self.ROWS, 5), 1, (0, 2))
        self.out = nn.Conv2d(width, BINS, 1)
        orthogonal(self)
        nn.init.orthogonal_(self.out.weight, 0.1)
        channels_last(self)

    def forward(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """Log-probabilities [N,COLUMNS,BINS] float32 of pictures [N,3,S,S] uint8."""
        # Repeated edges: padding by zeros would be pixels far darker than any.
        x = F.pad(image.to(dtype), (2, 2, 2, 2), mode='replicate')
        x = F.relu(self.first(x, dtype))
        for layer in self.narrow:
            assert isinstance(layer, nn.Conv2d)
            weight, bias = layer.weight.to(dtype), layer.bias
            assert bias is not None  # as they are made
            x = F.relu(F.conv2d(x, weight, bias.to(dtype), layer.stride, layer.padding))
        if x.shape[2:] != (self.ROWS, COLUMNS):
            x = averaged(x, self.ROWS, COLUMNS)
        x = apply(self.out, F.relu(apply(self.read, x)))
        return F.log_softmax(x.float().squeeze(2).transpose(1, 2), dim=-1)


class SearchPolicy(Policy):
    """The eyes of `search`: `look` says what a picture shows; a planner on a map decides.

    It has no memory, actor or critic: `forward` is refused. `encoder` compares picture and goal,
    `recogniser` reads the comparison, `ranges` sees the picture alone.

    Attributes:
        taught: the place that it knows, of a recorded drive; None: none.
        rules: of the decisions; None: the usual ones.
    """

    uses_odometry = True
    encoder: Matching

    def _build(self, config: NetworkConfig) -> None:
        pixels = config.pixel_mean, config.pixel_std
        self.taught: TaughtPlace | None = None
        self.rules: Rules | None = None
        self.tracker = self.places = self.routes = self.around = None
        self.encoder = Matching(config.size, config.channels, config.features, config.blocks,
                                *pixels)
        self.recogniser = Recogniser(config.features)
        self.ranges = Ranges(*pixels)
        self.heads = nn.ModuleDict()
        self.target_side = self.cell = 0

    def encode_goals(self, goals: Tensor) -> Tensor:
        """What is kept of goals [G,3,S,S] uint8: [G,2*C*h*w+COLUMNS*BINS].

        What pictures are compared with, of each goal and of its mirror image; behind it the ranges
        that are seen in it, as log-probabilities.
        """
        maps = [self.encoder.encode_goals(pictures, self.compute_dtype).flatten(1)
                for pictures in (goals, goals.flip(-1))]
        return torch.cat([*maps, self.see_ranges(goals).flatten(1).to(maps[0].dtype)], dim=1)

    def see(self, pictures: Tensor) -> Tensor:
        """What `compare` takes of pictures [N,3,S,S] uint8 and their mirror images: [N,2,...]."""
        return torch.stack([self.encoder.see(own, self.compute_dtype)
                            for own in (pictures, pictures.flip(-1))], dim=1)

    def compare(self, seen: Tensor, goal_maps: Tensor) -> Recognition:
        """Where the goals stand in N pictures.

        A mirrored place is a place as well: what is said of it, mirrored back, is a second opinion
        whose errors are others.

        Args:
            seen: [N,2,...] of `see`; goal_maps: [N,...] of `encode_goals`.
        """
        maps = views_of(goal_maps, seen)
        own, other = (self.recogniser(self.encoder.meet(seen[:, k], maps[:, k], None)[1])
                      for k in range(2))
        return agreed(own, mirrored(other))

    def look(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None = None) -> Look:
        """What is seen, in pictures and their mirror images together; not for learning.

        Args:
            image: [N,3,S,S] uint8.
            goal_maps: of `encode_goals`.
            goal_index: [N] int64, the goal of each picture; left out: goal n belongs to picture n.
        """
        if goal_index is not None:
            goal_maps = goal_maps.index_select(0, goal_index)
        seen = self.compare(self.see(image), goal_maps)
        return Look(self.see_ranges(image), seen.position, PER_AXIS * seen.log_scale.exp(),
                    seen.heading,
                    torch.from_numpy(heading_deviation(seen.log_concentration.numpy())),
                    seen.co_visible, seen.arrived)

    def see_ranges(self, image: Tensor) -> Tensor:
        """Log-probabilities [N,COLUMNS,BINS] of pictures and their mirror images together."""
        own, other = self.ranges(torch.cat([image, image.flip(-1)]), self.compute_dtype).chunk(2)
        return torch.logsumexp(torch.stack([own, other.flip(1)]), dim=0) - math.log(2)

    def latents(self, obs: Observation, starts: Tensor, state: RecurrentState | None = None,
                goal_maps: Tensor | None = None) -> tuple[Latents, RecurrentState]:
        """There are none.

        Raises:
            UserError: always.
        """
        raise _no_actor()

    def read(self, latents: Latents) -> PolicyOutput:
        """There is no actor.

        Raises:
            UserError: always.
        """
        raise _no_actor()


def views_of(goal_maps: Tensor, seen: Tensor) -> Tensor:
    """Maps [G,2,C,h,w] of goals and of their mirror images, of `SearchPolicy.encode_goals`.

    Args:
        goal_maps: [G,...]; seen: of `SearchPolicy.see`, whose maps are as large.
    """
    return goal_maps[:, :-COLUMNS * BINS].unflatten(1, seen.shape[1:])


def mirrored(said: Recognition) -> Recognition:
    """What is said of pairs of pictures, of the mirrored ones: left is right."""
    sides = said.position.new_tensor([1.0, -1.0])
    return said._replace(position=sides * said.position, heading=sides * said.heading)


def agreed(one: Recognition, other: Recognition) -> Recognition:
    """What two opinions of the same pairs come to: means, of poses by how sure each is."""
    means = [(a + b) / 2 for a, b in zip(one, other, strict=True)]
    share = torch.sigmoid(2 * (other.log_scale - one.log_scale)).unsqueeze(1)
    heading = (one.log_concentration.exp().unsqueeze(1) * one.heading
               + other.log_concentration.exp().unsqueeze(1) * other.heading)
    return Recognition(*means)._replace(
        position=share * one.position + (1 - share) * other.position,
        heading=F.normalize(heading, dim=1, eps=1e-6))


def _no_actor() -> UserError:
    return UserError('a policy of the architecture search decides by its map and planner',
                     'its networks, asked for an action', 'use it in the runtime of '
                     'vn_nav.policy.search')
