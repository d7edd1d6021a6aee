"""What a step was computed from whose loss is not finite, left for people to look at."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.learning.rollout import Rollout
from vn_nav.policy.network import Policy


def give_up(path: Path | None, network: Policy, batch: Rollout, advantage: Tensor, target: Tensor,
            figures: dict[str, Tensor], replayed: dict[str, Rollout | dict]) -> None:
    """Leave what the step was computed from, and end the training.

    `torch.load(path)` gives plain values and tensors: `batch` (the fields of `Rollout`, one
    minibatch), `advantage` and `target` [T,B] as the losses used them, `losses` by name,
    `replayed` (what was drawn for each task whose loss is not finite) and the `network`'s
    weights before the step.

    Args:
        path: of the file; None: there is none.
        network: that failed.
        batch, advantage, target: of the step.
        figures: losses by name.
        replayed: what was drawn from the replay memory, by task.

    Raises:
        UserError: always.
    """
    where = ''
    if path is not None:
        drawn = {name: part for name, part in replayed.items()
                 if not torch.isfinite(figures[name])}
        buffer = io.BytesIO()
        torch.save({
            'batch': _plain(batch), 'advantage': advantage, 'target': target,
            'losses': {name.removesuffix('_loss'): float(value)
                       for name, value in figures.items()},
            'replayed': {name: _plain(part) for name, part in drawn.items()},
            'network': network.state_dict()}, buffer)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, buffer.getvalue())
            where = f'; the batch is in {path} (torch.load reads it)'
        except OSError as error:
            where = f'; the batch could not be written to {error.filename}: {error.strerror}'
    raise UserError('losses and gradients stay finite',
                    ', '.join(f'{name} {float(value):g}' for name, value in figures.items()),
                    f'lower the learning rate and resume from the last checkpoint{where}')


def _plain(part: Rollout | dict) -> dict:
    """As a dictionary that `torch.load` trusts, and the network's goals once."""
    if isinstance(part, dict):
        return part
    rows = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    state = None if part.state is None else part.state._asdict()
    return {**rows, 'observation': part.observation._asdict(), 'state': state}
