"""Places of simulators that know a floor, walls or rooms: what a `House` has beside a `Place`.

The kinds are structural: a place of a new simulator is one of them by having the names.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.floor.floor_map import FloorMap, Rect, Room
from vn_sim_bridge.simulator import Place


@runtime_checkable
class FloorPlace(Place, Protocol):
    """A place with a floor map."""

    @property
    def floor(self) -> FloorMap:
        """Where the robot can stand."""


@runtime_checkable
class WalledPlace(FloorPlace, Protocol):
    """A place of a simulator with `capabilities.walls`."""

    @property
    def obstacles(self) -> Sequence[tuple[Rect, str]]:
        """What a robot cannot drive through, and what it is."""

    @property
    def obstacle_rects(self) -> np.ndarray:
        """[M,4] float64: x0, y0, x1, y1 [m] of every obstacle."""


@runtime_checkable
class RoomPlace(FloorPlace, Protocol):
    """A place of a simulator with `capabilities.rooms`."""

    @property
    def rooms(self) -> Sequence[Room]:
        """Their names, types and floors."""


def have_floors(places: Sequence[Place]) -> TypeGuard[Sequence[FloorPlace]]:
    """Whether all places have a floor map."""
    return all(getattr(place, 'floor', None) is not None for place in places)


def walled(place: Place) -> WalledPlace:
    """The place, of which walls are asked.

    Raises:
        UserError: it has none.
    """
    if not isinstance(place, WalledPlace):
        raise UserError('a place of a simulator that knows walls has floor, obstacles and '
                        'obstacle_rects', place.name, 'add them, or declare walls=False')
    return place


def with_rooms(place: Place) -> RoomPlace:
    """The place, of which rooms are asked.

    Raises:
        UserError: it has none.
    """
    if not isinstance(place, RoomPlace):
        raise UserError('a place of a simulator that knows rooms has rooms and floor', place.name,
                        'add them, or declare rooms=False')
    return place
