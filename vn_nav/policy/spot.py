"""What a robot keeps in mind of the spot where it stands: what led nowhere, and how long it turns.

A contact ends a move, and a picture as before follows. A network sees it, and has hardly ever been
taught what follows from it: it tries again, or turns away and at once back. Where nothing decides
between two ways it turns to and fro. So policies that know their moves are told, on a robot as in
any simulator, by the pictures and their own actions alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

SIDE = 8  # of the small pictures that are compared, in which noise is averaged out
# Mean difference of two of them [grey levels] below which nothing has moved. With noise, on the
# spot: 0.3; after half a metre: 7 in one of twenty (bench/teach_and_drive.py's house).
UNCHANGED = 2.0
HEADINGS = 72  # that are told apart
AS_FAR = math.radians(15)  # rad: a contact stands for headings up to so far from its own
AGAIN, BACK = 20.0, 10.0  # off the logits: of the move once more; of turning back to face it
# Whoever has turned by so much on the spot has seen what there is: from there on the logit of
# driving forward grows by 1 with each further angle of this size.
SEEN, RESTLESS = math.radians(240), math.radians(60)  # rad


class SpotMemory:
    """Of N robots: moves that have led nowhere from where they stand, and their turns there.

    Until a robot has moved on. The heading is counted from its own turns.

    Args:
        moves: [A][3] dx, dy [m], dyaw [rad] of the actions.
        num_envs: robots, N.
    """

    def __init__(self, moves: Sequence[Sequence[float]], num_envs: int):
        own = torch.tensor(moves, dtype=torch.float64)
        self._turn = own[:, 2]
        self._moves = own[:, :2].abs().sum(1) > 0  # [A] those that lead elsewhere
        self._forward = int(own[:, 0].argmax())
        self._before = torch.zeros(num_envs, 3 * SIDE**2)
        self._heading = torch.zeros(num_envs, dtype=torch.float64)
        self._turned = torch.zeros(num_envs, dtype=torch.float64)  # rad, to either side
        self._blocked = torch.zeros(num_envs, len(moves), HEADINGS, dtype=torch.bool)
        gap = torch.arange(HEADINGS).minimum(HEADINGS - torch.arange(HEADINGS))
        self._near = gap * (2 * math.pi / HEADINGS) <= AS_FAR  # [HEADINGS] about heading 0

    def advise(self, pictures: Tensor, last_action: Tensor, starts: Tensor) -> Tensor:
        """What to add to the logits, [N,A] float32.

        Args:
            pictures: [N,3,S,S] uint8, after the last actions.
            last_action: [N] int64; -1: none, or none of these.
            starts: [N] bool, where an episode begins: nothing is remembered.
        """
        small = F.adaptive_avg_pool2d(pictures.float(), SIDE).flatten(1)
        still = (small - self._before).abs().mean(1) < UNCHANGED
        self._before = small
        known = (last_action >= 0) & ~starts
        action = last_action.clamp(min=0)
        moved = known & self._moves[action]
        self._blocked[~known | (moved & ~still)] = False
        turn = torch.where(known, self._turn[action], 0.0)
        self._heading = torch.where(known, self._heading + turn, 0.0)
        self._turned = torch.where(known & ~moved, self._turned + turn.abs(), 0.0)
        for n in (moved & still).nonzero().flatten().tolist():
            self._blocked[n, action[n]] |= self._near.roll(int(self._bin(self._heading[n])))
        said = torch.zeros(self._blocked.shape[:2])
        said[:, self._forward] = ((self._turned - SEEN) / RESTLESS).clamp(min=0).float()
        if not self._blocked.any():
            return said
        here = self._bin(self._heading)
        again = self._blocked[torch.arange(len(here)), :, here]
        there = self._bin(self._heading[:, None] + self._turn)  # [N,A]
        facing = self._blocked[:, self._forward].gather(1, there) & (self._turn != 0)
        return said - AGAIN * again - BACK * (facing & ~self._moves)

    @staticmethod
    def _bin(heading: Tensor) -> Tensor:
        return (heading * (HEADINGS / (2 * math.pi))).round().long() % HEADINGS
