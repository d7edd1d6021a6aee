"""Which pictures of a route a robot sees, by the eyes of its policy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vn_nav.policy.search.eyes import Eyes, Seen, goal_places, likeness
from vn_nav.policy.search.lens import pose_in_metres


class Sighting(NamedTuple):
    """Of R pictures of a route."""

    co_visible: np.ndarray  # [R] probability that they show what the robot sees
    distance: np.ndarray  # [R] m to where they were taken, if they do


COMPARED = 64  # pictures at most; of more those that are most alike


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
        self._places: np.ndarray | None = None  # [K,P,C], see `goal_places`
        self._newest: tuple[np.ndarray, Seen] | None = None

    def look(self, picture: np.ndarray, rows: np.ndarray) -> Sighting:
        """Compare one picture [3,S,S] with those of these numbers [R].

        Of more than `COMPARED` the least alike are not compared: they are not in view.
        """
        if self._newest is None or self._newest[0] is not picture:
            self._newest = picture, self._eyes.see(picture[None])
        seen = self._newest[1]
        chosen = np.arange(len(rows))
        if len(rows) > COMPARED:
            chosen = np.sort(np.argpartition(-self._likeness(seen, rows), COMPARED)[:COMPARED])
        said = self._eyes.compare(np.repeat(seen.features, len(chosen), axis=0),
                                  self._maps[rows[chosen]])
        position = pose_in_metres(*said[:4], self._zoom)[0]
        found = Sighting(np.zeros(len(rows)), np.full(len(rows), np.inf))
        found.co_visible[chosen] = (1 + np.tanh(said.co_visible / 2)) / 2
        found.distance[chosen] = np.hypot(*position.T)
        return found

    def _likeness(self, seen: Seen, rows: np.ndarray) -> np.ndarray:
        """How alike pictures [R] are to what is seen."""
        if self._places is None:
            self._places = goal_places(self._maps, seen.features.shape[2:])
        return likeness(self._places[rows], seen.places[0])
