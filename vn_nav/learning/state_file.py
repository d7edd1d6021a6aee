"""Files of training state: whole or not at all, and verified when read."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import torch

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint import write_file


def write_state(path: Path, state: dict) -> None:
    """Write tensors and plain values, behind a first line with their SHA-256.

    Raises:
        UserError: the disk is full, or the file cannot be written; the one before is whole.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getvalue()
    try:
        write_file(path, hashlib.sha256(data).hexdigest().encode() + b'\n' + data)
    except OSError as error:
        raise UserError(f'the training can write its state ({len(data) / 1e6:.0f} MB)',
                        f'{path}: {error.strerror}',
                        'free some space and resume: the last saved state is whole') from error


def read_state(path: Path) -> dict:
    """Read such a file; nothing in it is executed.

    Raises:
        UserError: a file that is damaged.
    """
    digest, _, data = path.read_bytes().partition(b'\n')
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise UserError('the training state has the SHA-256 of its first line', str(path),
                        'the file is corrupt: start a new training')
    return torch.load(io.BytesIO(data), weights_only=True)
