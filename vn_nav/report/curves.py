"""Learning curves: runs read, seeds averaged, and when a success was reached."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_nav.files import write_file

METRICS = 'metrics.csv'
NEEDED = ('frames', 'minutes', 'tau', 'success')
THRESHOLDS = (0.5, 0.9)  # of success
FULL_TAU = 0.999  # a tau from here on is 1: starts as far from the goal as in the evaluation
RECENT_EPISODES = 200  # that success, return, length and collisions of a row are means over
HOLD_SHARE = 0.1  # of a run: how long a success has to hold on average
CURVE_POINTS = 240  # of a curve
KEPT_ROWS = 400  # of a curve that stays
SMOOTHING_SHARE = 0.02  # of the axis: width of the running mean
SEED = re.compile(r'[-_](?:seed|s)\d+$')


@dataclasses.dataclass(frozen=True)
class Run:
    """One training."""

    path: Path
    label: str  # runs of equal labels are seeds of one curve
    # `NEEDED`, the metric and, if it is known, length; one value an update.
    columns: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Curve:
    """The mean over seeds on a common grid, as far as all of them go."""

    x: np.ndarray  # [CURVE_POINTS] frames or minutes
    mean: np.ndarray
    low: np.ndarray  # of the band
    high: np.ndarray
    full: np.ndarray  # bool: tau is 1 in all runs


def read_runs(paths: Sequence[Path], metric: str = 'success',
              labels: Sequence[str] | None = None) -> list[Run]:
    """Runs by the metrics that their trainings wrote.

    Args:
        paths: folders with metrics.csv, or such files.
        metric: a column.
        labels: one a run; left out, the folder's name without a trailing -seedN or _sN.

    Raises:
        UserError: a missing or unreadable file, a missing column, too few rows, another number of
            labels than runs, or the same run twice.
    """
    if labels is not None and len(labels) != len(paths):
        raise UserError(f'there is a label for each of {len(paths)} runs', len(labels),
                        'give as many --labels as runs')
    files = [path / METRICS if path.is_dir() else path for path in map(Path, paths)]
    if len({file.resolve() for file in files}) < len(files):
        raise UserError('every run is named once', ', '.join(map(str, paths)),
                        'leave the repeated one out')
    return [Run(Path(path), label, _columns(file, metric)) for path, file, label in zip(
        paths, files, labels or [_label(file) for file in files], strict=True)]


def _label(file: Path) -> str:
    file = file.resolve()
    return SEED.sub('', file.parent.name if file.name == METRICS else file.stem)


def _columns(file: Path, metric: str) -> dict[str, np.ndarray]:
    try:
        with open(file, newline='') as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f'a run is a folder with {METRICS}, or such a file', f'{file}: {error}',
                        'name the folder that vn_nav train --out wrote') from error
    names = dict.fromkeys((*NEEDED, metric, *(['length'] if rows and 'length' in rows[0] else [])))
    for name in names:
        if rows and name not in rows[0]:
            raise UserError(f'{METRICS} has the columns {", ".join(names)}',
                            f'{file} without {name}', 'choose another --metric, or another run')
    try:
        columns = {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (TypeError, ValueError) as error:
        raise UserError(f'{METRICS} holds numbers', f'{file}: {error}',
                        'remove the broken line') from error
    if (np.isfinite(columns[metric]).sum() if rows else 0) < 2:
        raise UserError(f'a curve has at least two rows with a finite {metric}', str(file),
                        'train for longer, or choose another --metric')
    if (np.diff(columns['frames']) <= 0).any() or (np.diff(columns['minutes']) < 0).any():
        raise UserError('frames and minutes grow from row to row', str(file),
                        'remove the lines of another training')
    return columns


def grouped(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by label, in the order in which the labels come."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.label, []).append(run)
    return groups


def average(runs: Sequence[Run], axis: str, metric: str, *, band: str = 'range',
            log: bool = False) -> Curve:
    """Mean and band over some runs.

    Args:
        runs: seeds of one thing.
        axis: 'frames' or 'minutes'.
        metric: a column.
        band: 'range': smallest to largest; 'std': one standard deviation each way.
        log: the grid and the running mean are even on a logarithmic axis.
    """
    forward, back = (np.log10, lambda u: 10.0**u) if log else (np.asarray, np.asarray)
    seeds = []
    for run in runs:
        x, y = run.columns[axis], run.columns[metric]
        known = np.isfinite(y) & (x > 0)
        seeds.append((forward(x[known]), y[known], forward(x[x > 0]), run.columns['tau'][x > 0]))
    begin, end = max(u[0] for u, *_ in seeds), min(u[-1] for u, *_ in seeds)
    grid = np.linspace(begin, end, CURVE_POINTS)
    values = np.array([_smooth(u, y, grid, SMOOTHING_SHARE * (end - begin)) for u, y, *_ in seeds])
    taus = np.array([tau[np.clip(np.searchsorted(u, grid, side='right') - 1, 0, None)]
                     for *_, u, tau in seeds])
    mean, spread = values.mean(axis=0), values.std(axis=0)
    low, high = ((mean - spread, mean + spread) if band == 'std'
                 else (values.min(axis=0), values.max(axis=0)))
    return Curve(back(grid), mean, low, high, np.all(taus >= FULL_TAU, axis=0))


def _smooth(x: np.ndarray, y: np.ndarray, grid: np.ndarray, width: float) -> np.ndarray:
    """Means of the line through (x, y) over windows around the grid's points."""
    # Equal x (two updates within the clock's resolution) hold their mean.
    x, where = np.unique(x, return_inverse=True)
    y = np.bincount(where, y) / np.bincount(where)
    if width <= 0 or len(x) < 2:
        return np.interp(grid, x, y)
    left, right = np.clip(grid - width / 2, x[0], x[-1]), np.clip(grid + width / 2, x[0], x[-1])
    nodes = np.union1d(x, np.concatenate([left, right]))
    heights = np.interp(nodes, x, y)
    area = np.concatenate([[0.0], np.cumsum(np.diff(nodes) * (heights[1:] + heights[:-1]) / 2)])
    return ((area[np.searchsorted(nodes, right)] - area[np.searchsorted(nodes, left)])
            / (right - left))


