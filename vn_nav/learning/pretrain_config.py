"""Numbers of a pre-training, and which parts of the loss some drives can teach."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.learning.hindsight import Drives
from vn_nav.learning.supervised import BY_WINDOW, NEEDS, PARTS
from vn_nav.policy.network_config import IMAGE_HEADS


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """Numbers of the pre-training."""

    epochs: int = 30  # thesis, table 5.1
    batch: int = 32  # pairs of pictures in a step of the optimiser
    learning_rate: float = 1e-3  # at the start; falls linearly to a twentieth
    window: int = 16  # steps
    farthest: int = 48  # steps from a window's first one to its goal
    validation_share: float = 0.1
    # Weights of the losses; of one image head: `image`.
    image: float = 1.0
    goal_pose: float = 1.0
    cloning: float = 1.0
    arrival: float = 0.5
    distance: float = 0.2
    max_gradient_norm: float = 1.0
    save_seconds: float = 30.0
    seed: int = 0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != 'seed' and not value > 0:
                raise UserError(f'{field.name} of a pre-training is positive', value, 'correct it')
        if self.validation_share >= 1:
            raise UserError('the share of the validation is below 1', self.validation_share,
                            'leave something to learn from')
        if self.seed < 0:
            raise UserError('the seed of a pre-training is not negative', self.seed, 'correct it')

    def weight(self, part: str) -> float:
        """Of a part of the loss."""
        return self.image if part in IMAGE_HEADS else getattr(self, part)


def choose_parts(drives: Drives, asked: Sequence[str] | None, own: Sequence[str],
                 cloning: bool | None) -> tuple[tuple[str, ...], list[str]]:
    """What can be learned from some drives.

    Args:
        drives: the bags.
        asked: heads; None: those whose keys the bags have and, of the others, the network's own.
        own: heads of the network.
        cloning: of the actions; None: where there are any.

    Returns:
        Some of `PARTS`, and lines about what is left out and why.

    Raises:
        UserError: no such head, cloning without actions, or nothing to learn.
    """
    heads = [part for part in PARTS if part != 'cloning']
    if asked is not None and not set(asked) <= set(heads):
        raise UserError(f'heads to pre-train are some of {", ".join(heads)}', ', '.join(asked),
                        'correct --heads')
    acts = bool((drives.action >= 0).any())
    if cloning and not acts:
        raise UserError("cloning needs motions that are the robot's actions",
                        'bags without any', 'give the robot that drove with --robot, or use '
                        '--no-cloning')
    cloning = acts if cloning is None else cloning
    if asked is None:
        asked = [*NEEDS, *(name for name in ('goal_pose', *BY_WINDOW) if name in own)]
        if not (drives.has['depth'].any() or drives.has['labels'].any()):
            asked.append('reconstruction')
    parts, notes = [], []
    for name in PARTS:
        if name == 'cloning':
            if cloning:
                parts.append(name)
            continue
        if name not in asked:
            continue
        known = drives.has[NEEDS[name]] if name in NEEDS else np.ones(1, bool)
        topic = f'{NEEDS.get(name)}/image_raw'
        if not known.any():
            notes.append(f'{name} is left out: no bag has {topic} for all its pictures')
        elif name in BY_WINDOW and not cloning:
            notes.append(f'{name} is left out: it is learned along the actions of a drive')
        else:
            parts.append(name)
            if not known.all():
                notes.append(f'{name} learns from {known.mean():.0%} of the pictures: the others '
                             f'lack {topic}')
    if not parts:
        raise UserError('there is something to pre-train', '; '.join(notes) or 'no head, and no '
                        'cloning', 'choose other --heads, or other bags')
    return tuple(parts), notes
