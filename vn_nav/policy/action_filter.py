"""The action filter: a memory of blocked actions, between the policy's logits and its action.

A contact ends a move, and a picture as before follows. A network sees it, and has hardly ever been
trained on the consequence: it tries again, or turns away and at once back. Where nothing decides
between two ways it turns to and fro. The filter remembers actions without progress and offsets
the logits.
It reads the pictures and the policy's own last actions, nothing else, so that it works the same on
a robot, in every simulator, in training and with an exported network.

The rule, the state and when it is forgotten: docs/method.md, "The action filter". The field
`action_filter` of the network in a checkpoint's `config.json` says whether it is on (`FILTERS`).
Everything here needs NumPy alone. Given tensors it computes the same on their device.

With ONNX Runtime:

    blocked = BlockedActionFilter(json.loads(metadata['moves']), 1)
    ...
    logits += blocked.offsets(image, last_action, start)  # before the action is chosen
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    import torch

# NumPy's or torch's, which have in common what is used here; no type says so.
Array: TypeAlias = Any

NONE, BLOCKED_ACTIONS = FILTERS = ('none', 'blocked_actions')
THUMBNAIL_SIDE = 8  # pixels of the small pictures that are compared, in which noise averages out
# Mean difference of two of them [grey levels] below which nothing has moved. With noise, on the
# spot: 0.3; after half a metre: 7 in one of twenty (bench/teach_and_drive.py's house).
UNCHANGED_GREY_LEVELS = 2.0
HEADINGS = 72  # that are distinguished, 5 deg each
BLOCKED_HEADINGS = 3  # a contact counts in headings up to so many from its own: 15 deg
BLOCKED_LOGITS = 20.0  # off the logit of an action that is blocked here: 2e-9 of its odds are left
FACING_LOGITS = 10.0  # off the logit of a turn whose end faces what is blocked
# Whoever has turned by so much without a move has seen what there is: from there on the logit of
# driving forward grows by 1 with each further angle of this size.
SEEN_RAD, RESTLESS_RAD = math.radians(240), math.radians(60)


class BlockedActionFilter:
    """Of N robots: the actions without progress at their places, and how far they turned.

    Args:
        moves: [A][3] dx, dy [m], dyaw [rad] of the actions.
        num_envs: robots, N.
        device: of tensors; left out, it takes and gives NumPy arrays.
    """

    _before: Array  # [N,192] float32 thumbnails
    _heading: Array  # [N] rad, since the last move
    _turned: Array  # [N] rad, either way added
    _blocked: Array  # [N,A,72] bool

    def __init__(self, moves: Sequence[Sequence[float]], num_envs: int,
                 device: torch.device | str | None = None):
        own = np.array(moves, np.float64)
        self._device = device
        self._turn = self._array(own[:, 2])
        self._leads = self._array(np.abs(own[:, :2]).sum(1) > 0)  # [A] elsewhere
        self._actions = self._array(np.arange(len(own)))
        self._forward = self._array(np.arange(len(own)) == own[:, 0].argmax())
        self._headings = self._array(np.arange(HEADINGS, dtype=np.float64))
        self.load_state_dict({
            'before': np.zeros((num_envs, 3 * THUMBNAIL_SIDE**2), np.float32),
            'heading': np.zeros(num_envs), 'turned': np.zeros(num_envs),
            'blocked': np.zeros((num_envs, len(own), HEADINGS), bool)})

    def offsets(self, pictures: Array, last_action: Array, starts: Array) -> Array:
        """What to add to the logits, [N,A] float32; call it once for each decision.

        Args:
            pictures: [N,3,S,S] uint8, after the last actions.
            last_action: [N] int64; -1: none, or none of these.
            starts: [N] bool, where an episode begins: nothing is remembered.
        """
        small = thumbnails(pictures)
        still = abs(small - self._before).mean(1) < UNCHANGED_GREY_LEVELS
        self._before = small
        done = (last_action[:, None] == self._actions) & ~starts[:, None]  # [N,A]
        known, moved = done.any(1), (done & self._leads).any(1)
        turn = (done * self._turn).sum(1)
        self._heading = known * (self._heading + turn)
        self._turned = (known & ~moved) * (self._turned + abs(turn))
        here = self._number(self._heading)[:, None]
        half = HEADINGS // 2
        near = abs((self._headings - here + half) % HEADINGS - half) <= BLOCKED_HEADINGS  # [N,72]
        touched = done & (moved & still)[:, None]
        kept = known & ~(moved & ~still)
        self._blocked = (self._blocked & kept[:, None, None]
                         | touched[:, :, None] & near[:, None])
        again = (self._blocked & (self._headings == here)[:, None]).any(2)
        ahead = (self._blocked & self._forward[:, None]).any(1)  # [N,72] driving forward is
        there = self._number(self._heading[:, None] + self._turn)[:, :, None]  # after each action
        facing = (ahead[:, None] & (self._headings == there)).any(2) & (self._turn != 0)
        restless = (self._turned - SEEN_RAD) / RESTLESS_RAD
        return (_real(restless * (restless > 0))[:, None] * _real(self._forward)
                - BLOCKED_LOGITS * _real(again) - FACING_LOGITS * _real(facing & ~self._leads))

    def state_dict(self) -> dict[str, Array]:
        """Everything that is remembered; arrays of the filter's kind."""
        return {'before': self._before, 'heading': self._heading, 'turned': self._turned,
                'blocked': self._blocked}

    def load_state_dict(self, state: dict[str, Array]) -> None:
        """Go on where `state_dict` was taken."""
        self._before, self._heading, self._turned, self._blocked = (
            self._array(state[name]) for name in ('before', 'heading', 'turned', 'blocked'))

    def _array(self, rows: Array) -> Array:
        if self._device is None:
            return np.asarray(rows)
        import torch
        return torch.as_tensor(rows, device=self._device)

    @staticmethod
    def _number(heading: Array) -> Array:
        """Numbers of headings, whole and from 0 to 71."""
        return (heading * (HEADINGS / (2 * math.pi))).round() % HEADINGS


