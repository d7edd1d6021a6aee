"""The floor of a triangle mesh: its storeys, what stands in the way, where a robot can be.

A mesh is its triangles in the map frame (z up, metres). `floor_levels` finds the storeys,
`choose_level` one of them; the mesh is then moved so that this floor is z = 0, and `mesh_floor`
makes of it what contacts, distances, scans and maps use: rectangles, and a map of free cells.
Stairs need no rule of their own: their first step up is an obstacle, and down there is no floor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.floor import mesh_raster
from vn_sim_bridge.floor.floor_map import CELL, FREE_MARGIN, FloorMap, Rect

OBSTACLE_CELL = 0.02  # m, side of the cells in which obstacles are looked for
STEP = 0.15  # m: lower than that, a robot drives over it; and how uneven a floor may be
HEIGHT = 1.2  # m: what is higher above the floor is in nobody's way
HEADROOM = 1.2  # m: a floor under something at least so high is indoors
BIN = 0.02  # m, of the histogram of heights
SPREAD = 0.1  # m either way: one floor
STOREY = 1.8  # m: floors that are less far apart are one storey with its furniture
LEAST_FLOOR = 3.0  # m^2
LEAST_SHARE = 0.25  # of the largest storey: a smaller one is a landing, or a cupboard
HOLE = 0.5  # m: narrower gaps in a floor (thresholds, holes of a scan) are none
MARGIN = 0.5  # m around the floor
MOST_CELLS = 60_000_000  # of `OBSTACLE_CELL`: 24,000 m^2
TALL = 1.7  # m: what has no class and reaches this high hides what is behind it, as a wall does
WALL, OUTSIDE = 'wall', 'outside'


class Level(NamedTuple):
    """A storey: its height [m] and the floor's area [m^2], indoors where there is a ceiling."""

    z: float
    area: float


@dataclasses.dataclass(frozen=True)
class MeshFloor:
    """What a `WalledPlace` needs of a mesh whose floor is z = 0."""

    outline: Rect
    floor: FloorMap
    obstacles: tuple[tuple[Rect, str], ...]  # 'outside': there is no floor
    obstacle_rects: np.ndarray  # [M,4] float64

    @property
    def area(self) -> float:
        """Of the free cells [m^2]."""
        return float(self.floor.free.sum()) * CELL * CELL


