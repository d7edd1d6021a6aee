"""Seeds and options of an environment's `reset`, checked before anything moves."""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vn_nav.errors import UserError

MAX_SEED = (1 << 63) - 1


def read_seed(seed: Any) -> int | None:
    """A seed as Python's integer; None stays None.

    Raises:
        UserError: it is no whole number from 0 to `MAX_SEED`; True and False are none.
    """
    if seed is not None and not _is_seed(seed):
        raise UserError('a seed is a whole number that is not negative', seed, 'pass such a seed')
    return None if seed is None else int(seed)


def are_several(seed: object) -> bool:
    """Whether a seed is a sequence or an array, of seeds or of anything else."""
    return np.ndim(np.asarray(seed, object)) > 0


def read_seeds(seed: Any, count: int) -> list[int | None]:
    """The seeds of environments, one each, out of a sequence or an array.

    Raises:
        UserError: another number of seeds, or such as `read_seed` refuses.
    """
    given = list(seed) if are_several(seed) else []
    if len(given) != count or not all(one is None or _is_seed(one) for one in given):
        raise UserError(f'a seed is a whole number that is not negative, or {count} of them',
                        seed, 'pass such seeds')
    return [None if one is None else int(one) for one in given]


def read_options(options: object, known: Sequence[str] = ()) -> Mapping:
    """The options of a reset by name; None: there are none.

    Raises:
        UserError: no mapping, or an option that this environment does not know.
    """
    rule = f'the options of a reset are a mapping of {", ".join(known)}' if known else (
        'this environment has no options of a reset')
    if options is not None and not (isinstance(options, Mapping) and all(
            name in known for name in options)):
        raise UserError(rule, options, f'pass options={{"{known[0]}": ...}}, or none' if known else
                        'leave them out')
    return options or {}


def _is_seed(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool) and (
        0 <= int(value) <= MAX_SEED)
