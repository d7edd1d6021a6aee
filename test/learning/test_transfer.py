"""A policy goes on in another simulator: what it takes along, what is new, what is left out."""

import csv
import dataclasses

import pytest
import torch
from other_corridors import CLASSES, Lacking, ManyLabels, register

from vn_nav.cli import main
from vn_nav.cli.publish import held_out
from vn_nav.errors import UserError
from vn_nav.learning.left_out import config_without
from vn_nav.learning.presets import preset
from vn_nav.learning.transfer import initial_weights
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig, tells
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator

ACTIONS = ('forward', 'rotate_left', 'rotate_right')
THESIS = NetworkConfig(ACTIONS, 36, 'thesis', hidden=32, heads=(
    'pixel_control', 'reward_prediction', 'depth', 'segmentation', 'goal_segmentation'))
INFO = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}


def network(config, seed=0):
    torch.manual_seed(seed)
    return Policy(config)


def saved(tmp_path, config, **info):
    save_checkpoint(tmp_path / 'checkpoint', network(config), {**INFO, **info})
    return tmp_path / 'checkpoint', load_checkpoint(tmp_path / 'checkpoint').network.state_dict()


def test_the_same_network_is_taken_whole(tmp_path):
    path, given = saved(tmp_path, THESIS, label_names=['a', 'b'])
    for names in ((), ('a', 'b')):  # unknown names are believed to be the same
        start = initial_weights(path, network(THESIS, 1), names)
        assert start.words == [] and start.weights.keys() == given.keys()
        assert all(torch.equal(start.weights[name], given[name]) for name in given)


@pytest.mark.parametrize(('config', 'names'), [
    (THESIS, ('a', 'c')), (dataclasses.replace(THESIS, classes=CLASSES), ())])
def test_segmentations_of_other_classes_are_new(tmp_path, config, names):
    path, given = saved(tmp_path, THESIS, label_names=['a', 'b'])
    own = network(config, 1).state_dict()
    start = initial_weights(path, network(config, 1), names)
    for name, tensor in start.weights.items():
        fresh = 'segmentation' in name
        assert torch.equal(tensor, own[name] if fresh else given[name]), name
    assert [line.split(':')[0] for line in start.words] == [
        'head segmentation is new', 'head goal_segmentation is new']
    assert all('classes of labels' in line for line in start.words)


def test_heads_that_only_one_of_them_has(tmp_path):
    path, given = saved(tmp_path, THESIS)
    config = dataclasses.replace(THESIS, heads=('pixel_control', 'arrival'))
    start = initial_weights(path, network(config, 1))
    assert start.words == ['head arrival is new: the checkpoint has none', *(
        f"the checkpoint's head {name} is left out: this training has none"
        for name in ('reward_prediction', 'depth', 'segmentation', 'goal_segmentation'))]
    assert torch.equal(start.weights['heads.pixel_control.expand.weight'],
                       given['heads.pixel_control.expand.weight'])


def test_actions_go_by_their_names(tmp_path):
    path, given = saved(tmp_path, THESIS)
    actions = ('left', 'rotate_right', 'forward', 'right')
    config = dataclasses.replace(THESIS, actions=actions)
    policy = network(config, 1)
    own, start = policy.state_dict(), initial_weights(path, policy)
    features = policy.encoder.features
    for k, name in enumerate(actions):
        before = ACTIONS.index(name) if name in ACTIONS else None
        for part in ('actor.weight', 'actor.bias'):
            want = own[part][k] if before is None else given[part][before]
            assert torch.equal(start.weights[part][k], want)
        inputs = 'memory.input_weight'
        want = own[inputs][:, features + k] if before is None else (
            given[inputs][:, features + before])
        assert torch.equal(start.weights[inputs][:, features + k], want)
    assert torch.equal(start.weights[inputs][:, :features], given[inputs][:, :features])
    assert torch.equal(start.weights[inputs][:, -1], given[inputs][:, -1])  # the reward
    assert torch.equal(start.weights['encoder.fuse.weight'], given['encoder.fuse.weight'])
    assert start.words == [
        'head pixel_control is new: its actions are others here',
        'actions go by their names: rotate_right, forward as in the checkpoint; '
        'new: left, right; left out: rotate_left']
    # The same names in another order are a mistake of somebody's.
    with pytest.raises(UserError, match='in that order'):
        initial_weights(path, network(dataclasses.replace(THESIS, actions=ACTIONS[::-1])))
    with pytest.raises(UserError, match='same network'):
        initial_weights(path, network(dataclasses.replace(config, hidden=33)))


