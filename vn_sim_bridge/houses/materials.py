"""Materials of the usual looks, each a small tiling picture [S,S,3] in [0,1] drawn by formula."""

from __future__ import annotations

import cv2
import numpy as np

SIDE = 64  # texels


def noise(rng: np.random.Generator, cells: int) -> np.ndarray:
    """Smooth tiling noise in [0,1], [S,S]."""
    grid = rng.random((cells, cells)).astype(np.float32)
    wrapped = np.pad(grid, 2, mode='wrap')
    scale = SIDE // cells
    big = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.clip(big[2 * scale:2 * scale + SIDE, 2 * scale:2 * scale + SIDE], 0, 1)


def grey(values: np.ndarray) -> np.ndarray:
    """Grey values [S,S] as a picture [S,S,3]."""
    return np.repeat(values[:, :, None], 3, axis=2)


def _plain(rng) -> np.ndarray:
    return grey(0.97 + 0.03 * noise(rng, 16))


def _plaster(rng) -> np.ndarray:
    return grey(0.88 + 0.08 * noise(rng, 32) + 0.04 * noise(rng, 8))


def _stripes(rng) -> np.ndarray:
    x = np.arange(SIDE) % 16
    return grey(np.where(x < 8, 1.0, 0.80)[None, :] * (0.97 + 0.03 * noise(rng, 16)))


def _dots(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] % 32
    dot = ((x - 8) ** 2 + (y - 8) ** 2 < 22) | ((x - 24) ** 2 + (y - 24) ** 2 < 22)
    return grey(np.where(dot, 0.70, 1.0) * (0.96 + 0.04 * noise(rng, 16)))


