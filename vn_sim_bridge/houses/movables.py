"""How furniture of wood and cloth is built from parts.

Every function takes a piece `p` and its width, depth and height [m]: `w`, `d`, `h`. `x`, `y` and
`z` lie along, off and above the wall.
"""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.houses.fixtures import DARK
from vn_sim_bridge.houses.piece import Piece


def _bed(p: Piece, w, d, h):
    p.back(-w / 2, w / 2, 0, 0.08, 0, h, 'bed', p.look.wood, p.wood)
    p.box(-w / 2, w / 2, 0.08, d, 0.1, 0.3, 'bed', p.look.wood, p.wood, bottom=True)
    p.legs(-w / 2 + .05, w / 2 - .05, 0.15, d - .05, 0.1, 'bed', p.wood * 0.7, 0.08)
    p.box(-w / 2 + .03, w / 2 - .03, 0.08, d - .03, 0.3, 0.5, 'bed', p.upholstery, p.cloth,
          tile=0.5)
    p.box(-w / 2 + .02, w / 2 - .02, 0.55 * d, d - .02, 0.3, 0.53, 'bed', p.upholstery,
          p.choose(p.look.fabrics), tile=0.5)
    for side in (-1, 1):
        centre = side * w / 4
        p.box(centre - w / 6, centre + w / 6, 0.12, 0.5, 0.5, 0.6, 'bed', 'plain', p.white)


def _nightstand(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, h, 'nightstand', p.look.wood, p.wood,
          front=(p.front, p.wood * 0.85))
    p.cylinder(0, d / 2, 0.03, h, h + 0.22, 'lamp', 'plain', p.metal, sides=5, lid=False)
    p.shade(0, d / 2, 0.13, h + 0.22, h + 0.42)


def _wardrobe(p, w, d, h):
    wood = p.choose(p.look.woods + p.look.whites)
    p.box(-w / 2, 0, 0, d, 0.05, h, 'wardrobe', p.look.wood, wood, front=(p.front, wood * 0.95))
    p.box(0, w / 2, 0, d, 0.05, h, 'wardrobe', p.look.wood, wood, front=(p.front, wood * 0.85))
    p.box(-w / 2 + .03, w / 2 - .03, 0, d - .04, 0, 0.05, 'wardrobe', 'plain', wood * 0.5)


def _table_top(p, w, d, h, label, y0=0.02):
    p.box(-w / 2, w / 2, y0, d, h - 0.05, h, label, p.look.wood, p.wood, back=True, bottom=True)
    p.legs(-w / 2 + .03, w / 2 - .03, y0 + .03, d - .03, h - 0.05, label, p.wood * 0.8)


def _picture(p) -> str:
    return p.pick(p.look.paintings)


def _desk(p, w, d, h):
    _table_top(p, w, d, h, 'desk')
    p.box(-0.25, 0.25, 0.12, 0.16, h + 0.08, h + 0.42, 'tv', 'plain', DARK,
          front=(_picture(p), np.full(3, 0.9)), back=True)
    p.box(-0.05, 0.05, 0.1, 0.2, h, h + 0.08, 'tv', 'plain', DARK, back=True)
    p.box(w / 2 - .45, w / 2 - .05, 0.06, d - .05, 0.1, h - 0.05, 'desk', p.look.wood,
          p.wood * 0.9, front=(p.front, p.wood * 0.75))
    x, y = -0.1, d + 0.2
    p.cylinder(x, y, 0.24, 0, 0.05, 'chair', 'plain', p.metal, sides=5)
    p.cylinder(x, y, 0.03, 0.05, 0.42, 'chair', 'plain', p.metal, sides=5, lid=False)
    p.box(x - .21, x + .21, y - .21, y + .21, 0.42, 0.5, 'chair', p.upholstery, p.cloth,
          back=True, bottom=True)
    p.box(x - .19, x + .19, y + .15, y + .2, 0.5, 0.98, 'chair', p.upholstery, p.cloth, back=True)


def _chair_at(p, x, y, colour, facing_wall):
    seat = 0.42
    p.box(x, x + seat, y, y + seat, 0.42, 0.47, 'chair', p.upholstery, colour, back=True,
          bottom=True)
    p.legs(x + .01, x + seat - .01, y + .01, y + seat - .01, 0.42, 'chair', p.wood * 0.7, 0.04)
    low, high = (y + seat - 0.05, y + seat) if facing_wall else (y, y + 0.05)
    p.back(x, x + seat, low, high, 0.47, 0.92, 'chair', p.look.wood, p.wood)


