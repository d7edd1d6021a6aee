"""How two views of a place relate: the pose of one as the other sees it, and what both show.

Pure functions of poses, depth pictures and cameras. They are labels for learning and figures for
evaluation; no network is ever shown them. A leaf, because the simulator and learning from bags
label by it.
"""

from __future__ import annotations

import math

import numba
import numpy as np

# What poses alone say, see `co_visible_by_poses`.
NEAR = 1.0  # m driven between them
AHEAD = 5.0  # m that a goal straight ahead may be away
STRAIGHT = 1.1  # metres driven for each metre of the straight line
FAR = 6.0  # m of straight line
FAR_TURN = math.radians(60.0)
PAST_VIEW = math.radians(15.0)  # that a camera turns beyond its field of view
GRID = 8  # points across a goal picture, and down
FARTHEST = 12.0  # m: a point beyond is left out
TOLERANCE = 0.1  # share of its depth by which a point may disagree with the robot's picture,
SLACK = 0.05  # m, and this much more


def relative_pose(poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
    """Goal poses as robots see them.

    Args:
        poses: [N,4] x, y [m], yaw, pitch [rad] of the robots in the map frame.
        goal_poses: [N,4] of the goals' cameras.

    Returns:
        [N,4] float32: x forward, y left [m], cosine and sine of (goal yaw - robot yaw).
    """
    gap = goal_poses[:, :2] - poses[:, :2]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = goal_poses[:, 2] - poses[:, 2]
    return np.stack([c * gap[:, 0] + s * gap[:, 1], c * gap[:, 1] - s * gap[:, 0],
                     np.cos(turn), np.sin(turn)], axis=1).astype(np.float32)


def lift(depth: np.ndarray, cameras: np.ndarray, fov: np.ndarray) -> np.ndarray:
    """Points of the place that pictures show, on a grid of `GRID` x `GRID` pixels.

    Args:
        depth: [K,S,S] float32 m along the optical axis, 0 where nothing is seen.
        cameras: [K,5] x, y, z [m], yaw (left), pitch (down) [rad], as the renderer takes them.
        fov: [K] field of view [rad].

    Returns:
        [K,GRID^2,3] float32 m in the map frame; NaN without a surface or beyond `FARTHEST`.
    """
    size = depth.shape[-1]
    pixels = ((np.arange(GRID) + 0.5) * size / GRID).astype(np.int64)
    z = depth[:, pixels[:, None], pixels[None, :]].astype(np.float64)
    z[(z <= 0) | (z > FARTHEST)] = np.nan
    slope = (pixels + 0.5 - size / 2) / (size / 2 / np.tan(np.asarray(fov) / 2))[:, None]
    seen = np.stack([z, z * slope[:, None, :], z * slope[:, :, None]], axis=-1)
    points = np.einsum('kijc,kcd->kijd', seen, _axes(cameras)) + cameras[:, None, None, :3]
    return points.reshape(len(depth), -1, 3).astype(np.float32)


def co_visible(points: np.ndarray, depth: np.ndarray, cameras: np.ndarray,
               fov: np.ndarray) -> np.ndarray:
    """Share of some points that a picture shows too.

    A point counts as seen where it falls into the picture and its depth agrees with that of the
    picture, within `TOLERANCE` of it and `SLACK`: else something stands before it.

    Args:
        points: [N,P,3] m, as `lift` returns them, of the goals.
        depth: [N,S,S]; cameras: [N,5]; fov: [N]; as for `lift`, of the robots.

    Returns:
        [N] float32 in [0, 1]; 0 where there are no points.
    """
    size = depth.shape[-1]
    focal = size / 2 / np.tan(np.asarray(fov, float) / 2)
    return _co_visible(points, depth, np.ascontiguousarray(cameras[:, :3]), _axes(cameras),
                       np.ascontiguousarray(focal))


def co_visible_by_poses(goal_pose: np.ndarray, driven: np.ndarray, fov: float) -> np.ndarray:
    """Whether pictures show the same, as far as poses alone say so.

    1: no more than `NEAR` was driven between them and the headings differ by less than half a
    field of view; or the goal is ahead, within a third of the field of view as is its heading,
    and the robot drove there straight, so that nothing stands in between. 0: the robot stayed
    `NEAR` but turned by more than its field of view and `PAST_VIEW`; or they are `FAR` apart and
    turned by `FAR_TURN`. Else -1: walls decide, of which poses know nothing. Along shortest paths
    in validation houses 99.0 % of the ones share at least a tenth of the goal picture, and 95.7 %
    of the zeros do not (docs/method.md). Metres along the drive, because a straight line may pass
    through a wall; but a straight line for what is far, because a drive may come back.

    Args:
        goal_pose: [K,4] as of `relative_pose`.
        driven: [K] m between the two pictures.
        fov: of the camera [rad].

    Returns:
        [K] float32.
    """
    gap = np.hypot(goal_pose[:, 0], goal_pose[:, 1])
    bearing = np.abs(np.arctan2(goal_pose[:, 1], goal_pose[:, 0]))
    turn = np.abs(np.arctan2(goal_pose[:, 3], goal_pose[:, 2]))
    near = driven <= NEAR
    ahead = (gap <= AHEAD) & (driven <= STRAIGHT * gap) & (np.maximum(bearing, turn) <= fov / 3)
    shown = np.full(len(goal_pose), -1.0, np.float32)
    shown[(near & (turn <= fov / 2)) | ahead] = 1.0
    shown[(near & (turn >= fov + PAST_VIEW)) | ((gap >= FAR) & (turn >= FAR_TURN))] = 0.0
    return shown


def _axes(cameras: np.ndarray) -> np.ndarray:
    """Forward, right and down axes of cameras in the map frame, [K,3,3]."""
    cy, sy, cp, sp = (f(cameras[:, k]) for k in (3, 4) for f in (np.cos, np.sin))
    zero = np.zeros_like(cy)
    return np.stack([np.stack([cp * cy, cp * sy, -sp], axis=1), np.stack([sy, -cy, zero], axis=1),
                     np.stack([-sp * cy, -sp * sy, -cp], axis=1)], axis=1)


@numba.njit(cache=True)
def _co_visible(points, depth, origin, axes, focal):
    count, most = points.shape[:2]
    size = depth.shape[1]
    share = np.zeros(count, np.float32)
    for n in range(count):
        known, seen = 0, 0
        for p in range(most):
            if math.isnan(points[n, p, 0]):
                continue
            known += 1
            x, y, z = (points[n, p, 0] - origin[n, 0], points[n, p, 1] - origin[n, 1],
                       points[n, p, 2] - origin[n, 2])
            ahead = x * axes[n, 0, 0] + y * axes[n, 0, 1] + z * axes[n, 0, 2]
            if ahead <= 0.0:
                continue
            scale = focal[n] / ahead
            column = math.floor((x * axes[n, 1, 0] + y * axes[n, 1, 1]) * scale + 0.5 * size)
            row = math.floor((x * axes[n, 2, 0] + y * axes[n, 2, 1] + z * axes[n, 2, 2]) * scale
                             + 0.5 * size)
            if 0 <= column < size and 0 <= row < size:
                gap = abs(ahead - depth[n, int(row), int(column)])
                if gap <= TOLERANCE * ahead + SLACK:
                    seen += 1
        if known > 0:
            share[n] = seen / known
    return share
