"""Which stretches of a drive show one place, and where a drive changes its place unnoticed.

Pictures decide: stretches belong together if enough loop closures lead from one to the other. And
where odometry says again and again that the robot stands where it stood before, but no picture
ever looks as it did then, the robot was carried, or another drive begins.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

# A pair of pictures that must look alike: by all that is known no farther apart than these.
COMMON_VIEW_M_RAD = (0.6, math.radians(20))  # m, rad
MIN_FEATURES = 40  # features: with fewer a picture may be of a wall
# So many such pairs, none recognised, are no chance: of a sound drive 80 to 95 % are recognised,
# and where it is cut in two anywhere at most 4 lead across without any that is.
MIN_UNMATCHED_PAIRS = 12


def together(count: int, pairs: Iterable[Sequence[int]], least: int) -> np.ndarray:
    """Number of the place of each of some stretches, [count] int64, 0 and up.

    Args:
        count: stretches.
        pairs: the two stretches of each closure.
        least: closures that join two stretches.
    """
    links = np.zeros((count, count), np.int64)
    for one, other in pairs:
        links[one, other] += 1
    linked = links + links.T >= least
    place = np.arange(count)
    for one, other in zip(*np.nonzero(linked), strict=True):
        low, high = sorted((place[one], place[other]))
        place[place == high] = low
    return np.unique(place, return_inverse=True)[1]


def unnoticed(first: np.ndarray, second: np.ndarray, recognised: np.ndarray) -> int | None:
    """The keyframe at which another place begins, though odometry goes on; None: there is none.

    Args:
        first, second: [K] keyframes of pairs that must look alike, the second is the later one.
        recognised: [K] bool, whether they do.
    """
    if not len(first):
        return None
    cuts = np.arange(1, int(second.max()) + 1)

    def across(chosen: np.ndarray) -> np.ndarray:
        """How many of the chosen pairs lead across each cut."""
        begin = np.bincount(first[chosen] + 1, minlength=cuts[-1] + 2)
        end = np.bincount(second[chosen] + 1, minlength=cuts[-1] + 2)
        return np.cumsum(begin - end)[cuts]
    wrong = np.where(across(recognised) == 0, across(~recognised), 0)
    best = int(np.argmax(wrong))
    return int(cuts[best]) if wrong[best] >= MIN_UNMATCHED_PAIRS else None