def _dining(p, w, d, h):
    """A table with chairs on two sides; d includes the chairs."""
    y0, y1 = 0.45, d - 0.45
    p.box(-w / 2, w / 2, y0, y1, h - 0.05, h, 'table', p.look.wood, p.wood, back=True,
          bottom=True)
    p.legs(-w / 2 + .03, w / 2 - .03, y0 + .03, y1 - .03, h - 0.05, 'table', p.wood * 0.8, 0.07)
    for x in (-w / 4 - 0.21, w / 4 - 0.21):
        _chair_at(p, x, 0.12, p.cloth, facing_wall=False)
        _chair_at(p, x, d - 0.54, p.cloth, facing_wall=True)
    p.cylinder(0, d / 2, 0.12, h, h + 0.1, 'plant', 'plain', p.white, sides=7)
    p.cylinder(0, d / 2, 0.1, h + 0.1, h + 0.3, 'plant', 'leaves', np.array([.3, .7, .3]),
               sides=6, top_radius=0.05)


def _round_table(p, w, d, h):
    centre = d / 2
    p.cylinder(0, centre, 0.25, 0, 0.03, 'table', 'plain', p.metal, sides=7)
    p.cylinder(0, centre, 0.06, 0.03, h - 0.04, 'table', p.look.wood, p.wood * 0.8, sides=6,
               lid=False)
    p.cylinder(0, centre, 0.5, h - 0.04, h, 'table', p.look.wood, p.wood, sides=12, bottom=True)
    for x in (-w / 2, w / 2 - 0.36):
        p.cylinder(x + 0.18, centre, 0.13, 0, 0.4, 'stool', 'plain', p.metal, sides=6, lid=False,
                   top_radius=0.08)
        p.cylinder(x + 0.18, centre, 0.18, 0.4, 0.46, 'stool', p.upholstery, p.cloth, bottom=True)


def _arms(p, x0, x1, y0, y1, height, width, label, colour):
    form = p.pick(p.look.arms)
    width = width if form != 'slim' else 0.5 * width
    if form == 'none':
        return
    for left in (True, False):
        a, b = (x0, x0 + width) if left else (x1 - width, x1)
        if form == 'sloped':
            p.box(a, b, y0, (y0 + y1) / 2, 0, height, label, p.upholstery, colour, tile=0.4)
            p.box(a, b, (y0 + y1) / 2, y1, 0, 0.7 * height, label, p.upholstery, colour, tile=0.4)
        else:
            p.box(a, b, y0, y1, 0, height, label, p.upholstery, colour, tile=0.4)


def _sofa(p, w, d, h):
    p.box(-w / 2, w / 2, 0, 0.25, 0, h, 'sofa', p.upholstery, p.cloth, tile=0.4)
    _arms(p, -w / 2, w / 2, 0.25, d, 0.6, 0.18, 'sofa', p.cloth * 0.9)
    seat = (w - 0.36) / 2
    for i in range(2):
        x = -w / 2 + 0.18 + i * seat
        p.box(x + .01, x + seat - .01, 0.25, d - .02, 0.05, 0.43, 'sofa', p.upholstery,
              p.cloth * 1.05, tile=0.4)
    p.box(-w / 2 + 0.22, -w / 2 + 0.6, 0.25, 0.4, 0.43, 0.75, 'sofa', p.pick(p.look.rug_textures),
          p.choose(p.look.fabrics))


def _armchair(p, w, d, h):
    p.box(-w / 2, w / 2, 0.02, 0.22, 0, h, 'armchair', p.upholstery, p.cloth, back=True, tile=0.4)
    p.box(-w / 2 + .15, w / 2 - .15, 0.22, d, 0, 0.42, 'armchair', p.upholstery, p.cloth, tile=0.4)
    _arms(p, -w / 2, w / 2, 0.22, d, 0.6, 0.15, 'armchair', p.cloth * 0.85)


def _tv(p, w, d, h):
    wood = p.choose(p.look.woods + p.look.whites)
    p.box(-w / 2, w / 2, 0, d, 0, h, 'tv_stand', p.look.wood, wood, front=(p.front, wood * 0.8))
    wide = min(w - 0.2, 1.3)
    p.box(-0.15, 0.15, d / 2 - .06, d / 2 + .1, h, h + 0.06, 'tv', 'plain', DARK, back=True)
    p.box(-wide / 2, wide / 2, d / 2, d / 2 + .06, h + .06, h + .06 + wide * 0.56, 'tv', 'plain',
          DARK, back=True, front=(_picture(p), np.full(3, 0.75)))


