"""The files of a replay memory: rings that are mapped, and which training they belong to."""

from __future__ import annotations

import json
import math
import os
import uuid
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError

HEADER = 'replay.json'


class RingFiles:
    """A folder with a file for each ring, and a header that says what they fit.

    Args:
        directory: the folder.
        header: what the memory is; files of another header are refused.

    Attributes:
        directory: the folder.
        identity: of the training that the files belong to; empty: none.
    """

    def __init__(self, directory: Path, header: dict):
        self.directory, self._header = directory, header
        self.identity = ''
        self._maps: list[np.memmap] = []

    def open(self, layout: dict) -> dict[str, Tensor]:
        """Open the files that are there, or make them."""
        header, path = self._header, self.directory / HEADER
        sizes = {name: math.prod(shape) * dtype.itemsize
                 for name, (dtype, shape) in layout.items()}
        if path.exists():
            try:
                found = json.loads(path.read_text())
                self.identity = found.pop('identity')
            except (ValueError, KeyError, TypeError, AttributeError):
                found = {}
            wrong = sorted(key for key in header if found.get(key) != header[key])
            wrong += sorted(name for name, size in sizes.items()
                            if not self._file(name).exists()
                            or self._file(name).stat().st_size != size)
            if wrong:
                raise UserError('replay files fit the memory that opens them',
                                f'{path.parent}: {", ".join(wrong)} differ',
                                'remove that folder: the memory is then filled anew')
        else:
            self.directory.mkdir(parents=True, exist_ok=True)
            for name, size in sizes.items():
                self._allocate(self._file(name), size)
        rings = {}
        for name, (dtype, shape) in layout.items():
            kind = torch.empty(0, dtype=dtype).numpy().dtype
            self._maps.append(np.memmap(self._file(name), kind, 'r+', shape=shape))
            rings[name] = torch.from_numpy(self._maps[-1])
        return rings

    def take_over(self) -> None:
        """A new training takes the files over: from here on no older checkpoint fits them."""
        self.identity = uuid.uuid4().hex
        path = self.directory / HEADER
        part = path.with_suffix('.part')
        part.write_text(json.dumps({**self._header, 'identity': self.identity}, indent=1))
        os.replace(part, path)

    def flush(self) -> None:
        """Write the mapped files to the disk."""
        for ring in self._maps:
            ring.flush()

    def _file(self, name: str) -> Path:
        return self.directory / f'{name}.ring'

    def _allocate(self, path: Path, size: int) -> None:
        """Make a file whose blocks are there: a full disk must show here, not as a bus error."""
        try:
            with path.open('wb') as file:
                os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            raise UserError(f'the replay files find {size / 1e9:.2f} GB on the disk',
                            f'{path}: {error.strerror}',
                            'free the space, or keep fewer steps') from error
