"""How the fixtures of kitchen, bathroom and heating are built from parts.

Every function takes a piece `p` and its width, depth and height [m]: `w`, `d`, `h`. `x`, `y` and
`z` lie along, off and above the wall.
"""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.houses.piece import Piece

DARK = np.full(3, 0.08)  # RGB


def _counter(p: Piece, w, d, h):
    door, top = p.choose(p.look.woods + p.look.whites), p.choose(p.look.whites)
    parts = max(2, round(w / 0.6))
    stove = int(p.rng.integers(parts))
    for i in range(parts):
        x0, x1 = -w / 2 + i * w / parts, -w / 2 + (i + 1) * w / parts
        if i == stove:
            p.box(x0, x1, 0, d, 0, h - .04, 'stove', 'plain', np.full(3, 0.35),
                  front=(p.front, np.full(3, 0.25)))
            for x in (x0 + 0.17, x1 - 0.17):
                for y in (0.2, d - 0.18):
                    p.cylinder(x, y, 0.08, h, h + 0.012, 'stove', 'plain', DARK, sides=7)
        else:
            p.box(x0, x1, 0, d, 0, h - .04, 'counter', 'plain', door, front=(p.front, door))
    p.box(-w / 2, w / 2, 0, d + .02, h - .04, h, 'counter', 'marble', top)
    side = -1 if stove >= parts / 2 else 1
    x = side * (w / 2 - 0.3)
    p.box(x - .2, x + .2, .12, d - .1, h, h + .02, 'sink', 'plain', np.full(3, .8))
    p.cylinder(x, .1, .02, h, h + .25, 'sink', 'plain', p.metal, sides=5)
    p.box(-w / 2, w / 2, 0, 0.33, 1.45, 2.1, 'cabinet', 'plain', door,
          front=(p.front, door * 0.95))
    p.box(-0.25 - side * 0.2, 0.25 - side * 0.2, 0.05, 0.4, h, h + 0.3, 'microwave', 'plain',
          p.metal, front=('door', DARK * 3))


def _fridge(p, w, d, h):
    white = p.choose(p.look.whites + p.look.metals)
    p.box(-w / 2, w / 2, 0, d, 0, 0.7, 'fridge', 'plain', white)
    p.box(-w / 2, w / 2, 0, d, 0.72, h, 'fridge', 'plain', white)
    for z0, z1 in ((0.85, 1.4), (0.35, 0.62)):
        p.box(w / 2 - .08, w / 2 - .05, d, d + .03, z0, z1, 'fridge', 'plain', DARK * 4)


def _toilet(p, w, d, h):
    p.box(-w / 2, w / 2, 0, 0.2, 0.35, h, 'toilet', 'plain', p.white, bottom=True)
    p.cylinder(0, 0.42, 0.16, 0, 0.38, 'toilet', 'plain', p.white * 0.95, top_radius=0.21)
    p.cylinder(0, 0.42, 0.22, 0.38, 0.42, 'toilet', 'plain', p.white, bottom=True)


def _bathtub(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, h, 'bathtub', 'plain', p.white)
    p.polygon([(-w / 2 + .08, .08, h + .003), (w / 2 - .08, .08, h + .003),
               (w / 2 - .08, d - .08, h + .003), (-w / 2 + .08, d - .08, h + .003)],
              'bathtub', 'marble', np.array([0.45, 0.65, 0.75]))
    p.cylinder(w / 2 - .15, d / 2, .025, h, h + .2, 'bathtub', 'plain', p.metal, sides=5)


def _shower(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, 0.12, 'shower', 'plain', p.white)
    for x in (-w / 2, w / 2 - .03):
        p.box(x, x + .03, d - .03, d, 0.12, h, 'shower', 'plain', p.metal, back=True)
    p.box(-w / 2, w / 2, 0, 0.02, 0.12, h, 'shower', 'tiles', np.array([.7, .8, .85]))
    p.cylinder(0, 0.2, 0.1, h - 0.12, h - 0.08, 'shower', 'plain', p.metal, bottom=True)
    p.box(-.015, .015, 0.02, 0.05, 0.9, h - 0.1, 'shower', 'plain', p.metal)


def _washbasin(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, h - 0.2, h, 'washbasin', 'plain', p.white, bottom=True)
    p.cylinder(0, d / 2, 0.09, 0, h - 0.2, 'washbasin', 'plain', p.white * 0.9, sides=6)
    p.cylinder(0, 0.08, 0.02, h, h + 0.15, 'washbasin', 'plain', p.metal, sides=5)
    p.box(-w / 2, w / 2, 0, 0.03, 1.15, 1.85, 'mirror', 'plain', np.array([.55, .65, .7]))


def _washing_machine(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, h, 'washing_machine', 'plain', p.white)
    hub = [(0.2 * math.cos(a), d + .005, 0.45 * h + 0.2 * math.sin(a))
           for a in np.linspace(0, 2 * math.pi, 10, endpoint=False)[::-1]]
    p.polygon(hub, 'washing_machine', 'plain', np.array([0.25, 0.3, 0.35]))
    p.box(-w / 2 + .03, w / 2 - .03, d, d + .01, h - 0.13, h - 0.02, 'washing_machine', 'plain',
          DARK * 4)


def _radiator(p, w, d, h):
    p.box(-w / 2, w / 2, 0.03, d, 0.12, h, 'radiator', 'plain', p.white,
          front=('stripes', p.white), bottom=True)
    p.box(-w / 2 - .04, -w / 2, 0.05, 0.09, 0.2, 0.28, 'radiator', 'plain', p.metal, back=True)


def _fireplace(p, w, d, h):
    stone = p.choose(p.look.walls)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'fireplace', 'brick', stone, front=('brick', stone))
    p.box(-w / 2 - .06, w / 2 + .06, 0, d + .06, h, h + 0.08, 'fireplace', p.look.wood, p.wood,
          bottom=True)
    p.polygon([(w / 4, d + .005, 0.05), (-w / 4, d + .005, 0.05), (-w / 4, d + .005, 0.62),
               (w / 4, d + .005, 0.62)], 'fireplace', 'fire', np.ones(3), fit=True)
    p.box(-w / 4, w / 4, 0, d * 0.7, h + .08, 2.6, 'fireplace', 'plaster', stone)


FIXTURES = {
    'counter': _counter, 'fridge': _fridge, 'toilet': _toilet, 'bathtub': _bathtub,
    'shower': _shower, 'washbasin': _washbasin, 'washing_machine': _washing_machine,
    'radiator': _radiator, 'fireplace': _fireplace,
}
