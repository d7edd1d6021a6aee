"""What a real sensor does to a picture: motion blur and noise, in place."""

from __future__ import annotations

import numba
import numpy as np


def expose(rgb: np.ndarray, noise: np.ndarray, blur: np.ndarray, keys: np.ndarray) -> None:
    """Blur and noise pictures in place.

    Args:
        rgb: [N,3,S,S] uint8.
        noise: [N] float32, standard deviation [grey levels].
        blur: [N] float32, length of a horizontal box filter as a share of the width.
        keys: [N] uint64, of the noise: equal keys give equal noise.
    """
    _expose(rgb, np.ascontiguousarray(noise, np.float32),
            np.rint(blur * rgb.shape[-1]).astype(np.int64), np.ascontiguousarray(keys, np.uint64))


@numba.njit(cache=True)
def _expose(rgb, noise, length, keys):
    count, channels, height, width = rgb.shape
    line = np.empty(width + 64, np.int32)
    for n in range(count):
        if length[n] > 1:
            span = min(length[n], 63)
            before = span // 2
            for channel in range(channels):
                for row in range(height):
                    pixels = rgb[n, channel, row]
                    total = np.int32(0)
                    for k in range(-before, span - before):
                        total += pixels[min(max(k, 0), width - 1)]
                    for column in range(width):
                        line[column] = total // span
                        total += np.int32(pixels[min(column + span - before, width - 1)])
                        total -= np.int32(pixels[max(column - before, 0)])
                    for column in range(width):
                        pixels[column] = line[column]
        if noise[n] > 0:
            # The sum of four bytes has a standard deviation of 147.8.
            scale = np.int32(noise[n] / 147.8 * 65536)
            flat = rgb[n].reshape(-1)
            key = np.uint32(keys[n] ^ (keys[n] >> np.uint64(32)))
            for i in range(flat.size):
                # Numba widens products of 32-bit numbers: cut them back.
                x = np.uint32(np.uint32(i) * np.uint32(0x9E3779B1)) ^ key
                x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B))
                x = np.uint32((x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35))
                x = np.uint32(x ^ (x >> np.uint32(16)))
                total = np.int32((x & np.uint32(255)) + ((x >> np.uint32(8)) & np.uint32(255))
                                 + ((x >> np.uint32(16)) & np.uint32(255))
                                 + (x >> np.uint32(24))) - np.int32(510)
                value = np.int32(flat[i]) + ((total * scale + np.int32(32768)) >> np.int32(16))
                flat[i] = np.uint8(min(max(value, np.int32(0)), np.int32(255)))
