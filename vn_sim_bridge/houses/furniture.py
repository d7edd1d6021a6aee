"""Furniture: each piece is a few convex polygons in its own frame, placed against a wall.

A piece's frame: x runs along the wall, y points out of the wall into the room, z up; the origin
lies on the floor, at the wall, in the middle of the piece.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from vn_sim_bridge.houses.textures import PAINTINGS, TEXTURES
from vn_sim_bridge.scene import SceneBuilder

LABELS = (
    'nothing', 'wall', 'floor', 'ceiling', 'door', 'window', 'picture', 'rug', 'bed', 'nightstand',
    'wardrobe', 'desk', 'chair', 'table', 'sofa', 'armchair', 'tv', 'tv_stand', 'bookshelf',
    'counter', 'fridge', 'stove', 'sink', 'toilet', 'bathtub', 'washbasin', 'plant', 'lamp',
    'cabinet', 'stool', 'mirror', 'bin', 'coffee_table', 'washing_machine', 'box',
)
LABEL = {name: index for index, name in enumerate(LABELS)}

WOODS = ((0.72, 0.50, 0.30), (0.50, 0.33, 0.20), (0.85, 0.70, 0.48), (0.36, 0.24, 0.17))
FABRICS = ((0.70, 0.25, 0.22), (0.25, 0.38, 0.62), (0.35, 0.50, 0.34), (0.78, 0.66, 0.42),
           (0.45, 0.32, 0.52), (0.30, 0.56, 0.58), (0.82, 0.48, 0.25), (0.40, 0.42, 0.46))
WHITES = ((0.95, 0.95, 0.93), (0.88, 0.90, 0.92), (0.96, 0.92, 0.84))
METALS = ((0.72, 0.74, 0.77), (0.30, 0.31, 0.33))


class Piece:
    """Draws the parts of one piece of furniture into a scene.

    Args:
        builder: the scene under construction.
        origin: (x, y) of the piece's origin [m]; quarter: its rotation in quarter turns.
        instance: instance id of every part.
        rng: colours and proportions.
    """

    def __init__(self, builder: SceneBuilder, origin, quarter: int, instance: int,
                 rng: np.random.Generator):
        self.builder, self.origin, self.instance, self.rng = builder, origin, instance, rng
        self._cos, self._sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4]

    def choose(self, palette):
        """A colour of the palette with a little variation, so that no two pieces are equal."""
        colour = np.array(palette[int(self.rng.integers(len(palette)))])
        return np.clip(colour * self.rng.uniform(0.85, 1.12), 0.03, 1.0)

    def polygon(self, points, label: str, texture: str, colour, **options):
        """One polygon in the piece's frame."""
        points = np.asarray(points, float)
        world = points.copy()
        world[:, 0] = self.origin[0] + self._cos * points[:, 0] - self._sin * points[:, 1]
        world[:, 1] = self.origin[1] + self._sin * points[:, 0] + self._cos * points[:, 1]
        self.builder.polygon(world, texture=TEXTURES[texture], colour=colour, label=LABEL[label],
                             instance=self.instance, **options)

    def box(self, x0, x1, y0, y1, z0, z1, label, texture, colour, *, front=None, back=False,
            bottom=False, tile=1.0):
        """An axis-aligned box; the side at the wall and the bottom are left out by default.

        Args:
            front: (texture, colour) of the side that faces the room, fitted to it.
        """
        corners = {
            'front': [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
            'right': [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
            'left': [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
            'top': [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
        }
        if back or y0 > 0.05:
            corners['back'] = [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)]
        if bottom or z0 > 1.0:
            corners['bottom'] = [(x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)]
        for side, points in corners.items():
            if side == 'front' and front:
                self.polygon(points, label, front[0], front[1], fit=True)
            else:
                self.polygon(points, label, texture, colour, tile=tile)

    def cylinder(self, x, y, radius, z0, z1, label, texture, colour, *, sides=8, top_radius=None):
        """A prism (or a frustum) with a lid."""
        upper = radius if top_radius is None else top_radius
        angles = [2 * math.pi * (i + 0.5) / sides for i in range(sides)]
        low = [(x + radius * math.cos(a), y + radius * math.sin(a), z0) for a in angles]
        high = [(x + upper * math.cos(a), y + upper * math.sin(a), z1) for a in angles]
        for i in range(sides):
            j = (i + 1) % sides
            self.polygon([low[i], low[j], high[j], high[i]], label, texture, colour)
        self.polygon(high, label, texture, colour)

    def legs(self, x0, x1, y0, y1, height, label, colour, thickness=0.05):
        """Four legs in the corners of a rectangle."""
        for x in (x0, x1 - thickness):
            for y in (y0, y1 - thickness):
                self.box(x, x + thickness, y, y + thickness, 0, height, label, 'wood', colour,
                         back=True)


def _bed(p: Piece, w, d, h):
    wood, cover = p.choose(WOODS), p.choose(FABRICS)
    p.box(-w / 2, w / 2, 0, 0.08, 0, h, 'bed', 'wood', wood, back=True)
    p.box(-w / 2, w / 2, 0.08, d, 0, 0.28, 'bed', 'wood', wood)
    p.box(-w / 2 + .03, w / 2 - .03, 0.08, d - .03, 0.28, 0.5, 'bed', 'fabric', cover, tile=0.5)
    for side in (-1, 1):
        centre = side * w / 4
        p.box(centre - w / 6, centre + w / 6, 0.12, 0.5, 0.5, 0.6, 'bed', 'plain',
              p.choose(WHITES))


def _nightstand(p, w, d, h):
    wood = p.choose(WOODS)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'nightstand', 'wood', wood, front=('door', wood * 0.85))
    shade = p.choose(WHITES)
    p.cylinder(0, d / 2, 0.03, h, h + 0.22, 'lamp', 'plain', p.choose(METALS), sides=5)
    p.cylinder(0, d / 2, 0.13, h + 0.22, h + 0.42, 'lamp', 'plain', shade, sides=7,
               top_radius=0.08)


def _wardrobe(p, w, d, h):
    wood = p.choose(WOODS + WHITES)
    p.box(-w / 2, 0, 0, d, 0, h, 'wardrobe', 'wood', wood, front=('door', wood * 0.95))
    p.box(0, w / 2, 0, d, 0, h, 'wardrobe', 'wood', wood, front=('door', wood * 0.85))


def _table_top(p, w, d, h, label, wood):
    p.box(-w / 2, w / 2, 0.02, d, h - 0.05, h, label, 'wood', wood, back=True, bottom=True)
    p.legs(-w / 2 + .03, w / 2 - .03, 0.05, d - .03, h - 0.05, label, wood * 0.8)


def _desk(p, w, d, h):
    wood = p.choose(WOODS)
    _table_top(p, w, d, h, 'desk', wood)
    p.box(-0.25, 0.25, 0.12, 0.16, h + 0.08, h + 0.42, 'tv', 'plain', np.full(3, 0.08),
          front=(f'painting_{int(p.rng.integers(PAINTINGS))}', np.full(3, 0.9)), back=True)
    p.box(w / 2 - .45, w / 2 - .05, 0.06, d - .05, 0.1, h - 0.05, 'desk', 'wood', wood * 0.9,
          front=('door', wood * 0.75))
    _chair_at(p, -0.1, d - 0.02, p.choose(FABRICS), facing_wall=True)


def _chair_at(p, x, y, colour, facing_wall):
    seat = 0.42
    p.box(x, x + seat, y, y + seat, 0.42, 0.47, 'chair', 'fabric', colour, back=True, bottom=True)
    p.legs(x + .01, x + seat - .01, y + .01, y + seat - .01, 0.42, 'chair', colour * 0.4, 0.04)
    back = (y + seat - 0.05, y + seat) if facing_wall else (y, y + 0.05)
    p.box(x, x + seat, back[0], back[1], 0.47, 0.9, 'chair', 'fabric', colour, back=True)


def _dining(p, w, d, h):
    """A table in the room with chairs on two sides; d includes the chairs."""
    wood, cloth = p.choose(WOODS), p.choose(FABRICS)
    y0, y1 = 0.45, d - 0.45
    p.box(-w / 2, w / 2, y0, y1, h - 0.05, h, 'table', 'wood', wood, back=True, bottom=True)
    p.legs(-w / 2 + .03, w / 2 - .03, y0 + .03, y1 - .03, h - 0.05, 'table', wood * 0.8, 0.07)
    for x in (-w / 4 - 0.21, w / 4 - 0.21):
        _chair_at(p, x, 0.12, cloth, facing_wall=False)
        _chair_at(p, x, d - 0.54, cloth, facing_wall=True)
    p.cylinder(0, d / 2, 0.12, h, h + 0.1, 'plant', 'plain', p.choose(WHITES), sides=7)
    p.cylinder(0, d / 2, 0.1, h + 0.1, h + 0.3, 'plant', 'leaves', np.array([.3, .7, .3]),
               sides=6, top_radius=0.05)


def _round_table(p, w, d, h):
    wood, cloth = p.choose(WOODS), p.choose(FABRICS)
    centre = d / 2
    p.cylinder(0, centre, 0.07, 0, h - 0.04, 'table', 'wood', wood * 0.8, sides=6)
    p.cylinder(0, centre, 0.5, h - 0.04, h, 'table', 'wood', wood, sides=12)
    p.box(-w / 2, w / 2, centre - .5, centre + .5, 0, 0.02, 'rug', 'fabric', cloth * 0.8)
    for x in (-w / 2, w / 2 - 0.36):
        p.cylinder(x + 0.18, centre, 0.17, 0, 0.45, 'stool', 'fabric', cloth, sides=8)


def _sofa(p, w, d, h):
    cloth = p.choose(FABRICS)
    p.box(-w / 2, w / 2, 0, 0.25, 0, h, 'sofa', 'fabric', cloth, tile=0.4)
    for x in (-w / 2, w / 2 - 0.18):
        p.box(x, x + 0.18, 0.25, d, 0, 0.6, 'sofa', 'fabric', cloth * 0.9, tile=0.4)
    seat = (w - 0.36) / 2
    for i in range(2):
        x = -w / 2 + 0.18 + i * seat
        p.box(x + .01, x + seat - .01, 0.25, d - .02, 0, 0.43, 'sofa', 'fabric', cloth * 1.05,
              tile=0.4)
    accent = p.choose(FABRICS)
    p.box(-w / 2 + 0.22, -w / 2 + 0.6, 0.25, 0.4, 0.43, 0.75, 'sofa', 'dots', accent)


def _armchair(p, w, d, h):
    cloth = p.choose(FABRICS)
    p.box(-w / 2, w / 2, 0.02, 0.22, 0, h, 'armchair', 'fabric', cloth, back=True, tile=0.4)
    p.box(-w / 2 + .15, w / 2 - .15, 0.22, d, 0, 0.42, 'armchair', 'fabric', cloth, tile=0.4)
    for x in (-w / 2, w / 2 - 0.15):
        p.box(x, x + 0.15, 0.22, d, 0, 0.6, 'armchair', 'fabric', cloth * 0.85, tile=0.4)


def _tv(p, w, d, h):
    wood = p.choose(WOODS + WHITES)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'tv_stand', 'wood', wood, front=('door', wood * 0.8))
    wide = min(w - 0.2, 1.3)
    p.box(-wide / 2, wide / 2, d / 2, d / 2 + .06, h + .06, h + .06 + wide * 0.56, 'tv', 'plain',
          np.full(3, 0.06), back=True,
          front=(f'painting_{int(p.rng.integers(PAINTINGS))}', np.full(3, 0.75)))


def _bookshelf(p, w, d, h):
    wood = p.choose(WOODS)
    p.box(-w / 2, w / 2, 0, d - 0.03, 0, h, 'bookshelf', 'wood', wood)
    shelves = 4
    for i in range(shelves):
        z0, z1 = 0.08 + i * (h - 0.1) / shelves, 0.04 + (i + 1) * (h - 0.1) / shelves
        p.polygon([(w / 2 - .03, d, z0), (-w / 2 + .03, d, z0), (-w / 2 + .03, d, z1),
                   (w / 2 - .03, d, z1)], 'bookshelf', 'books', np.full(3, 1.0), tile=0.6)


def _counter(p, w, d, h):
    door, top = p.choose(WOODS + WHITES + FABRICS), p.choose(METALS + WOODS)
    units = max(2, round(w / 0.6))
    for i in range(units):
        x0, x1 = -w / 2 + i * w / units, -w / 2 + (i + 1) * w / units
        if i == units // 2:
            p.box(x0, x1, 0, d, 0, h - .04, 'stove', 'plain', np.full(3, 0.35),
                  front=('door', np.full(3, 0.25)))
        else:
            p.box(x0, x1, 0, d, 0, h - .04, 'counter', 'plain', door, front=('door', door))
    p.box(-w / 2, w / 2, 0, d + .02, h - .04, h, 'counter', 'marble', top)
    p.box(-w / 2 + .1, -w / 2 + .5, .12, d - .1, h, h + .02, 'sink', 'plain', np.full(3, .8))
    p.box(-w / 2, w / 2, 0, 0.33, 1.45, 2.1, 'cabinet', 'plain', door, front=('door', door * 0.95))


def _fridge(p, w, d, h):
    white = p.choose(WHITES + METALS)
    p.box(-w / 2, w / 2, 0, d, 0, 0.7, 'fridge', 'plain', white)
    p.box(-w / 2, w / 2, 0, d, 0.72, h, 'fridge', 'plain', white)
    p.box(w / 2 - .08, w / 2 - .05, d, d + .03, 0.85, 1.4, 'fridge', 'plain', np.full(3, 0.3))


def _toilet(p, w, d, h):
    white = p.choose(WHITES)
    p.box(-w / 2, w / 2, 0, 0.2, 0, h, 'toilet', 'plain', white)
    p.cylinder(0, 0.42, 0.16, 0, 0.4, 'toilet', 'plain', white * 0.95, top_radius=0.21)


def _bathtub(p, w, d, h):
    white = p.choose(WHITES)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'bathtub', 'plain', white)
    p.polygon([(-w / 2 + .08, .08, h + .003), (w / 2 - .08, .08, h + .003),
               (w / 2 - .08, d - .08, h + .003), (-w / 2 + .08, d - .08, h + .003)],
              'bathtub', 'marble', np.array([0.45, 0.65, 0.75]))


