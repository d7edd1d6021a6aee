"""The shipped models act as they did when these actions were recorded, bit for bit."""

import json
from pathlib import Path

import numpy as np
import pytest
from paths import ROOT

from vn_nav.cli.world import load_for, make_env
from vn_nav.evaluation.evaluator import PolicyActor
from vn_nav.scenes import house_scene

# Of 60 decisions of 4 environments: actions as digits (4: declared), the last poses, and how many
# decisions the last episodes had.
RECORDED = json.loads((Path(__file__).parent / 'present_actions.json').read_text())


@pytest.mark.slow
@pytest.mark.parametrize(('model', 'seeds', 'stop'), [
    ('house', (7,), 'declared'), ('anywhere', (0, 11_000), 'arrival')])
def test_shipped_models_act_as_before(model, seeds, stop):
    checkpoint, _ = load_for(ROOT / 'models' / model)
    info, recorded = checkpoint.info, RECORDED[model]
    assert info['simulator'] == 'house' and house_scene(seeds[0]) in info['scenes']
    env = make_env(map(house_scene, seeds), 4, size=checkpoint.config.size,
                   randomisation=info['randomisation'], seed=3, stop=stop,
                   actions=checkpoint.config.actions, goals_per_room=info['goals_per_room'],
                   max_decisions=40)
    actor = PolicyActor(env, checkpoint.network, info['decoding'], 5, info['stop_threshold'])
    observation, info = env.reset(seed=11)
    chosen = []
    for _ in range(len(recorded['actions'][0])):
        chosen.append(actor(observation, info['reset']))
        observation, *_, info = env.step(chosen[-1])
    assert [''.join(map(str, own)) for own in np.array(chosen).T] == recorded['actions']
    assert np.array_equal(info['pose'], recorded['poses'])
    assert info['decisions'].tolist() == recorded['decisions']
    env.close()
