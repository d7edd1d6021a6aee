"""Checkpoints: a folder with model.safetensors, config.json and README.md (the model card).

The network's shape comes from config.json alone; nothing in the folder can execute code.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import safetensors
import safetensors.torch
import torch

from vn_nav.errors import UserError
from vn_nav.policy.network import NetworkConfig, Policy

FORMAT = 1  # of config.json
WEIGHTS, CONFIG, CARD = 'model.safetensors', 'config.json', 'README.md'
DECODINGS = ('sample', 'greedy')


class Checkpoint(NamedTuple):
    """A loaded checkpoint."""

    network: Policy  # in evaluation mode, float32
    config: NetworkConfig
    info: dict  # everything else of config.json: world_version, houses, frames, results, ...


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file so that a crash leaves the old or the new content, never a part."""
    temporary = path.with_name(path.name + '.part')
    with open(temporary, 'wb') as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def save_checkpoint(folder: str | Path, network: Policy, info: dict, *, half: bool = False) -> None:
    """Write a checkpoint; the folder appears, or is replaced, as a whole.

    Args:
        folder: where to.
        network: the weights and their configuration.
        info: JSON facts about the training: world_version, houses, rooms, seed, frames, minutes,
            command, camera_fov_deg, camera_height, decoding, results.
        half: store the weights in half precision.
    """
    folder = Path(folder)
    fresh = folder.with_name(folder.name + '.part')
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    tensors = {name: tensor.detach().to(torch.float16 if half else torch.float32).contiguous()
               for name, tensor in network.state_dict().items()}
    weights = safetensors.torch.save(tensors)
    config = {'format': FORMAT, 'network': dataclasses.asdict(network.config),
              'sha256': hashlib.sha256(weights).hexdigest(), **info}
    write_atomically(fresh / WEIGHTS, weights)
    write_atomically(fresh / CONFIG, json.dumps(config, indent=2).encode())
    write_atomically(fresh / CARD, model_card(folder.name, config).encode())
    old = folder.with_name(folder.name + '.old')
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        os.rename(folder, old)
    os.rename(fresh, folder)
    shutil.rmtree(old, ignore_errors=True)


def load_checkpoint(folder: str | Path, *, expect_actions: Sequence[str] | None = None,
                    expect_world: str | None = None) -> Checkpoint:
    """Read and verify a checkpoint.

    Args:
        folder: what `save_checkpoint` wrote.
        expect_actions: action names that the caller's robot or environment has, in its order.
        expect_world: world version of the simulator that will be used.

    Raises:
        UserError: anything missing, corrupt or different from what is expected.
    """
    folder = Path(folder)
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise UserError(f'a checkpoint is a folder with {CONFIG} and {WEIGHTS}', str(folder),
                            'give the folder of a trained model, for example models/house')
    try:
        info = json.loads((folder / CONFIG).read_text())
        shape = {**info.pop('network')}
        config = NetworkConfig(**shape)
        checksum, version = info['sha256'], info['format']
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f'{CONFIG} describes a network of this program', f'{folder}: {error!r}',
                        'take the checkpoint from its source again') from error
    if version != FORMAT:
        raise UserError(f'the checkpoint has format {FORMAT}', version,
                        'use the version of vn_nav that wrote it')
    weights = (folder / WEIGHTS).read_bytes()
    if hashlib.sha256(weights).hexdigest() != checksum:
        raise UserError(f'the SHA-256 of {WEIGHTS} is the one in {CONFIG}', str(folder),
                        'the file is damaged: take the checkpoint from its source again')
    if expect_actions is not None and tuple(expect_actions) != config.actions:
        raise UserError(f'the checkpoint was trained with the actions {", ".join(expect_actions)}',
                        ', '.join(config.actions), 'use the robot it was trained for, or train '
                        'one for this robot')
    if expect_world is not None and info.get('world_version') != expect_world:
        raise UserError(f'the checkpoint belongs to world version {expect_world!r}',
                        info.get('world_version'), 'train it again (vn_nav train), or install '
                        'the version of vn_nav that it came with')
    network = Policy(config)
    try:
        tensors = safetensors.torch.load(weights)
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except (RuntimeError, safetensors.SafetensorError) as error:
        first = str(error).splitlines()[0]
        raise UserError('the weights fit the network of config.json', f'{folder}: {first}',
                        'take the checkpoint from its source again') from error
    return Checkpoint(network.eval(), config, info)


def model_card(name: str, config: dict) -> str:
    """The README.md of a checkpoint: what it is, how it was made, how well it does."""
    lines = [f'# {name}', '',
             'A goal-picture navigation policy of vn_nav: it sees the camera picture and a goal '
             'picture and chooses one of ' + ', '.join(f'`{a}`' for a in config['network']['actions'])
             + '.', '', '| fact | value |', '|---|---|']
    facts = {'trained in houses (seeds)': 'houses', 'rooms': 'rooms',
             'world version': 'world_version', 'command': 'command', 'seed': 'seed',
             'frames (agent decisions)': 'frames', 'wall-clock minutes': 'minutes',
             'machine': 'machine', 'date': 'date', 'camera field of view [deg]': 'camera_fov_deg',
             'camera height [m]': 'camera_height', 'decoding': 'decoding'}
    for title, key in facts.items():
        if key in config:
            value = f'`{config[key]}`' if key == 'command' else config[key]
            lines.append(f'| {title} | {value} |')
    for place, results in config.get('results', {}).items():
        lines += ['', f'## {place}', '', results_table(results)]
    return '\n'.join(lines) + '\n'


def results_table(results: dict) -> str:
    """Markdown of {control: summary} as `vn_nav evaluate` measures them."""
    rows = ['| policy | episodes | success (95 %) | SPL | decisions | seconds | '
            'collisions | contact-free success | stop error | return |',
            '|---|---|---|---|---|---|---|---|---|---|']
    for control, r in results.items():
        low, high = r['success_interval']
        rows.append(
            f'| {control} | {r["episodes"]} | {r["success"]:.2f} ({low:.2f}-{high:.2f}) | '
            f'{r["spl"]:.2f} | {r["decisions"]:.0f} | {r["seconds"]:.0f} | '
            f'{r["collisions"]:.3f} | {r["contact_free_success"]:.2f} | '
            f'{r["stop_error_m"]:.2f} m, {r["stop_error_deg"]:.0f} deg | {r["return"]:.2f} |')
    return '\n'.join(rows)
