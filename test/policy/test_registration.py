"""A goal picture's ranges, fitted to the map of a search."""

import math

import numpy as np
import pytest

from vn_nav.measured_ranges import laser_scan
from vn_nav.policy.search.grid import OccupancyGrid
from vn_nav.policy.search.hypotheses import Hypotheses, apart
from vn_nav.policy.search.look import BINS, RANGE_EDGES, column_bearings, range_classes
from vn_nav.policy.search.registration import Registration

BEARINGS = column_bearings(math.radians(90))
ROOM = np.array([-1.5, -1.0, 3.0, 2.0])  # left, bottom, right, top [m]
GOAL = np.array([1.2, 0.4, math.radians(20)])


def ranges_from(pose, bearings=BEARINGS):
    """To the walls of the room."""
    angles = pose[2] + bearings
    with np.errstate(divide='ignore'):
        ways = [np.where(d > 0, (high - at) / d, (low - at) / d) for d, at, low, high in (
            (np.cos(angles), pose[0], ROOM[0], ROOM[2]),
            (np.sin(angles), pose[1], ROOM[1], ROOM[3]))]
    return np.minimum(*ways)


def seen_from(pose):
    """Probabilities [C,BINS], sure of them."""
    return np.eye(BINS)[range_classes(ranges_from(pose))]


@pytest.fixture(scope='module')
def room():
    grid = OccupancyGrid(0.18)
    for x, y in ((0.0, 0.0), (1.5, 0.5)):
        for yaw in np.radians(np.arange(0, 360, 30)):
            pose = np.array([x, y, yaw])
            grid.add_ranges(pose, BEARINGS, seen_from(pose), RANGE_EDGES)
    return grid


@pytest.mark.parametrize('off', [(0.4, 0.3, 0.1), (-0.5, 0.2, -0.15), (0.0, 0.0, 0.0)])
def test_it_comes_nearer_to_where_the_picture_was_taken(room, off):
    found = Registration(BEARINGS, seen_from(GOAL)).fit(room, GOAL + off, 4.0)
    gap, turn = apart(found, GOAL)
    assert gap < 0.15 and turn < math.radians(8)


def test_a_measured_map_does_as_well():
    grid = OccupancyGrid(0.18)
    around = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    scan = laser_scan(ranges_from(np.zeros(3), around).astype(np.float32), -math.pi,
                      math.radians(1), 0.1, 12.0)
    grid.add_scan(np.zeros(3), scan, BEARINGS)
    found = Registration(BEARINGS, seen_from(GOAL)).fit(grid, GOAL + (0.4, 0.3, 0.1), 4.0)
    gap, turn = apart(found, GOAL)
    assert gap < 0.3 and turn < math.radians(8)


def test_floor_that_nobody_has_seen_says_nothing():
    voted = np.array([2.0, -1.0, 3.1])
    found = Registration(BEARINGS, seen_from(GOAL)).fit(OccupancyGrid(0.18), voted, 1.0)
    gap, turn = apart(found, voted)
    assert gap < 1e-6 and turn < 1e-6


def test_a_picture_that_shows_nothing_moves_nothing(room):
    found = Registration(BEARINGS, np.full((len(BEARINGS), BINS), 1 / BINS)).fit(room, GOAL, 1.0)
    assert np.hypot(*(found[:2] - GOAL[:2])) < 0.05


def test_a_sure_vote_is_moved_less(room):
    registration, voted = Registration(BEARINGS, seen_from(GOAL)), GOAL + (0.6, 0.0, 0.0)
    gaps = [apart(registration.fit(room, voted, precision), voted)[0]
            for precision in (0.5, 400.0)]
    assert gaps[0] > gaps[1]


def test_votes_stay_apart_from_what_the_map_says(room):
    hypotheses = Hypotheses()
    hypotheses.look(np.zeros(3), np.array([1.5, 0.4]), 0.4, np.array([1.0, 0.0]), 0.95)
    own, = hypotheses.all
    own.pose = Registration(BEARINGS, seen_from(GOAL)).fit(room, own.voted, own.precision)
    assert apart(own.pose, GOAL)[0] < apart(own.voted, GOAL)[0]
    hypotheses.look(np.zeros(3), np.array([1.5, 0.4]), 0.4, np.array([1.0, 0.0]), 0.95)
    assert own.voted == pytest.approx([1.5, 0.4, 0.0]), 'the same vote twice'
    told = hypotheses.suggest(np.array([1.5, 0.4, 0.0]), 1.0, 100.0)
    assert told is own and own.told
