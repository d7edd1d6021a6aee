"""Recorded pictures in another light: what a drive of one afternoon cannot show."""

from __future__ import annotations

import numba
import numpy as np

from vn_sim_bridge.counter_random import Stream, uniform

STOPS = 0.7  # either way: exposure
TINT = 0.2  # either way, natural logarithm: red and blue against green
CONTRAST = 0.2  # either way: exponent, natural logarithm
GAMMA = 2.2  # of a display


def draw_light(seed: int | np.ndarray, stream: Stream, env: np.ndarray,
               episode: np.ndarray) -> np.ndarray:
    """Tables [N,3,256] uint8 of the grey levels that channels take, for each picture or episode.

    Args:
        as of `counter_random.uniform`; seed one number or [N], env and episode [N].
    """
    env, episode = np.asarray(env)[:, None], np.asarray(episode)[:, None]
    seed = np.broadcast_to(seed, len(env))[:, None]
    drawn = 2 * uniform(seed, stream, env, episode, np.arange(4)) - 1
    light = np.log(2) * STOPS * drawn[:, :1] + TINT * np.stack(
        [drawn[:, 1], np.zeros(len(drawn)), drawn[:, 2]], axis=1)
    level = (np.arange(256) / 255)[None, None]
    exponent = np.exp(CONTRAST * drawn[:, 3])[:, None, None]
    table = np.exp(light / GAMMA)[:, :, None] * level**exponent
    return np.rint(255 * table.clip(0, 1)).astype(np.uint8)


@numba.njit(cache=True)
def relight(pictures: np.ndarray, tables: np.ndarray) -> None:
    """Change pictures [N,3,S,S] uint8 in place by tables [N,3,256]."""
    count, channels, rows, columns = pictures.shape
    for n in range(count):
        for c in range(channels):
            for i in range(rows):
                for j in range(columns):
                    pictures[n, c, i, j] = tables[n, c, pictures[n, c, i, j]]
