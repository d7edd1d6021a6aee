"""Floor plans: a rectangle split into rooms, and the doors that join them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

WALL = 0.12  # m, thickness of inner and outer walls
DOOR_WIDTH = 0.95  # m
MIN_SIDE = 2.9  # m, least side of a room between wall centres


class Rect(NamedTuple):
    """An axis-aligned rectangle [m]."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def area(self) -> float:
        """In square metres."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


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


def wall_obstacles(outline: Rect, rooms: list[Rect], doors: list[Door]) -> list[Rect]:
    """The footprint of every wall, with the doors left open."""
    half = WALL / 2
    found = [
        Rect(outline.x0 - half, outline.y0 - half, outline.x1 + half, outline.y0 + half),
        Rect(outline.x0 - half, outline.y1 - half, outline.x1 + half, outline.y1 + half),
        Rect(outline.x0 - half, outline.y0 - half, outline.x0 + half, outline.y1 + half),
        Rect(outline.x1 - half, outline.y0 - half, outline.x1 + half, outline.y1 + half),
    ]
    for contact in contacts(rooms):
        openings = [d for d in doors if (d.first, d.second) == (contact.first, contact.second)
                    and d.axis == contact.axis]
        edges = [contact.low - half]
        for door in sorted(openings, key=lambda d: d.low):
            edges += [door.low, door.high]
        edges.append(contact.high + half)
        for low, high in zip(edges[::2], edges[1::2], strict=True):
            if contact.axis == 0:
                found.append(Rect(low, contact.at - half, high, contact.at + half))
            else:
                found.append(Rect(contact.at - half, low, contact.at + half, high))
    return found