def _washbasin(p, w, d, h):
    white = p.choose(WHITES)
    p.box(-w / 2, w / 2, 0, d, h - 0.2, h, 'washbasin', 'plain', white, bottom=True)
    p.cylinder(0, d / 2, 0.09, 0, h - 0.2, 'washbasin', 'plain', white * 0.9, sides=6)
    p.box(-w / 2, w / 2, 0, 0.03, 1.15, 1.85, 'mirror', 'plain', np.array([.55, .65, .7]))


def _washing_machine(p, w, d, h):
    white = p.choose(WHITES)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'washing_machine', 'plain', white)
    hub = [(0.2 * math.cos(a), d + .005, h / 2 + 0.2 * math.sin(a))
           for a in np.linspace(0, 2 * math.pi, 10, endpoint=False)[::-1]]
    p.polygon(hub, 'washing_machine', 'plain', np.array([0.25, 0.3, 0.35]))


def _plant(p, w, d, h):
    p.cylinder(0, d / 2, 0.12, 0, 0.35, 'plant', 'plain', p.choose(FABRICS + WOODS),
               top_radius=0.17)
    green = np.array([0.25, 0.62, 0.25]) * p.rng.uniform(0.8, 1.3)
    p.cylinder(0, d / 2, 0.10, 0.35, 0.8, 'plant', 'leaves', green, top_radius=w / 2)
    p.cylinder(0, d / 2, w / 2, 0.8, h, 'plant', 'leaves', green, top_radius=0.06)