def _bookshelf(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d - 0.03, 0, h, 'bookshelf', p.look.wood, p.wood)
    for i in range(4):
        z0, z1 = 0.08 + i * (h - 0.1) / 4, 0.04 + (i + 1) * (h - 0.1) / 4
        p.polygon([(w / 2 - .04, d, z0), (-w / 2 + .04, d, z0), (-w / 2 + .04, d, z1),
                   (w / 2 - .04, d, z1)], 'bookshelf', 'books', p.rng.uniform(0.7, 1, 3),
                  fit=True)


def _plant(p, w, d, h):
    p.cylinder(0, d / 2, 0.12, 0, 0.35, 'plant', 'plain', p.choose(p.look.fabrics + p.look.woods),
               top_radius=0.17)
    green = np.array([0.25, 0.62, 0.25]) * p.rng.uniform(0.8, 1.3)
    form, y = p.pick(p.look.plants), d / 2
    if form == 'bush':
        p.cylinder(0, y, 0.10, 0.35, 0.8, 'plant', 'leaves', green, top_radius=w / 2, lid=False)
        p.cylinder(0, y, w / 2, 0.8, h, 'plant', 'leaves', green, top_radius=0.06)
    elif form == 'tall':
        p.cylinder(0, y, 0.03, 0.35, h - 0.5, 'plant', 'wood', p.wood * 0.6, sides=5, lid=False)
        p.cylinder(0, y, 0.12, h - 0.5, h - 0.25, 'plant', 'leaves', green, top_radius=w / 2,
                   lid=False, bottom=True)
        p.cylinder(0, y, w / 2, h - 0.25, h, 'plant', 'leaves', green, top_radius=0.1)
    elif form == 'palm':
        p.cylinder(0, y, 0.05, 0.35, h - 0.3, 'plant', 'wood', p.wood, sides=6, lid=False)
        for k in range(5):
            a = 2 * math.pi * k / 5
            c, s = 0.5 * w * math.cos(a), 0.5 * w * math.sin(a)
            leaf = [(0, y, h - 0.3), (c - 0.3 * s, y + s + 0.3 * c, h - 0.1), (c, y + s, h - 0.25)]
            p.polygon(leaf, 'plant', 'leaves', green)
            p.polygon(leaf[::-1], 'plant', 'leaves', green * 0.8)
    else:
        p.cylinder(0, y, 0.13, 0.35, h - 0.1, 'plant', 'stripes', green, sides=9,
                   top_radius=0.15, lid=False)
        p.cylinder(0, y, 0.15, h - 0.1, h, 'plant', 'stripes', green, sides=9, top_radius=0.05)


def _lamp(p, w, d, h):
    p.cylinder(0, d / 2, 0.14, 0, 0.04, 'lamp', 'plain', p.metal)
    p.cylinder(0, d / 2, 0.02, 0.04, h - 0.35, 'lamp', 'plain', p.metal, sides=5, lid=False)
    p.shade(0, d / 2, 0.2, h - 0.35, h)


def _cabinet(p, w, d, h):
    wood = p.choose(p.look.woods + p.look.fabrics)
    p.box(-w / 2, 0, 0, d, 0.08, h, 'cabinet', p.look.wood, wood, front=(p.front, wood))
    p.box(0, w / 2, 0, d, 0.08, h, 'cabinet', p.look.wood, wood, front=(p.front, wood * 0.9))
    p.box(-w / 2 + .04, w / 2 - .04, 0.02, d - .04, 0, 0.08, 'cabinet', 'plain', wood * 0.4)
    p.cylinder(w / 4, d / 2, 0.06, h, h + 0.22, 'cabinet', 'plain', p.choose(p.look.fabrics),
               sides=7, top_radius=0.1)


def _dresser(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, h, 'dresser', p.look.wood, p.wood, front=(p.front, p.wood))
    p.box(-w / 3, w / 3, 0.02, 0.05, h, h + 0.7, 'mirror', 'plain', np.array([.55, .65, .7]))
    p.cylinder(w / 2 - .15, d / 2, 0.05, h, h + 0.14, 'dresser', 'plain', p.metal, sides=6)


def _coffee_table(p, w, d, h):
    _table_top(p, w, d, h, 'coffee_table')
    p.box(-.15, .1, d / 2 - .1, d / 2 + .1, h, h + .05, 'coffee_table', 'plain', p.cloth,
          back=True)


