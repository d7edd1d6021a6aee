"""Checkpoints: a folder with `model.safetensors`, `config.json` and a model card, `README.md`.

Nothing in it is executable: weights are safetensors, everything else is JSON and text.
"""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
import json
import math
import os
import reprlib
import shutil
from pathlib import Path

import safetensors
import safetensors.torch
import torch

from vn_nav.errors import UserError
from vn_nav.files import sync_folder, write_file
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint_info import (
    CARD,
    CHECKSUM,
    CONFIG,
    FORMAT,
    NUMBER,
    WEIGHTS,
    check_info,
    config_checksum,
    read_config,
)
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy

HEADER_BYTES = 1_000_000  # of a safetensors file, beside its weights
MAX_SIZE = 65_536  # of a layer, and whatever else a network counts


@dataclasses.dataclass(frozen=True)
class LoadedCheckpoint:
    """A checkpoint in memory."""

    network: Policy  # in evaluation mode, float32
    config: NetworkConfig
    info: dict  # the keys of `INFO`, and 'sha256' of the weights


def save_checkpoint(folder: str | Path, network: Policy, info: dict, *,
                    half: bool = False) -> None:
    """Write a checkpoint; the folder appears, or is replaced, whole or not at all.

    Args:
        folder: where; its parent is made.
        network: the policy.
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
    config = {
        'format': FORMAT,
        'network': dataclasses.asdict(network.config),
        'action_names': list(network.config.actions),
        'sha256': hashlib.sha256(weights).hexdigest(),
        **info,
    }
    del config['network']['actions']  # said once, under action_names
    config['network']['action_filter'] = network.config.filter_name
    try:
        # As it will be read: JSON has no tuples, and only text as keys.
        config = json.loads(json.dumps(config, allow_nan=False))
        config[CHECKSUM] = config_checksum(config)
        text = json.dumps(config, indent=2, allow_nan=False) + '\n'
    except (TypeError, ValueError) as error:
        raise UserError('info holds only JSON values', str(error), 'convert them first') from error
    parameters = sum(tensor.numel() for tensor in tensors.values())
    files = {WEIGHTS: weights, CONFIG: text.encode(),
             CARD: model_card(config, parameters, len(weights)).encode()}
    try:
        _write_folder(folder, files)
    except OSError as error:
        raise UserError(f'a checkpoint can be written ({len(weights) / 1e6:.1f} MB)',
                        f'{error.filename or folder}: {error.strerror}',
                        'free some space, or choose a folder that may be written: the checkpoint '
                        'before is whole') from error


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
    config, info = read_config(folder)
    where = str(folder / CONFIG)
    network_config, shapes = _read_network(config, where)
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
    return LoadedCheckpoint(network.eval(), network_config, {**info, 'sha256': digest})


def _read_network(config: dict, where: str) -> tuple[NetworkConfig, dict[str, tuple]]:
    """The network of a `config.json`, and the shapes of its weights by name.

    The shapes come from a network without memory: an absurd size must not be allocated.
    """
    names, given = config['action_names'], config['network']
    if not (isinstance(names, list) and len(names) <= 256
            and all(isinstance(name, str) for name in names)):
        raise UserError('action_names is a list of at most 256 names',
                        f'{where}: {reprlib.repr(names)}', 'get the checkpoint again')
    if not isinstance(given, dict):
        raise UserError(f'the network in {CONFIG} is a mapping', f'{where}: {reprlib.repr(given)}',
                        'get the checkpoint again')
    fields = {field.name: field.default for field in dataclasses.fields(NetworkConfig)
              if field.name != 'actions'}
    for name, value in given.items():
        if name not in fields:
            raise UserError(f'the network in {CONFIG} has only the fields {", ".join(fields)}',
                            f'{where}: {name}', 'use the version of vn_nav that wrote it, or '
                            'train again')
        if not _fits(value, fields[name]):
            raise UserError(f'{name} of the network in {CONFIG} is of the type and '
                            f'size of {fields[name]!r}', f'{where}: {reprlib.repr(value)}',
                            'get the checkpoint again')
    try:
        network = NetworkConfig(actions=tuple(names), **given)
        with torch.device('meta'):
            shapes = {name: tuple(tensor.shape)
                      for name, tensor in build_policy(network).state_dict().items()}
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise UserError(f'the network in {CONFIG} can be built',
                        f'{where}: {" ".join(str(error).split())[:200]}',
                        'get the checkpoint again') from error
    return network, shapes


def _fits(value: object, default: object) -> bool:
    """Whether a value out of JSON has the type of a field of `NetworkConfig`."""
    if isinstance(default, tuple):
        return isinstance(value, list) and all(
            isinstance(part, (str, int)) or (isinstance(part, list) and all(
                _fits(number, 0.0) for number in part)) for part in value)
    if isinstance(default, float):
        return (isinstance(value, NUMBER) and not isinstance(value, bool)
                and math.isfinite(value))
    return type(value) is type(default) and not (type(value) is int and abs(value) > MAX_SIZE)


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


def model_card(config: dict, parameters: int, size: int) -> str:
    """The README of a checkpoint, from the content of its `config.json`."""
    network = config['network']
    side, scenes = network['size'], config['scenes']
    home = 'its training environment'
    if scenes:
        home = (f'{len(scenes)} scene{"s" * (len(scenes) > 1)} ({", ".join(scenes[:8])}'
                f'{", ..." * (len(scenes) > 8)})')
    facts = {
        'Input': f'RGB {side} x {side} from a camera {config["camera_height"]:g} m above the '
                 f'floor, {config["camera_fov_deg"]:g} deg field of view; the goal picture alike',
        'Actions': ', '.join(config['action_names']),
        'Decoding': {'sample': 'sampled from the policy', 'greedy': 'the likeliest action'}[
            config['decoding']],
        'Network': f'{_describe(network)}; {parameters:,} parameters, {size / 1e6:.1f} MB',
        **({'Action filter': 'blocked actions: an action without progress is not repeated '
            'from the same place; part of every figure (docs/method.md)'}
           if network.get('action_filter', NONE) != NONE else {}),
        'Trained in': config['data'] or home,
        **({'Losses': ', '.join(config['losses']).replace('_', ' ')} if config['losses'] else {}),
        'Training': ('no episode was driven; ' if config['data'] and not config['frames'] else
                     f'{config["frames"]:,} frames (agent decisions) in ')
        + f'{config["minutes"]:.1f} minutes, seed {config["seed"]}',
        'World version': config['world_version'],
        'Weights': f'SHA-256 `{config["sha256"]}`',
    }
    purpose = ('Drives a robot to the place where a picture was taken.' if not config['losses']
               else 'Weights to begin a training with (`vn_nav train --init`), pre-trained on '
               'recorded pictures. No episode was driven: whether it arrives is not known.')
    lines = ['# Visual navigation policy', '',
             f'{purpose} It sees its camera, the goal picture and its own last action; no map, no '
             'depth, no pose.', '',
             '| | |', '|---|---|', *(f'| {key} | {value} |' for key, value in facts.items())]
    if config['command']:
        lines += ['', 'Trained with', '', '```', str(config['command']), '```']
    lines += ['', '## Measured', '']
    lines += _results_table(config['results']) or ['Nothing yet.']
    if config['notes']:
        lines += ['', '## Notes', '', str(config['notes'])]
    return '\n'.join(lines) + '\n'


def _describe(network: dict) -> str:
    """The network in words."""
    if network['architecture'] == 'icra2017':
        frozen = {'': 'the small random encoder', 'resnet50': 'ResNet-50',
                  'given': "ResNet-50 in the scenes' files"}[network['frozen']]
        return (f'Zhu et al. 2017 on frozen features of {frozen}; {network["frames"]} stacked '
                f'frames; layers for {network["scenes"]} scene{"s" * (network["scenes"] > 1)}')
    words = {'thesis': "the thesis's two streams", 'unreal': "UNREAL's single stream",
             'fused': f'convolutions {" / ".join(map(str, network["channels"]))}, picture and '
                      f'goal fused in the first; {network["features"]} features',
             'matching': f'convolutions {" / ".join(map(str, network["channels"]))}, picture and '
                         'goal compared place by place (correlation volume); '
                         f'{network["features"]} features'}[
        network['architecture']]
    if network['blocks']:
        words += f'; {network["blocks"]} residual block(s) a stage'
    if network.get('moves'):
        words += '; the goal tracked by dead reckoning'
    words += (f'; {network["frames"]} stacked frames' if network['frames'] > 1
              else f'; LSTM {network["hidden"]}')
    heads = ', '.join(network['heads']).replace('_', ' ')
    return words + (f'; heads {heads}' if heads else '')


def _results_table(results: dict) -> list[str]:
    """One row for each nested mapping, its figures as columns; other values as a list."""
    rows = {name: row for name, row in results.items() if isinstance(row, dict)}
    lines = []
    if rows:
        columns = list(dict.fromkeys(key for row in rows.values() for key in row))
        lines += ['| | ' + ' | '.join(key.replace('_', ' ') for key in columns) + ' |',
                  '|---' * (len(columns) + 1) + '|']
        lines += [f'| {name.replace("_", " ")} | '
                  + ' | '.join(_figure(row.get(key, '')) for key in columns) + ' |'
                  for name, row in rows.items()]
    single = [f'- {name.replace("_", " ")}: {_figure(value)}' for name, value in results.items()
              if name not in rows]
    return lines + ([''] if rows and single else []) + single


def _figure(value: object) -> str:
    if isinstance(value, float):
        return f'{value:.3g}' if abs(value) < 1000 else f'{value:,.0f}'
    if isinstance(value, (list, tuple)):
        return ' to '.join(_figure(part) for part in value)
    return str(value)


def _write_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Write a folder that appears, or is replaced, whole or not at all."""
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists() and any(path.name not in (WEIGHTS, CONFIG, CARD)
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