def test_a_memory_that_sees_less_keeps_the_rest(tmp_path):
    wide = NetworkConfig(ACTIONS, 36, features=16, hidden=16, heads=('goal_pose',),
                         pose_to_memory=True)
    path, given = saved(tmp_path, wide)
    plain = dataclasses.replace(wide, heads=(), pose_to_memory=False)
    start = initial_weights(path, network(plain, 1))
    inputs = start.weights['memory.input_weight']
    assert torch.equal(inputs, given['memory.input_weight'][:, :16 + 3 + 1])
    assert start.words == ["the checkpoint's head goal_pose is left out: this training has none",
                           'what the memory sees beside features, action and reward is new']


def test_what_a_simulator_tells(monkeypatch):
    register(monkeypatch, 'lacking', Lacking)
    found = {}
    for scene in ('house:1?rooms=1', 'examples.corridor:5', 'lacking:5'):
        simulator = open_simulator([scene], Setup(1, NavigationEnv(EnvConfig(
            scenes=(scene,), num_envs=1, size=36)).robot, 36))
        found[scene.partition(':')[0]] = tells(simulator)
        simulator.close()
    assert found['house'] == {'depth', 'segmentation', 'goal_segmentation', 'oracle_action',
                              'goal_pose', 'overlap', 'explorer_action'}
    assert found['examples.corridor'] == found['house'] - {'explorer_action'}
    assert found['lacking'] == {'oracle_action'}


def test_a_training_asks_for_no_more():
    config, words = config_without(preset('thesis'), (), 'lacking')
    assert config.tasks == ('pixel_control', 'value_replay', 'reward_prediction')
    assert config.heads == ('pixel_control', 'reward_prediction')
    assert words == ['depth is left out: lacking does not tell depth',
                     'segmentation is left out: lacking does not tell labels',
                     'goal_segmentation is left out: lacking does not tell labels']
    config, words = config_without(preset('anywhere'), ('goal_pose', 'overlap'), 'open')
    assert 'imitation' not in config.tasks and 'goal_pose' in config.tasks
    assert words == ['imitation is left out: open does not tell walls']
    config, words = config_without(preset('fast'), (), 'lacking')
    assert config.tasks == ('arrival', 'distance') and not config.pose_to_memory
    assert len(words) == 3 and config.pair_minutes == 0
    same = preset('thesis')
    assert config_without(same, ('depth', 'segmentation', 'goal_segmentation'), 'house') == (
        same, [])


def train(scene, out, *more, preset='thesis'):
    return main(['train', '--scene', scene, '--preset', preset, '--envs', '4', '--size', '36',
                 '--frames', '320', '--set', 'replay_steps=400', '--no-tensorboard',
                 '--out', str(out), *more])


