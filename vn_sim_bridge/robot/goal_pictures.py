"""Goal pictures from outside, a bag for instance, with the poses that arrival is judged by.

A folder of JPEG or PNG files, and `goals.json`: a list of `{"picture": NAME, "pose": [x, y, yaw]}`
in metres and radians of the map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_nav.goal_picture import read_goal_picture

INDEX = 'goals.json'


class GoalPicture(NamedTuple):
    """A picture, and where it was taken."""

    picture: np.ndarray  # [H,W,3] uint8 RGB
    pose: tuple[float, float, float]  # x, y [m], yaw [rad] in the map


def save_goal_pictures(folder: str | Path, goals: Iterable[GoalPicture]) -> None:
    """Write a folder as `load_goal_pictures` reads it; made if need be."""
    folder, index = Path(folder), []
    folder.mkdir(parents=True, exist_ok=True)
    for number, (picture, pose) in enumerate(goals):
        name = f'{number:03d}.png'
        data = cv2.imencode('.png', cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        (folder / name).write_bytes(data.tobytes())
        index.append({'picture': name, 'pose': [float(value) for value in pose]})
    (folder / INDEX).write_text(json.dumps(index, indent=1) + '\n')


def load_goal_pictures(folder: str | Path) -> list[GoalPicture]:
    """Read a folder of goal pictures.

    Raises:
        UserError: no such folder, an index that is none, or a picture that cannot be read.
    """
    path = Path(folder) / INDEX
    remedy = 'write [{"picture": "000.png", "pose": [x, y, yaw]}, ...]'
    try:
        entries = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f'a folder of goal pictures holds {INDEX}', f'{folder}: {error}',
                        remedy) from error
    if not (isinstance(entries, list) and entries and all(map(_is_entry, entries))):
        raise UserError(f'{INDEX} lists pictures and their poses', str(path), remedy)
    return [GoalPicture(read_goal_picture(path.parent / entry['picture']).picture,
                        (float(x), float(y), float(yaw)))
            for entry in entries for x, y, yaw in [entry['pose']]]


def _is_entry(entry) -> bool:
    return (isinstance(entry, dict) and isinstance(entry.get('picture'), str)
            and isinstance(entry.get('pose'), list) and len(entry['pose']) == 3
            and all(isinstance(value, (int, float)) and math.isfinite(value)
                    for value in entry['pose']))
