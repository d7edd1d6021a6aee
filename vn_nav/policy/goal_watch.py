"""Distinguishes a new goal from a repeated one."""

from __future__ import annotations

import collections

REPETITION_S = 5.0  # the same picture within this time of the one before is said again
MAX_REPETITIONS = 2  # and from the second repetition on it is taken as one goal
RATE_WINDOW_S = 20.0  # of which a rate is counted


class GoalWatch:
    """Keeps the identity of the goal: its stamp and its picture. No ROS.

    A new stamp begins a new episode, as the contract says. Somebody who publishes one picture at a
    rate, each time with a new stamp, does not mean that: from the third message on it is one goal.

    Args:
        trust_stamps: every new stamp is a new episode, whatever the picture (lock-step: only the
            simulator speaks, and its episodes may last a moment).
    """

    def __init__(self, *, trust_stamps: bool = False):
        self._trust_stamps = trust_stamps
        self._identity: tuple | None = None
        self._repeats = 0
        self._heard: collections.deque = collections.deque(maxlen=20)  # (steady time, is new)

    def is_new(self, stamp: object, picture: object, now: float) -> bool:
        """Whether a goal begins a new episode.

        Args:
            stamp, picture: what they are compared by: equal is the same.
            now: steady time [s].
        """
        if (stamp, picture) == self._identity:
            return False  # received twice, or latched and received again
        soon = bool(self._heard) and now - self._heard[-1][0] <= REPETITION_S
        same = self._identity is not None and self._identity[1] == picture
        self._repeats = self._repeats + 1 if same and soon else 0
        self._identity = (stamp, picture)
        new = self._trust_stamps or self._repeats < MAX_REPETITIONS
        self._heard.append((now, new))
        return new

    def warning(self, now: float) -> str:
        """What is wrong with how goals are published; empty: nothing."""
        recent = [(at, new) for at, new in self._heard if now - at <= RATE_WINDOW_S]
        if self._trust_stamps or len(recent) < 4 or now - recent[-1][0] > REPETITION_S:
            return ''
        rate = (len(recent) - 1) / max(recent[-1][0] - recent[0][0], 1e-3)
        if not recent[-1][1]:
            return (f'goal_image is published {rate:.1f} times a second, each time with a new '
                    'stamp: one picture is one goal; publish it once')
        if rate > 0.2 and sum(new for _, new in recent) >= 4:
            return (f'goal_image changes {rate:.1f} times a second, and each picture is a new '
                    'goal: the robot waits; publish a goal once')
        return ''
