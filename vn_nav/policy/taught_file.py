"""The file of a checkpoint that holds the place which a policy that searches was taught."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint_info import CONFIG, PLACE
from vn_nav.policy.search.taught import TaughtPlace

MOST_BYTES = 512 * 2**20  # of the file
_AGAIN = 'get the checkpoint again'


def place_bytes(place: TaughtPlace) -> bytes:
    """The file's content."""
    return safetensors.numpy.save({field.name: np.ascontiguousarray(getattr(place, field.name))
                                   for field in dataclasses.fields(place)})


def read_place(folder: Path, digest: str, size: int) -> TaughtPlace:
    """The place in the folder of a checkpoint.

    Args:
        folder: of the checkpoint.
        digest: SHA-256 of the file, as the configuration says.
        size: side of the policy's pictures [pixels].

    Raises:
        UserError: a missing or corrupt file, or one of another policy.
    """
    path = folder / PLACE
    try:
        with path.open('rb') as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise UserError(f'{PLACE} of a taught policy can be read', f'{path}: {error.strerror}',
                        _AGAIN) from error
    if len(data) > MOST_BYTES:
        raise UserError(f'{PLACE} has at most {MOST_BYTES} bytes', str(path), _AGAIN)
    found = hashlib.sha256(data).hexdigest()
    if found != digest:
        raise UserError(f'the SHA-256 of {PLACE} is the one in {CONFIG}', found,
                        f'{path} is corrupt or of another checkpoint: get it again')
    names = {field.name for field in dataclasses.fields(TaughtPlace)}
    try:
        arrays = safetensors.numpy.load(data)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f'{PLACE} is a safetensors file', f'{path}: {error}', _AGAIN) from error
    if arrays.keys() != names:
        raise UserError(f'{PLACE} holds {", ".join(sorted(names))}',
                        f'{path}: {", ".join(sorted(arrays))}', _AGAIN)
    place = TaughtPlace(**arrays)
    if place.pictures.shape[-1] != size:
        raise UserError(f'key pictures have the size of the policy, {size} pixels a side',
                        f'{place.pictures.shape[-1]} in {path}', _AGAIN)
    return place
