"""Statistics of a dataset in LeRobot's format: of an episode exactly, merged over episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

QUANTILES = {'q01': 0.01, 'q10': 0.10, 'q50': 0.50, 'q90': 0.90, 'q99': 0.99}
PIXEL_STRIDE = 4  # row and column of a picture is counted

Stats = dict[str, list]  # min, max, mean, std, count and `QUANTILES`; lists as JSON has them


def describe(values: np.ndarray) -> Stats:
    """Statistics of a column [K] or [K,D]: lists of 1 or D numbers, and the count K."""
    values = values.reshape(len(values), -1).astype(np.float64)
    figures = {'min': values.min(0), 'max': values.max(0), 'mean': values.mean(0),
               'std': values.std(0),
               **{name: np.quantile(values, q, axis=0) for name, q in QUANTILES.items()}}
    return {name: value.tolist() for name, value in figures.items()} | {'count': [len(values)]}


class Colours:
    """Colours of pictures, counted."""

    def __init__(self):
        self._counts = np.zeros((3, 256), np.int64)
        self._pictures = 0

    def add(self, picture: np.ndarray) -> None:
        """Count a picture [H,W,3] uint8."""
        few = picture[::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(-1, 3)
        self._counts += np.stack([np.bincount(few[:, k], minlength=256) for k in range(3)])
        self._pictures += 1

    def describe(self) -> Stats:
        """Statistics by colour as [3,1,1], of values in [0, 1], and the count of pictures."""
        values, total = np.arange(256) / 255, self._counts.sum(1)
        mean = self._counts @ values / total
        share = np.cumsum(self._counts, 1) / total[:, None]
        figures = {
            'min': values[(self._counts > 0).argmax(1)],
            'max': values[255 - (self._counts[:, ::-1] > 0).argmax(1)], 'mean': mean,
            'std': np.sqrt(np.maximum(self._counts @ values**2 / total - mean**2, 0.0)),
            **{name: values[(share >= q).argmax(1)] for name, q in QUANTILES.items()}}
        return {name: value.reshape(3, 1, 1).tolist() for name, value in figures.items()} | {
            'count': [self._pictures]}


def merge(parts: Sequence[Stats]) -> Stats:
    """Statistics of all episodes; quantiles are means, weighted by length, as LeRobot has them."""
    def stacked(name: str) -> np.ndarray:
        return np.array([part[name] for part in parts])

    count, mean = stacked('count')[:, 0], stacked('mean')
    weight = (count / count.sum()).reshape(-1, *[1] * (mean.ndim - 1))
    middle = (weight * mean).sum(0)
    spread = (weight * (stacked('std')**2 + (mean - middle)**2)).sum(0)
    figures = {'min': stacked('min').min(0), 'max': stacked('max').max(0), 'mean': middle,
               'std': np.sqrt(spread),
               **{name: (weight * stacked(name)).sum(0) for name in QUANTILES}}
    return {name: value.tolist() for name, value in figures.items()} | {
        'count': [int(count.sum())]}
