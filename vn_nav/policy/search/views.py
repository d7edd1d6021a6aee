"""Full pictures, by whose local features a policy that searches may verify what it sees.

What they say is in `vn_nav.policy.search.verification`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_nav.policy.search.local_features import Features, extract

NONE, SIFT = VERIFY = 'none', 'sift'


class View(NamedTuple):
    """A full picture."""

    picture: np.ndarray  # [H,W,3] uint8 RGB
    fov: float  # of its shorter side [rad]

    def features(self) -> Features:
        """Its local features."""
        return extract(self.picture, self.fov)


class Pair(NamedTuple):
    """Local features of a robot's picture and of its goal's."""

    own: Features
    goal: Features


class FeaturePairs:
    """Local features of robots' pictures and of their goals, which are kept.

    Args:
        fov: of the square pictures [rad].
    """

    def __init__(self, fov: float):
        self._fov = fov
        self._goals: np.ndarray | None = None
        self._known: dict[int, Features] = {}

    def of(self, images: np.ndarray, goals: np.ndarray, goal_index: np.ndarray) -> list[Pair]:
        """Of N robots.

        Args:
            images: [N,3,H,H] uint8; goals: [G,3,H,H], kept as long as it is the same array.
            goal_index: [N] of each robot's goal.
        """
        if goals is not self._goals:
            self._goals, self._known = goals, {}
        for k in set(map(int, goal_index)) - self._known.keys():
            self._known[k] = self._extract(goals[k])
        return [Pair(self._extract(image), self._known[int(k)])
                for image, k in zip(images, goal_index, strict=True)]

    def _extract(self, image: np.ndarray) -> Features:
        return extract(image.transpose(1, 2, 0), self._fov)


def check_verify(verify: str, searches: bool) -> None:
    """Whether a policy can be told to verify.

    Raises:
        UserError: an unknown word, or a policy that does not search.
    """
    if verify not in VERIFY:
        raise UserError(f'verify is one of {", ".join(VERIFY)}', verify, 'choose one')
    if verify != NONE and not searches:
        raise UserError('local features verify what a policy that searches sees',
                        f'verify {verify}, a policy of another architecture',
                        'leave it out (verify)')
