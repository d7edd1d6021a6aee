"""Pre-training of the encoder on picture pairs: where does the goal stand, and is it in view?

What a policy for unseen houses has to learn is to compare two pictures; reinforcement alone
hardly teaches it, and its labels are free (docs/results.md).
"""

from __future__ import annotations

import csv
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.learning.auxiliary import POSE_OVERLAP, image_target, pose_loss
from vn_nav.learning.state_file import read_state, write_state
from vn_nav.policy.encoders import Fused, Matching
from vn_nav.policy.heads import Pose
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import IMAGE_HEADS

STATE, METRICS = 'pairs_state', 'pairs.csv'
COLUMNS = ('pairs', 'minutes', 'loss', 'bearing_deg', 'bearing_within_30', 'heading_deg',
           'distance_m', 'overlap_accuracy', 'validation_bearing_deg',
           'validation_bearing_within_30', 'validation_heading_deg', 'validation_distance_m',
           'validation_overlap_accuracy')


class PairSource(Protocol):
    """Draws pairs; `vn_sim_bridge.datasets.view_pairs.PairSampler` does."""

    count: int  # robots placed so far; may be set

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """`image` and `goal` [K,3,S,S] uint8, `goal_pose` [K,4], `overlap` [K]."""

    def draw_groups(self, count: int, robots: int) -> dict[str, np.ndarray]:
        """`image` [V,3,S,S] uint8, pairs of them `first`, `second` [K], and the same labels."""


@dataclasses.dataclass(frozen=True)
class PairConfig:
    """Numbers of the pre-training."""

    minutes: float = 10.0  # wall-clock, drawing included
    groups: int = 64  # of views, in a step
    robots: int = 1  # in a group, in addition to the goal; R make R * (R + 1) pairs
    learning_rate: float = 1e-3  # at the start; falls linearly to a twentieth
    report_every: int = 200  # steps
    image_weight: float = 0.5  # of the image heads, where the network has some
    save_seconds: float = 30.0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) > 0:
                raise UserError(f'{field.name} of the pair pre-training is positive',
                                getattr(self, field.name), 'correct it')


