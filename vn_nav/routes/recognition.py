"""Which pictures of a route a robot sees, by the eyes of its policy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vn_nav.policy.search.eyes import Eyes
from vn_nav.policy.search.lens import pose_in_metres


class Sighting(NamedTuple):
    """Of R pictures of a route."""

    co_visible: np.ndarray  # [R] probability that they show what the robot sees
    distance: np.ndarray  # [R] m to where they were taken, if they do


class RouteEyes:
    """Compares what a robot sees with the pictures of a route.

    Args:
        eyes: of a policy that searches.
        pictures: [K,3,S,S] uint8, as the policy takes goals.
        zoom: of the lens, see `vn_nav.policy.search.lens`.
    """

    def __init__(self, eyes: Eyes, pictures: np.ndarray, zoom: float = 1.0):
        self._eyes, self._zoom = eyes, zoom
        self._maps = eyes.encode_goals(pictures)

    def look(self, picture: np.ndarray, rows: np.ndarray) -> Sighting:
        """Compare one picture [3,S,S] with those of these numbers [R]."""
        features = self._eyes.see(picture[None]).features
        said = self._eyes.compare(np.repeat(features, len(rows), axis=0), self._maps[rows])
        position = pose_in_metres(*said[:4], self._zoom)[0]
        return Sighting((1 + np.tanh(said.co_visible / 2)) / 2, np.hypot(*position.T))
