"""Checkpoints: a folder with `model.safetensors`, `config.json` and a model card, `README.md`.

One of a policy that searches and was taught a place has `place.safetensors` as well. Nothing in it
is executable: weights are safetensors, everything else is JSON and text.
"""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
import json
import math
import os
import shutil
from pathlib import Path

import safetensors
import safetensors.torch
import torch

from vn_nav.errors import UserError
from vn_nav.files import sync_folder, write_file
from vn_nav.policy.checkpoint_info import (
    CARD,
    CHECKSUM,
    CONFIG,
    EXPORT,
    FORMAT,
    PLACE,
    PLACE_CHECKSUM,
    TRIAL,
    WEIGHTS,
    check_info,
    config_checksum,
    read_config,
)
from vn_nav.policy.model_card import model_card
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig, no_network, read_network
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.taught_file import place_bytes, read_place
from vn_nav.policy.zhu_policy import build_policy

HEADER_BYTES = 1_000_000  # of a safetensors file, without its weights


@dataclasses.dataclass(frozen=True)
class LoadedCheckpoint:
    """A checkpoint in memory."""

    network: Policy  # in evaluation mode, float32
    config: NetworkConfig
    info: dict  # the keys of `INFO`, and 'sha256' of the weights


def save_checkpoint(folder: str | Path, network: Policy, info: dict, *,
                    half: bool = False) -> None:
    """Write a checkpoint; the folder appears, or is replaced, whole or not at all.

    The trial of a policy that drives alike stays in it.

    Args:
        folder: where; its parent is made.
        network: the policy, with the place that it was taught.
        info: some of the keys of `INFO`.
        half: store weights in 16 bits, half the size.

    Raises:
        UserError: a missing or unknown key of `info`, a value that JSON cannot hold, a weight
            that is not finite, or a full disk; the checkpoint before is whole.
    """
    folder = Path(folder)
    info = check_info(info, 'the checkpoint to save')
    tensors = {}
    for name, tensor in network.state_dict().items():
        stored = tensor.detach().to(torch.float16 if half else torch.float32)
        if not torch.isfinite(stored).all():
            raise UserError('weights are finite and within their type', name,
                            'go back to an earlier checkpoint, or store them in 32 bits')
        tensors[name] = stored.contiguous()
    weights = safetensors.torch.save(tensors)
    place = taught_bytes(network)
    config, text = config_file(network, info, hashlib.sha256(weights).hexdigest(), place)
    files = {WEIGHTS: weights} if place is None else {WEIGHTS: weights, PLACE: place}
    parameters = sum(tensor.numel() for tensor in tensors.values())
    files |= {CONFIG: text.encode(), CARD: model_card(config, parameters, len(weights)).encode()}
    try:
        if (folder / TRIAL).is_file() and _drives_as(folder, config):
            files[TRIAL] = (folder / TRIAL).read_bytes()
        _write_folder(folder, files)
    except OSError as error:
        raise UserError(f'a checkpoint can be written ({len(weights) / 1e6:.1f} MB)',
                        f'{error.filename or folder}: {error.strerror}',
                        'free some space, or choose a folder that may be written: the checkpoint '
                        'before is whole') from error


def _drives_as(folder: Path, config: dict) -> bool:
    """Whether a folder's checkpoint drives as that of a configuration: what is kept is of both."""
    try:
        before, _ = read_config(folder)
    except UserError:  # none, or one that nobody reads any more
        return False
    return all(before.get(key) == config.get(key) for key in (
        'sha256', PLACE_CHECKSUM, 'stop_threshold', 'world_version'))


def taught_bytes(network: Policy) -> bytes | None:
    """The file of the place that a policy was taught; None: of none."""
    place = network.taught if isinstance(network, SearchPolicy) else None
    return None if place is None else place_bytes(place)


def config_file(network: Policy, info: dict, digest: str, place: bytes | None
                ) -> tuple[dict, str]:
    """What `config.json` says of a checkpoint, and the file's text.

    Args:
        network: the policy; info: all keys of `INFO`.
        digest: SHA-256 of the weights' file; place: of `taught_bytes`.

    Raises:
        UserError: a value that JSON cannot hold.
    """
    config = {'format': FORMAT, 'network': dataclasses.asdict(network.config),
              'action_names': list(network.config.actions), 'sha256': digest, **info}
    if place is not None:
        config[PLACE_CHECKSUM] = hashlib.sha256(place).hexdigest()
    del config['network']['actions']  # said once, under action_names
    config['network']['action_filter'] = network.config.filter_name
    try:
        # As it will be read: JSON has no tuples, and only text as keys.
        config = json.loads(json.dumps(config, allow_nan=False))
        config[CHECKSUM] = config_checksum(config)
        return config, json.dumps(config, indent=2, allow_nan=False) + '\n'
    except (TypeError, ValueError) as error:
        raise UserError('info holds only JSON values', str(error), 'convert them first') from error


