"""`house.json`: levels, and the nodes in them."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_nav.errors import UserError

TYPES = ('Object', 'Room', 'Ground', 'Box')
REMEDY = 'take the file of the data set as it was'


class Material(NamedTuple):
    """What replaces a material of a model; None: as the model has it."""

    diffuse: tuple[float, float, float] | None  # display values, 0 to 1
    texture: str | None  # name of a file in texture/, without its ending


@dataclasses.dataclass(frozen=True)
class Node:
    """A thing of a level, in SUNCG's axes."""

    id: str  # 'L_i'
    type: str  # of TYPES
    model: str  # '': none
    low: np.ndarray  # [3] m, of its bounding box
    high: np.ndarray
    transform: np.ndarray  # [4,4] from the model to the house
    mirrored: bool
    state: int  # 1: a door or drawer that is open
    materials: tuple[Material, ...]
    room_types: tuple[str, ...]
    hidden: frozenset[str]  # of 'f', 'c', 'w': floor, ceiling and walls that are not drawn
    dimensions: np.ndarray | None  # [3] m, of a Box


@dataclasses.dataclass(frozen=True)
class Level:
    """A storey."""

    number: int
    low: np.ndarray  # [3] m
    high: np.ndarray
    nodes: tuple[Node, ...]


@dataclasses.dataclass(frozen=True)
class HouseFile:
    """A `house.json`."""

    path: Path
    id: str
    scale: float  # m per unit
    levels: tuple[Level, ...]

    def level(self, number: int) -> Level:
        """A storey by its place in the file, 0 the lowest.

        Raises:
            UserError: there is none.
        """
        if not 0 <= number < len(self.levels):
            raise UserError(f'{self.path} has the levels 0 to {len(self.levels) - 1}', number,
                            'choose one of them (option level)')
        return self.levels[number]


def read_house(path: Path) -> HouseFile:
    """The levels and nodes of a house; nodes that the file calls invalid are left out.

    Raises:
        UserError: no such file, or one that does not follow the format.
    """
    if not path.is_file():
        raise UserError('a SUNCG house has a house.json', str(path),
                        'correct its id, or the folder (SUNCG_PATH)')
    try:
        data = json.loads(path.read_text('utf-8'))
        if list(map(float, data.get('up', [0, 1, 0]))) != [0, 1, 0]:
            raise ValueError(f'its up axis is {data["up"]}, not [0, 1, 0]')
        scale = float(data.get('scaleToMeters', 1))
        if not (math.isfinite(scale) and scale > 0):
            raise ValueError(f'scaleToMeters is {scale}')
        levels = tuple(_level(number, level) for number, level in enumerate(data['levels']))
        if not levels:
            raise ValueError('it has no levels')
        return HouseFile(path, str(data['id']), scale, levels)
    except KeyError as error:
        raise UserError('a house.json follows its format', f'{path}: {error} is missing',
                        REMEDY) from error
    except (OSError, ValueError, TypeError, AttributeError, IndexError) as error:
        raise UserError('a house.json follows its format', f'{path}: {error}', REMEDY) from error


def _level(number: int, data: dict[str, Any]) -> Level:
    # Some houses have levels without anything in them.
    nodes = tuple(_node(node) for node in data.get('nodes', ()) if node.get('valid', 1))
    if 'bbox' in data and data['bbox'].get('min'):
        low, high = _box(data['bbox'])
    elif not nodes:
        low = high = np.zeros(3)
    else:
        low, high = (np.array([getattr(node, end) for node in nodes]) for end in ('low', 'high'))
        low, high = low.min(axis=0), high.max(axis=0)
    return Level(number, low, high, nodes)


def _box(data: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    low, high = (_numbers(data[end], 3) for end in ('min', 'max'))
    if (low > high).any():
        raise ValueError(f'a bounding box from {low.tolist()} to {high.tolist()}')
    return low, high


def _numbers(values, count: int) -> np.ndarray:
    found = np.array(values, float)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError(f'{count} numbers, where it has {values}')
    return found


def _node(data: dict[str, Any]) -> Node:
    kind = data['type']
    if kind not in TYPES:
        raise ValueError(f'a node is one of {", ".join(TYPES)}, not {kind!r}')
    model = str(data.get('modelId', ''))
    if not model and kind != 'Box':
        raise ValueError(f'the node {data["id"]} has no modelId')
    transform = np.eye(4)
    if 'transform' in data:
        transform = _numbers(data['transform'], 16).reshape(4, 4).T  # stored column by column
    dimensions = _numbers(data['dimensions'], 3) if kind == 'Box' else None
    if 'bbox' in data and data['bbox'].get('min'):
        low, high = _box(data['bbox'])
    elif kind == 'Box':
        reach = np.abs(transform[:3, :3]) @ dimensions / 2
        low, high = transform[:3, 3] - reach, transform[:3, 3] + reach
    else:
        raise ValueError(f'the node {data["id"]} has no bounding box')
    hidden = frozenset(letter for letter, name in (
        ('f', 'hideFloor'), ('c', 'hideCeiling'), ('w', 'hideWalls')) if data.get(name))
    return Node(str(data['id']), kind, model, low, high, transform,
                bool(data.get('isMirrored', 0)), int(data.get('state', 0)),
                tuple(_material(item or {}) for item in data.get('materials', ())),
                tuple(map(str, data.get('roomTypes', ()))), hidden, dimensions)


def _material(data: dict[str, Any]) -> Material:
    diffuse = data.get('diffuse')
    if diffuse is not None:
        text = str(diffuse)
        if len(text) != 7 or text[0] != '#':
            raise ValueError(f'a colour is #rrggbb, not {text!r}')
        diffuse = tuple(int(text[k:k + 2], 16) / 255 for k in (1, 3, 5))
    return Material(diffuse, data.get('texture') or None)
