"""Pictures of lenses narrower, or wider, than the one that a policy knows.

A picture through a lens that magnifies `zoom` times shows a point (forward x, left y) where the
known lens would show one at (x / zoom, y): the place as if it were squeezed in depth. Turned
cameras fit that picture only nearly. A leaf: datasets label by it, policies turn it back
(`vn_nav.policy.search.lens`).
"""

from __future__ import annotations

import math

import numpy as np

SAME = 0.05  # a zoom off 1 by less is none


def zoom_of(fov: float, known: float) -> float:
    """How many times a lens magnifies against the known one, of fields of view [rad]."""
    return math.tan(known / 2) / math.tan(fov / 2)


def squeezed_pose(goal_pose: np.ndarray, zoom: np.ndarray) -> np.ndarray:
    """Poses [K,4] as of `vn_nav.co_visibility.relative_pose`, as the networks see them.

    Args:
        goal_pose: [K,4] x, y [m], cosine, sine; zoom: [K].
    """
    squeezed = np.array(goal_pose, np.float32)
    squeezed[:, 0] /= zoom
    squeezed[:, 3] *= zoom
    squeezed[:, 2:] /= np.hypot(squeezed[:, 2], squeezed[:, 3])[:, None]
    return squeezed


def bearings_through(bearings: np.ndarray, zoom: np.ndarray | float) -> np.ndarray:
    """True bearings of the picture columns that have these bearings [rad] in the known lens."""
    return np.arctan(np.tan(bearings) / zoom)


def squeezed_ranges(ranges: np.ndarray, bearings: np.ndarray, zoom: np.ndarray) -> np.ndarray:
    """Ranges [V,C] m along `bearings_through`, as the networks see them.

    Args:
        ranges: [V,C] m; bearings: [C] rad of the columns in the known lens; zoom: [V].
    """
    true = bearings_through(bearings, zoom[:, None])
    return (ranges * np.cos(true) / zoom[:, None] / np.cos(bearings)).astype(np.float32)
