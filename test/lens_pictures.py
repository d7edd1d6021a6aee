"""Pictures of a known scene through real lenses, by OpenCV's models: straight from the scene."""

import types

import cv2
import numpy as np

SIZE = 640, 480
MATRIX = np.array([[330.0, 0, 327.0], [0, 331.0, 236.0], [0, 0, 1]])
FISHEYE = np.array([[205.0, 0, 322.0], [0, 205.0, 238.0], [0, 0, 1]])
LENSES = {  # model, coefficients, matrix
    'barrel': ('plumb_bob', (-0.28, 0.07, 0.0008, -0.0005, -0.006), MATRIX),
    'pincushion': ('plumb_bob', (0.12, 0.03, -0.0006, 0.0007), MATRIX),
    'rational': ('rational_polynomial', (4.2, 1.6, 0.0004, -0.0002, 0.06, 4.5, 3.1, 0.35),
                 MATRIX),
    'fisheye': ('equidistant', (-0.02, 0.004, -0.002, 0.0003), FISHEYE),
    'off the middle': ('plumb_bob', (0.0,) * 5, np.array(
        [[330.0, 0, 343.0], [0, 330.0, 230.0], [0, 0, 1]])),
}


def camera_info(size=SIZE, matrix=MATRIX, model='plumb_bob', d=(), *, p=(0.0,) * 12,
                r=(0.0,) * 9, region=(0, 0, 0, 0), binning=(0, 0)):
    """A CameraInfo's fields."""
    roi = types.SimpleNamespace(x_offset=region[0], y_offset=region[1], width=region[2],
                                height=region[3], do_rectify=False)
    return types.SimpleNamespace(
        width=size[0], height=size[1], k=np.asarray(matrix, float).ravel().tolist(), d=list(d),
        distortion_model=model, p=list(p), r=list(np.ravel(r)), roi=roi, binning_x=binning[0],
        binning_y=binning[1])


def scene(x, y):
    """The colours [...,3] uint8 of a wall one metre ahead, x to the right and y down [m]."""
    waves = [np.sin(5 * x + 1) * np.cos(4 * y), np.sin(3 * x * y + 2 * x), np.cos(6 * y - x)]
    return (np.stack(waves, -1) * 90 + 128).astype(np.uint8)


def line(_, y):
    """A white line on black, 0.03 m wide, 0.35 m below the axis."""
    return np.repeat((np.abs(y - 0.35) < 0.015)[..., None] * np.uint8(255), 3, -1)


def photograph(model, d, matrix, size=SIZE, wall=scene, rotation=None):
    """The wall [H,W,3] through a lens: each pixel's ray, undistorted by OpenCV.

    Args:
        rotation: [3,3] from the camera's frame to the wall's.
    """
    width, height = size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    pixels = pixels.reshape(-1, 1, 2).astype(float)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-8)
    if model == 'equidistant':
        rays = cv2.fisheye.undistortPoints(pixels, matrix, np.array(d), criteria=stop)
    elif hasattr(cv2, 'undistortPointsIter'):  # OpenCV 4
        rays = cv2.undistortPointsIter(pixels, matrix, np.array(d), None, None, stop)
    else:
        rays = cv2.undistortPoints(pixels, matrix, np.array(d), criteria=stop)
    rays = np.column_stack([rays[:, 0], np.ones(len(pixels))])
    if rotation is not None:
        rays = rays @ np.transpose(rotation)
    return wall(*(rays[:, :2] / rays[:, 2:]).T).reshape(height, width, 3)


def pinhole(width, height, fov_across, wall=scene):
    """The wall [H,W,3] as a pinhole camera on the axis shows it."""
    focal = width / 2 / np.tan(fov_across / 2)
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return photograph('plumb_bob', (0.0,) * 4, matrix, (width, height), wall)