def pretrain_pairs(network: Policy, source: PairSource, validation: PairSource, folder: Path,
                   config: PairConfig, on_report: Callable[[dict], None] | None = None) -> None:
    """Train a network's encoder, its head `goal_pose` and its image heads.

    Goes on where it was interrupted.

    Args:
        network: changed in place.
        source, validation: pairs to learn from, and others to judge by.
        folder: gets `pairs_state` (at least every `save_seconds`) and `pairs.csv`.
        config: numbers.
        on_report: called with each row of the metrics.
    """
    drawn = [name for name in network.heads if name in IMAGE_HEADS]
    parameters = [*network.encoder.parameters(),
                  *(p for name in ('goal_pose', *drawn) for p in network.heads[name].parameters())]
    optimiser = torch.optim.Adam(parameters, config.learning_rate)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / STATE
    seconds = 0.0
    rows: list[dict] = []
    if path.is_file():
        seconds, rows = _load(path, network, optimiser, source)
    held_out = validation.draw(1024)
    clock = saved = time.monotonic()
    losses: list[Tensor] = []
    while seconds < 60 * config.minutes:
        share = min(seconds / 60 / config.minutes, 1.0)
        for group in optimiser.param_groups:
            group['lr'] = config.learning_rate * (1 - 0.95 * share)
        pairs = source.draw_groups(config.groups, config.robots)
        pose, maps = look(network, pairs['image'], pairs['first'], pairs['second'])
        overlap = torch.from_numpy(pairs['overlap'])
        loss = pose_loss(*pose, torch.from_numpy(pairs['goal_pose']), overlap, overlap >= 0)
        for name in drawn:
            error = network.heads[name](maps) - _shown(network, name, pairs)
            loss = loss + config.image_weight * (error ** 2).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        losses.append(loss.detach())
        now = time.monotonic()
        seconds, clock = seconds + now - clock, now
        if len(losses) == config.report_every or seconds >= 60 * config.minutes:
            row = {'pairs': source.count * (1 + config.robots), 'minutes': seconds / 60,
                   'loss': float(torch.stack(losses).mean()), **errors(pose, pairs),
                   **{f'validation_{name}': value
                      for name, value in measure(network, held_out).items()}}
            rows.append({name: row[name] for name in COLUMNS})
            losses.clear()
            if on_report is not None:
                on_report(rows[-1])
        if now - saved >= config.save_seconds:
            _save(path, network, optimiser, source, seconds, rows)
            saved = now
    _save(path, network, optimiser, source, seconds, rows)
    with open(folder / METRICS, 'w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows({name: f'{value:.5g}' for name, value in row.items()} for row in rows)


@torch.no_grad()
def measure(network: Policy, pairs: dict[str, np.ndarray]) -> dict[str, float]:
    """`errors` of a network on some pairs."""
    poses = []
    for k in range(0, len(pairs['image']), 128):
        views = np.concatenate([pairs['image'][k:k + 128], pairs['goal'][k:k + 128]])
        first = np.arange(len(views) // 2)
        poses.append(look(network, views, first, first + len(first))[0])
    return errors(Pose(*(torch.cat(parts) for parts in zip(*poses, strict=True))), pairs)


def errors(pose: Pose, pairs: dict[str, np.ndarray]) -> dict[str, float]:
    """Median errors over the pairs that overlap; of the overlap accuracy, where it is known."""
    truth = torch.from_numpy(pairs['goal_pose'])
    overlap = torch.from_numpy(pairs['overlap'])
    sees, known = overlap >= POSE_OVERLAP, overlap >= 0
    position, heading = pose.position.detach()[sees], pose.heading.detach()[sees]
    true_position, true_heading = truth[sees, :2], truth[sees, 2:]
    far = true_position.norm(dim=1) > 0.3  # nearer, a bearing means nothing
    bearing = _angle(position, true_position)[far]
    correct = (pose.co_visible.detach() > 0) == sees
    return {
        'bearing_deg': _median(bearing), 'bearing_within_30': _mean(bearing <= 30),
        'heading_deg': _median(_angle(heading, true_heading)),
        'distance_m': _median((position - true_position).norm(dim=1)),
        'overlap_accuracy': _mean(correct[known]),
    }


def look(network: Policy, views: np.ndarray, first: np.ndarray, second: np.ndarray
         ) -> tuple[Pose, Tensor]:
    """What a network says of pairs of views, and its maps; every view is encoded once.

    Args:
        network: with the head `goal_pose`.
        views: [V,3,S,S] uint8; first, second: [K] int64, the second is the goal.

    Returns:
        The poses of K pairs, and maps [K,C,h,w].
    """
    shown = torch.from_numpy(views)
    goals, _ = network.goal_parts(network.encode_goals(shown))
    encoder = network.encoder
    assert isinstance(encoder, (Fused, Matching))  # those that see a picture before its goal
    seen = encoder.see(shown, network.compute_dtype)
    maps, features = encoder.meet(seen[first], goals[second], None)
    return network.heads['goal_pose'](features), maps


def _shown(network: Policy, name: str, pairs: dict[str, np.ndarray]) -> Tensor:
    """What an image head shall draw of pairs."""
    key, view = {'reconstruction': ('image', 'first'), 'depth': ('depth', 'first'),
                 'segmentation': ('segmentation', 'first'),
                 'goal_segmentation': ('segmentation', 'second')}[name]
    return image_target(network, name, torch.from_numpy(pairs[key]))[pairs[view]]


def _angle(one: Tensor, other: Tensor) -> Tensor:
    """Angle between plane vectors [N,2], degrees."""
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return torch.atan2(cross, (one * other).sum(1)).abs() * (180 / math.pi)


def _median(values: Tensor) -> float:
    return float(values.median()) if len(values) else math.nan


def _mean(values: Tensor) -> float:
    return float(values.float().mean()) if len(values) else math.nan


def _save(path: Path, network: Policy, optimiser, source: PairSource, seconds: float,
          rows: list[dict]) -> None:
    write_state(path, {'network': network.state_dict(), 'optimiser': optimiser.state_dict(),
                       'count': source.count, 'seconds': seconds, 'rows': rows})


def _load(path: Path, network: Policy, optimiser, source: PairSource) -> tuple[float, list[dict]]:
    state = read_state(path)
    try:
        network.load_state_dict(state['network'])
    except RuntimeError as error:
        raise UserError('a pre-training is resumed with its own network',
                        str(error).splitlines()[0], 'use the same options, or another folder'
                        ) from error
    optimiser.load_state_dict(state['optimiser'])
    source.count = state['count']
    return state['seconds'], state['rows']
