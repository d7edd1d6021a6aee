"""The large files of a LeRobot dataset as they grow: video and table."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.bags.export.lerobot_layout import CAMERA, FIRST
from vn_nav.errors import UserError


class Video:
    """The camera's video: H.264, every second picture whole, so that any can be read soon.

    Attributes:
        size: height, width [pixels]; None before the first picture.
    """

    def __init__(self, folder: Path, fps: int):
        self._path, self._fps = folder / 'videos' / CAMERA / f'{FIRST}.mp4', fps
        self.size: tuple[int, int] | None = None
        self._file: Any = None
        self._count = 0

    def __enter__(self) -> Video:
        return self

    def add(self, picture: np.ndarray) -> None:
        """Append a picture [H,W,3] uint8 RGB.

        Raises:
            UserError: it has another size than the first.
        """
        import av
        # 4:2:0 has even sides: an odd row or column is left out.
        height, width = (side - side % 2 for side in picture.shape[:2])
        size = self.size or self._begin(height, width)
        if (height, width) != size:
            raise UserError('pictures of a dataset have one size', f'{width} x {height} after '
                            f'{size[1]} x {size[0]}', 'split the bag where the camera '
                            'changes')
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture[:height, :width]), format='rgb24')
        frame.pts, frame.time_base = self._count, Fraction(1, self._fps)
        self._count += 1
        self._file.mux(self._stream.encode(frame))

    def _begin(self, height: int, width: int) -> tuple[int, int]:
        import av
        if not (height and width):
            raise UserError('a video has two rows and columns at least', f'{width} x {height}',
                            'export a camera with larger pictures')
        self._path.parent.mkdir(parents=True)
        self.size = height, width
        self._file = av.open(str(self._path), 'w')
        self._stream = self._file.add_stream('libx264', rate=self._fps, options={
            'g': '2', 'bf': '0', 'crf': '20', 'preset': 'veryfast'})
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = 'yuv420p'
        return self.size

    def __exit__(self, *error) -> None:
        if self._file is None:
            return
        try:
            if error[0] is None:
                self._file.mux(self._stream.encode())
        finally:
            self._file.close()


class Table:
    """The numbers of all rows, an episode at a time."""

    def __init__(self, folder: Path):
        self._path = folder / 'data' / f'{FIRST}.parquet'
        self._file: Any = None  # a ParquetWriter; pyarrow has no types

    def __enter__(self) -> Table:
        return self

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Append an episode: columns [K] or [K,D]."""
        import pyarrow
        import pyarrow.parquet
        arrays = {}
        for name, values in columns.items():
            flat = pyarrow.array(values.ravel())
            arrays[name] = (flat if values.ndim == 1 else
                            pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1]))
        table = pyarrow.table(arrays)
        if self._file is None:
            self._path.parent.mkdir(parents=True)
            self._file = pyarrow.parquet.ParquetWriter(self._path, table.schema)
        self._file.write_table(table)

    def __exit__(self, *error) -> None:
        if self._file is not None:
            self._file.close()