def load_checkpoint(folder: str | Path, expect_actions: tuple[str, ...] | None = None
                    ) -> LoadedCheckpoint:
    """Read a checkpoint and verify it.

    Args:
        folder: a checkpoint folder.
        expect_actions: refuse any other action names or order.

    Raises:
        UserError: a missing or corrupt file, another architecture, unknown keys, values of a
            wrong type or size, or other actions.
    """
    folder = Path(folder)
    config, info = read_config(folder, (WEIGHTS,))
    where = str(folder / CONFIG)
    network_config = read_network(config, where)
    shapes = _shapes(network_config, where)
    if expect_actions is not None and tuple(expect_actions) != network_config.actions:
        raise UserError(f'the policy has the actions {", ".join(expect_actions)}, in that order',
                        ', '.join(network_config.actions), 'use a checkpoint trained for them')
    weights = _read_weights(folder / WEIGHTS, shapes)
    digest = hashlib.sha256(weights).hexdigest()
    if digest != config['sha256']:
        raise UserError(f'the SHA-256 of {WEIGHTS} is the one in {CONFIG}', digest,
                        f'the file is corrupt or not the one of {where}: get it again')
    tensors = _check_weights(weights, shapes, str(folder / WEIGHTS))
    network = build_policy(network_config)
    network.load_state_dict(tensors)
    if PLACE_CHECKSUM in config:
        if not isinstance(network, SearchPolicy):
            raise UserError('a policy that searches alone is taught with key pictures',
                            f'{where}: architecture {network_config.architecture}, '
                            f'{PLACE_CHECKSUM}', 'get the checkpoint again')
        network.taught = read_place(folder, config[PLACE_CHECKSUM], network_config.size)
    return LoadedCheckpoint(network.eval(), network_config, {**info, 'sha256': digest})


def _shapes(network: NetworkConfig, where: str) -> dict[str, tuple]:
    """The shapes of a network's weights by name.

    They come from a network without memory: an absurd size must not be allocated.
    """
    try:
        with torch.device('meta'):
            return {name: tuple(tensor.shape)
                    for name, tensor in build_policy(network).state_dict().items()}
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise no_network(where, error) from error


def _read_weights(path: Path, shapes: dict[str, tuple]) -> bytes:
    """The file's bytes, no more than these weights can have."""
    most = 4 * sum(map(math.prod, shapes.values())) + HEADER_BYTES
    try:
        with path.open('rb') as file:
            weights = file.read(min(most, path.stat().st_size) + 1)
    except OSError as error:
        raise UserError(f'{WEIGHTS} can be read', f'{path}: {error.strerror}',
                        'correct its permissions, or get the checkpoint again') from error
    if len(weights) > most:
        raise UserError(f'{WEIGHTS} fits the network of {CONFIG}: at most {most} bytes',
                        f'{path.stat().st_size} in {path}', 'get the checkpoint again')
    return weights


def _check_weights(weights: bytes, wanted: dict[str, tuple], where: str
                   ) -> dict[str, torch.Tensor]:
    """The weights by name, float32."""
    try:
        tensors = safetensors.torch.load(weights)
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise UserError(f'{WEIGHTS} is a safetensors file', f'{where}: {error}',
                        'get the checkpoint again') from error
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if wanted != found:
        name = sorted(name for name in wanted.keys() | found.keys()
                      if wanted.get(name) != found.get(name))[0]
        raise UserError(f'{WEIGHTS} fits the network of {CONFIG}: {name} is {wanted.get(name)}',
                        f'{found.get(name)} in {where}', 'get the checkpoint again')
    for name, tensor in tensors.items():
        if tensor.dtype not in (torch.float16, torch.float32) or not torch.isfinite(tensor).all():
            raise UserError('weights are finite numbers of 16 or 32 bits', f'{name} in {where}',
                            'get the checkpoint again')
    return {name: tensor.float() for name, tensor in tensors.items()}


def _write_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Write a folder that appears, or is replaced, whole or not at all."""
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    # What was made of the checkpoint before goes with it: an export, a trial of another policy.
    if folder.exists() and any(path.name not in (WEIGHTS, CONFIG, CARD, PLACE, EXPORT, TRIAL)
                               for path in folder.iterdir()):
        raise UserError('only a checkpoint folder is replaced by a checkpoint', str(folder),
                        'choose another folder')
    temporary = folder.with_name(f'.{folder.name}.{os.getpid()}.tmp')
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        for name, data in files.items():
            write_file(temporary / name, data)
        if folder.exists():
            _exchange(temporary, folder)
        else:
            temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    sync_folder(folder.parent)


def _exchange(one: Path, other: Path) -> None:
    """Swap two folders of one file system, atomically where the kernel can (Linux)."""
    exchange, here = 2, -100  # RENAME_EXCHANGE, AT_FDCWD
    try:
        swapped = ctypes.CDLL(None).renameat2(here, os.fsencode(one), here, os.fsencode(other),
                                              exchange) == 0
    except AttributeError:
        swapped = False
    if not swapped:
        aside = one.with_name(one.name + '.old')
        other.rename(aside)
        one.rename(other)
        aside.rename(one)
