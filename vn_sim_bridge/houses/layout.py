"""Floor plans: one or two rectangular wings split into rooms, and the doors that join them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vn_sim_bridge.floor.floor_map import Rect

WALL = 0.12  # m, thickness of inner and outer walls
DOOR_WIDTH = 0.95  # m
MIN_SIDE = 2.9  # m, least side of a room between wall centres


class Door(NamedTuple):
    """An opening in the wall between two rooms.

    `axis` 0: the wall runs along x at y = `at`; 1: along y at x = `at`. The opening spans
    [`low`, `high`] along the wall. Room `first` lies on the smaller side.
    """

    axis: int
    at: float
    low: float
    high: float
    first: int
    second: int


class Contact(NamedTuple):
    """A stretch of wall that two rooms share; fields as in `Door`."""

    axis: int
    at: float
    low: float
    high: float
    first: int
    second: int


def split(outline: Rect, rooms: int, rng: np.random.Generator) -> list[Rect]:
    """Split a rectangle into `rooms` rectangles of similar area, none thinner than `MIN_SIDE`."""
    if rooms == 1:
        return [outline]
    width, depth = outline.x1 - outline.x0, outline.y1 - outline.y0
    fewer = rooms // 2 if rooms % 2 == 0 or rng.random() < 0.5 else rooms - rooms // 2
    share = np.clip(fewer / rooms + rng.uniform(-0.07, 0.07), 0.15, 0.85)
    along_x = width * rng.uniform(0.85, 1.15) > depth
    length = width if along_x else depth
    cut = float(np.clip(length * share, min(MIN_SIDE, length / 2),
                        max(length - MIN_SIDE, length / 2)))
    if along_x:
        halves = (outline._replace(x1=outline.x0 + cut), outline._replace(x0=outline.x0 + cut))
    else:
        halves = (outline._replace(y1=outline.y0 + cut), outline._replace(y0=outline.y0 + cut))
    return split(halves[0], fewer, rng) + split(halves[1], rooms - fewer, rng)


def contacts(rooms: list[Rect]) -> list[Contact]:
    """All stretches of wall between two rooms."""
    found = []
    for i, a in enumerate(rooms):
        for j, b in enumerate(rooms):
            if abs(a.y1 - b.y0) < 1e-6:
                low, high = max(a.x0, b.x0), min(a.x1, b.x1)
                if high - low > 1e-6:
                    found.append(Contact(0, a.y1, low, high, i, j))
            if abs(a.x1 - b.x0) < 1e-6:
                low, high = max(a.y0, b.y0), min(a.y1, b.y1)
                if high - low > 1e-6:
                    found.append(Contact(1, a.x1, low, high, i, j))
    return found


def place_doors(rooms: list[Rect], rng: np.random.Generator,
                loop_probability: float = 0.4) -> list[Door] | None:
    """Doors along a random spanning tree of the rooms, plus some that close loops.

    Returns:
        The doors, or None when no set of doors joins all rooms.
    """
    margin = WALL / 2 + 0.25
    candidates = [c for c in contacts(rooms) if c.high - c.low >= DOOR_WIDTH + 2 * margin]
    candidates = [candidates[i] for i in rng.permutation(len(candidates))]
    component = list(range(len(rooms)))
    doors = []
    for contact in candidates:
        joins = component[contact.first] != component[contact.second]
        if not joins and rng.random() >= loop_probability:
            continue
        old, new = component[contact.second], component[contact.first]
        component = [new if c == old else c for c in component]
        low = rng.uniform(contact.low + margin, contact.high - margin - DOOR_WIDTH)
        doors.append(Door(contact.axis, contact.at, low, low + DOOR_WIDTH,
                          contact.first, contact.second))
    return doors if len(set(component)) == 1 else None


def wings(rooms: int, area: float, rng: np.random.Generator, count: int) -> list[list[Rect]]:
    """The rooms of each wing; a second wing stands at the east or north side of the first.

    Args:
        rooms: in all; area: mean area of a room [m^2]; count: 1 or 2 wings.
    """
    first = rooms if count == 1 else rooms - max(1, round(rooms * rng.uniform(0.3, 0.45)))
    size = first * area * rng.uniform(0.95, 1.15)
    aspect = rng.uniform(0.75, 1.35)
    main = Rect(0.0, 0.0, math.sqrt(size * aspect), math.sqrt(size / aspect))
    found = [split(main, first, rng)]
    if count == 2:
        size = (rooms - first) * area * rng.uniform(0.95, 1.15)
        along = max(MIN_SIDE, math.sqrt(size * rng.uniform(0.6, 1.2)))
        east = rng.random() < 0.5
        side = main.y1 if east else main.x1
        along = min(along, side - 1.0)  # a wing as long as the house would be no wing
        deep = max(MIN_SIDE, size / along)
        start = 0.0 if rng.random() < 0.5 else side - along
        wing = (Rect(main.x1, start, main.x1 + deep, start + along) if east
                else Rect(start, main.y1, start + along, main.y1 + deep))
        found.append(split(wing, rooms - first, rng))
    return found


def bounds(rects: list[Rect]) -> Rect:
    """The smallest rectangle around some."""
    return Rect(min(r.x0 for r in rects), min(r.y0 for r in rects), max(r.x1 for r in rects),
                max(r.y1 for r in rects))


def outside(outline: Rect, parts: list[Rect]) -> list[Rect]:
    """What of the outline no wing covers, as rectangles."""
    xs = sorted({r.x0 for r in [outline, *parts]} | {r.x1 for r in [outline, *parts]})
    ys = sorted({r.y0 for r in [outline, *parts]} | {r.y1 for r in [outline, *parts]})
    cells = [Rect(x0, y0, x1, y1) for x0, x1 in zip(xs, xs[1:], strict=False)
             for y0, y1 in zip(ys, ys[1:], strict=False)]
    return [c for c in cells if c.area > 1e-6 and not any(
        r.x0 - 1e-6 <= c.x0 and c.x1 <= r.x1 + 1e-6 and r.y0 - 1e-6 <= c.y0
        and c.y1 <= r.y1 + 1e-6 for r in parts)]


def wall_obstacles(rooms: list[Rect], doors: list[Door]) -> list[Rect]:
    """The footprint of every wall, with the doors left open."""
    half = WALL / 2
    found = []
    for x0, y0, x1, y1 in rooms:  # outer walls are walls of one room, inner ones of two
        for axis, at, low, high in ((0, y0, x0, x1), (0, y1, x0, x1), (1, x0, y0, y1),
                                    (1, x1, y0, y1)):
            openings = sorted((d.low, d.high) for d in doors if d.axis == axis
                              and abs(d.at - at) < 1e-6 and d.low < high and low < d.high)
            edges = [low - half, *(edge for opening in openings for edge in opening), high + half]
            for start, end in zip(edges[::2], edges[1::2], strict=True):
                found.append(Rect(start, at - half, end, at + half) if axis == 0
                             else Rect(at - half, start, at + half, end))
    return sorted(set(found))
