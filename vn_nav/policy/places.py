"""Place recognition: where in the one place that it was taught a policy sees itself.

A policy for any house compares picture and goal, and looks for the goal where it sees nothing of
it. In a place that it was shown it can know where the goal stands instead. The classifier answers
as the place cells and head-direction cells of Banino et al. 2018 (Nature 557): probabilities over
place cells on the floor and over headings, which can say "here or there" where a pose (Kendall et
al. 2015, PoseNet) would have to lie in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.policy.encoders import Matching, Pixels, apply, directions, orthogonal

HEADINGS = 16  # directions that are distinguished
PLACE_FEATURES = 128  # of the place features for the memory


class PlaceClassifier(nn.Module):
    """Place cell and heading of a picture, as probabilities.

    The layers by which `Matching` compares pictures, which know one thing in many lights and from
    many sides, then a convolution 3x3 and two linear layers. It is fitted before the policy learns
    (`vn_nav.learning.places`) and stays as it is: no gradient passes it.

    Args:
        size: side of the pictures [pixels]; spots: number of place cells, K.
        mean, std: grey levels.

    Attributes:
        spots: [K,2] m, where the place cells lie in the frame of the place; called so in
            the weights of checkpoints.
    """

    spots: Tensor

    def __init__(self, size: int, spots: int, mean: float, std: float):
        super().__init__()
        self.width = spots + HEADINGS
        self.first = Pixels(3, 32, 8, 4, mean, std)
        self.second = nn.Conv2d(32, 64, 3, 2, 1)
        self.key = nn.Conv2d(64, 64, 1)
        self.third = nn.Conv2d(64, 64, 3)
        side = ((size - 8) // 4 + 2) // 2 - 2
        self.trunk = nn.Linear(64 * side**2, 256)
        self.out = nn.Linear(256, self.width)
        self.register_buffer('spots', torch.zeros(spots, 2))
        orthogonal(self)
        nn.init.orthogonal_(self.out.weight, 0.1)
        self.requires_grad_(False)

    def see_as(self, encoder: nn.Module) -> tuple[nn.Module, ...]:
        """Take the first layers of an encoder, if it has the like; what is left to learn."""
        if not isinstance(encoder, Matching) or (
                self.second.weight.shape != encoder.conv2.weight.shape):
            return self.first, self.second, self.key, self.third, self.trunk, self.out
        for mine, other in ((self.first, encoder.first), (self.second, encoder.conv2),
                            (self.key, encoder.key)):
            mine.load_state_dict(other.state_dict())
        return self.third, self.trunk, self.out

    def scores(self, pictures: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Log-probabilities of place cells [N,K] and headings [N,16], float32; of [N,3,S,S]."""
        x = F.relu(apply(self.second, F.relu(self.first(pictures, dtype))))
        x = Matching.SCALE * directions(apply(self.key, x))
        x = F.relu(apply(self.third, x))
        x = F.relu(apply(self.trunk, x.permute(0, 2, 3, 1).flatten(1)))
        x = apply(self.out, x).float()
        spots = x.shape[1] - HEADINGS
        return F.log_softmax(x[:, :spots], dim=1), F.log_softmax(x[:, spots:], dim=1)

    def forward(self, pictures: Tensor, dtype: torch.dtype) -> Tensor:
        """Probabilities [N,K+16] float32 of pictures [N,3,S,S] uint8."""
        return torch.cat(self.scores(pictures, dtype), dim=1).exp()

    def pose(self, code: Tensor) -> Tensor:
        """The mean pose [N,3] x, y [m], yaw [rad] of probabilities [N,K+16]."""
        spots = len(self.spots)
        position = code[:, :spots] @ self.spots
        angle = heading_cells(code.device)
        y, x = (code[:, spots:] @ part(angle) for part in (torch.sin, torch.cos))
        return torch.cat([position, torch.atan2(y, x).unsqueeze(1)], dim=1)


class MultiViewAveraging(nn.Module):
    """Multi-view averaging: while a robot turns, the mean of what its pictures say of its place.

    One direction often looks like two places. If the place changed with every turn, the advice
    would turn the robot to and fro. Probabilities are averaged (a mixture), not multiplied:
    pictures of one place are anything but independent.

    Args:
        moves: [A,3] dx, dy [m], dyaw [rad] of the actions.
        spots: number of place cells, K.

    Attributes:
        width: K + 1 numbers to remember: the sum of the probabilities, and of how many pictures.
    """

    stays: Tensor

    def __init__(self, moves: Sequence[Sequence[float]], spots: int):
        super().__init__()
        self.width = spots + 1
        # The last row: no action yet.
        stays = torch.tensor([*([dx == dy == 0.0] for dx, dy, _ in moves), [False]])
        self.register_buffer('stays', stays, persistent=False)

    @torch.no_grad()
    def forward(self, here: Tensor, last_action: Tensor, starts: Tensor, before: Tensor
                ) -> tuple[Tensor, Tensor]:
        """Go through T steps.

        Args:
            here: [T,B,K+16] probabilities of the pictures.
            last_action: [T,B], -1 where there is none; starts: [T,B] bool.
            before: [B,K+1] remembered from before the first row.

        Returns:
            [T,B,K+16], place cells averaged and headings as they are, and what is remembered
            after the last row.
        """
        keep = (self.stays[last_action] & ~starts.unsqueeze(2)).to(before.dtype)
        spots = here[..., :self.width - 1].to(before.dtype)
        rows = []
        for t in range(len(here)):
            new = torch.cat([spots[t], torch.ones_like(spots[t, :, :1])], dim=1)
            before = keep[t] * before + new
            rows.append(before[:, :-1] / before[:, -1:])
        return torch.cat([torch.stack(rows).to(here.dtype), here[..., self.width - 1:]],
                         dim=2), before


class PathAdvice(nn.Module):
    """Which way it is from where the robot is to where the goal was taken.

    Two hidden layers, read by the memory, and an advice to the actor: both are first taught the
    shortest ways of the place (`vn_nav.learning.places`), and then learn with the policy.
    """

    def __init__(self, width: int, actions: int):
        super().__init__()
        self.join = nn.Linear(2 * width, 512)
        self.out = nn.Linear(512, PLACE_FEATURES)
        self.advise = nn.Linear(PLACE_FEATURES, actions)
        orthogonal(self)
        nn.init.zeros_(self.advise.weight)

    def forward(self, here: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """What the memory reads [N,128], and logits [N,A] float32 to add to the actor's.

        Args:
            here, goal: [N,K+16] probabilities of picture and goal.
        """
        x = F.relu(apply(self.join, torch.cat([here, goal], dim=-1)))
        x = F.relu(apply(self.out, x))
        return x, apply(self.advise, x).float()


def heading_cells(device: torch.device | str = 'cpu') -> Tensor:
    """[16] the headings that are distinguished [rad]."""
    return torch.arange(HEADINGS, device=device) * (2 * math.pi / HEADINGS)
