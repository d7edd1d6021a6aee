"""Motion, contacts and distances of one robot in a house, for Warp's kernels."""

from __future__ import annotations

import math

import warp as wp

from vn_sim_bridge.floor.contacts import PRECISION, STEP
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.navigation.warp_state import Houses

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_f64 = wp.float64
_pi = wp.constant(wp.float64(math.pi))
_step = wp.constant(wp.float64(STEP))
_precision = wp.constant(wp.float64(PRECISION))
_cell = wp.constant(wp.float64(CELL))
_infinity = wp.constant(wp.float64(math.inf))


@wp.func
def wrap(angle: wp.float64):
    """To [-pi, pi)."""
    return angle - _f64(2.0) * _pi * wp.floor((angle + _pi) / (_f64(2.0) * _pi))


@wp.func
def collides(houses: Houses, house: int, x: wp.float64, y: wp.float64, radius: wp.float64):
    """As `contacts._collides`."""
    for m in range(houses.first_rect[house], houses.first_rect[house + 1]):
        dx = wp.max(wp.max(houses.rects[m, 0] - x, x - houses.rects[m, 2]), _f64(0.0))
        dy = wp.max(wp.max(houses.rects[m, 1] - y, y - houses.rects[m, 3]), _f64(0.0))
        if dx * dx + dy * dy < radius * radius:
            return True
    return False


@wp.func
def travel(houses: Houses, house: int, x: wp.float64, y: wp.float64, ux: wp.float64,
           uy: wp.float64, length: wp.float64, radius: wp.float64):
    """As `contacts._travel`."""
    free = _f64(0.0)
    while free < length:
        next_stop = wp.min(free + _step, length)
        if collides(houses, house, x + ux * next_stop, y + uy * next_stop, radius):
            low, high = free + _f64(0.0), next_stop + _f64(0.0)
            while high - low > _precision:
                middle = _f64(0.5) * (low + high)
                if collides(houses, house, x + ux * middle, y + uy * middle, radius):
                    high = middle
                else:
                    low = middle
            return low
        free = next_stop
    return length


@wp.func
def distance_at(houses: Houses, house: int, goal: int, px: wp.float64, py: wp.float64):
    """As `distance.interpolate`: bilinear, or from the nearest cells that know it [m]."""
    x = (px - houses.origin[house, 0]) / _cell - _f64(0.5)
    y = (py - houses.origin[house, 1]) / _cell - _f64(0.5)
    height, width = houses.maps.shape[1], houses.maps.shape[2]
    j, i = wp.int32(wp.floor(x)), wp.int32(wp.floor(y))
    if 0 <= i and i < height - 1 and 0 <= j and j < width - 1:
        a, b = houses.maps[goal, i, j], houses.maps[goal, i, j + 1]
        c, d = houses.maps[goal, i + 1, j], houses.maps[goal, i + 1, j + 1]
        if wp.max(wp.max(a, b), wp.max(c, d)) < wp.float32(1.0e30):
            u, v = x - _f64(j), y - _f64(i)
            one = _f64(1.0)
            return ((_f64(a) * (one - u) + _f64(b) * u) * (one - v)
                    + (_f64(c) * (one - u) + _f64(d) * u) * v)
    best = _infinity
    ring = int(2)
    while best == _infinity and ring < 2 * (height + width):
        for p in range(wp.max(0, i - ring), wp.min(height, i + ring + 2)):
            for q in range(wp.max(0, j - ring), wp.min(width, j + ring + 2)):
                value = houses.maps[goal, p, q]
                if value < wp.float32(1.0e30):
                    gx, gy = _f64(q) - x, _f64(p) - y
                    best = wp.min(best, _f64(value) + _cell * wp.sqrt(gx * gx + gy * gy))
        ring *= 2
    return best
