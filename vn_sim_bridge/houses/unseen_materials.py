"""Materials of the unseen look alone, drawn as in `materials`."""

from __future__ import annotations

import cv2
import numpy as np

from vn_sim_bridge.houses.materials import SIDE, grey, noise


def _herringbone(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    diagonal = np.where((x // 16) % 2 == 0, x + y, y - x) % 16
    tone = 0.78 + 0.22 * (((np.where((x // 16) % 2 == 0, x + y, y - x)) // 16) % 4) / 3
    return grey(np.where((diagonal < 1) | (x % 16 == 0), 0.55, tone))


def _cork(rng) -> np.ndarray:
    return grey(np.where(rng.random((SIDE, SIDE)) < 0.16, 0.62, 0.95)
                * (0.88 + 0.12 * noise(rng, 16)))


def _diamonds(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    inside = (abs(x % 32 - 16) + abs(y % 32 - 16)) < 14
    return grey(np.where(inside, 0.68, 1.0) * (0.95 + 0.05 * noise(rng, 16)))


def _hexagons(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    nearest = np.full((2, SIDE, SIDE), 1e9)
    for i in range(-1, 6):
        for j in range(-1, 6):
            d = np.hypot(x - (16 * i + 8 * (j % 2)), y - 64 / 4 * j)
            nearest = np.sort(np.concatenate([nearest, d[None]]), axis=0)[:2]
    return grey(np.where(nearest[1] - nearest[0] < 1.6, 0.6, 0.96))


def _terrazzo(rng) -> np.ndarray:
    picture = np.ones((SIDE, SIDE, 3)) * 0.9
    for _ in range(110):
        centre = tuple(int(v) for v in rng.integers(0, SIDE, 2))
        cv2.circle(picture, centre, int(rng.integers(1, 4)),
                   tuple(float(c) for c in rng.uniform(0.35, 1.0, 3)), -1)
    return picture


def _concrete(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    joint = (x % 64 == 0) | (y % 32 == 0)
    return grey(np.where(joint, 0.7, 0.78 + 0.22 * noise(rng, 8)))


def _damask(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] * (2 * np.pi / 32)
    return grey(np.where(np.sin(x) * np.cos(y) + 0.6 * np.cos(2 * x + np.sin(y)) > 0.15, 0.74,
                         1.0))


def _bands(rng) -> np.ndarray:
    y = np.arange(SIDE) % 32
    return grey(np.repeat(np.where(y < 11, 0.72, np.where(y < 14, 0.5, 1.0))[:, None], SIDE, 1))


def _panels(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    edge = (abs(abs((x % 32) - 16) - 11) < 1) | (abs(abs((y % 64) - 32) - 26) < 1)
    return grey(np.where(edge, 0.66, 0.97))


def _plaid(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    return grey(0.62 + 0.19 * (x % 16 < 9) + 0.19 * (y % 16 < 9))


def _corduroy(rng) -> np.ndarray:
    x = np.arange(SIDE) % 4
    return grey(np.repeat((0.72 + 0.09 * x)[None, :], SIDE, 0))


def _rings(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] % 32 - 15.5
    return grey(np.where((np.hypot(x, y) // 4) % 2 > 0, 0.66, 1.0))


def _knotty(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    grain = 0.86 + 0.10 * np.sin(y * 2 * np.pi / 8 + 4 * noise(rng, 4))
    for _ in range(5):
        cx, cy = rng.integers(8, 56, 2)
        grain = np.where(np.hypot(x - cx, 2 * (y - cy)) < 4, 0.45, grain)
    return grey(grain)


def _louvre(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    return grey(np.where((x < 5) | (x > 58) | (y < 4) | (y > 59), 1.0, 0.6 + 0.09 * (y % 5)))


def _grooves(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    picture = np.where(x % 10 < 2, 0.6, 1.0)
    picture[(y > 28) & (y < 36) & (x > 52)] = 0.25
    return grey(picture)


UNSEEN_MATERIALS = {
    'herringbone': _herringbone, 'cork': _cork, 'diamonds': _diamonds, 'hexagons': _hexagons,
    'terrazzo': _terrazzo, 'concrete': _concrete, 'damask': _damask, 'bands': _bands,
    'panels': _panels, 'plaid': _plaid, 'corduroy': _corduroy, 'rings': _rings, 'knotty': _knotty,
    'louvre': _louvre, 'grooves': _grooves,
}
