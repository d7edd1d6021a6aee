"""What every simulator behind vn_nav offers: motion and pixels, batched; no task."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Protocol

import numpy as np


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """What a backend can do; whoever needs more says so before the first step."""

    continuous: bool  # any displacement; False: only the actions of a grid
    depth: bool
    labels: bool
    geodesic: bool  # knows driving distances
    tilt: bool  # the camera can look up and down


class Motion(NamedTuple):
    """What really happened in a move."""

    delta: np.ndarray  # [K,4] float64: dx, dy [m], dyaw, dpitch [rad] in the body frame at start
    collided: np.ndarray  # [K] bool


class Frames(NamedTuple):
    """What the cameras see."""

    rgb: np.ndarray  # [K,3,H,W] uint8
    depth: np.ndarray  # [K,H,W] float32 m along the optical axis
    labels: np.ndarray  # [K,H,W] uint8 class ids
    instances: np.ndarray  # [K,H,W] uint16


class Backend(Protocol):
    """A batch of N robots in one simulator."""

    num_envs: int
    capabilities: Capabilities
    world_version: str
    poses: np.ndarray  # [N,4] float64: x, y [m], yaw, pitch [rad] in the map frame

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4]."""

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""

    def observe(self, env_ids: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras; valid until the next call."""