def thumbnails(pictures: Array) -> Array:
    """Means [N,192] float32 over 8 x 8 windows of pictures [N,3,S,S]."""
    if not isinstance(pictures, np.ndarray):
        from torch.nn import functional as F
        return F.adaptive_avg_pool2d(pictures.float(), THUMBNAIL_SIDE).flatten(1)
    side, cells = pictures.shape[-1], np.arange(THUMBNAIL_SIDE)[:, None]
    first, last = cells * side // THUMBNAIL_SIDE, -(-(cells + 1) * side // THUMBNAIL_SIDE)
    pixels = np.arange(side)
    windows = ((first <= pixels) & (pixels < last)).astype(np.float32)  # [8,S]
    sums = windows @ pictures.astype(np.float32) @ windows.T  # whole numbers: exact
    sizes = windows.sum(1)
    return (sums / sizes[:, None] / sizes).reshape(len(pictures), -1)


def _real(values: Array) -> Array:
    """As float32."""
    return values.astype(np.float32) if isinstance(values, np.ndarray) else values.float()


def make_filter(name: str, moves: Sequence[Sequence[float]], num_envs: int,
                device: torch.device | str | None = None) -> BlockedActionFilter | None:
    """The filter that a checkpoint names, one of `FILTERS`; None: its logits count as they are."""
    return BlockedActionFilter(moves, num_envs, device) if name == BLOCKED_ACTIONS else None


@dataclasses.dataclass
class FilterCounts:
    """How often a filter acted."""

    decisions: int = 0
    acted: int = 0  # at which it offset a logit: blocked an action, or pushed one
    changed: int = 0  # at which another action came out than without it

    def add(self, acted: bool, changed: bool) -> None:
        """Count a decision."""
        self.decisions += 1
        self.acted += bool(acted)
        self.changed += bool(changed)
