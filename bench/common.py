"""What the benchmarks share: interleaved rounds, pinned cores, one JSON line a figure."""

from __future__ import annotations

import json
import math
import os
import time

import numpy as np

from vn_nav.cli.world import machine

ROUNDS = 9


def pin(cores: int) -> None:
    """Keep this process to the first cores that it may use."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


def frames_per_second(draw, frames: int, seconds: float = 0.4) -> float:
    """Repeat `draw`, which makes so many frames, for some time."""
    begun, count = time.perf_counter(), 0
    while (spent := time.perf_counter() - begun) < seconds:
        draw()
        count += frames
    return count / spent


def report(name: str, values, conditions: str, *, unit: str = 'frames/s', peer: str | None = None,
           peer_values=None) -> None:
    """One JSON line: medians and ranges; the ratio is taken round by round."""
    values = np.asarray(values, float)
    line = {'name': name, 'value': _short(np.median(values)), 'unit': unit,
            'range': [_short(values.min()), _short(values.max())], 'peer': peer,
            'peer_value': None, 'ratio': None, 'conditions': f'{conditions}; {machine()}'}
    if peer is not None:
        ratio = values / np.asarray(peer_values, float)
        line |= {'peer_value': _short(np.median(peer_values)),
                 'ratio': round(float(np.median(ratio)), 2),
                 'ratio_range': [round(float(ratio.min()), 2), round(float(ratio.max()), 2)]}
    print(json.dumps(line), flush=True)


def _short(value: float) -> float:
    return round(float(value), max(0, 2 - math.floor(math.log10(max(abs(value), 1e-3)))))


def random_cameras(house, count: int, seed: int = 0) -> np.ndarray:
    """Cameras [N,5] at free places of a house, level, in any direction."""
    rng = np.random.default_rng(seed)
    cells = house.floor.centres()
    return np.column_stack([cells[rng.integers(len(cells), size=count)], np.ones(count),
                            rng.uniform(-math.pi, math.pi, count), np.zeros(count)])
