"""Which seeds are for training, which for choosing, which for judging. Frozen.

| split | seeds | look |
|---|---|---|
| train | 0 to 9,999 | standard |
| validation | 10,000 to 10,999 | standard |
| test | 11,000 to 11,999 | standard |
| unseen look | 12,000 to 12,999 | colours, materials and furniture forms of no other split |
"""

from __future__ import annotations

from vn_nav.errors import UserError
from vn_sim_bridge.houses.looks import STANDARD, UNSEEN, Look

SPLITS = {
    'train': range(0, 10_000),
    'validation': range(10_000, 11_000),
    'test': range(11_000, 12_000),
    'unseen_look': range(12_000, 13_000),
}


def split_of(seed: int) -> str:
    """Name of the split that a house seed belongs to.

    Raises:
        UserError: a seed of no split.
    """
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    last = max(seeds.stop for seeds in SPLITS.values()) - 1
    raise UserError(f'the seed of a house is a whole number from 0 to {last}', seed,
                    'choose another; ' + ', '.join(
                        f'{name}: {seeds.start} to {seeds.stop - 1}'
                        for name, seeds in SPLITS.items()))


def look_of(seed: int) -> Look:
    """What a house of this seed draws its appearance from."""
    return UNSEEN if split_of(seed) == 'unseen_look' else STANDARD
