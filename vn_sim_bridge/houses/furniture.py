"""Furniture: how each kind is built from parts, how large it is, and which rooms it stands in."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from vn_sim_bridge.houses.piece import Piece

DARK = np.full(3, 0.08)


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


def _counter(p, w, d, h):
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


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of furniture: sizes [m] are (least, most); depth is measured from the wall."""

    draw: Callable
    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]
    standing: float = 0.0  # m beyond `depth` that belongs to it (a desk's chair)
    centre: bool = False  # stands in the middle of a room rather than at a wall


KINDS = {
    'bed': Kind(_bed, (1.4, 1.8), (2.0, 2.1), (0.8, 1.1)),
    'nightstand': Kind(_nightstand, (0.4, 0.5), (0.35, 0.45), (0.45, 0.6)),
    'wardrobe': Kind(_wardrobe, (1.0, 1.8), (0.55, 0.62), (1.9, 2.2)),
    'desk': Kind(_desk, (1.2, 1.5), (0.65, 0.75), (0.72, 0.76), standing=0.45),
    'dining': Kind(_dining, (1.3, 1.7), (1.75, 1.95), (0.72, 0.76), centre=True),
    'round_table': Kind(_round_table, (1.7, 1.9), (1.1, 1.2), (0.72, 0.76), centre=True),
    'sofa': Kind(_sofa, (1.7, 2.2), (0.85, 0.95), (0.75, 0.9)),
    'armchair': Kind(_armchair, (0.8, 0.9), (0.8, 0.9), (0.85, 0.95)),
    'tv': Kind(_tv, (1.3, 1.7), (0.4, 0.45), (0.45, 0.6)),
    'bookshelf': Kind(_bookshelf, (0.8, 1.4), (0.3, 0.35), (1.6, 2.1)),
    'counter': Kind(_counter, (1.8, 2.6), (0.6, 0.62), (0.9, 0.92)),
    'fridge': Kind(_fridge, (0.6, 0.75), (0.62, 0.68), (1.6, 1.9)),
    'toilet': Kind(_toilet, (0.42, 0.46), (0.65, 0.66), (0.8, 0.9)),
    'bathtub': Kind(_bathtub, (1.5, 1.7), (0.7, 0.75), (0.5, 0.6)),
    'shower': Kind(_shower, (0.8, 0.95), (0.8, 0.9), (2.0, 2.1)),
    'washbasin': Kind(_washbasin, (0.55, 0.8), (0.42, 0.5), (0.85, 0.9)),
    'washing_machine': Kind(_washing_machine, (0.6, 0.6), (0.58, 0.6), (0.85, 0.87)),
    'plant': Kind(_plant, (0.5, 0.7), (0.5, 0.7), (1.1, 1.6)),
    'lamp': Kind(_lamp, (0.4, 0.48), (0.4, 0.48), (1.5, 1.7)),
    'cabinet': Kind(_cabinet, (0.8, 1.3), (0.4, 0.48), (0.8, 1.2)),
    'dresser': Kind(_dresser, (0.9, 1.2), (0.42, 0.5), (0.75, 0.9)),
    'coffee_table': Kind(_coffee_table, (0.8, 1.1), (0.5, 0.6), (0.4, 0.45), centre=True),
    'ottoman': Kind(_ottoman, (0.5, 0.7), (0.5, 0.6), (0.38, 0.45)),
    'bin': Kind(_bin, (0.3, 0.36), (0.3, 0.36), (0.4, 0.6)),
    'boxes': Kind(_boxes, (0.5, 0.7), (0.45, 0.6), (0.5, 0.9)),
    'piano': Kind(_piano, (1.4, 1.5), (0.95, 1.05), (1.1, 1.25)),
    'coat_rack': Kind(_coat_rack, (0.4, 0.45), (0.4, 0.45), (1.7, 1.9)),
    'bench': Kind(_bench, (0.9, 1.3), (0.35, 0.42), (0.42, 0.46)),
    'aquarium': Kind(_aquarium, (0.8, 1.1), (0.38, 0.45), (1.15, 1.35)),
    'radiator': Kind(_radiator, (0.8, 1.2), (0.11, 0.14), (0.6, 0.75)),
    'fireplace': Kind(_fireplace, (1.2, 1.5), (0.35, 0.42), (1.0, 1.2)),
    'whiteboard': Kind(_whiteboard, (1.0, 1.4), (0.4, 0.45), (1.8, 1.95)),
}
TALL = ('wardrobe', 'bookshelf', 'fridge', 'counter', 'washbasin', 'shower', 'dresser', 'tv',
        'fireplace', 'whiteboard', 'aquarium', 'piano')  # nothing hangs on the wall behind these

# What stands in a room of each type, most important first; the part after None only sometimes.
ROOM_PROGRAMMES = {
    'living_room': ('sofa', 'tv', 'coffee_table', 'bookshelf', 'armchair', 'plant', 'lamp', None,
                    'fireplace', 'piano', 'aquarium', 'ottoman', 'radiator', 'cabinet'),
    'kitchen': ('counter', 'fridge', 'round_table', 'bin', None, 'cabinet', 'plant', 'radiator'),
    'bedroom': ('bed', 'nightstand', 'wardrobe', 'dresser', 'lamp', None, 'armchair', 'plant',
                'bench', 'radiator', 'bookshelf', 'boxes'),
    'bathroom': ('toilet', 'washbasin', 'bathtub', 'shower', 'washing_machine', None, 'bin',
                 'cabinet', 'radiator'),
    'dining_room': ('dining', 'cabinet', 'plant', 'lamp', None, 'bookshelf', 'fireplace', 'piano',
                    'radiator', 'dresser'),
    'office': ('desk', 'bookshelf', 'bookshelf', 'whiteboard', 'bin', None, 'armchair', 'boxes',
               'plant', 'lamp', 'cabinet', 'radiator'),
    'hall': ('coat_rack', 'bench', 'cabinet', None, 'plant', 'bookshelf', 'boxes', 'aquarium',
             'radiator'),
}
OPTIONAL_PROBABILITY = 0.45
