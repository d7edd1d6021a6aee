"""Files of training state: whole or not at all, and verified when read."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import torch

from vn_nav.errors import UserError
from vn_nav.files import write_file


def write_state(path: Path, state: dict) -> None:
    """Write tensors and plain values, behind a first line with their SHA-256.

    Raises:
        UserError: the disk is full, or the file cannot be written; the one before is whole.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getvalue()
    with written(path):
        write_file(path, hashlib.sha256(data).hexdigest().encode() + b'\n' + data)


@contextlib.contextmanager
def written(path: Path) -> Iterator[None]:
    """Turn the operating system's errors inside into the one that a user understands.

    Raises:
        UserError: the disk is full, or the file cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise UserError('a training can write its files',
                        f'{error.filename or path}: {error.strerror}',
                        'free some space, or allow it to write there, and resume: the last saved '
                        'state is whole') from error


@contextlib.contextmanager
def own_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and keep other trainings out of it; an empty one is removed at the end.

    Raises:
        UserError: another process trains there, or it cannot be made.
    """
    with written(folder):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError('one training at a time writes into a folder',
                            f'{folder}, where another process does', 'wait for it, end it, or '
                            'choose another folder') from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)  # which ends the lock, as the end of this process does
        with contextlib.suppress(OSError):
            folder.rmdir()


def remove_partial(folder: Path) -> None:
    """Remove what killed processes had not finished writing, see `checkpoint.write_file`.

    Only where no other process writes.
    """
    for path in folder.glob('.*.tmp*'):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def read_state(path: Path) -> dict:
    """Read such a file; nothing in it is executed.

    Raises:
        UserError: a file that is damaged.
    """
    digest, _, data = path.read_bytes().partition(b'\n')
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise UserError('the training state has the SHA-256 of its first line', str(path),
                        'the file is corrupt: start a new training')
    return torch.load(io.BytesIO(data), weights_only=True, map_location='cpu')
