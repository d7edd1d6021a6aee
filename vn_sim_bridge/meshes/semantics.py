"""Habitat's semantic files: which colour is which object, and what has which colour."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh import read_parts
from vn_sim_bridge.houses.surface import Part, linear_from_srgb
from vn_sim_bridge.notices import say_once

HEADER = 'HM3D Semantic Annotations'
SPACING = 0.05  # m between samples of a semantic mesh
VOXELS = (0.01, 0.05, 0.2)  # m: a triangle takes the class of what is so near
LONGEST = 0.5  # m: larger triangles are split before they get a class
MOST_SPLITS = 12  # times in halves


class Thing(NamedTuple):
    """An annotated object."""

    number: int
    category: str
    region: int


def read_annotations(path: Path) -> dict[int, Thing]:
    """The objects of a .semantic.txt file, by colour (0xRRGGBB).

    Its lines are: number, colour in hexadecimal, "category", region.

    Raises:
        UserError: another file.
    """
    remedy = 'take the file of the data set as it was downloaded'
    try:
        lines = path.read_text('utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError('a semantic file can be read', f'{path}: {error}', remedy) from error
    if not lines or lines[0].strip() != HEADER:
        raise UserError(f'a semantic file begins with "{HEADER}"',
                        f'{path}: {(lines or [""])[0][:40]!r}', remedy)
    found = {}
    for number, row in enumerate(csv.reader(lines[1:]), 2):
        if not row:
            continue
        try:
            index, colour, category, region = row[:4]
            found[int(colour, 16)] = Thing(int(index), category.strip(), int(region))
        except ValueError as error:
            raise UserError('a line of a semantic file is number, colour, "category", region',
                            f'{path}, line {number}: {",".join(row)[:60]}', remedy) from error
    return found


def colours_of(parts: list[Part]) -> np.ndarray:
    """The colour of each triangle of a semantic mesh, 0xRRGGBB [T]: its texel, or vertex colour.

    These are numbers and no light: what the reader takes for linear is taken back.
    """
    found = []
    for part in parts:
        if part.picture is None or part.uv is None:
            rgb = np.rint(linear_from_srgb(part.colour) * 255).astype(np.int64)
        else:
            height, width = part.picture.shape[:2]
            middle = part.uv.mean(axis=1)
            middle -= np.floor(middle)
            column = np.minimum((middle[:, 0] * width).astype(int), width - 1)
            row = np.minimum((middle[:, 1] * height).astype(int), height - 1)
            rgb = part.picture[row, column].astype(np.int64)
        found.append(rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2])
    return np.concatenate(found)


class SemanticMesh:
    """Where which annotated object is.

    Args:
        path: of the .semantic.glb file; things: see `read_annotations`.
        matrix: [4,4] from its axes to the map frame.

    Raises:
        UserError: a file that cannot be read, or none of whose colours is annotated.
    """

    def __init__(self, path: Path, things: dict[int, Thing], matrix: np.ndarray):
        parts = read_parts(path)
        self.colours = colours_of(parts)
        known = np.isin(self.colours, list(things))
        if not known.any():
            raise UserError('colours of a semantic mesh stand in its semantic file',
                            f'{path}: {self.colours[0]:06X} and others do not',
                            'take both files from the same release of the data set')
        if not known.all():
            say_once(f'{path.name}: {1 - known.mean():.1%} of the triangles have colours that '
                     'are not annotated; they have no class')
        corners = np.concatenate([part.corners for part in parts])
        self.corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
        points, owners = _samples(self.corners)
        self._tables = []
        for side in VOXELS:
            keys, first = np.unique(_keys(points, side), return_index=True)
            self._tables.append((side, keys, self.colours[owners[first]]))

    def at(self, points: np.ndarray) -> np.ndarray:
        """Colours at points [K,3] of the map frame; -1 where nothing is near."""
        found = np.full(len(points), -1, np.int64)
        offsets = np.array([(a, b, c) for a in (0, -1, 1) for b in (0, -1, 1)
                            for c in (0, -1, 1)], float)
        for side, keys, colours in self._tables:
            for offset in offsets:
                left = np.nonzero(found < 0)[0]
                if not len(left):
                    return found
                wanted = _keys(points[left] + offset * side, side)
                place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
                hit = keys[place] == wanted
                found[left[hit]] = colours[place[hit]]
        return found


def _keys(points: np.ndarray, side: float) -> np.ndarray:
    """Numbers of the voxels of points [K,3]."""
    cells = np.floor(points / side).astype(np.int64) + (1 << 20)
    return cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]


def _samples(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [K,3] on triangles, `SPACING` apart or nearer, and whose they are [K]."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(longest / SPACING), 1, 400).astype(int)
    points, owners = [corners.mean(axis=1)], [np.arange(len(corners))]
    for count in np.unique(steps):
        own = np.nonzero(steps == count)[0]
        shares = np.array([(i + 1 / 3, j + 1 / 3) for i in range(count)
                           for j in range(count - i)]) / count
        a, b, c = (corners[own, k][:, None] for k in range(3))
        spread = a + shares[None, :, :1] * (b - a) + shares[None, :, 1:] * (c - a)
        points.append(spread.reshape(-1, 3))
        owners.append(np.repeat(own, len(shares)))
    return np.concatenate(points), np.concatenate(owners)


def split_large(corners: np.ndarray, uv: np.ndarray | None, colour: np.ndarray,
                longest: float = LONGEST):
    """Triangles none of whose sides is longer than so many metres, as far as few halvings go."""
    for _ in range(MOST_SPLITS):
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # [T,3]
        large = sides.max(axis=1) > longest
        if not large.any():
            break
        turn = sides[large].argmax(axis=1)
        order = (turn[:, None] + np.arange(3)) % 3
        corners = _halved(corners, large, order)
        uv = None if uv is None else _halved(uv, large, order)
        colour = np.concatenate([colour[~large], colour[large], colour[large]])
    return corners, uv, colour


def _halved(values: np.ndarray, large: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Corners or coordinates [T,3,n], those of large triangles cut at their longest side."""
    own = np.take_along_axis(values[large], order[..., None], axis=1)
    middle = 0.5 * (own[:, 0] + own[:, 1])
    return np.concatenate([values[~large], np.stack([own[:, 0], middle, own[:, 2]], 1),
                           np.stack([middle, own[:, 1], own[:, 2]], 1)])
