"""The carpentry of furniture: boxes, prisms, legs, fronts and backs in a piece's own frame.

A piece's frame: x runs along the wall, y points out of the wall into the room, z up; the origin
lies on the floor, at the wall, in the middle of the piece.
"""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.houses.labels import LABEL
from vn_sim_bridge.houses.looks import Look
from vn_sim_bridge.houses.textures import TEXTURES
from vn_sim_bridge.render.scene import SceneBuilder


class Piece:
    """Draws the parts of one piece of furniture into a scene.

    Args:
        builder: the scene under construction.
        look: colours, materials and forms to draw from.
        origin: (x, y) of the piece's origin [m]; quarter: its rotation in quarter turns.
        instance: instance id of every part.
        rng: colours, forms and proportions.
    """

    def __init__(self, builder: SceneBuilder, look: Look, origin, quarter: int, instance: int,
                 rng: np.random.Generator):
        self.builder, self.look = builder, look
        self.origin, self.instance, self.rng = origin, instance, rng
        self._cos, self._sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4]
        self.wood = self.choose(look.woods)
        self.cloth = self.choose(look.fabrics)
        self.white = self.choose(look.whites)
        self.metal = self.choose(look.metals)
        self.upholstery = self.pick(look.cloth)
        self.front = self.pick(look.fronts)

    def choose(self, palette) -> np.ndarray:
        """A colour of the palette with a little variation, so that no two pieces are equal."""
        colour = np.array(palette[int(self.rng.integers(len(palette)))])
        return np.clip(colour * self.rng.uniform(0.85, 1.12), 0.03, 1.0)

    def pick(self, options: tuple[str, ...]) -> str:
        """One of some forms or textures."""
        return options[int(self.rng.integers(len(options)))]

    def polygon(self, points, label: str, texture: str, colour, **options) -> None:
        """One polygon in the piece's frame."""
        points = np.asarray(points, float)
        world = points.copy()
        world[:, 0] = self.origin[0] + self._cos * points[:, 0] - self._sin * points[:, 1]
        world[:, 1] = self.origin[1] + self._sin * points[:, 0] + self._cos * points[:, 1]
        self.builder.polygon(world, texture=TEXTURES[texture], colour=np.clip(colour, 0, 1),
                             label=LABEL[label], instance=self.instance, **options)

    def box(self, x0, x1, y0, y1, z0, z1, label, texture, colour, *, front=None, back=False,
            bottom=False, tile=1.0) -> None:
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

    def cylinder(self, x, y, radius, z0, z1, label, texture, colour, *, sides=8,
                 top_radius=None, lid=True, bottom=False) -> None:
        """A prism (or a frustum), with a lid."""
        upper = radius if top_radius is None else top_radius
        angles = [2 * math.pi * (i + 0.5) / sides for i in range(sides)]
        low = [(x + radius * math.cos(a), y + radius * math.sin(a), z0) for a in angles]
        high = [(x + upper * math.cos(a), y + upper * math.sin(a), z1) for a in angles]
        for i in range(sides):
            j = (i + 1) % sides
            self.polygon([low[i], low[j], high[j], high[i]], label, texture, colour)
        if lid:
            self.polygon(high, label, texture, colour)
        if bottom:
            self.polygon(low[::-1], label, texture, colour)

    def legs(self, x0, x1, y0, y1, height, label, colour, thickness=0.05) -> None:
        """What carries a top of the given rectangle, in one of the look's forms."""
        wood, t = self.look.wood, thickness
        form = self.pick(self.look.legs)
        if form in ('square', 'round'):
            for x in (x0, x1 - t):
                for y in (y0, y1 - t):
                    if form == 'square':
                        self.box(x, x + t, y, y + t, 0, height, label, wood, colour, back=True)
                    else:
                        self.cylinder(x + t / 2, y + t / 2, 0.6 * t, 0, height, label, wood,
                                      colour, sides=5, lid=False)
        elif form == 'panel':
            for x in (x0, x1 - t):
                self.box(x, x + t, y0, y1, 0, height, label, wood, colour, back=True)
        elif form == 'sled':
            for x in (x0, x1 - t):
                self.box(x, x + t, y0, y1, 0, t, label, 'plain', self.metal, back=True)
                self.box(x, x + t, (y0 + y1 - t) / 2, (y0 + y1 + t) / 2, t, height, label,
                         'plain', self.metal, back=True)
        else:
            x, y = (x0 + x1) / 2, (y0 + y1) / 2
            radius = 0.32 * min(x1 - x0, y1 - y0)
            self.cylinder(x, y, radius, 0, t, label, 'plain', self.metal, sides=7)
            self.cylinder(x, y, t, t, height, label, 'plain', self.metal, sides=6, lid=False)

    def back(self, x0, x1, y0, y1, z0, z1, label, texture, colour) -> None:
        """The upright back of a chair or the head of a bed, in one of the look's forms."""
        form = self.pick(self.look.backs)
        if form == 'solid':
            self.box(x0, x1, y0, y1, z0, z1, label, texture, colour, back=True)
            return
        t = min(0.06, (x1 - x0) / 6)
        for x in (x0, x1 - t):
            self.box(x, x + t, y0, y1, z0, z1, label, texture, colour, back=True)
        if form == 'slats':
            for k in (1, 2, 3):
                x = x0 + (x1 - x0 - t) * k / 4
                self.box(x, x + t * 0.8, y0, y1, z0, z1 - 0.05, label, texture, colour, back=True)
        elif form == 'ladder':
            for share in (0.15, 0.5, 0.85):
                z = z0 + (z1 - z0) * share
                self.box(x0 + t, x1 - t, y0, y1, z - 0.04, z + 0.04, label, texture, colour,
                         back=True)
        self.box(x0, x1, y0, y1, z1 - 0.07, z1, label, texture, colour, back=True, bottom=True)

    def shade(self, x, y, radius, z0, z1, label='lamp') -> None:
        """A lamp shade, in one of the look's forms."""
        form = self.pick(self.look.shades)
        colour = self.choose(self.look.whites + self.look.fabrics[:2])
        if form == 'cone':
            self.cylinder(x, y, radius, z0, z1, label, 'fabric', colour, top_radius=0.6 * radius,
                          bottom=z0 > 1)
        elif form == 'drum':
            self.cylinder(x, y, 0.85 * radius, z0, z1, label, 'fabric', colour, bottom=z0 > 1)
        elif form == 'globe':
            middle = (z0 + z1) / 2
            self.cylinder(x, y, 0.4 * radius, z0, middle, label, 'plain', colour,
                          top_radius=radius, lid=False, bottom=True)
            self.cylinder(x, y, radius, middle, z1, label, 'plain', colour,
                          top_radius=0.4 * radius)
        else:
            self.cylinder(x, y, 1.2 * radius, z1 - 0.06, z1, label, 'plain', colour, sides=10,
                          bottom=True)