@pytest.mark.slow
def test_the_thesis_goes_on_where_there_is_neither_depth_nor_labels(tmp_path, monkeypatch, capsys):
    register(monkeypatch, 'lacking', Lacking)
    register(monkeypatch, 'many', ManyLabels)
    one, two, three = (tmp_path / name for name in ('one', 'two', 'three'))
    assert train('examples.corridor:5', one) == 0
    assert 'left out' not in capsys.readouterr().out
    begin = '--learning-rate', '1e-12', '--init', str(one / 'checkpoint')
    assert train('lacking:5', two, *begin) == 0
    told = capsys.readouterr().out.splitlines()
    assert 'depth is left out: lacking does not tell depth' in told
    gone = [line for line in told if "the checkpoint's head" in line]
    assert len(gone) == 3 and all('is left out: this training has none' in line for line in gone)
    first, second = (load_checkpoint(run / 'checkpoint') for run in (one, two))
    assert first.config.heads == THESIS.heads
    assert second.config.heads == ('pixel_control', 'reward_prediction')
    before, after = first.network.state_dict(), second.network.state_dict()
    assert all(torch.allclose(after[name], before[name], atol=1e-6) for name in after)
    with open(two / 'metrics.csv', newline='') as file:
        row = list(csv.DictReader(file))[-1]
    assert row['depth'] in ('', 'nan') and float(row['pixel_control']) >= 0
    assert main(['evaluate', str(two / 'checkpoint'), '--episodes', '2', '--max-decisions', '5',
                 '--no-controls']) == 0
    assert main(['evaluate', str(two / 'checkpoint'), '--rooms', '3']) == 2
    assert 'rooms are a number of houses' in capsys.readouterr().err
    # With labels again, of other classes: their heads begin anew.
    assert train('many:5', three, *begin) == 0
    told = capsys.readouterr().out
    assert 'head segmentation is new: its classes of labels are others here' in told
    assert 'head depth' not in told


@pytest.mark.slow
def test_fast_learns_what_there_is(tmp_path, monkeypatch, capsys):
    class Wayless(Lacking):
        capabilities = dataclasses.replace(Lacking.capabilities, geodesic=False)

    register(monkeypatch, 'wayless', Wayless)
    assert train('wayless:5', tmp_path / 'run', preset='fast') == 0
    told = capsys.readouterr().out
    assert 'progress_reward is left out: the simulator knows no driving distances' in told
    assert 'goal_pose is left out: wayless does not tell what two pictures share' in told
    assert load_checkpoint(tmp_path / 'run' / 'checkpoint').config.heads == ('arrival', 'distance')
    # What somebody asks for by name is no preset's wish.
    assert train('wayless:5', tmp_path / 'other', '--progress-reward', '1', preset='fast') == 2
    assert 'progress_reward' in capsys.readouterr().err


def test_what_is_held_out_is_a_scene_of_the_policys_simulator(tmp_path, capsys):
    path, _ = saved(tmp_path, dataclasses.replace(THESIS, actions=DRIVE_ACTIONS),
                    simulator='examples.corridor', scenes=['examples.corridor:5'])
    for unseen in ('house:7', '7', 'examples.corridor:5'):
        assert main(['publish', str(path), str(tmp_path / 'other'), '--unseen', unseen]) == 2
    assert 'held out' in capsys.readouterr().err and not (tmp_path / 'other').exists()
    info = {'simulator': 'house', 'scenes': ['house:7?rooms=3']}
    assert held_out('8', info) == held_out('house:8?rooms=3', info) == 'house:8?rooms=3'
    info = {'simulator': 'examples.corridor', 'scenes': ['examples.corridor:5']}
    assert held_out('examples.corridor:7', info) == 'examples.corridor:7'


@pytest.mark.slow
def test_picture_pairs_are_of_the_simulator_that_is_trained_in(tmp_path, capsys):
    assert train('examples.corridor:5', tmp_path / 'run', '--pair-minutes', '0.02',
                 preset='fast') == 0
    told = capsys.readouterr().out
    assert 'picture pairs are of the training scenes: examples.corridor has no splits' in told
    assert 'pairs ' in told and 'bearing' in told


@pytest.mark.slow
def test_a_policy_of_varying_light_is_measured_where_light_does_not_vary(tmp_path, capsys):
    save_checkpoint(tmp_path / 'checkpoint', network(dataclasses.replace(
        THESIS, actions=('forward', 'backward', 'rotate_left', 'rotate_right'))), {
            **INFO, 'world_version': '2', 'simulator': 'house', 'scenes': ['house:1'],
            'randomisation': 'standard', 'goals_per_room': 3})
    command = ['evaluate', str(tmp_path / 'checkpoint'), '--scene', 'examples.corridor:5',
               '--episodes', '2', '--max-decisions', '4']
    assert main(command) == 0
    assert capsys.readouterr().out.count('randomisation is left out') == 1
    assert main([*command, '--randomisation', 'standard']) == 2