def _brick(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    row = y // 8
    joint = (y % 8 == 0) | ((x + 8 * (row % 2)) % 16 == 0)
    tone = rng.uniform(0.75, 1.0, (8, 5))[row, ((x + 8 * (row % 2)) // 16) % 4]
    return grey(np.where(joint, 0.62, tone) * (0.92 + 0.08 * noise(rng, 16)))


def _planks(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    board = y // 16
    shift = np.array([0, 24, 8, 40])[board]
    joint = (y % 16 == 0) | ((x + shift) % SIDE == 0)
    tone = rng.uniform(0.78, 1.0, 4)[board]
    grain = 0.90 + 0.10 * np.sin(0.9 * y + 6 * noise(rng, 4) + 0.05 * x)
    return grey(np.where(joint, 0.55, tone * grain))


def _tiles(rng, checker: bool) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    joint = (x % 32 < 2) | (y % 32 < 2)
    tone = np.where(((x // 32) + (y // 32)) % 2 == 0, 1.0, 0.62 if checker else 0.94)
    return grey(np.where(joint, 0.68, tone) * (0.95 + 0.05 * noise(rng, 16)))


def _fabric(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    weave = 0.86 + 0.07 * ((x % 4 < 2) ^ (y % 4 < 2))
    return grey(weave + 0.07 * noise(rng, 8))


def _wood(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    return grey(0.84 + 0.12 * np.sin(x * 2 * np.pi / 16 + 5 * noise(rng, 4))
                * (0.5 + 0.5 * noise(rng, 8)))


def _marble(rng) -> np.ndarray:
    vein = np.abs(np.sin(6 * noise(rng, 4) + 3 * noise(rng, 8)))
    return grey(0.74 + 0.26 * np.clip(vein * 1.5, 0, 1))


def _books(rng) -> np.ndarray:
    picture = np.full((SIDE, SIDE, 3), 0.25)
    for shelf in range(2):
        x = 0
        while x < SIDE:
            width, height = int(rng.integers(3, 8)), int(rng.integers(20, 29))
            picture[shelf * 32 + 31 - height:shelf * 32 + 31, x:x + width - 1] = (
                rng.uniform(0.15, 1.0, 3))
            x += width
    return picture


def _window(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    sky = np.stack([0.72 + y / 300, 0.86 + y / 500, np.ones((SIDE, SIDE))], axis=2)
    hills = y > 44 + 6 * np.sin(x / 9)
    sky[hills] = (0.45, 0.62, 0.35)
    frame = (x < 4) | (x >= 60) | (y < 4) | (y >= 60) | (abs(x - 32) < 2)
    sky[frame] = 0.95
    return np.clip(sky, 0, 1)


def _doorleaf(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    panel = (abs((x % 32) - 16) < 11) & (abs((y % 32) - 16) < 11)
    return grey(np.where(panel, 0.82, 1.0))


def _leaves(rng) -> np.ndarray:
    return grey(0.45 + 0.55 * noise(rng, 16))


def painting(rng) -> np.ndarray:
    """An abstract picture with a frame: what makes two rooms differ."""
    picture = np.ones((SIDE, SIDE, 3), np.float32) * rng.uniform(0.2, 1.0, 3)
    for _ in range(int(rng.integers(4, 9))):
        colour = tuple(float(c) for c in rng.uniform(0.0, 1.0, 3))
        a, b = (tuple(int(v) for v in rng.integers(4, SIDE - 4, 2)) for _ in range(2))
        match int(rng.integers(3)):
            case 0:
                cv2.rectangle(picture, a, b, colour, -1)
            case 1:
                cv2.circle(picture, a, int(rng.integers(5, 22)), colour, -1)
            case _:
                cv2.line(picture, a, b, colour, int(rng.integers(3, 10)))
    frame = tuple(float(c) for c in rng.uniform(0.1, 0.5, 3))
    cv2.rectangle(picture, (0, 0), (SIDE - 1, SIDE - 1), frame, 5)
    return picture


def _parquet(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    across = ((x // 16) + (y // 16)) % 2 == 0
    along = np.where(across, x, y)
    joint = (along % 4 == 0) | (x % 16 == 0) | (y % 16 == 0)
    tone = rng.uniform(0.76, 1.0, (4, 4))[y // 16, x // 16]
    return grey(np.where(joint, 0.74, 1.0) * tone * (0.94 + 0.06 * noise(rng, 16)))


def _carpet(rng) -> np.ndarray:
    return grey(0.80 + 0.14 * rng.random((SIDE, SIDE)) + 0.06 * noise(rng, 8))


def _weave(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    return grey(0.80 + 0.10 * ((x // 4 + y // 4) % 2) + 0.06 * (x % 4 < 2) + 0.04 * rng.random(
        (SIDE, SIDE)))


def _leafy(rng) -> np.ndarray:
    picture = np.full((SIDE, SIDE), 1.0)
    for _ in range(26):
        centre = rng.integers(0, SIDE, 2)
        axes, angle = (int(rng.integers(3, 6)), 2), int(rng.integers(180))
        for dx in (-SIDE, 0, SIDE):
            for dy in (-SIDE, 0, SIDE):
                cv2.ellipse(picture, (int(centre[0]) + dx, int(centre[1]) + dy), axes, angle, 0,
                            360, float(rng.uniform(0.66, 0.86)), -1)
    return grey(picture * (0.97 + 0.03 * noise(rng, 16)))


def _medallion(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] - 31.5
    ring = (np.hypot(x, y) // 6) % 2
    rim = np.maximum(abs(x), abs(y)) > 27
    return grey(np.where(rim, 0.6, np.where(ring > 0, 0.72, 1.0)))


def _drawers(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    picture = np.where((y % 21 < 2) | (x < 2) | (x > 61), 0.62, 1.0)
    picture[(abs((y % 21) - 11) < 2) & (abs(x - 32) < 7)] = 0.35
    return grey(picture)


def _twin(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    picture = np.where((abs(x - 32) < 1) | (x < 2) | (x > 61) | (y < 2) | (y > 61), 0.55, 1.0)
    picture[(abs(abs(x - 32) - 5) < 2) & (abs(y - 32) < 7)] = 0.3
    return grey(picture)


def _fire(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    height = 24 + 20 * np.sin(x / 6.0) * np.sin(x / 2.7 + 1)
    glow = np.clip((y - (SIDE - height)) / 30, 0, 1)
    return np.stack([0.1 + 0.9 * glow, 0.05 + 0.5 * glow**2, 0.04 + 0.1 * glow**3], axis=2)


def _water(rng) -> np.ndarray:
    picture = np.ones((SIDE, SIDE, 3)) * (0.25, 0.55, 0.75)
    picture *= (0.8 + 0.3 * noise(rng, 8))[:, :, None]
    for _ in range(9):
        centre = tuple(int(v) for v in rng.integers(8, 56, 2))
        cv2.ellipse(picture, centre, (5, 3), 0, 0, 360,
                    tuple(float(c) for c in rng.uniform(0.3, 1.0, 3)), -1)
    picture[56:] = (0.75, 0.65, 0.45)
    return np.clip(picture, 0, 1)


def _clock(rng) -> np.ndarray:
    picture = np.full((SIDE, SIDE, 3), 0.95)
    cv2.circle(picture, (32, 32), 30, (0.15, 0.15, 0.17), 4)
    cv2.line(picture, (32, 32), (32, 12), (0.1, 0.1, 0.1), 3)
    cv2.line(picture, (32, 32), (46, 38), (0.7, 0.1, 0.1), 3)
    return picture


def _keys(rng) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    black = (x % 8 < 4) & ((x // 8) % 7 != 2) & ((x // 8) % 7 != 6) & (y < 38)
    return grey(np.where(black, 0.08, np.where(x % 8 == 5, 0.6, 0.97)))


MATERIALS = {
    'plain': _plain, 'plaster': _plaster, 'stripes': _stripes, 'dots': _dots, 'brick': _brick,
    'planks': _planks, 'tiles': lambda rng: _tiles(rng, False),
    'checker': lambda rng: _tiles(rng, True), 'fabric': _fabric, 'wood': _wood, 'marble': _marble,
    'books': _books, 'window': _window, 'door': _doorleaf, 'leaves': _leaves, 'parquet': _parquet,
    'carpet': _carpet, 'weave': _weave, 'leafy': _leafy, 'medallion': _medallion,
    'drawers': _drawers, 'twin': _twin, 'fire': _fire, 'water': _water, 'clock': _clock,
    'keys': _keys,
}
