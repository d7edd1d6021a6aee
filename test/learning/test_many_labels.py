"""Tasks with labels of their own: a simulator with more classes than a byte counts."""

import numpy as np
import pytest
import torch
from other_corridors import CLASSES, SHIFT, ManyLabels, register

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.labels import label_dtype
from vn_nav.learning.auxiliary import image_target
from vn_nav.learning.pixel_change import label_colours
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def test_ids_are_as_wide_as_their_number_asks():
    assert [label_dtype(count) for count in (0, 57, 256, 257, 65_536)] == [
        np.uint8, np.uint8, np.uint8, np.uint16, np.uint16]
    with pytest.raises(UserError, match='at most 65536 classes'):
        label_dtype(65_537)


def test_an_environment_passes_them_on(monkeypatch):
    register(monkeypatch, 'many', ManyLabels)
    env = NavigationEnv(EnvConfig(scenes=('many:5',), num_envs=2, size=24,
                                  privileged=('segmentation', 'goal_segmentation')))
    _, info = env.reset(seed=0)
    ids = set(range(SHIFT, SHIFT + 3))
    for key in ('segmentation', 'goal_segmentation'):
        assert info[key].dtype == np.uint16 and set(np.unique(info[key])) <= ids
    assert env.label_names == ManyLabels.label_names
    env.close()


def test_each_class_has_its_own_colour_as_a_target():
    network = Policy(NetworkConfig(('a', 'b'), 36, 'thesis', heads=('segmentation',),
                                   classes=CLASSES))
    labels = torch.full((1, 36, 36), SHIFT, dtype=torch.uint16)
    drawn = image_target(network, 'segmentation', labels)[0, :, 0, 0]
    assert torch.allclose(drawn, label_colours(CLASSES)[SHIFT])


@pytest.mark.slow
def test_the_thesis_learns_from_them(tmp_path, monkeypatch):
    register(monkeypatch, 'many', ManyLabels)
    assert main(['train', '--scene', 'many:5', '--preset', 'thesis', '--envs', '4', '--size', '36',
                 '--frames', '400', '--set', 'replay_steps=400', '--no-tensorboard', '--out',
                 str(tmp_path / 'run')]) == 0
    made = load_checkpoint(tmp_path / 'run' / 'checkpoint')
    assert made.config.classes == CLASSES
    assert tuple(made.info['label_names']) == ManyLabels.label_names
