"""A goal as a file: the picture that somebody took of the place to go to."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_nav.errors import UserError


def read_goal_picture(path: Path) -> np.ndarray:
    """The picture [H,W,3] uint8 RGB of a JPEG or PNG file.

    Raises:
        UserError: there is no such file, or it holds something else.
    """
    try:
        return decode_rgb(SimpleNamespace(format=path.suffix, data=path.read_bytes()))
    except (OSError, ImageError) as error:
        raise UserError('a goal picture is a JPEG or PNG file', f'{path}: {error}',
                        'give another one, or convert it') from error
