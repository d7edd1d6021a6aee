"""`Eyes` by PyTorch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vn_nav.policy.encoders import apply, averaged, directions
from vn_nav.policy.search.eyes import POOLED, Placed, Seen
from vn_nav.policy.search.look import Look, Recognition
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.rules import Rules

BATCH = 64  # pictures at once


class TorchEyes:
    """See `Eyes`.

    Args:
        network: used as it is, in its `compute_dtype`.
    """

    def __init__(self, network: SearchPolicy):
        self.network = network
        self.config, self.taught = network.config, network.taught

    @property
    def rules(self) -> Rules | None:
        """Of the decisions, as the network says."""
        return self.network.rules

    @torch.inference_mode()
    def encode_goals(self, goals: np.ndarray) -> np.ndarray:
        """See `Eyes`."""
        pictures = torch.from_numpy(np.ascontiguousarray(goals))
        return torch.cat([self.network.encode_goals(part).float()
                          for part in pictures.split(BATCH)]).numpy()

    @torch.inference_mode()
    def look(self, image: np.ndarray, goal_maps: np.ndarray) -> Look:
        """See `Eyes`."""
        return Look(*(part.numpy() for part in self.network.look(
            torch.from_numpy(image), self._maps(goal_maps))))

    @torch.inference_mode()
    def see(self, image: np.ndarray) -> Seen:
        """See `Eyes`."""
        parts = [seen_by(self.network, part) for part in torch.from_numpy(image).split(BATCH)]
        return Seen(*(torch.cat(each).float().numpy() for each in zip(*parts, strict=True)))

    @torch.inference_mode()
    def compare(self, features: np.ndarray, goal_maps: np.ndarray) -> Placed:
        """See `Eyes`."""
        pairs = zip(torch.from_numpy(features).to(self.network.compute_dtype).split(BATCH),
                    self._maps(goal_maps).split(BATCH), strict=True)
        parts = [self.network.compare(*pair) for pair in pairs]
        return Placed.of(Recognition(*(torch.cat(each).numpy()
                                       for each in zip(*parts, strict=True))))

    def _maps(self, goal_maps: np.ndarray) -> Tensor:
        return torch.from_numpy(goal_maps).to(self.network.compute_dtype)


def seen_by(network: SearchPolicy, pictures: Tensor) -> tuple[Tensor, Tensor]:
    """`Seen` of pictures, as tensors."""
    features = network.see(pictures)
    query = directions(apply(network.encoder.query, features[:, 0]))
    return features, directions(averaged(query, POOLED, POOLED)).permute(0, 2, 3, 1).flatten(1, 2)
