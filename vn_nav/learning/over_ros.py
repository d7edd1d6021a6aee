"""What of a training can be learned where only topics say what happens."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

from vn_nav.errors import UserError
from vn_nav.learning.learner_config import PRIVILEGED
from vn_nav.learning.presets import TrainConfig


def config_over_ros(config: TrainConfig, world: dict, offers: Collection[str], lock_step: bool
                    ) -> tuple[TrainConfig, list[str]]:
    """What of a training can be learned where only topics say what happens.

    Heads whose task is left out stay, so that the checkpoint of a simulator fits and bags can go
    on teaching them.

    Args:
        config: as it would be in a simulator.
        world: options of the environment, of `WORLD`.
        offers: keys of `info` that the topics can give.
        lock_step: the robot is simulated and waits.

    Returns:
        The configuration, and lines about what is left out and why.

    Raises:
        UserError: a device or architecture for which goals must be known before they are seen;
            or motion while the learner is busy.
    """
    rules = (
        (config.device == 'cpu', 'goals that come one by one are kept on the CPU',
         f'--device {config.device}', 'leave --device out'),
        (config.architecture != 'icra2017', 'goals that come one by one are encoded anew',
         'the architecture icra2017, which does so once', 'choose another --preset'),
        (lock_step or not config.overlap, 'a robot stands still while the learner is busy',
         '--overlap', 'leave it out, or train in --lock-step'),
    )
    for kept, rule, received, remedy in rules:
        if not kept:
            raise UserError(rule, received, remedy)
    lost = [name for name in config.tasks if not set(PRIVILEGED.get(name, ())) <= set(offers)
            or name == 'imitation']
    notes = [f'{name} is left out: no topic has {" or ".join(PRIVILEGED.get(name, ("it",)))}'
             for name in lost]
    notes += [f'{name} is left out: no topic has it'
              for name in ('progress_reward', 'exploration_reward') if world.get(name)]
    if config.start_difficulty < 1:
        notes.append('there is no curriculum: robots start where they are')
    if config.pair_minutes:
        notes.append("there are no picture pairs: they are the simulator's")
    without: dict[str, Any] = dict.fromkeys(lost, 0.0)
    return dataclasses.replace(
        config, **without, teacher_share=0.0, pair_minutes=0.0,
        start_difficulty=1.0, extra_heads=(*config.extra_heads, *(
            name for name in lost if name != 'imitation'))), notes
