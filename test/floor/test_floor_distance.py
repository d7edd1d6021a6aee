"""Distances over a floor, on its cells and off them."""

import math

import numpy as np
import pytest

from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, FloorMap


def test_behind_a_gap_that_cells_miss_the_way_to_the_nearest_cell_is_straight():
    """However far behind; a robot that is as narrow as the gap gets there."""
    free = np.zeros((40, 200), bool)
    free[:, :60] = True  # a room; on its right, solid by the cells, 7 m more
    distance = FloorDistance(FloorMap((1.0, 2.0), free), 2.0, 3.0)
    edge = np.array([[1.0 + 59.5 * CELL, 3.0]])
    for beyond in (0.3, 1.0, 3.0, 6.5):
        there = distance.at(edge + [[beyond, 0.0]])
        assert there == pytest.approx(distance.at(edge) + beyond, abs=CELL)


def test_where_no_cell_is_reached_there_is_no_way():
    walled = FloorDistance(FloorMap((0.0, 0.0), np.zeros((8, 8), bool)), 0.2, 0.2)
    assert walled.at(np.array([[0.2, 0.2]])) == [math.inf]
