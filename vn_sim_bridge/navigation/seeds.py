"""Seeds of `NavigationEnv`: random numbers are functions of an environment's seed and number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.reset_arguments import are_several, read_seed, read_seeds


class Seeds:
    """The seed and the number of each of N environments.

    Attributes:
        seeds: [N] int64.
        numbers: [N] int64: environments of one seed differ by them.
    """

    def __init__(self, seed: int, count: int):
        self.seeds, self.numbers = np.full(count, seed, np.int64), np.arange(count)

    def take(self, seed: int | Sequence[int | None], mask: np.ndarray) -> np.ndarray:
        """Give seeds to the environments of the mask [N]; the indices of those that got one.

        Args:
            seed: of all, or one for each (None: as it was): that environment then has number 0.
            mask: [N] bool.

        Raises:
            UserError: another number of seeds, or no seed.
        """
        count = len(self.seeds)
        if are_several(seed):
            given, own = read_seeds(seed, count), np.zeros(count, np.int64)
        else:
            given, own = [read_seed(seed)] * count, np.arange(count)
        taken = []
        for n in np.nonzero(mask)[0]:
            if (new := given[n]) is not None:
                self.seeds[n], self.numbers[n] = new, own[n]
                taken.append(n)
        return np.array(taken, np.int64)

    def get_state(self) -> dict[str, np.ndarray]:
        """To go on from. One seed for all, as a training has it, is kept as one number."""
        alike = (self.seeds == self.seeds[0]).all() and (
            self.numbers == np.arange(len(self.numbers))).all()
        if alike:
            return {'seed': np.array(self.seeds[0])}
        return {'seed': self.seeds.copy(), 'numbers': self.numbers.copy()}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Be as `get_state` was."""
        self.seeds[:] = state['seed']
        self.numbers[:] = state.get('numbers', np.arange(len(self.numbers)))


def read_reset_mask(options: Mapping, has_begun: np.ndarray) -> np.ndarray:
    """Which environments begin a new episode, [N] bool.

    Args:
        options: of `reset`; without `reset_mask` all begin.
        has_begun: [N] bool, which have had an episode.

    Raises:
        UserError: the mask is none.
    """
    count = len(has_begun)
    if 'reset_mask' not in options:
        return np.ones(count, bool)
    try:
        mask = np.asarray(options['reset_mask'])
    except ValueError:  # rows of several lengths
        mask = np.zeros(0, bool)
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise UserError(f'a reset_mask is {count} booleans, one of them true',
                        options['reset_mask'], 'pass such an array')
    if not has_begun[~mask].all():
        raise UserError('every environment has begun before some of them begin again',
                        'a reset_mask at the first reset', 'reset once without a mask')
    return mask.copy()
