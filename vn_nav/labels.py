"""Class ids of labels: how many there can be, and what holds them."""

from __future__ import annotations

import numpy as np

from vn_nav.errors import UserError

# Colours of segmentation targets where nobody names more classes; label ids are below.
CLASSES = 64
MAX_CLASSES = 1 << 16


def label_dtype(classes: int) -> np.dtype:
    """Of the ids of so many classes: bytes, as long as these can count them.

    Raises:
        UserError: more classes than 16 bits can count.
    """
    if classes > MAX_CLASSES:
        raise UserError(f'labels are of at most {MAX_CLASSES} classes', classes,
                        'join some of them')
    return np.dtype(np.uint8 if classes <= 1 << 8 else np.uint16)
