"""Scans by REP 117, depth pictures as scans, and where a sensor sits."""

import math

import numpy as np
import pytest

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.measured_ranges import DEPTH_COLUMNS, DepthCamera, laser_scan

INF = math.inf


def test_numbers_outside_the_limits_mean_nothing_and_infinities_something():
    scan = laser_scan([1.0, 0.05, 9.0, INF, -INF, math.nan], -1.0, 0.4, 0.1, 8.0)
    assert np.array_equal(scan.ranges, np.float32([1.0, math.nan, math.nan, INF, -INF, math.nan]),
                          equal_nan=True)
    assert scan.scanner.bearings == pytest.approx(-1.0 + 0.4 * np.arange(6))


def test_a_scanner_that_turns_to_the_right_is_read_the_other_way_round():
    scan = laser_scan([1.0, 2.0, 3.0], 0.5, -0.5, 0.1, 8.0)
    assert scan.scanner.bearings == pytest.approx([-0.5, 0.0, 0.5])
    assert scan.ranges.tolist() == [3.0, 2.0, 1.0]


@pytest.mark.parametrize(('ranges', 'numbers', 'words'), [
    ([1.0], (0.0, 0.1, 0.1, 8.0), 'rays'),
    (np.ones((2, 2)), (0.0, 0.1, 0.1, 8.0), 'rays'),
    (np.ones(30_000), (0.0, 1e-4, 0.1, 8.0), 'rays'),
    ([1.0, 1.0], (math.nan, 0.1, 0.1, 8.0), 'finite'),
    ([1.0, 1.0], (0.0, 0.1, 0.1, INF), 'finite'),
    ([1.0, 1.0], (0.0, 0.1, 8.0, 0.1), 'least range'),
    ([1.0, 1.0], (0.0, 0.1, -0.1, 8.0), 'least range'),
    ([1.0, 1.0], (0.0, 0.0, 0.1, 8.0), 'full turn'),
    (np.ones(100), (0.0, 0.1, 0.1, 8.0), 'full turn')])
def test_what_no_scanner_says_is_refused(ranges, numbers, words):
    with pytest.raises(UserError, match=words):
        laser_scan(ranges, *numbers)


def test_a_scan_is_seen_from_where_the_robot_is_now():
    scan = laser_scan([1.0, 1.0], 0.0, 0.1, 0.1, 8.0, (0.2, 0.1, 0.3))
    # The robot stood a metre behind where it is now, turned to the left.
    mount = scan.seen_from(np.array([-1.0, 0.0, math.pi / 2])).scanner.mount
    assert mount[:2] == pytest.approx((-1.1, 0.2))
    assert wrap_angle(mount[2] - 0.3 - math.pi / 2) == pytest.approx(0.0)
    assert scan.scanner.mount == (0.2, 0.1, 0.3)


def depth_of_boxes(camera, height, width, boxes, farthest=20.0):
    """Depth [H,W] m of a floor and boxes [x0, x1, y0, y1, z0, z1], ray by ray."""
    depth = np.zeros((height, width), np.float32)
    cp, sp = math.cos(camera.pitch), math.sin(camera.pitch)
    for row in range(height):
        for column in range(width):
            down = (row + 0.5 - camera.centre[1]) / camera.focal[1]
            right = (column + 0.5 - camera.centre[0]) / camera.focal[0]
            way = np.array([cp - down * sp, -right, -(sp + down * cp)])  # for a metre of depth
            best = camera.height / -way[2] if way[2] < 0 else INF
            for box in boxes:
                low, high = np.array(box[::2]), np.array(box[1::2])
                at = np.array([0.0, 0.0, camera.height])
                with np.errstate(divide='ignore', invalid='ignore'):
                    a, b = (low - at) / way, (high - at) / way
                enter, leave = np.fmin(a, b).max(), np.fmax(a, b).min()
                if 0 < enter <= leave:
                    best = min(best, enter)
            depth[row, column] = best if best < farthest else 0
    return depth


@pytest.mark.parametrize('pitch', [0.0, 0.25])
def test_a_depth_picture_is_a_scan_of_what_is_as_high_as_the_robot(pitch):
    camera = DepthCamera((40.0, 40.0), (32.0, 24.0), 0.8, pitch)
    boxes = ([2.0, 2.5, 0.3, 3.0, 0.0, 0.5],  # to the left: a chest
             [1.5, 2.0, -3.0, -0.3, 1.5, 2.0],  # to the right, above the robot: a shelf
             [3.0, 3.1, -9.0, 9.0, 0.0, 2.5],  # a wall
             [1.2, 1.4, -0.2, 0.2, 0.0, 0.1])  # a threshold
    scan = camera.scan(depth_of_boxes(camera, 48, 64, boxes))
    across = np.tan(scan.scanner.bearings)
    ahead = scan.ranges * np.cos(scan.scanner.bearings)
    assert (np.diff(scan.scanner.bearings) > 0).all() and len(ahead) == 64
    left, right = across > 0.2, across < 0.1
    assert np.allclose(ahead[left], 2.0, atol=0.02) and np.allclose(ahead[right], 3.0, atol=0.02)


def test_a_wide_depth_picture_is_read_along_fewer_columns_and_an_unknown_one_says_nothing():
    camera = DepthCamera((300.0, 300.0), (320.5, 240.5), 1.0)
    scan = camera.scan(np.full((480, 640), 2.0, np.float32))
    assert len(scan.ranges) == DEPTH_COLUMNS
    assert np.allclose(scan.ranges * np.cos(scan.scanner.bearings), 2.0, atol=0.02)
    for nothing in (0.0, math.nan, 9.0):  # unknown, unknown, and farther than is believed
        assert np.isnan(camera.scan(np.full((480, 640), nothing, np.float32)).ranges).all()


def test_nearer_than_it_sees_the_floor_a_depth_camera_clears_none():
    level = DepthCamera.of_square(64, math.pi / 2, 1.0)
    assert level.scanner(64, 64).clear_from == pytest.approx(0.85)  # what is 0.15 m high
    assert DepthCamera.of_square(64, math.pi / 2, 1.0, 0.3).scanner(64, 64).clear_from < 0.5
    assert DepthCamera.of_square(64, math.pi / 2, 0.1).scanner(64, 64).clear_from == 0.0
    with pytest.raises(UserError, match='sees the floor ahead'):
        DepthCamera.of_square(64, 0.5, 1.0, -0.4).scanner(64, 64)