def _lamp(p, w, d, h):
    p.cylinder(0, d / 2, 0.14, 0, 0.04, 'lamp', 'plain', p.choose(METALS))
    p.cylinder(0, d / 2, 0.02, 0.04, h - 0.35, 'lamp', 'plain', p.choose(METALS), sides=5)
    p.cylinder(0, d / 2, 0.2, h - 0.35, h, 'lamp', 'fabric', p.choose(WHITES + FABRICS),
               top_radius=0.12)


def _cabinet(p, w, d, h):
    wood = p.choose(WOODS + FABRICS)
    p.box(-w / 2, 0, 0, d, 0, h, 'cabinet', 'wood', wood, front=('door', wood))
    p.box(0, w / 2, 0, d, 0, h, 'cabinet', 'wood', wood, front=('door', wood * 0.9))


def _coffee_table(p, w, d, h):
    _table_top(p, w, d, h, 'coffee_table', p.choose(WOODS))


def _bin(p, w, d, h):
    p.cylinder(0, d / 2, w / 2 - .03, 0, h, 'bin', 'plain', p.choose(METALS + FABRICS),
               top_radius=w / 2)


def _boxes(p, w, d, h):
    card = np.array([0.75, 0.6, 0.42])
    p.box(-w / 2, w / 2, 0.02, d, 0, h * 0.6, 'box', 'plain', card, back=True)
    p.box(-w / 4, w / 3, 0.08, d - .05, h * 0.6, h, 'box', 'plain', card * 0.9, back=True)


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of furniture: sizes [m] are (least, most); depth is measured from the wall."""

    draw: Callable
    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]


KINDS = {
    'bed': Kind(_bed, (1.4, 1.8), (2.0, 2.1), (0.8, 1.1)),
    'nightstand': Kind(_nightstand, (0.4, 0.5), (0.35, 0.45), (0.45, 0.6)),
    'wardrobe': Kind(_wardrobe, (1.0, 1.8), (0.55, 0.62), (1.9, 2.2)),
    'desk': Kind(_desk, (1.2, 1.5), (0.65, 0.75), (0.72, 0.76)),
    'dining': Kind(_dining, (1.3, 1.7), (1.75, 1.95), (0.72, 0.76)),
    'round_table': Kind(_round_table, (1.7, 1.9), (1.1, 1.2), (0.72, 0.76)),
    'sofa': Kind(_sofa, (1.7, 2.2), (0.85, 0.95), (0.75, 0.9)),
    'armchair': Kind(_armchair, (0.8, 0.9), (0.8, 0.9), (0.85, 0.95)),
    'tv': Kind(_tv, (1.3, 1.7), (0.4, 0.45), (0.45, 0.6)),
    'bookshelf': Kind(_bookshelf, (0.8, 1.4), (0.3, 0.35), (1.6, 2.1)),
    'counter': Kind(_counter, (1.8, 2.6), (0.6, 0.62), (0.9, 0.92)),
    'fridge': Kind(_fridge, (0.6, 0.75), (0.62, 0.68), (1.6, 1.9)),
    'toilet': Kind(_toilet, (0.4, 0.45), (0.65, 0.66), (0.8, 0.9)),
    'bathtub': Kind(_bathtub, (1.5, 1.7), (0.7, 0.75), (0.5, 0.6)),
    'washbasin': Kind(_washbasin, (0.55, 0.8), (0.42, 0.5), (0.85, 0.9)),
    'washing_machine': Kind(_washing_machine, (0.6, 0.6), (0.58, 0.6), (0.85, 0.87)),
    'plant': Kind(_plant, (0.5, 0.7), (0.5, 0.7), (1.0, 1.6)),
    'lamp': Kind(_lamp, (0.4, 0.42), (0.4, 0.42), (1.5, 1.7)),
    'cabinet': Kind(_cabinet, (0.8, 1.3), (0.4, 0.48), (0.8, 1.2)),
    'coffee_table': Kind(_coffee_table, (0.8, 1.1), (0.5, 0.6), (0.4, 0.45)),
    'bin': Kind(_bin, (0.3, 0.36), (0.3, 0.36), (0.4, 0.6)),
    'boxes': Kind(_boxes, (0.5, 0.7), (0.45, 0.6), (0.5, 0.9)),
}

# What stands in a room of each type, most important first.
ROOM_PROGRAMMES = {
    'living_room': ('sofa', 'tv', 'bookshelf', 'armchair', 'plant', 'lamp', 'cabinet'),
    'kitchen': ('counter', 'fridge', 'round_table', 'bin', 'plant'),
    'bedroom': ('bed', 'nightstand', 'wardrobe', 'lamp', 'cabinet', 'plant'),
    'bathroom': ('bathtub', 'toilet', 'washbasin', 'washing_machine', 'bin'),
    'dining_room': ('dining', 'cabinet', 'plant', 'bookshelf', 'lamp'),
    'office': ('desk', 'bookshelf', 'bookshelf', 'armchair', 'boxes', 'bin', 'plant'),
    'hall': ('cabinet', 'plant', 'boxes', 'bookshelf'),
}