def _bin(p, w, d, h):
    p.cylinder(0, d / 2, w / 2 - .03, 0, h, 'bin', 'plain', p.choose(p.look.metals
               + p.look.fabrics), top_radius=w / 2, lid=False)
    p.cylinder(0, d / 2, w / 2 - .04, h - 0.06, h - 0.05, 'bin', 'plain', DARK)


def _boxes(p, w, d, h):
    card = np.array([0.75, 0.6, 0.42])
    p.box(-w / 2, w / 2, 0.02, d, 0, h * 0.6, 'box', 'plain', card, back=True)
    p.box(-w / 4, w / 3, 0.08, d - .05, h * 0.6, h, 'box', 'plain', card * 0.9, back=True)


def _piano(p, w, d, h):
    p.box(-w / 2, w / 2, 0, 0.35, 0, h, 'piano', p.look.wood, p.wood * 0.5)
    p.box(-w / 2, w / 2, 0.35, d - 0.3, 0.62, 0.72, 'piano', p.look.wood, p.wood * 0.5,
          bottom=True)
    p.polygon([(w / 2 - .08, 0.37, 0.73), (w / 2 - .08, d - .32, 0.73),
               (-w / 2 + .08, d - .32, 0.73), (-w / 2 + .08, 0.37, 0.73)][::-1], 'piano', 'keys',
              np.ones(3), tile=0.35)
    p.box(-0.3, 0.3, d - 0.25, d, 0.42, 0.48, 'bench', p.upholstery, p.cloth, back=True,
          bottom=True)
    p.legs(-0.28, 0.28, d - 0.24, d - 0.01, 0.42, 'bench', p.wood * 0.5)


def _coat_rack(p, w, d, h):
    y = d / 2
    p.cylinder(0, y, 0.17, 0, 0.04, 'coat_rack', p.look.wood, p.wood)
    p.cylinder(0, y, 0.025, 0.04, h, 'coat_rack', p.look.wood, p.wood, sides=5)
    p.cylinder(0, y, 0.17, h - 0.95, h - 0.12, 'coat_rack', p.upholstery, p.cloth, sides=6,
               top_radius=0.07, bottom=True)


def _bench(p, w, d, h):
    _table_top(p, w, d, h, 'bench')
    p.box(-w / 2 + .05, w / 2 - .05, 0.04, d - .02, h, h + 0.06, 'bench', p.upholstery, p.cloth)


def _aquarium(p, w, d, h):
    p.box(-w / 2, w / 2, 0, d, 0, h - 0.5, 'cabinet', p.look.wood, p.wood,
          front=(p.front, p.wood * 0.9))
    p.box(-w / 2, w / 2, 0.02, d, h - 0.5, h - 0.06, 'aquarium', 'plain',
          np.array([.3, .55, .7]), front=('water', np.ones(3)))
    p.box(-w / 2, w / 2, 0.02, d, h - 0.06, h, 'aquarium', 'plain', DARK)


def _whiteboard(p, w, d, h):
    p.box(-w / 2, w / 2, d / 2, d / 2 + .03, 0.8, h, 'whiteboard', 'plain', p.white, back=True,
          bottom=True)
    p.box(-w / 2, w / 2, d / 2 + .03, d / 2 + .09, 0.78, 0.81, 'whiteboard', 'plain', p.metal,
          back=True, bottom=True)
    p.legs(-w / 2 + .05, w / 2 - .05, 0.05, d - .02, 0.8, 'whiteboard', p.metal)


def _ottoman(p, w, d, h):
    p.box(-w / 2, w / 2, 0.02, d, 0.08, h, 'ottoman', p.upholstery, p.cloth, back=True,
          bottom=True, tile=0.4)
    p.legs(-w / 2 + .04, w / 2 - .04, 0.06, d - .04, 0.08, 'ottoman', p.wood * 0.6)


MOVABLES = {
    'bed': _bed, 'nightstand': _nightstand, 'wardrobe': _wardrobe, 'desk': _desk,
    'dining': _dining, 'round_table': _round_table, 'sofa': _sofa, 'armchair': _armchair,
    'tv': _tv, 'bookshelf': _bookshelf, 'plant': _plant, 'lamp': _lamp, 'cabinet': _cabinet,
    'dresser': _dresser, 'coffee_table': _coffee_table, 'ottoman': _ottoman, 'bin': _bin,
    'boxes': _boxes, 'piano': _piano, 'coat_rack': _coat_rack, 'bench': _bench,
    'aquarium': _aquarium, 'whiteboard': _whiteboard,
}