def reached(run: Run, threshold: float, metric: str = 'success', *, falls: bool = False,
            in_curriculum: bool = False) -> tuple[float, float] | None:
    """Frames and minutes to a value of a metric; None: not in this run.

    A success inside the curriculum is none: its starts are nearer. Nor is one that does not hold.
    So a row counts when all of the episodes that it is a mean of have begun since the run, or its
    last stage, began (those that end first are the successful ones), and when the mean over the
    following tenth of the run, which has to be there, is as good.

    Args:
        run: as read.
        threshold: of the metric, the trainer's mean over its last 200 episodes.
        metric: a column.
        falls: less is better.
        in_curriculum: count rows inside the curriculum as well.
    """
    frames, sign = run.columns['frames'], -1 if falls else 1
    values = sign * run.columns[metric]
    good = values >= sign * threshold
    begun = frames[0]
    if not in_curriculum:
        full = run.columns['tau'] >= FULL_TAU
        begun = frames[np.argmax(full)] if full.any() else np.inf
    good &= frames >= begun
    if 'length' in run.columns:
        good &= frames - begun >= RECENT_EPISODES * np.nan_to_num(
            run.columns['length'], nan=np.inf)
    good &= frames <= (1 - HOLD_SHARE) * frames[-1]
    for k in np.nonzero(good)[0]:
        following = (frames >= frames[k]) & (frames <= frames[k] + HOLD_SHARE * frames[-1])
        if np.nanmean(values[following]) >= sign * threshold:
            return float(frames[k]), float(run.columns['minutes'][k])
    return None


def thin(folder: Path, target: Path) -> None:
    """Write a run's curve into a folder that stays, with at most `KEPT_ROWS` rows.

    Args:
        folder: of the run.
        target: gets metrics.csv, the last row included.
    """
    with open(folder / METRICS, newline='') as file:
        rows = list(csv.DictReader(file))
    every = max(1, -(-len(rows) // KEPT_ROWS))
    kept = io.StringIO()
    writer = csv.DictWriter(kept, rows[0].keys(), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows[::-every][::-1])
    target.mkdir(parents=True, exist_ok=True)
    write_file(target / METRICS, kept.getvalue().encode())


def summary(groups: dict[str, list[Run]]) -> dict[str, dict]:
    """For each label what the table shows, ready for JSON; lists have an entry a run.

    Returns:
        label -> `runs` (their paths), `frames` and `minutes` (in all), `success` (mean over the
        last tenth of the run; None: no episode ended there) and `tau` there, and
        `reached`: threshold -> `frames`, `minutes` (None: not reached).
    """
    result = {}
    for label, runs in groups.items():
        ends = [run.columns['frames'] >= (1 - HOLD_SHARE) * run.columns['frames'][-1]
                for run in runs]
        success = [run.columns['success'][end] for run, end in zip(runs, ends, strict=True)]
        result[label] = {
            'runs': [str(run.path) for run in runs],
            'frames': [float(run.columns['frames'][-1]) for run in runs],
            'minutes': [float(run.columns['minutes'][-1]) for run in runs],
            'success': [float(np.nanmean(s)) if np.isfinite(s).any() else None for s in success],
            'tau': [float(run.columns['tau'][-1]) for run in runs],
            'reached': {str(threshold): _both([reached(run, threshold) for run in runs])
                        for threshold in THRESHOLDS},
        }
    return result


def _both(points: list[tuple[float, float] | None]) -> dict[str, list[float | None]]:
    return {name: [None if point is None else point[k] for point in points]
            for k, name in enumerate(('frames', 'minutes'))}
