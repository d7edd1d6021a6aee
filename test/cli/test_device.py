"""Where robots are simulated when the network is on a GPU."""

import pytest
import torch

from vn_nav.cli.world import MOTION_NOISE, make_env
from vn_nav.errors import UserError
from vn_nav.experiments.experiment import experiment_names, load_experiment
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import PRIVILEGED, EnvConfig, not_on_device

HOUSE = ('house:7?rooms=1',)


@pytest.mark.parametrize(('options', 'words'), [
    ({'task': 'room'}, 'image task'), (MOTION_NOISE['moves'], 'turns are as noisy'),
    ({'privileged': ('explorer_action',)}, 'teachers plan on the CPU')])
def test_what_a_gpu_cannot_simulate_is_simulated_beside_it_and_said(monkeypatch, options, words):
    monkeypatch.setattr(torch.cuda, 'device_count', lambda: 1)
    said = []
    env = make_env(HOUSE, 2, device='cuda:0', size=32, say=said.append, **options)
    assert isinstance(env, NavigationEnv)
    assert len(said) == 1 and words in said[0] and 'the network is on cuda:0' in said[0]
    env.close()


def test_without_a_gpu_it_is_refused():
    for options in ({}, {'task': 'room'}):
        with pytest.raises(UserError, match='is a GPU that torch'):
            make_env(HOUSE, 2, device='cuda:7', size=32, **options)


def test_every_experiment_has_somewhere_to_drive_beside_a_gpu():
    """On the device, or on the CPU: `vn_nav reproduce --full --device cuda:0` refuses none."""
    on_device = {}
    for name in experiment_names():
        experiment = load_experiment(name)
        for arm in experiment.arms:
            options = experiment.options(arm, 'full')
            scenes = options['scene']
            noise = MOTION_NOISE[options.get('motion_noise', 'all')]
            given = preset(options['preset'])
            world = {key: value for key, value in ENVIRONMENT[options['preset']].items()
                     if key != 'envs'}
            config = EnvConfig(
                scenes=tuple(scenes if isinstance(scenes, list) else [scenes]),
                task=options.get('task', 'image'), **noise, **world,
                privileged=tuple(sorted(set(given.privileged) & set(PRIVILEGED))))
            on_device.setdefault(name, set()).add(not_on_device(config) is None)
    assert on_device == {'ablation': {True}, 'fig5.4': {False}, 'fig5.5': {False},
                         'fig5.6': {False}, 'fig5.7': {False}}
