"""Cameras as they are: what a policy sees is what a pinhole camera on the axis would show."""

import dataclasses
import math
import time

import cv2
import numpy as np
import pytest
from lens_pictures import (
    LENSES,
    MATRIX,
    SIZE,
    camera_info,
    line,
    photograph,
    pinhole,
    scene,
)

from vn_msgs_py.camera import intrinsics
from vn_msgs_py.image_error import ImageError
from vn_nav.calibration import assumed_calibration, is_rectified, read_calibration
from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY, preprocess, through_lens
from vn_nav.rectification import Camera

# Of 255: resampled twice, colours of 8 bits.
MEAN_ERROR, P99_ERROR = 1.0, 4.0


def camera_of(name, target=1.0, **more):
    model, d, matrix = LENSES[name]
    return Camera(read_calibration(camera_info(SIZE, matrix, model, d, **more)), target)


def difference(seen, wanted):
    """Of the pixels [3,S,S] that the lens reaches: mean and 99th percentile."""
    reached = (seen != OUTSIDE_GREY).any(0)
    assert reached.mean() > 0.9
    off = np.abs(seen.astype(int) - wanted).max(0)
    # Beside grey margins a pixel is half grey.
    reached = cv2.erode(reached.astype(np.uint8), np.ones((3, 3)), borderValue=1).astype(bool)
    return off[reached].mean(), np.quantile(off[reached], 0.99)


