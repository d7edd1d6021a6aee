"""What a training says while it runs: metrics as CSV, TensorBoard, the terminal."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.state_file import written

if TYPE_CHECKING:
    from rich.progress import Progress
    from torch.utils import tensorboard

METRICS, TENSORBOARD = 'metrics.csv', 'tensorboard'


class Log:
    """Metrics to CSV, TensorBoard and the terminal; used as a context.

    Args:
        folder: of the run.
        config: of the training.
        columns: of the metrics; the first is the frames.
        frames: where the training stands. Rows beyond are dropped: they were never saved.

    Raises:
        UserError: in every method where the disk is full or the folder cannot be written.
    """

    def __init__(self, folder: Path, config: TrainConfig, columns: Sequence[str], frames: int):
        self.config, self.columns, self.path = config, columns, folder / METRICS
        self.writer: tensorboard.SummaryWriter | None = None
        self.bar: Progress | None = None
        self.printed = -math.inf
        with written(self.path):
            if config.tensorboard:
                try:
                    from torch.utils.tensorboard import SummaryWriter
                except ImportError as error:
                    raise UserError('logging to TensorBoard needs the package tensorboard',
                                    str(error), 'pip install "vn_nav[train]", or leave '
                                    'TensorBoard off') from error
                self.writer = SummaryWriter(folder / TENSORBOARD)
            folder.mkdir(parents=True, exist_ok=True)
            _cut_after(self.path, frames)
            self.file = open(self.path, 'a', newline='')
            self.rows = csv.DictWriter(self.file, columns)
            if self.file.tell() == 0:
                self.rows.writeheader()

    def __enter__(self) -> Log:
        if sys.stdout.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
            self.bar = Progress(BarColumn(24), TextColumn('{task.percentage:>3.0f}%'),
                                TimeElapsedColumn(), TextColumn('{task.description}'))
            self.task = self.bar.add_task('collecting the first frames', total=1.0)
            self.bar.start()
        return self

    def __exit__(self, kind, *_):
        if self.bar is not None:
            self.bar.stop()
        # What failed already has been said; a row that did not fit fails again here.
        with contextlib.suppress(OSError) if kind is not None else written(self.path):
            try:
                if self.writer is not None:
                    self.writer.close()
            finally:
                self.file.close()

    def write(self, row: dict) -> None:
        """One update's figures."""
        with written(self.path):
            self.rows.writerow({name: f'{value:.6g}' if isinstance(value, float) else value
                                for name, value in row.items()})
            self.file.flush()
            if self.writer is not None:
                for name in self.columns[1:]:
                    if math.isfinite(row[name]):
                        self.writer.add_scalar(f'train/{name}', row[name], row['frames'])
        share = row['frames'] / self.config.frames
        if self.config.minutes is not None:
            share = max(share, row['minutes'] / self.config.minutes)
        line = (f'{row["frames"]:,} frames · {row["minutes"]:.1f} min · {row["fps"]:,.0f} fps · '
                f'tau {row["tau"]:.2f} · success {row["success"]:.2f} · '
                f'length {row["length"]:.0f} · collisions {row["collisions"]:.2f} · '
                f'entropy {row["entropy"]:.2f} · kl {row["kl"]:.4f} · '
                f'value {row["value_loss"]:.3f}')
        if self.bar is not None:
            self.bar.update(self.task, completed=share, description=line)
        elif time.monotonic() - self.printed >= 10 or share >= 1:
            print(f'{min(share, 1):4.0%} {line}', flush=True)
            self.printed = time.monotonic()

    def sync(self) -> None:
        """Bring the rows to the disk, before a state that has them is saved."""
        with written(self.path):
            os.fsync(self.file.fileno())


def _cut_after(path: Path, frames: int) -> None:
    """Keep a metrics file's whole rows up to a resumption point."""
    if not path.exists():
        return
    if frames == 0:
        path.unlink()
        return
    header, *lines = path.read_text().splitlines(keepends=True) or ['']
    kept = [line for line in lines  # a full disk cuts a row in two
            if line.endswith('\n') and line.count(',') == header.count(',')
            and int(line.split(',', 1)[0]) <= frames]
    write_file(path, ''.join([header, *kept]).encode() if header.endswith('\n') else b'')
