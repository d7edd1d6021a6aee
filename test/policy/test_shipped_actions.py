"""The shipped models act on seeded episodes as they did when they were shipped, bit for bit.

`shipped_actions.json` was recorded before the memory of blocked actions became the filter of
`vn_nav.policy.action_filter`. Record it anew (`python test/policy/test_shipped_actions.py`) only
where pixels, motion, weights or the filter's rule change on purpose.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation

RECORD = Path(__file__).with_name('shipped_actions.json')
HOUSES = {'house': (7,), 'anywhere': (10_000, 10_001, 10_002)}
ENVIRONMENTS, STEPS, LIMIT, SEED = 3, 150, 60, 5
ALONE = 80  # decisions of one robot


def make_env(model: str, info: dict, size: int) -> NavigationEnv:
    """Episodes of at most `LIMIT` decisions, with the randomisation of the model's training."""
    return NavigationEnv(EnvConfig(
        scenes=house_scenes(HOUSES[model]), num_envs=ENVIRONMENTS, size=size,
        max_decisions=LIMIT, randomisation=load_randomisation(info['randomisation'])))


def actions_of(model: str, decoding: str) -> list[str]:
    """The actions of `BatchedPolicy`, a line of digits for each environment."""
    torch.set_num_threads(1)
    checkpoint = load_checkpoint(share_file(f'models/{model}'))
    env = make_env(model, checkpoint.info, checkpoint.config.size)
    policy = BatchedPolicy(checkpoint.network, ENVIRONMENTS, decoding, seed=SEED)
    observation, info = env.reset(seed=SEED)
    rows = []
    for _ in range(STEPS):
        rows.append(policy.act(observation, env.goals, info['reset']))
        observation, _, _, _, info = env.step(rows[-1])
    return [''.join(map(str, line)) for line in np.array(rows).T]


def actions_alone(model: str) -> str:
    """The actions of `PolicyRuntime`, where they drive the first environment."""
    folder = share_file(f'models/{model}')
    runtime = PolicyRuntime(folder, seed=SEED, stop_threshold=1.0)
    env = make_env(model, runtime.info, runtime.size)
    observation, info = env.reset(seed=SEED)
    goal, rows = None, []
    for _ in range(ALONE):
        if goal != observation['goal_index'][0] or info['reset'][0]:
            goal = observation['goal_index'][0]
            runtime.set_goal(env.goals[goal])
        rows.append(runtime.act(observation['image'][0]))
        observation, _, _, _, info = env.step(np.full(ENVIRONMENTS, rows[-1]))
    return ''.join(map(str, rows))


def record(model: str) -> dict:
    """All that is recorded of a model."""
    return {**{decoding: actions_of(model, decoding) for decoding in ('sample', 'greedy')},
            'alone': actions_alone(model)}


@pytest.mark.slow
@pytest.mark.parametrize('model', HOUSES)
def test_it_acts_as_it_did_when_it_was_shipped(model):
    recorded = json.loads(RECORD.read_text())[model]
    assert record(model) == recorded
    assert {len(line) for line in recorded['sample']} == {STEPS}


@pytest.mark.parametrize('model, name', [('house', 'none'), ('anywhere', 'blocked_actions')])
def test_a_checkpoint_that_says_nothing_has_the_filter_if_it_knows_its_moves(
        tmp_path, model, name):
    folder = shutil.copytree(share_file(f'models/{model}'), tmp_path / model)
    config = json.loads((folder / 'config.json').read_text())
    config['network'].pop('action_filter', None)  # a checkpoint from before it could be named
    config.pop('config_sha256', None)
    (folder / 'config.json').write_text(json.dumps(config))
    assert load_checkpoint(folder).config.filter_name == name


if __name__ == '__main__':
    RECORD.write_text(json.dumps({model: record(model) for model in HOUSES}, indent=1) + '\n')
