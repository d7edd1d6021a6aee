"""Movable objects: goals of the object task, fruit of the collect task. Each is a small scene."""

from __future__ import annotations

import functools

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.looks import STANDARD
from vn_sim_bridge.houses.piece import Piece
from vn_sim_bridge.houses.textures import texture_library
from vn_sim_bridge.render.scene import Scene, SceneBuilder


def _ball(p):
    red = np.array([0.9, 0.2, 0.15])
    for z0, z1, low, high in ((0, .1, .1, .22), (.1, .25, .22, .27), (.25, .4, .27, .22),
                              (.4, .5, .22, .1)):
        p.cylinder(0, 0, low, z0, z1, 'ball', 'stripes', red, sides=10, top_radius=high,
                   lid=z1 > .45)


def _teddy(p):
    fur = np.array([0.72, 0.48, 0.26])
    p.cylinder(0, 0, .16, 0, .35, 'teddy', 'carpet', fur, top_radius=.13)
    p.cylinder(0, 0, .14, .35, .6, 'teddy', 'carpet', fur, top_radius=.12)
    for x in (-.1, .1):
        p.cylinder(x, 0, .05, .58, .68, 'teddy', 'carpet', fur * .8, sides=6)
        p.box(x * 2 - .05, x * 2 + .05, -.05, .1, .2, .3, 'teddy', 'carpet', fur, back=True,
              bottom=True)


def _vase(p):
    blue = np.array([0.2, 0.4, 0.85])
    p.cylinder(0, 0, .1, 0, .25, 'vase', 'marble', blue, sides=10, top_radius=.2, lid=False)
    p.cylinder(0, 0, .2, .25, .5, 'vase', 'marble', blue, sides=10, top_radius=.08, lid=False)
    p.cylinder(0, 0, .08, .5, .6, 'vase', 'marble', blue, sides=10, top_radius=.12)


def _suitcase(p):
    green = np.array([0.1, 0.5, 0.4])
    p.box(-.28, .28, -.12, .12, .03, .55, 'suitcase', 'corduroy', green, back=True, bottom=True)
    p.box(-.1, .1, -.02, .02, .55, .62, 'suitcase', 'plain', green * .3, back=True)
    p.box(-.2, -.15, -.125, .125, .03, .555, 'suitcase', 'plain', green * .3, back=True)
    p.box(.15, .2, -.125, .125, .03, .555, 'suitcase', 'plain', green * .3, back=True)


def _toy_car(p):
    yellow = np.array([0.95, 0.75, 0.1])
    p.box(-.32, .32, -.17, .17, .08, .25, 'toy_car', 'plain', yellow, back=True, bottom=True)
    p.box(-.16, .2, -.15, .15, .25, .42, 'toy_car', 'plain', np.array([.4, .6, .8]), back=True)
    for x in (-.2, .2):
        p.box(x - .08, x + .08, -.19, .19, 0, .16, 'toy_car', 'plain', np.full(3, .08), back=True)


def _book_pile(p):
    for k, colour in enumerate(((.6, .1, .2), (.1, .3, .6), (.8, .7, .2), (.2, .5, .2),
                                (.5, .2, .6))):
        shift = .03 * ((k * 7) % 3 - 1)
        p.box(-.2 + shift, .2 + shift, -.15, .15, .09 * k, .09 * (k + 1), 'book_pile', 'plain',
              np.array(colour), back=True)


def _basket(p):
    straw = np.array([0.8, 0.6, 0.3])
    p.cylinder(0, 0, .2, 0, .35, 'basket', 'weave', straw, sides=9, top_radius=.27, lid=False)
    p.cylinder(0, 0, .25, .3, .31, 'basket', 'fabric', np.array([.9, .9, .95]), sides=9)


def _apple(p):
    green = np.array([0.2, 0.85, 0.2])
    p.cylinder(0, 0, .12, .1, .25, 'apple', 'plain', green, top_radius=.22, lid=False, bottom=True)
    p.cylinder(0, 0, .22, .25, .42, 'apple', 'plain', green, top_radius=.12)
    p.cylinder(0, 0, .02, .42, .52, 'apple', 'wood', green * .4, sides=5)


def _lemon(p):
    yellow = np.array([1.0, 0.9, 0.1])
    p.cylinder(0, 0, .06, .08, .2, 'lemon', 'plain', yellow, top_radius=.18, lid=False,
               bottom=True)
    p.cylinder(0, 0, .18, .2, .36, 'lemon', 'plain', yellow, lid=False)
    p.cylinder(0, 0, .18, .36, .48, 'lemon', 'plain', yellow, top_radius=.06)


OBJECTS = {'ball': _ball, 'teddy': _teddy, 'vase': _vase, 'suitcase': _suitcase,
           'toy_car': _toy_car, 'book_pile': _book_pile, 'basket': _basket, 'apple': _apple,
           'lemon': _lemon}
GOAL_OBJECTS = ('ball', 'teddy', 'vase', 'suitcase', 'toy_car', 'book_pile', 'basket')


@functools.cache
def object_scene(name: str) -> Scene:
    """The scene of an object that stands on the floor at its origin.

    Raises:
        UserError: an unknown object.
    """
    if name not in OBJECTS:
        raise UserError(f'an object is one of {", ".join(OBJECTS)}', name, 'choose one of them')
    builder = SceneBuilder(texture_library())
    OBJECTS[name](Piece(builder, STANDARD, (0.0, 0.0), 0, 0, np.random.default_rng(1)))
    return builder.build()
