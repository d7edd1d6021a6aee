"""How far a place is free along bearings: labels of views from depth pictures, without walls."""

from __future__ import annotations

import math

import numpy as np

from vn_nav.depth_ranges import least_ranges


def ranges_of_depth(depth: np.ndarray, cameras: np.ndarray, fov: np.ndarray, yaw: np.ndarray,
                    bearings: np.ndarray) -> np.ndarray:
    """Ranges to the nearest point at the height of a robot, [V,C] float32 m; NaN: nobody knows.

    A point belongs to the bearing whose tangent is nearest, within half a column.

    Args:
        depth: [V,S,S] float32 m along the optical axis, 0 where nothing is seen.
        cameras: [V,5] x, y, z [m], yaw (left), pitch (down) [rad]; fov: [V] rad, as of
            `vn_nav.co_visibility.lift`.
        yaw: [V] rad, nominal headings, which the bearings [V,C] are off, evenly in their tangents.
    """
    half = depth.shape[-1] / 2
    slopes = np.broadcast_to(np.tan(np.asarray(bearings, float)),
                             (len(depth), np.shape(bearings)[-1]))
    found = np.empty(slopes.shape, np.float32)
    for n, (_, _, height, camera_yaw, pitch) in enumerate(cameras):
        focal = half / math.tan(fov[n] / 2)
        found[n] = least_ranges(depth[n], focal, focal, half, half, height, pitch,
                                camera_yaw - yaw[n], np.ascontiguousarray(slopes[n]))
    return found
