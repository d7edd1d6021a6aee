"""What a policy that searches keeps of a drive: key pictures, and a map by its own ranges."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import torch

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.lens import bearings_through
from vn_nav.policy.search.grid import CELL, MARGIN, MOST, OccupancyGrid
from vn_nav.policy.search.lens import in_metres
from vn_nav.policy.search.look import RANGE_EDGES, column_bearings
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.taught import MOST_SIDE, TaughtPlace
from vn_nav.policy.search.torch_eyes import TorchEyes

KEY_M, KEY_RAD = 0.3, math.radians(25)  # a key picture stands for views about so near
MOST_KEYS = 400  # beyond, key pictures are chosen farther apart
WIDER = 1.1  # times, until they are few enough
PLAIN = 8.0  # grey levels: a picture that varies less tells no place
BATCH = 64  # pictures
LANE_M = 0.15  # about where the robot's centre was: steps of a robot are not the joystick's


def choose_keys(pictures: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Rows [K] of pictures [N,3,S,S], poses [N,3], that stand for all: at most `MOST_KEYS`.

    Each other picture that shows something has one of them within `KEY_M` and `KEY_RAD`, or as
    much more as it takes.
    """
    rows = np.flatnonzero(pictures.mean(axis=1).std(axis=(1, 2)) >= PLAIN)
    wide = 1.0
    while True:
        kept: list[int] = []
        for row in rows:
            own = poses[kept] - poses[row]
            off = np.hypot(np.hypot(own[:, 0], own[:, 1]) / KEY_M, wrap_angle(own[:, 2]) / KEY_RAD)
            if not len(kept) or off.min() > wide:
                kept.append(int(row))
        if len(kept) <= MOST_KEYS:
            return np.array(kept, np.int64)
        wide *= WIDER


@torch.inference_mode()
def recall_drive(network: SearchPolicy, pictures: np.ndarray, poses: np.ndarray,
                 keys: np.ndarray, zoom: float = 1.0,
                 show: Callable[[float], None] = lambda share: None) -> TaughtPlace:
    """The place of a drive, its map drawn by what the policy sees on the way.

    Args:
        network: the policy.
        pictures: [N,3,S,S] uint8; poses: [N,3] x, y [m], yaw [rad].
        keys: rows of the key pictures.
        zoom: of the pictures' lens, see `vn_nav.policy.search.lens`.
        show: called with the share that is done.

    Raises:
        UserError: none of the pictures shows anything, or the drive is too wide for a map.
    """
    if not len(keys):
        raise UserError('pictures of a drive show something', 'plain ones alone',
                        'drive through a place with something to see')
    config, poses = network.config, np.array(poses, float)
    low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
    side = math.ceil((high - low).max() / CELL) + 2 * MARGIN + 2
    if side > MOST_SIDE:
        raise UserError(f'a place is at most {(MOST_SIDE - 2 * MARGIN) * CELL:.0f} m wide',
                        f'{(high - low).max():.0f} m', 'teach a part of the drive (--pictures)')
    grid = OccupancyGrid(config.footprint, side, (low + high) / 2)
    bearings = column_bearings(config.view)
    eyes = TorchEyes(network)
    goal = eyes.encode_goals(pictures[keys[:1]])  # any: ranges have none
    # By key pictures alone: of views so near one another the ranges err together, and many of them
    # would outvote the walls that others see.
    for start in range(0, len(keys), BATCH):
        show(start / len(keys))
        rows = keys[start:start + BATCH]
        look = in_metres(eyes.look(pictures[rows], np.repeat(goal, len(rows), axis=0)), bearings,
                         zoom)
        for pose, own in zip(poses[rows], np.exp(look.ranges), strict=True):
            grid.add_ranges(pose, bearings_through(bearings, zoom), own, RANGE_EDGES)
    for pose in poses:
        grid.add_footprint(pose)
    off = cv2.distanceTransform((~grid.been).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    lane = CELL * off <= LANE_M
    # The robot stood there, whatever its ranges say.
    log_odds = np.where(grid.stood, -MOST, grid.log_odds).astype(np.float32)
    seen = np.where(grid.stood, np.maximum(grid.seen, 1.0), grid.seen).astype(np.float32)
    inside = np.argwhere(seen > 0)
    (r0, c0), (r1, c1) = inside.min(axis=0), inside.max(axis=0) + 1
    layers = {name: np.ascontiguousarray(layer[r0:r1, c0:c1], np.float32)
              for name, layer in (('log_odds', log_odds), ('seen', seen), ('lane', lane))}
    return TaughtPlace(
        pictures=np.ascontiguousarray(pictures[keys]), poses=poses[keys].astype(np.float32),
        origin=(grid.origin + CELL * np.array([c0, r0])).astype(np.float32),
        zoom=np.array([zoom], np.float32), **layers)
