"""The state of a training as it is saved: what it is made of, and how a training goes on from it.

Resumed, a training repeats the uninterrupted one bit for bit (`vn_nav.learning.trainer.train`), so
all that changes is here: weights, optimiser, random numbers, curriculum, environments, memories.
"""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.labels import CLASSES
from vn_nav.learning.rollout import Episode, Rollout
from vn_nav.vector_env import RecallingEnv, RestorableEnv

if TYPE_CHECKING:
    from vn_nav.learning.training import Training


def state_of(training: Training) -> dict:
    """All that changes while a training runs, for a file."""
    replay = training.learner.replay
    env = None  # of many processes each has its own, which nobody saves
    if training.env.restorable and training.processes.count == 1:
        assert isinstance(training.env, RestorableEnv)  # what it calls itself
        env = {name: torch.from_numpy(np.array(rows))
               for name, rows in training.env.get_state().items()}
    return {
        'identity': _identity(training),
        'network': training.network.state_dict(),
        'optimiser': training.learner.optimiser.state_dict(),
        'curriculum': training.curriculum.state_dict(),
        'collector': training.collector.state_dict(),
        'generator': training.generator.get_state(),
        'actor_generator': training.drawn.get_state(),
        # Of many processes nobody saves what was collected, as nobody saves the environments.
        'ahead': None if training.ahead is None or training.processes.count > 1 else (
            training.ahead[0].state_dict(), [tuple(episode) for episode in training.ahead[1]]),
        'recent': [tuple(episode) for episode in training.recent],
        'frames': training.frames, 'updates': training.updates, 'seconds': training.seconds,
        'env': env,
        'bags': None if training.bags is None else training.bags.state_dict(),
        # Of an environment that does not know its goals before it has seen them.
        'shown goals': (torch.from_numpy(training.env.shown_goals.copy())
                        if isinstance(training.env, RecallingEnv) else None),
        'replay': None if replay is None else replay.state_dict(),
    }


def restore(training: Training, state: dict) -> None:
    """Go on from a save, and say how.

    Raises:
        UserError: of another network, world or number of environments.
    """
    saved = {'kind of device': 'cpu', **state['identity']}
    for name, value in _identity(training).items():
        if saved.get(name) != value:
            raise UserError(f'a training is resumed with its own {name}: {saved.get(name)}',
                            value,
                            'resume it with the same options, or start a new one')
    training.network.load_state_dict(state['network'])
    training.learner.optimiser.load_state_dict(state['optimiser'])
    training.curriculum.load_state_dict(state['curriculum'])
    training.recent.extend(Episode(*episode) for episode in state['recent'])
    training.frames, training.updates = state['frames'], state['updates']
    training.seconds = state['seconds']
    if training.bags is not None:
        training.bags.load_state_dict(state['bags'])
    if state.get('shown goals') is not None:
        if not isinstance(training.env, RecallingEnv):
            raise UserError('a training whose goals were seen on the way is resumed in an '
                            'environment that recalls them', type(training.env).__name__,
                            'resume it where it began, or start a new one')
        training.env.recall_goals(state['shown goals'].numpy())
    words = [f'resumed at {training.frames:,} frames']
    if state['env'] is not None and training.processes.count == 1:
        training.generator.set_state(state['generator'])
        if training.config.overlap and state.get('ahead'):
            training.actor.load_state_dict(state['network'])
            training.drawn.set_state(state['actor_generator'])
            rollout, episodes = state['ahead']
            training.ahead = (Rollout.from_state(rollout, training.collector.goals),
                              [Episode(*episode) for episode in episodes])
        training.env.set_difficulty(training.curriculum.tau)
        training.collector.load_state_dict(state['collector'])
        assert isinstance(training.env, RestorableEnv)  # `state_of` has saved its state
        training.env.set_state({name: rows.numpy() for name, rows in state['env'].items()})
    else:
        # No environment's first episode is an old one, wherever the counting begins.
        count = training.env.num_envs * training.processes.count
        training.curriculum.load_state_dict({
            **state['curriculum'], 'first': [0] * count, 'finished': [False] * count})
        training.begin(training.updates)
        words.append('episodes begin anew')
    replay = training.learner.replay
    if replay is not None:
        replay.load_state_dict(state.get('replay') or {'total': 0})
        words.append(
            f'the replay memory is mapped: {replay.count * replay.num_envs:,} steps are there'
            if replay.resumed == 'mapped' else 'the replay memory is refilled from now on')
    if training.processes.leads:
        print('; '.join(words), flush=True)
    training.clock = time.monotonic()


def _identity(training: Training) -> dict:
    """What must not change between save and resumption."""
    network = dataclasses.asdict(training.network.config)
    if training.config.action_filter:  # of before there was a choice: they know no such key
        del network['action_filter']
    if network['classes'] == CLASSES:  # likewise
        del network['classes']
    return {
        'bags': None if training.bags is None else training.bags.identity,
        'action names': list(network.pop('actions')),
        'network': {key: list(value) if isinstance(value, tuple) else value
                    for key, value in network.items()},
        'world version': training.env.world_version,
        'number of environments': training.env.num_envs,
        'kind of device': training.network.device.type,  # random numbers differ
    }
