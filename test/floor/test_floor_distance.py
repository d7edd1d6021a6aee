"""Distances over a floor, on its cells and off them."""

import numpy as np
import pytest

from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, FloorMap
from vn_sim_bridge.navigation.goal_distances import FloorDistances

EDGE = 1.0 + 59.5 * CELL  # m


class Place:
    """A room; on its right, solid by the cells, 7 m more."""

    floor = FloorMap((1.0, 2.0), np.arange(200)[None] < np.full((40, 1), 60))


def test_a_robot_behind_a_gap_that_cells_miss_has_a_straight_way_to_the_nearest_cell():
    """However far behind: one that is as narrow as the gap got there."""
    own = FloorDistance(Place.floor, 2.0, 3.0)
    distances = FloorDistances([Place()], 1)
    distances.set(0, own)
    edge = own.at(np.array([[EDGE, 3.0]]))
    for beyond in (0.3, 2.0, 3.0, 6.5):
        poses = np.array([[EDGE + beyond, 3.0]])
        found = distances.at(np.zeros(1, np.int64), np.zeros(1, np.int64), poses)
        assert found == pytest.approx(edge + beyond, abs=CELL)
        # A place so far behind a wall is not reached.
        assert np.isfinite(own.at(poses)) == (beyond < 1.0)


def test_where_no_cell_is_reached_there_is_no_way():
    walled = FloorDistance(FloorMap((0.0, 0.0), np.zeros((8, 8), bool)), 0.2, 0.2)
    assert np.isinf(walled.at(np.array([[0.2, 0.2]])))
