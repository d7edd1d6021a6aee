"""The texture library: small tiling pictures drawn by formula, the same for every house.

Houses vary by which textures they use and by the colours that multiply them. Each texture is kept
as a chain of halved pictures (mip-map), so that distant surfaces do not shimmer.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np

from vn_sim_bridge.scene import MIP_LEVELS, TEXTURE_SIZE

_SIZE = TEXTURE_SIZE
PAINTINGS = 32  # distinct pictures for walls


def _noise(rng: np.random.Generator, cells: int) -> np.ndarray:
    """Smooth tiling noise in [0,1], [S,S]."""
    grid = rng.random((cells, cells)).astype(np.float32)
    wrapped = np.pad(grid, 2, mode='wrap')
    scale = _SIZE // cells
    big = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.clip(big[2 * scale:2 * scale + _SIZE, 2 * scale:2 * scale + _SIZE], 0, 1)


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[:, :, None], 3, axis=2)


def _plain(rng) -> np.ndarray:
    return _grey(0.97 + 0.03 * _noise(rng, 16))


def _plaster(rng) -> np.ndarray:
    return _grey(0.88 + 0.08 * _noise(rng, 32) + 0.04 * _noise(rng, 8))


def _stripes(rng) -> np.ndarray:
    x = np.arange(_SIZE) % 16
    return _grey(np.where(x < 8, 1.0, 0.80)[None, :] * (0.97 + 0.03 * _noise(rng, 16)))


def _dots(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE] % 32
    dot = ((x - 8) ** 2 + (y - 8) ** 2 < 22) | ((x - 24) ** 2 + (y - 24) ** 2 < 22)
    return _grey(np.where(dot, 0.70, 1.0) * (0.96 + 0.04 * _noise(rng, 16)))


def _brick(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    row = y // 8
    joint = (y % 8 == 0) | ((x + 8 * (row % 2)) % 16 == 0)
    tone = rng.uniform(0.75, 1.0, (8, 5))[row, ((x + 8 * (row % 2)) // 16) % 4]
    return _grey(np.where(joint, 0.62, tone) * (0.92 + 0.08 * _noise(rng, 16)))


def _planks(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    board = y // 16
    shift = np.array([0, 24, 8, 40])[board]
    joint = (y % 16 == 0) | ((x + shift) % _SIZE == 0)
    tone = rng.uniform(0.78, 1.0, 4)[board]
    grain = 0.90 + 0.10 * np.sin(0.9 * y + 6 * _noise(rng, 4) + 0.05 * x)
    return _grey(np.where(joint, 0.55, tone * grain))


def _tiles(rng, checker: bool) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    joint = (x % 32 < 2) | (y % 32 < 2)
    tone = np.where(((x // 32) + (y // 32)) % 2 == 0, 1.0, 0.62 if checker else 0.94)
    return _grey(np.where(joint, 0.68, tone) * (0.95 + 0.05 * _noise(rng, 16)))


def _fabric(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    weave = 0.86 + 0.07 * ((x % 4 < 2) ^ (y % 4 < 2))
    return _grey(weave + 0.07 * _noise(rng, 8))


def _wood(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    return _grey(0.84 + 0.12 * np.sin(x * 2 * np.pi / 16 + 5 * _noise(rng, 4))
                 * (0.5 + 0.5 * _noise(rng, 8)))


def _marble(rng) -> np.ndarray:
    vein = np.abs(np.sin(6 * _noise(rng, 4) + 3 * _noise(rng, 8)))
    return _grey(0.74 + 0.26 * np.clip(vein * 1.5, 0, 1))


def _books(rng) -> np.ndarray:
    picture = np.full((_SIZE, _SIZE, 3), 0.25)
    for shelf in range(2):
        x = 0
        while x < _SIZE:
            width, height = int(rng.integers(3, 8)), int(rng.integers(20, 29))
            picture[shelf * 32 + 31 - height:shelf * 32 + 31, x:x + width - 1] = (
                rng.uniform(0.15, 1.0, 3))
            x += width
    return picture


def _window(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    sky = np.stack([0.72 + y / 300, 0.86 + y / 500, np.ones((_SIZE, _SIZE))], axis=2)
    hills = y > 44 + 6 * np.sin(x / 9)
    sky[hills] = (0.45, 0.62, 0.35)
    frame = (x < 4) | (x >= 60) | (y < 4) | (y >= 60) | (abs(x - 32) < 2)
    sky[frame] = 0.95
    return np.clip(sky, 0, 1)


def _doorleaf(rng) -> np.ndarray:
    y, x = np.mgrid[:_SIZE, :_SIZE]
    panel = (abs((x % 32) - 16) < 11) & (abs((y % 32) - 16) < 11)
    return _grey(np.where(panel, 0.82, 1.0))


def _leaves(rng) -> np.ndarray:
    return _grey(0.45 + 0.55 * _noise(rng, 16))


def _painting(rng) -> np.ndarray:
    """An abstract picture with a frame: what makes two rooms differ."""
    picture = np.ones((_SIZE, _SIZE, 3), np.float32) * rng.uniform(0.2, 1.0, 3)
    for _ in range(int(rng.integers(4, 9))):
        colour = tuple(float(c) for c in rng.uniform(0.0, 1.0, 3))
        a, b = (tuple(int(v) for v in rng.integers(4, _SIZE - 4, 2)) for _ in range(2))
        match int(rng.integers(3)):
            case 0:
                cv2.rectangle(picture, a, b, colour, -1)
            case 1:
                cv2.circle(picture, a, int(rng.integers(5, 22)), colour, -1)
            case _:
                cv2.line(picture, a, b, colour, int(rng.integers(3, 10)))
    frame = tuple(float(c) for c in rng.uniform(0.1, 0.5, 3))
    cv2.rectangle(picture, (0, 0), (_SIZE - 1, _SIZE - 1), frame, 5)
    return picture


_RECIPES = {
    'plain': _plain, 'plaster': _plaster, 'stripes': _stripes, 'dots': _dots, 'brick': _brick,
    'planks': _planks, 'tiles': lambda rng: _tiles(rng, False),
    'checker': lambda rng: _tiles(rng, True), 'fabric': _fabric, 'wood': _wood,
    'marble': _marble, 'books': _books, 'window': _window, 'door': _doorleaf, 'leaves': _leaves,
} | {f'painting_{i}': _painting for i in range(PAINTINGS)}

TEXTURES = {name: index for index, name in enumerate(_RECIPES)}


@functools.cache
def texture_library() -> np.ndarray:
    """All textures with their mip chains.

    Returns:
        [n_textures, texels, 3] uint8; a chain is 64 x 64, 32 x 32, ... one after another.
    """
    chains = []
    for index, recipe in enumerate(_RECIPES.values()):
        picture = recipe(np.random.default_rng(1000 + index)).astype(np.float32)
        levels = []
        for level in range(MIP_LEVELS):
            side = _SIZE >> level
            small = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
            levels.append(np.clip(small * 255, 0, 255).round().astype(np.uint8).reshape(-1, 3))
        chains.append(np.concatenate(levels))
    return np.stack(chains)