@pytest.mark.slow
@pytest.mark.parametrize('name', LENSES)
def test_the_policy_sees_what_a_pinhole_camera_shows(name):
    model, d, matrix = LENSES[name]
    picture, size, target = photograph(model, d, matrix), 84, math.radians(60)
    camera = camera_of(name)
    assert not camera.is_pinhole and camera.fov > target
    seen = preprocess(camera.rectify(picture), size, fov=camera.fov, target_fov=target)
    wanted = pinhole(4 * size, 4 * size, target)
    wanted = cv2.resize(wanted, (size, size), interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
    mean, high = difference(seen, wanted)
    assert mean < MEAN_ERROR and high < P99_ERROR, (mean, high)
    # Without it the same comparison fails.
    plain = 2 * math.atan(SIZE[1] / 2 / matrix[0, 0])
    raw = preprocess(picture, size, fov=max(plain, target), target_fov=target)
    assert np.abs(raw.astype(int) - wanted).mean() > 3 * MEAN_ERROR


@pytest.mark.slow
@pytest.mark.parametrize('name', ['barrel', 'rational', 'fisheye'])
def test_a_policy_that_searches_sees_the_same(name):
    model, d, matrix = LENSES[name]
    camera, size, target = camera_of(name), 64, math.radians(90)
    seen, zoom = through_lens(camera.rectify(photograph(model, d, matrix)), size, fov=camera.fov,
                              target_fov=target)
    across = 2 * math.atan(math.tan(target / 2) / zoom)
    wanted = cv2.resize(pinhole(4 * size, 4 * size, across), (size, size),
                        interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
    inner = slice(size // 4, -size // 4)  # above and below there is grey
    off = np.abs(seen.astype(int) - wanted)[:, inner, 2:-2]
    assert off.mean() < MEAN_ERROR and np.quantile(off, 0.99) < P99_ERROR + 2


def bend(picture):
    """How far the one bright line across a picture is off a straight one [pixels]."""
    bright = np.where(picture[..., 0] > OUTSIDE_GREY + 10, picture[..., 0], 0).astype(float)
    weight = bright.sum(0)
    columns = np.flatnonzero(weight > weight.max() / 2)[5:-5]
    rows = (np.arange(len(bright)) @ bright)[columns] / weight[columns]
    assert len(columns) > 300
    return np.abs(rows - np.polyval(np.polyfit(columns, rows, 1), columns)).max()


@pytest.mark.slow
@pytest.mark.parametrize('name', ['barrel', 'pincushion', 'rational', 'fisheye'])
@pytest.mark.parametrize('upright', [False, True])
def test_straight_lines_are_straight(name, upright):
    model, d, matrix = LENSES[name]
    picture = photograph(model, d, matrix, wall=lambda x, y: line(y, x) if upright else line(x, y))
    seen = camera_of(name).rectify(picture)
    if upright:
        picture, seen = picture.swapaxes(0, 1), seen.swapaxes(0, 1)
    assert bend(picture) > 2.5 and bend(seen) < 1.2, (bend(picture), bend(seen))


@pytest.mark.slow
def test_the_pixels_are_those_of_opencv():
    """Against `cv2.undistort` for a new camera matrix with its axis in the middle."""
    for name in ('barrel', 'rational'):
        model, d, matrix = LENSES[name]
        picture, camera = photograph(model, d, matrix), camera_of(name)
        ours = camera.rectify(picture)
        height, width = ours.shape[:2]
        new = np.array(intrinsics(width, height, camera.fov)[0]).reshape(3, 3)
        theirs = cv2.remap(picture, *cv2.initUndistortRectifyMap(
            matrix, np.array(d), np.eye(3), new, (width, height), cv2.CV_32FC1),
            cv2.INTER_LINEAR, borderValue=(OUTSIDE_GREY,) * 3)
        inner = slice(20, -20)
        assert np.abs(ours.astype(int) - theirs)[inner, inner].mean() < 1.0, name


def test_a_pinhole_camera_is_left_alone_to_the_last_bit():
    picture = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    for fov in (40, 60, 90):
        k, p = intrinsics(*SIZE, math.radians(fov))
        camera = Camera(read_calibration(camera_info(SIZE, k, d=(0.0,) * 5, p=p)))
        assert camera.is_pinhole and camera.fov == pytest.approx(math.radians(fov), rel=1e-12)
        assert camera.aspect == pytest.approx(4 / 3) and camera.rectify(picture) is picture
    # Only a focal length; a size of a quarter; hardly any distortion.
    alone = np.zeros(9)
    alone[0] = 320
    for model, d in (('', ()), ('plumb_bob', (1e-4, 0, 0, 0))):
        info = camera_info(SIZE, alone, model, d)
        camera = Camera(read_calibration(info))
        small = picture[::4, ::4]
        assert camera.is_pinhole and camera.rectify(small) is small


def test_a_lens_without_end_is_cut_where_policies_end():
    camera = camera_of('fisheye')
    assert math.degrees(camera.fov) == pytest.approx(120, abs=0.2)
    assert camera.aspect == pytest.approx(1.0, abs=0.01)
    picture = np.zeros((480, 640, 3), np.uint8)
    assert max(camera.rectify(picture).shape) < 2 * 640
    alone = np.zeros(9)
    alone[0] = 100  # a pinhole camera of 145 deg across and 135 down
    wide = Camera(read_calibration(camera_info(SIZE, alone)))
    picture = pinhole(*SIZE, 2 * math.atan(3.2))
    cut = wide.rectify(picture)
    assert math.degrees(wide.fov) == pytest.approx(120) and cut.shape[:2] == (346, 346)
    assert np.array_equal(cut, picture[67:-67, 147:-147])
    through_lens(cut, 64, fov=wide.fov, target_fov=math.radians(90))  # it is not too wide
    assert math.degrees(Camera(wide.calibration, math.radians(130)).fov) == pytest.approx(130)


@pytest.mark.slow
@pytest.mark.parametrize('scale', [0.5, 0.25])
def test_pictures_of_a_part_of_the_size(scale):
    """As a JPEG is decoded, and as drivers publish them: the same view."""
    model, d, matrix = LENSES['barrel']
    picture, camera = photograph(model, d, matrix), camera_of('barrel')
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    lens = {'fov': camera.fov, 'target_fov': math.radians(60)}
    one, other = (preprocess(camera.rectify(each), 48, **lens) for each in (picture, small))
    assert np.abs(one.astype(int) - other).mean() < 1.5
    assert camera.needed_side(48, math.radians(60)) >= 48


@pytest.mark.slow
def test_region_and_binning():
    model, d, matrix = LENSES['barrel']
    picture, whole = photograph(model, d, matrix), camera_of('barrel')
    lens = {'size': 48, 'target_fov': math.radians(40)}
    wanted = preprocess(whole.rectify(picture), fov=whole.fov, **lens)
    region = camera_of('barrel', region=(100, 40, 440, 400))
    part = picture[40:440, 100:540]
    seen = preprocess(region.rectify(part), fov=region.fov, **lens)
    assert region.fov < whole.fov and np.abs(seen.astype(int) - wanted).mean() < 1.0
    for binning in ((2, 2), (2, 1)):
        binned = camera_of('barrel', region=(100, 40, 440, 400), binning=binning)
        small = cv2.resize(part, (440 // binning[0], 400 // binning[1]),
                           interpolation=cv2.INTER_AREA)
        seen = preprocess(binned.rectify(small), fov=binned.fov, **lens)
        assert np.abs(seen.astype(int) - wanted).mean() < 1.5, binning
    with pytest.raises(ImageError, match='440 x 400'):
        region.rectify(picture[:, :480])
    with pytest.raises(UserError, match='region'):
        camera_of('barrel', region=(300, 0, 400, 480))


@pytest.mark.slow
def test_the_rotation_of_a_pair_is_undone():
    model, d, matrix = LENSES['barrel']
    rotation = cv2.Rodrigues(np.array([0.03, -0.05, 0.02]))[0]  # from the camera to the wall
    picture = photograph(model, d, matrix, rotation=rotation)
    camera = camera_of('barrel', r=rotation)
    seen = preprocess(camera.rectify(picture), 84, fov=camera.fov, target_fov=math.radians(50))
    wanted = cv2.resize(pinhole(336, 336, math.radians(50)), (84, 84),
                        interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
    assert np.abs(seen.astype(int) - wanted).mean() < MEAN_ERROR


def test_rectified_pictures_are_described_by_p():
    model, d, matrix = LENSES['barrel']
    p = [300.0, 0, 319.5, 0, 0, 300.0, 239.5, 0, 0, 0, 1, 0]
    camera = Camera(read_calibration(camera_info(SIZE, matrix, model, d, p=p), rectified=True))
    assert camera.is_pinhole and camera.fov == pytest.approx(2 * math.atan(0.8))
    for topic, known in (('/camera/image_rect', True), ('/c/image_rect_color/compressed', True),
                         ('/image_raw', False), ('/rectangle/image_raw', False)):
        assert is_rectified(topic) == known


def test_beyond_a_polynomials_turn_nothing_is_seen():
    """A barrel's polynomial turns back: mirrored pixels would be shown in the corners."""
    info = camera_info(SIZE, [[400.0, 0, 320], [0, 400, 240], [0, 0, 1]], 'plumb_bob',
                       (-0.55, 0.0, 0.0, 0.0))
    camera = Camera(read_calibration(info))
    white = np.full((480, 640, 3), 255, np.uint8)
    seen = camera.rectify(white)
    turn = math.sqrt(1 / (3 * 0.55))
    height, width = seen.shape[:2]
    focal = width / 2 / camera._half[0]
    y, x = np.mgrid[:height, :width]
    radius = np.hypot(x - (width - 1) / 2, y - (height - 1) / 2) / focal
    assert (radius > turn + 0.01).any() and (seen[radius > turn + 0.01] == OUTSIDE_GREY).all()


def test_depth_is_never_averaged():
    camera = camera_of('barrel')
    depth = np.where(np.arange(640) < 320, 1.0, 3.0).astype(np.float32)[None].repeat(480, 0)
    seen = camera.rectify(depth, nearest=True)
    assert set(np.unique(seen[np.isfinite(seen)])) == {1.0, 3.0} and np.isnan(seen).any()
    labels = camera.rectify(depth.astype(np.uint16), nearest=True)
    assert set(np.unique(labels)) == {0, 1, 3}


def test_an_uncalibrated_camera_is_none_or_what_is_assumed():
    zero = camera_info(SIZE, np.zeros(9))
    assert read_calibration(zero) is None
    camera = Camera(assumed_calibration(zero, math.radians(55)))
    assert camera.is_pinhole and math.degrees(camera.fov) == pytest.approx(55)
    assert assumed_calibration(camera_info((0, 0), np.zeros(9)), 1.0) is None


@pytest.mark.parametrize('change, word', [
    ({'model': 'kannala_brandt', 'd': (0.1,) * 4}, 'kannala_brandt'),
    ({'model': 'plumb_bob', 'd': (0.1,) * 8}, 'coefficients'),
    ({'model': 'plumb_bob', 'd': (math.nan,) * 5}, 'finite'),
    ({'model': 'plumb_bob', 'd': (1e300, 0, 0, 0, 0)}, 'calibrate'),
    ({'model': 'rational_polynomial', 'd': (0, 0, 0, 0, 0, 1e12, 0, 0)}, 'calibrate'),
    ({'r': 2 * np.eye(3)}, 'rotation'), ({'r': np.diag([1.0, -1, -1])}, 'rotation'),
    ({'matrix': [[math.nan] * 3] * 3}, 'camera sees'), ({'matrix': 1e-300 * MATRIX}, '180 deg'),
    ({'matrix': [[320.0, 0, -5], [0, 320, 240], [0, 0, 1]]}, 'axis'),
])
def test_what_is_no_camera_is_one_line(change, word):
    with pytest.raises(UserError) as caught:
        Camera(read_calibration(camera_info(**{'matrix': MATRIX, **change})))
    assert word in str(caught.value) and '\n' not in str(caught.value)


def test_a_lens_that_focuses_is_the_same_camera():
    one = read_calibration(camera_info(SIZE, MATRIX, 'plumb_bob', LENSES['barrel'][1]))
    assert one.is_near(dataclasses.replace(one, focal=(330.1, 331.1)))
    for change in ({'focal': (340.0, 341.0)}, {'width': 641}, {'distortion': ()},
                   {'model': 'equidistant'}, {'centre': (300.0, 236.0)}):
        assert not one.is_near(dataclasses.replace(one, **change))


def test_maps_are_made_once_for_a_size():
    camera, picture = camera_of('fisheye'), scene(*np.mgrid[0:1:480j, 0:1:640j])
    camera.rectify(picture)
    maps = dict(camera._maps)
    camera.rectify(picture[::-1])
    assert len(maps) == 1 and all(camera._maps[key] is value for key, value in maps.items())
    for k in range(10):  # a driver that changes its size all the time takes no more memory
        camera.rectify(cv2.resize(picture, (320 + 8 * k, 240 + 6 * k)))
    assert len(camera._maps) <= 4


def test_how_long_it_takes():
    """Printed, `pytest -s`: CPU time at 640 x 480, of a thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for name in LENSES:
            camera, picture = camera_of(name), np.zeros((480, 640, 3), np.uint8)
            begun = time.process_time()
            camera.rectify(picture)
            made = time.process_time()
            for _ in range(10):
                shape = camera.rectify(picture).shape
            took = (time.process_time() - made) / 10
            print(f'{name}: {1e3 * took:.1f} ms a picture, maps and the first one '
                  f'{1e3 * (made - begun):.0f} ms, {shape[1]} x {shape[0]}')
    finally:
        cv2.setNumThreads(threads)
