"""Presets: the numbers of the thesis, what sets its baselines apart, and what is refused."""

import argparse
import dataclasses
import re

import pytest

from vn_nav.cli.train import add_train_options, train_config
from vn_nav.errors import UserError
from vn_nav.learning.learner_config import TASKS
from vn_nav.learning.presets import ENVIRONMENT, PRESETS, TrainConfig, preset
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

# Thesis, table 5.1, in its order; the actor's weight is 1 by the form of the loss, RMSprop's
# alpha is the optimiser's (test_learner.py holds both against formulas).
TABLE = {
    'discount factor': ('gamma', 0.99),
    'maximum rollout length': ('rollout_length', 20),
    'maximum number of frames': ('frames', 40_000_000),
    'replay buffer size': ('replay_steps', 16 * 2000),  # of all environments together
    'optimizer': ('optimiser', 'rmsprop'),
    'RMSprop epsilon': ('rmsprop_epsilon', 1e-5),
    'learning rate at the first frame': ('learning_rate', 7e-4),
    'learning rate at the last frame': ('final_learning_rate', 0.0),
    'max. gradient norm': ('max_gradient_norm', 0.5),
    'entropy gradient weight': ('entropy_coefficient', 0.001),
    'entropy gradient weight at the end': ('final_entropy_coefficient', 0.001),
    'critic weight': ('value_coefficient', 0.5),
    'off-policy critic weight': ('value_replay', 1.0),
    'pixel control weight': ('pixel_control', 0.05),
    'reward prediction weight': ('reward_prediction', 1.0),
    'depth map prediction weight': ('depth', 0.1),
    'observation image segmentation prediction weight': ('segmentation', 0.1),
    'target segmentation prediction weight': ('goal_segmentation', 0.1),
    'pixel control discount factor': ('pixel_control_gamma', 0.9),
}
# What the table leaves out (thesis-facts.md, sections 1 and 2).
FACTS = {
    'n-step returns': ('lam', 1.0), 'one epoch': ('epochs', 1), 'one batch': ('minibatches', 1),
    'no clipping of ratios': ('clip', None), 'plain advantages': ('normalise_advantage', False),
    'sequences of each draw': ('replay_batch', 16), 'their steps': ('replay_length', 20),
    'images from the replay': ('images_from_replay', True),
    'grey pixel change': ('pixel_change_grey', True),
    'unrewarded samples': ('unrewarded', 1 / 3),
    'time-outs bootstrap': ('truncation_is_terminal', False),
    'pixels / 255': ('pixel_mean', 0.0), 'pixels / 255 too': ('pixel_std', 255.0),
    'curriculum': ('curriculum', 'frames'), 'its first tau': ('start_difficulty', 0.3),
    'LSTM': ('hidden', 512), 'two streams': ('architecture', 'thesis'),
    'no stack': ('stacked_frames', 1), 'single precision': ('bf16', False),
}


@pytest.mark.parametrize('name', [*TABLE, *FACTS])
def test_thesis_has_the_numbers_of_table_5_1(name):
    field, value = {**TABLE, **FACTS}[name]
    assert getattr(preset('thesis'), field) == value


def test_thesis_learns_in_what_table_5_1_says():
    world = ENVIRONMENT['thesis']
    assert world['envs'] == 16 and world['max_decisions'] == 900
    rewards = [name for name in world if name.endswith(('_reward', '_bonus'))]
    assert {'progress_reward', 'collision_reward'} <= set(rewards)
    assert all(world[name] == 0.0 for name in rewards)  # 1 at the goal and nothing else
    assert preset('thesis').rollout_length * world['envs'] == 320
    assert preset('thesis').replay_steps / world['envs'] == 2000


@pytest.mark.parametrize('size, cells, cell', [(84, 20, 4), (174, 42, 4)])
def test_thesis_has_downsize_factor_4_and_its_heads(size, cells, cell):
    """Table 5.1: pixel control and auxiliary VN downsize factor."""
    from vn_nav.policy.zhu_policy import build_policy
    config = preset('thesis').network(DRIVE_ACTIONS, size)
    network = build_policy(config)
    assert (network.target_side, network.cell) == (cells, cell)
    assert set(config.heads) == {'pixel_control', 'reward_prediction', 'depth', 'segmentation',
                                 'goal_segmentation'}


def differences(one, other):
    """Fields in which two presets differ, with the second one's values."""
    one, other = (dataclasses.asdict(preset(name)) for name in (one, other))
    return {name: value for name, value in other.items()
            if value != one[name] and name != 'preset'}


