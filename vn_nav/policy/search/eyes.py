"""The networks of `search` at work: NumPy arrays in and out, whatever computes them.

Shapes: N pictures, G goals, S side of the square pictures [pixels]. float32, unless said.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.pooling import averages
from vn_nav.policy.search.look import PER_AXIS, Look, Recognition, heading_deviation
from vn_nav.policy.search.rules import Rules
from vn_nav.policy.search.taught import TaughtPlace

POOLED = 4  # a side of the maps by which likeness is judged


class Seen(NamedTuple):
    """What is kept of N pictures."""

    features: np.ndarray  # [N,2,C,h,w], of pictures and their mirror images: for `Eyes.compare`
    places: np.ndarray  # [N,P,C]: what parts of the pictures look like, of length 1 along C


class Placed(NamedTuple):
    """Where the goals of N pairs stand; as of `Look`."""

    position: np.ndarray
    position_sigma: np.ndarray
    heading: np.ndarray
    heading_sigma: np.ndarray
    co_visible: np.ndarray
    arrived: np.ndarray

    @staticmethod
    def of(said: Recognition) -> Placed:
        """The same in metres and radians."""
        return Placed(said.position, PER_AXIS * np.exp(said.log_scale), said.heading,
                      heading_deviation(said.log_concentration), said.co_visible, said.arrived)


class Eyes(Protocol):
    """What sees for robots that search.

    Attributes:
        config: size of the pictures, lens, actions.
        taught: the place that it knows; None: none.
    """

    config: NetworkConfig
    taught: TaughtPlace | None

    @property
    def rules(self) -> Rules | None:
        """Of the decisions; None: the usual ones."""

    def encode_goals(self, goals: np.ndarray) -> np.ndarray:
        """What is kept of goals [G,3,S,S] uint8: [G,...], which `look.goal_ranges` can read."""

    def look(self, image: np.ndarray, goal_maps: np.ndarray) -> Look:
        """What is seen in pictures [N,3,S,S] uint8, each with its goal, [N,...]."""

    def see(self, image: np.ndarray) -> Seen:
        """What is kept of pictures [N,3,S,S] uint8."""

    def compare(self, features: np.ndarray, goal_maps: np.ndarray) -> Placed:
        """Where the goals [N,...] stand from pictures, `Seen.features`."""


def goal_places(goal_maps: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """As `Seen.places`, [G,P,C], of goals: alike where a picture shows the same.

    Args:
        goal_maps: [G,...] of `Eyes.encode_goals`; shape: C, h, w of the pictures' features.
    """
    maps = goal_maps[:, :math.prod(shape)].reshape(-1, *shape)
    down, across = (averages(side, POOLED) for side in shape[1:])
    mean = np.einsum('ph,gchw,qw->gpqc', down, maps, across).reshape(len(maps), -1, shape[0])
    return mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-12)


def likeness(places: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """How alike pictures are to another one [K], by `goal_places` [K,P,C] and its [P,C]."""
    alike = places @ seen.T  # [K,keys,query]
    return alike.max(axis=1).mean(axis=1) + alike.max(axis=2).mean(axis=1)