def facing_up(corners: np.ndarray, least: float = 0.8) -> np.ndarray:
    """Which triangles [T,3,3] look up, with a normal whose z is `least` or more, [T] bool."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal[:, 2] > least * np.linalg.norm(normal, axis=1)


def floor_levels(corners: np.ndarray) -> list[Level]:
    """The storeys of a mesh, from the lowest up.

    By a histogram of the heights of surfaces that face up and have room for a robot above them.
    What has no ceiling, a roof or the ground around a house, counts only where nothing has one.

    Args:
        corners: [T,3,3] m, counter-clockwise seen from the front.
    """
    corners = np.ascontiguousarray(corners, float)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    columns, rows = np.maximum(np.ceil((high - low)[:2] / CELL).astype(int), 1)
    _check_size(low, high)
    bins = int((high[2] - low[2]) / BIN) + 1
    bare, covered = np.zeros(bins, np.int64), np.zeros(bins, np.int64)
    mesh_raster.level_histogram(corners, facing_up(corners), low[0], low[1], CELL, rows,
                                columns, HEADROOM, low[2], BIN, bare, covered)
    counts = covered if covered.sum() * CELL * CELL >= LEAST_FLOOR else bare
    reach = int(SPREAD / BIN)
    around = np.convolve(counts, np.ones(2 * reach + 1), 'same')[:len(counts)]
    heights = low[2] + (np.arange(bins) + 0.5) * BIN
    left = around.astype(float)
    found: list[Level] = []
    while left.size and left.max() * CELL * CELL >= LEAST_FLOOR and (
            not found or left.max() * CELL * CELL >= LEAST_SHARE * found[0].area):
        peak = int(np.argmax(left))
        window = slice(max(peak - reach, 0), peak + reach + 1)
        # Most of a floor is at one height; rugs and thresholds are a little above.
        exact = int(np.argmax(counts[window])) + window.start
        found.append(Level(_exact(corners, heights[exact]), float(around[peak]) * CELL * CELL))
        left[np.abs(heights - heights[peak]) < STOREY] = 0
    return sorted(found)


def _exact(corners: np.ndarray, z: float) -> float:
    """The height of the floor in a bin: that of the surfaces in it, by area."""
    up = facing_up(corners)
    middle = corners[:, :, 2].mean(axis=1)
    near = up & (np.abs(middle - z) <= 0.75 * BIN)
    if not near.any():
        return float(z)
    span = corners[near]
    area = np.linalg.norm(np.cross(span[:, 1] - span[:, 0], span[:, 2] - span[:, 0]), axis=1)
    return float((middle[near] * area).sum() / area.sum())


def _check_size(low: np.ndarray, high: np.ndarray) -> None:
    width, depth = high[:2] - low[:2]
    if width * depth > MOST_CELLS * OBSTACLE_CELL**2:
        raise UserError(f'a scene covers at most {MOST_CELLS * OBSTACLE_CELL**2:.0f} square '
                        'metres', f'{width:.0f} x {depth:.0f} m',
                        'check its units (option scale), or cut it')


def choose_level(levels: Sequence[Level], storey: int | None = None, name: str = 'the scene'
                 ) -> Level:
    """One storey: by its number from the lowest, 0; else the one with the most floor.

    Raises:
        UserError: there is none, or not that one.
    """
    if not levels:
        raise UserError(f'a scene has a floor of {LEAST_FLOOR:g} square metres or more', name,
                        'check its up axis and scale (options up, scale)')
    if storey is None:
        return max(levels, key=lambda level: level.area)
    if not 0 <= storey < len(levels):
        listed = ', '.join(f'{k}: {level.z:.2f} m ({level.area:.0f} m2)'
                           for k, level in enumerate(levels))
        raise UserError(f'a storey is a number from 0 to {len(levels) - 1}', storey,
                        f'choose one of {listed}')
    return levels[storey]


def mesh_floor(corners: np.ndarray, kinds: np.ndarray, names: Sequence[str], radius: float, *,
               height: float = HEIGHT, step: float = STEP, passable: Collection[str] = (),
               unknown: Collection[str] = ('object',), name: str = 'the scene') -> MeshFloor:
    """What a robot can do on the floor z = 0 of a mesh.

    An obstacle is whatever lies between `step` and `height` above the floor. The floor is free
    where a robot has something to stand on (within `step`), touches nothing, and can get to: of
    parts that are not connected the one with the most floor under a ceiling (else the largest).

    Args:
        corners: [T,3,3] m, counter-clockwise seen from the front.
        kinds: [T] index into `names`, the class of each triangle.
        names: of classes.
        radius: of the robot's footprint [m].
        height, step: m.
        passable: classes that are in nobody's way (doors that count as open).
        unknown: classes that say nothing: where they reach up high they are walls.
        name: for errors.

    Raises:
        UserError: no free floor, or a scene that is too large.
    """
    corners = np.ascontiguousarray(corners, float)
    up = facing_up(corners, 0.7)
    flat = up & (np.abs(corners[:, :, 2]).min(axis=1) <= step)
    if not flat.any():
        raise UserError('a scene has a floor', name, 'check its up axis and storey')
    outline = _outline(corners[flat])
    kinds = np.asarray(kinds, np.int32)
    closed = np.isin(kinds, [k for k, label in enumerate(names) if label in passable],
                     invert=True)
    rects, labels = _standing(corners[closed], kinds[closed], names, step, height, outline,
                              unknown)
    origin, shape = (outline.x0, outline.y0), (round((outline.y1 - outline.y0) / CELL),
                                               round((outline.x1 - outline.x0) / CELL))
    ground = np.zeros(shape, bool)
    mesh_raster.supported(corners, up, *origin, CELL, -step, step, ground)
    ground, beyond = _without_holes(ground)
    outside = _outside(beyond, outline)
    found = zip(rects.tolist(), labels, strict=True)
    obstacles = (*((Rect(*rect), label) for rect, label in found),
                 *((rect, OUTSIDE) for rect in outside))
    rects = np.array([rect for rect, _ in obstacles], float).reshape(-1, 4)
    touching = np.zeros(shape, bool)
    mesh_raster.near_rectangles(*origin, CELL, rects, radius + FREE_MARGIN, touching)
    top = np.empty(shape)
    mesh_raster.highest(corners, *origin, CELL, top)
    free = _best_part(ground & ~touching, top > HEADROOM)
    if not free.any():
        raise UserError(f'a robot of radius {radius:g} m has floor to stand on', name,
                        'check its scale and storey, or use a smaller robot')
    return MeshFloor(outline, FloorMap(origin, free), obstacles, rects)


def _outline(flat: np.ndarray) -> Rect:
    """Of a floor's triangles, with a margin, on whole cells."""
    low = np.floor((flat.min(axis=(0, 1))[:2] - MARGIN) / CELL) * CELL
    high = np.ceil((flat.max(axis=(0, 1))[:2] + MARGIN) / CELL) * CELL
    _check_size(low, high)
    return Rect(*map(float, (*low, *high)))