def test_baselines_differ_from_the_thesis_only_in_what_they_should():
    assert differences('thesis', 'unreal') == {
        'depth': 0.0, 'segmentation': 0.0, 'goal_segmentation': 0.0}
    assert differences('unreal', 'a2c') == {
        'pixel_control': 0.0, 'reward_prediction': 0.0, 'value_replay': 0.0}
    assert differences('unreal', 'framestack') == {'stacked_frames': 4}
    for name in ('unreal', 'a2c', 'framestack'):
        assert ENVIRONMENT[name] == ENVIRONMENT['thesis']
    assert preset('a2c').tasks == () and preset('a2c').heads == ()
    assert preset('unreal').tasks == ('pixel_control', 'value_replay', 'reward_prediction')
    assert preset('thesis').from_replay == preset('thesis').tasks


def test_only_a_replayed_task_of_ours_is_off_in_the_thesis():
    ours = {'reconstruction', 'goal_pose', 'arrival', 'distance', 'imitation'}
    assert set(TASKS) - set(preset('thesis').tasks) == ours


@pytest.mark.parametrize('name', PRESETS)
def test_every_preset_names_itself_and_makes_its_network(name):
    config = preset(name)
    assert config.preset == name and set(ENVIRONMENT[name]) >= {'envs', 'max_decisions'}
    own = {} if name != 'search' else {
        'moves': RobotSpec().with_actions(DRIVE_ACTIONS).moves, 'view': 1.5, 'footprint': 0.2}
    network = config.network(DRIVE_ACTIONS, 84, **own)
    assert network.heads == config.heads and network.actions == DRIVE_ACTIONS


def test_changes_are_kept_and_unknown_names_are_refused():
    assert preset('thesis', frames=1000, depth=0.0).frames == 1000
    with pytest.raises(UserError, match='a preset is one of'):
        preset('ppo')
    with pytest.raises(UserError, match='only the numbers'):
        preset('thesis', learning_rat=1.0)


@pytest.mark.parametrize('change', [
    {'frames': 0}, {'minutes': 0.0}, {'rollout_length': 1}, {'curriculum': 'none'},
    {'start_difficulty': 0.0}, {'difficulty_step': 0.0}, {'advance_window': 0},
    {'pair_minutes': 1.0}, {'threads': 0}])
def test_bad_trainings_are_refused(change):
    with pytest.raises(UserError, match='correct the training configuration'):
        TrainConfig(**change)


def parse(*words):
    parser = argparse.ArgumentParser()
    parser.add_argument('--seed', type=int, default=0)
    add_train_options(parser)
    return parser.parse_args(['--out', 'nowhere', *words])


@pytest.mark.parametrize('text, rule', [
    ('learning_rate=abc', 'learning_rate is a number'), ('gamma=nan', 'gamma is a number'),
    ('gamma=true', 'gamma is a number'), ('epochs=2.5', 'epochs is a whole number'),
    ('frames=1e999', 'frames is a whole number'), ('epochs=', 'epochs is a whole number'),
    ('track_goal=1', 'track_goal is true or false'), ('clip=wide', 'clip is a number'),
    ('channels=[1,2]', 'channels is a list; each of its 3 parts is a whole number'),
    ('channels=7', 'channels is a list'), ('extra_heads=[1]', 'each of its parts is a text'),
    ('minutes=soon', 'minutes is a number')])
def test_a_wrong_value_is_blamed_on_the_value(text, rule):
    args = parse('--set', text)
    with pytest.raises(UserError, match=re.escape(rule)) as caught:
        train_config(args)
    name, _, value = text.partition('=')
    assert f'correct the value of {name}' in str(caught.value) and 'the name' not in str(
        caught.value)


def test_values_of_every_kind_are_taken():
    config = train_config(parse(
        '--set', 'gamma=1', '--set', 'frames=2e6', '--set', 'clip=None', '--set',
        'channels=[8,16,8]', '--set', 'track_goal=true', '--set', 'teacher=oracle'))
    assert (config.gamma, config.frames, config.clip, config.channels, config.track_goal,
            config.teacher) == (1.0, 2_000_000, None, (8, 16, 8), True, 'oracle')
    assert isinstance(config.gamma, float) and isinstance(config.frames, int)
    assert train_config(parse('--set', 'seed=5', '--set', 'tensorboard=true')).seed == 5
    config = train_config(parse('--preset', 'icra2017', '--set', 'frozen_weights=2015'))
    assert config.frozen_weights == '2015'  # a file's name, whatever it looks like


def test_a_number_may_have_any_name():
    with pytest.raises(UserError, match='a training has only the numbers'):
        preset('fast', **{'name': 1})
