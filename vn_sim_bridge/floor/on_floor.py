"""What every place with a floor map and rooms answers in the same way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import FloorMap, Room
from vn_sim_bridge.simulator import Goal


class OnFloor:
    """A place whose robots drive on `floor`, between `rooms`."""

    if TYPE_CHECKING:  # fields of some places, properties of others

        @property
        def floor(self) -> FloorMap:
            """Where a robot can stand."""

        @property
        def rooms(self) -> Sequence[Room]:
            """Rectangles of its rooms."""

    def geodesic(self, x: float, y: float) -> FloorDistance:
        """Shortest driving distance from anywhere to (x, y)."""
        return FloorDistance(self.floor, x, y)

    def distance_to(self, goal: Goal) -> FloorDistance:
        """Shortest driving distance from anywhere to a goal."""
        return self.geodesic(*goal.pose[:2])

    def starts(self) -> tuple[np.ndarray, None]:
        """Where episodes may begin, see `Place`: anywhere, facing anywhere."""
        return self.floor.centres(), None

    def room_at(self, x: float, y: float) -> str:
        """Name of the room that holds a point; '' inside walls and doors, or where none does."""
        for room in self.rooms:
            if room.rect.x0 <= x <= room.rect.x1 and room.rect.y0 <= y <= room.rect.y1:
                return room.name
        return ''
