"""What of a training can be learned where the environment does not tell everything."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

from vn_nav.learning.learner_config import PRIVILEGED, TEACHERS
from vn_nav.learning.presets import TrainConfig

# What an environment knows of itself, whatever its simulator.
ALWAYS = ('arrived', 'distance')
WORDS = {'depth': 'depth', 'segmentation': 'labels', 'goal_segmentation': 'labels',
         'overlap': 'what two pictures share', 'explorer_action': 'walls',
         'oracle_action': 'driving distances', 'oracle_regret': 'the cost of each action',
         'arrived': 'arrival', 'distance': 'distances'}


def config_without(config: TrainConfig, told: Collection[str], simulator: str, *,
                   always: Collection[str] = ALWAYS) -> tuple[TrainConfig, list[str]]:
    """A training without the tasks whose keys nobody tells; their heads are left out as well.

    Args:
        config: the training.
        told: keys of `info` that the environment gives.
        simulator: its name, for people.
        always: what it knows beside.

    Returns:
        The configuration, and what is left out and why, in words.
    """
    known = {*told, *always}
    lost = {}
    for name in config.tasks:
        keys = TEACHERS[config.teacher] if name == 'imitation' else PRIVILEGED.get(name, ())
        if missing := [key for key in keys if key not in known]:
            lost[name] = dict.fromkeys(WORDS[key] for key in missing if key in WORDS)
    if not lost:
        return config, []
    words = [f'{name} is left out: {simulator} does not tell {" and ".join(why)}'
             for name, why in lost.items()]
    changes: dict[str, Any] = dict.fromkeys(lost, 0.0)
    if 'imitation' in lost:
        changes['teacher_share'] = 0.0
    if 'goal_pose' in lost:
        changes |= {'pair_minutes': 0.0, 'pose_to_memory': False, 'track_goal': False}
        words += [f'{name} is left out: it is made of goal_pose' for name in
                  ('pair_minutes', 'pose_to_memory', 'track_goal') if getattr(config, name)]
    return dataclasses.replace(config, **changes), words
