"""A sequence of photographs with poses, depth and intrinsics, and pictures of it by other cameras.

A folder holds `images/*.jpg`, `depth/*.png` (uint16 mm, smaller by any whole factor), `K.txt` and
`poses.txt` (a row a picture, 4 x 4 camera to world, y up; axes right, down, ahead).
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np

from vn_nav.co_visibility import co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY

BLOCK = 3  # pixels of depth that one filled hole is wide
SUPERSAMPLING = 4  # of a picture's side, before it is averaged down
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera with square pictures that takes the place of the one that took the sequence.

    Attributes:
        fov: of the picture [rad], horizontal and vertical.
        cut: whether only the square of the photograph's shorter side is used.
        upright: whether roll is taken out, as of a camera on a robot.
        pitch: rad down that it looks; None: as the photograph.
        shown: how the pictures are changed, see `Sequence.pictures`.
    """

    fov: float
    cut: bool = False
    upright: bool = True
    pitch: float | None = None
    shown: str = 'plain'


class Sequence:
    """N photographs.

    Attributes:
        poses: [N,4] x, y [m], yaw (left), pitch (down) [rad].
        height: [N] m above any level.
        fov: [rad] horizontally; upright_fov: vertically.

    Raises:
        UserError: a folder that holds none.
    """

    def __init__(self, folder: Path):
        names = sorted((folder / 'images').glob('*.jpg'))
        if not names or not all((folder / name).exists() for name in ('K.txt', 'poses.txt')):
            raise UserError('a sequence has images/*.jpg, depth/*.png, K.txt and poses.txt',
                            str(folder), 'see the heading of bench/photo_sequence.py')
        self.images = np.stack([cv2.cvtColor(cv2.imread(str(name)), cv2.COLOR_BGR2RGB)
                                for name in names])
        self.intrinsics = np.loadtxt(folder / 'K.txt')
        world = np.loadtxt(folder / 'poses.txt').reshape(-1, 4, 4)
        self._turns = Z_UP @ world[:, :3, :3]  # [N,3,3] camera to map
        self._places = world[:, :3, 3] @ Z_UP.T
        ahead = self._turns[:, :, 2]
        self.poses = np.column_stack([
            self._places[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0]),
            -np.arcsin(ahead[:, 2] / np.linalg.norm(ahead, axis=1))])
        self.height = self._places[:, 2]
        depth = np.stack([cv2.imread(str(folder / 'depth' / f'{name.stem}.png'), -1)
                          for name in names]) / 1000.0
        height, width = self.images.shape[1:3]
        self.fov, self.upright_fov = (
            2 * math.atan(size / 2 / self.intrinsics[axis, axis])
            for axis, size in ((0, width), (1, height)))
        self._depth = self._squares(depth.astype(np.float32))

    def __len__(self) -> int:
        return len(self.images)

    def _squares(self, depth: np.ndarray) -> np.ndarray:
        """Depth [N,h,w] as of upright square cameras [N,w,w]; 0: unknown, or outside."""
        small = self.intrinsics.copy()
        small[:2] *= depth.shape[2] / self.images.shape[2]
        side = depth.shape[2]
        found = np.zeros((len(depth), side, side), np.float32)
        for n, own in enumerate(depth):
            found[n] = cv2.warpPerspective(
                own, self._homography(n, small, self.fov, side, None), (side, side),
                flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=0)
        return found

    def _homography(self, n: int, intrinsics: np.ndarray, fov: float, side: int,
                    pitch: float | None, upright: bool = True) -> np.ndarray:
        """From pixels of a square picture to those of photograph n."""
        focal = side / 2 / math.tan(fov / 2)
        middle = side / 2 - 0.5
        own = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
        turn = self._turns[n]
        if upright:
            yaw, down = self.poses[n, 2], self.poses[n, 3] if pitch is None else pitch
            c, s, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(down), math.sin(down)
            turn = np.array([[s, -sp * c, cp * c], [-c, -sp * s, cp * s], [0, -cp, -sp]])
        return intrinsics @ self._turns[n].T @ turn @ np.linalg.inv(own)

    def pictures(self, camera: Camera, size: int, chosen: np.ndarray) -> np.ndarray:
        """What a camera would have taken, [K,3,size,size] uint8; grey where nobody knows.

        `camera.shown`: 'plain'; 'standard': the mean and contrast of the training's pictures;
        'equal': adaptive histogram equalisation of the brightness; 'grey': without colour.
        """
        large = size * SUPERSAMPLING
        factor = 2 if self.images.shape[2] > large else 1
        shape = self.images.shape[2] // factor, self.images.shape[1] // factor
        small = self.intrinsics.copy()
        small[:2] /= factor
        small[:2, 2] += 0.5 / factor - 0.5
        found = np.empty((len(chosen), 3, size, size), np.uint8)
        for k, n in enumerate(chosen):
            photograph = _shown(self.images[n], camera.shown)
            photograph = cv2.resize(photograph, shape, interpolation=cv2.INTER_AREA)
            matrix = self._homography(n, small, camera.fov, large, camera.pitch, camera.upright)
            if camera.cut:
                edge = (shape[0] - shape[1]) // 2
                photograph[:, :edge] = photograph[:, shape[0] - edge:] = OUTSIDE_GREY
            wide = cv2.warpPerspective(
                photograph, matrix, (large, large),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=(OUTSIDE_GREY,) * 3)
            found[k] = cv2.resize(wide, (size, size), interpolation=cv2.INTER_AREA
                                  ).transpose(2, 0, 1)
        return found

    def overlaps(self, chosen: np.ndarray) -> np.ndarray:
        """True co-visibility [K,K]: share of the column's photograph that the row's shows.

        By depth: of the photographs themselves, whatever cameras take their place. Holes in the
        depth of the one that looks are filled from all the other photographs.
        """
        cameras = np.column_stack([self._places, self.poses[:, 2:]])
        fov = np.full(len(self), self.fov)
        points = lift(self._depth[chosen], cameras[chosen], fov[chosen])
        filled = self._filled(chosen, cameras)
        found = np.empty((len(chosen),) * 2, np.float32)
        for k, n in enumerate(chosen):
            same = np.full(len(chosen), k)
            found[k] = co_visible(points, filled[same], cameras[[n] * len(chosen)],
                                  fov[[n] * len(chosen)])
        return found

    def _filled(self, chosen: np.ndarray, cameras: np.ndarray) -> np.ndarray:
        """Depth of photographs, holes filled by the nearest of what all the others know there."""
        side = self._depth.shape[1]
        every = slice(None, None, BLOCK)
        focal = side / 2 / math.tan(self.fov / 2)
        slope = (np.arange(side)[every] + 0.5 - side / 2) / focal
        known = self._depth[:, every, every]
        n, row, column = np.nonzero(known)
        z = known[n, row, column]
        axes = _axes(cameras)
        cloud = cameras[n, :3] + z[:, None] * (
            axes[n, 0] + slope[column, None] * axes[n, 1] + slope[row, None] * axes[n, 2])
        _, first = np.unique(np.round(cloud / 0.03).astype(np.int64), axis=0, return_index=True)
        cloud = cloud[first]
        small = -(-side // BLOCK)
        found = self._depth[chosen].copy()
        inside = self._inside()
        for k, own in enumerate(chosen):
            seen = (cloud - cameras[own, :3]) @ axes[own].T  # ahead, right, down
            seen = seen[seen[:, 0] > 0.3]
            pixel = np.floor((seen[:, 1:] / seen[:, :1] * focal + side / 2) / BLOCK).astype(int)
            fits = ((pixel >= 0) & (pixel < small)).all(1)
            fill = np.full(small * small, np.inf)
            np.minimum.at(fill, pixel[fits, 1] * small + pixel[fits, 0], seen[fits, 0])
            fill[np.isinf(fill)] = 0
            wide = np.kron(fill.reshape(small, small), np.ones((BLOCK, BLOCK)))[:side, :side]
            hole = (found[k] == 0) & inside[own]
            found[k][hole] = wide[hole]
        return found

    def _inside(self) -> np.ndarray:
        """[N,w,w] bool: what of the square cameras' pictures the photographs show."""
        side = self._depth.shape[1]
        whole = np.ones((len(self), side * self.images.shape[1] // self.images.shape[2], side),
                        np.float32)
        return self._squares(whole) > 0

    def relative(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Poses [K,4] of photographs `other` as `one` see them, see `relative_pose`."""
        return relative_pose(self.poses[one], self.poses[other])


def _axes(cameras: np.ndarray) -> np.ndarray:
    """Ahead, right and down axes of cameras [N,5], [N,3,3]."""
    cy, sy, cp, sp = (f(cameras[:, k]) for k in (3, 4) for f in (np.cos, np.sin))
    return np.stack([np.stack([cp * cy, cp * sy, -sp], 1), np.stack([sy, -cy, 0 * cy], 1),
                     np.stack([-sp * cy, -sp * sy, -cp], 1)], 1)


def _shown(photograph: np.ndarray, how: str) -> np.ndarray:
    """A photograph [H,W,3] uint8, changed; a new array."""
    if how == 'standard':
        values = photograph.astype(np.float32)
        grey = values.mean(2)
        values = 120 + (values - grey.mean()) * (36 / max(float(grey.std()), 8.0))
        return np.clip(values, 0, 255).astype(np.uint8)
    if how == 'equal':
        lab = cv2.cvtColor(photograph, cv2.COLOR_RGB2LAB)
        lab[..., 0] = cv2.createCLAHE(2.0, (6, 4)).apply(lab[..., 0])
        return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)
    if how == 'grey':
        grey = cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY)
        return np.repeat(grey[..., None], 3, 2)
    return photograph.copy()