def _standing(corners: np.ndarray, kinds: np.ndarray, names: Sequence[str], low: float,
              high: float, outline: Rect, unknown: Collection[str]
              ) -> tuple[np.ndarray, list[str]]:
    """Rectangles [R,4] of what stands between two heights, and the class of each."""
    shape = (round((outline.y1 - outline.y0) / OBSTACLE_CELL),
             round((outline.x1 - outline.x0) / OBSTACLE_CELL))
    cells, bounds = np.full(shape, -1, np.int32), np.empty((*shape, 4))
    where = outline.x0, outline.y0, OBSTACLE_CELL
    mesh_raster.standing(corners, kinds, low, high, *where, cells, bounds)
    names = [*names, WALL]
    vague = np.isin(kinds, [k for k, label in enumerate(names) if label in unknown])
    if vague.any():
        tall, spare = np.full(shape, -1, np.int32), np.empty((*shape, 4))
        mesh_raster.standing(corners[vague], kinds[vague], TALL, TALL + 0.2, *where, tall, spare)
        here = np.isin(cells, np.unique(kinds[vague])) & (tall >= 0)
        cells[here] = len(names) - 1
    found = mesh_raster.rectangles(cells)
    return mesh_raster.extents(found, bounds), [names[k] for k in found[:, 4]]


def _without_holes(ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Floor without narrow gaps, and the cells that are beyond it."""
    side = round(HOLE / CELL)
    kernel = np.ones((side, side), np.uint8)
    padded = np.pad(ground.astype(np.uint8), side)
    whole = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)
    # A cell beside the floor is beyond it only if its neighbours are: floors end inside walls.
    near = cv2.dilate(whole, np.ones((3, 3), np.uint8))
    inner = slice(side, -side), slice(side, -side)
    return whole[inner] > 0, near[inner] == 0


def _outside(beyond: np.ndarray, outline: Rect) -> list[Rect]:
    """Rectangles over cells without a floor, and around the whole map."""
    x, y, far = outline.x0, outline.y0, 10.0
    return [*rectangles_of_cells(beyond, (x, y)), Rect(x - far, y - far, outline.x1 + far, y),
            Rect(x - far, outline.y1, outline.x1 + far, outline.y1 + far),
            Rect(x - far, y, x, outline.y1), Rect(outline.x1, y, outline.x1 + far, outline.y1)]


def _best_part(free: np.ndarray, roofed: np.ndarray) -> np.ndarray:
    """The connected part with the most cells under a ceiling, else the largest."""
    count, parts = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    if count <= 1:
        return np.zeros_like(free)
    covered = np.bincount(parts[free & roofed], minlength=count)[1:]
    if covered.sum() * CELL * CELL < LEAST_FLOOR:
        covered = np.bincount(parts[free], minlength=count)[1:]
    return parts == 1 + int(np.argmax(covered))


def rectangles_of_polygons(polygons: Sequence[np.ndarray]) -> list[Rect]:
    """Rectangles that cover polygons [n,2] m (of one room) to half a cell."""
    points = np.concatenate(polygons)
    low = np.floor(points.min(axis=0) / CELL) * CELL
    shape = np.ceil((points.max(axis=0) - low) / CELL).astype(int)[::-1] + 1
    mask = np.zeros(shape, np.uint8)
    scale = 1 << 8  # of OpenCV's fixed point; a centre of a cell is a whole number there
    for polygon in polygons:
        own = np.rint(((polygon - low) / CELL - 0.5) * scale).astype(np.int32)
        cv2.fillPoly(mask, [own[:, None]], 1, shift=8)
    return rectangles_of_cells(mask > 0, low)


def rectangles_of_triangles(corners: np.ndarray) -> list[Rect]:
    """Rectangles that cover the plan of triangles [T,3,>=2] m to half a cell."""
    return rectangles_of_polygons(list(np.asarray(corners, float)[:, :, :2]))


def rectangles_of_cells(mask: np.ndarray, origin) -> list[Rect]:
    """Rectangles over the cells [rows,columns] that are true."""
    found = mesh_raster.rectangles(np.where(mask, 0, -1).astype(np.int32))
    x, y = float(origin[0]), float(origin[1])
    return [Rect(x + float(j0) * CELL, y + float(i0) * CELL, x + float(j1 + 1) * CELL,
                 y + float(i1 + 1) * CELL) for i0, j0, i1, j1, _ in found]
