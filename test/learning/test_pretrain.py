"""Pre-training on drives: it learns, it resumes, it says what it leaves out, and RL goes on."""

import csv
import math
import re

import numpy as np
import pytest
import torch
from round_room import ROBOT, drive_set

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.learning.auxiliary import POSE_OVERLAP, image_target
from vn_nav.learning.hindsight import Drives, partners, rows_of, split
from vn_nav.learning.pairs import errors, measure
from vn_nav.learning.pretrain_config import PretrainConfig, choose_parts
from vn_nav.learning.pretraining import STATE, pretrain_network
from vn_nav.learning.state_file import read_state
from vn_nav.learning.supervised import Batch, Guess, Objective, Tally
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.heads import Pose
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.report.compare import compare

FACTS = {'world_version': 'a round room', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
EVERYTHING = ('goal_pose', 'arrival', 'distance', 'depth', 'segmentation', 'goal_segmentation')
QUICK = PretrainConfig(epochs=2, batch=16, window=8, save_seconds=1e9)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network_of(heads=EVERYTHING, **options):
    torch.manual_seed(0)
    return Policy(NetworkConfig(actions=ROBOT.action_names, **{
        'size': 36, 'channels': (8, 8, 8), 'features': 24, 'hidden': 16, 'heads': heads,
        'pose_to_memory': 'goal_pose' in heads} | options))


def learn(drives, folder, config=QUICK, network=None, parts=None, **options):
    """Pre-train on the parts that there are; the folder of the checkpoint."""
    network = network or network_of()
    parts = parts or choose_parts(drives, network.config.heads, (), None)[0]
    return pretrain_network(network, drives, parts, split(drives, 0.15, 0), folder, config,
                            info=FACTS, **options)


@pytest.mark.slow
def test_actions_and_poses_are_learned_and_hold_on_other_episodes(tmp_path):
    drives = Drives([drive_set(120)], ROBOT)
    network = network_of(('goal_pose',), channels=(16, 24, 24), features=64, hidden=32)
    rows = []
    config = PretrainConfig(epochs=7, learning_rate=3e-3, window=8, farthest=16)
    learn(drives, tmp_path, config, network, ('goal_pose', 'cloning'), on_epoch=rows.append)
    before, after = rows[0], min(rows[1:], key=lambda row: row['validation_loss'])
    held_out = rows_of(split(drives, 0.15, 0).validation)
    commonest = np.bincount(drives.action[held_out] + 1)[1:].max() / (
        drives.action[held_out] >= 0).sum()
    assert commonest < 0.55 and before['validation_action_accuracy'] < 0.55
    assert after['validation_action_accuracy'] > 0.68
    assert after['action_accuracy'] > 0.68
    # Poses against the best guess that looks at no picture, on the same pairs.
    spans = split(drives, 0.15, 0).validation
    first, second = rows_of(spans), partners(spans, np.random.default_rng(1))
    asked = {'image': drives.pictures('image', first), 'goal': drives.pictures('image', second),
             'goal_pose': drives.label(first, second).goal_pose,
             'overlap': drives.co_visibility(first, second)}
    learned = measure(load_checkpoint(tmp_path / 'checkpoint').network, asked)
    mean = torch.from_numpy(asked['goal_pose'][asked['overlap'] >= POSE_OVERLAP].mean(axis=0))
    guess = errors(Pose(*mean.expand(len(first), 4).split(2, dim=1), torch.ones(len(first))),
                   asked)
    assert learned['bearing_deg'] < 0.6 * guess['bearing_deg']
    assert learned['heading_deg'] < 0.6 * guess['heading_deg']
    assert learned['distance_m'] < 0.75 * guess['distance_m']
    assert learned['bearing_within_30'] > guess['bearing_within_30'] + 0.2
    assert learned['overlap_accuracy'] > guess['overlap_accuracy'] + 0.1


@pytest.mark.slow
def test_image_heads_learn_depth_and_classes_of_picture_and_goal(tmp_path):
    drives = Drives([drive_set(60)], ROBOT)
    heads, rows = ('depth', 'segmentation', 'goal_segmentation', 'reconstruction'), []
    network = network_of(heads, channels=(16, 24, 24))
    config = PretrainConfig(epochs=7, batch=16, learning_rate=3e-3)
    learn(drives, tmp_path, config, network, heads, on_epoch=rows.append)
    for name in heads:
        column = f'validation_{name}_loss'
        assert rows[-1][column] < 0.25 * rows[0][column], name
    # Better than the mean picture, which needs no input.
    for name, shown in (('depth', drives.sets[0].depth), ('segmentation', drives.sets[0].labels)):
        target = image_target(network, name, torch.from_numpy(shown))
        assert rows[-1][f'validation_{name}_loss'] < 0.75 * target.var(dim=0).mean(), name
    assert math.isnan(rows[-1]['validation_cloning_loss'])


class Failing(Drives):
    """Drives that fail after so many look-ups of pictures, as a killed process does."""

    left = 0

    def pictures(self, name, rows):
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super().pictures(name, rows)


def test_a_killed_run_resumes_to_the_same_weights_and_curves(tmp_path):
    sets = [drive_set(20)]
    whole = learn(Drives(sets, ROBOT), tmp_path / 'whole')
    every_step = PretrainConfig(epochs=2, batch=16, window=8, save_seconds=1e-9)
    for calls in (60, 150, 10**9):
        drives = Failing(sets, ROBOT)
        drives.left = calls
        resume = calls > 60
        try:
            parts = learn(drives, tmp_path / 'parts', every_step, resume=resume)
        except KeyboardInterrupt:
            assert calls < 10**9
    one, other = (load_checkpoint(path).network.state_dict() for path in (whole, parts))
    assert all(torch.equal(one[name], other[name]) for name in one)
    curves = [list(csv.DictReader(open(tmp_path / name / 'metrics.csv'))) for name in
              ('whole', 'parts')]
    for row in (*curves[0], *curves[1]):
        del row['minutes']
    assert curves[0] == curves[1] and len(curves[0]) == 3
    with pytest.raises(UserError, match='folder of its own'):
        learn(Drives(sets, ROBOT), tmp_path / 'whole')
    with pytest.raises(UserError, match='bags'):
        learn(Drives([drive_set(21)], ROBOT), tmp_path / 'whole', resume=True)
    with pytest.raises(UserError, match='numbers'):
        learn(Drives(sets, ROBOT), tmp_path / 'whole', PretrainConfig(epochs=3, batch=16,
                                                                      window=8), resume=True)
    with pytest.raises(UserError, match='resumed from its folder'):
        learn(Drives(sets, ROBOT), tmp_path / 'nowhere', resume=True)


def test_the_checkpoint_holds_the_weights_of_the_best_epoch_and_says_which(tmp_path):
    drives, kept, rows = Drives([drive_set(12)], ROBOT), [], []
    network = network_of(('goal_pose',))

    def keep(row):
        rows.append(row)
        kept.append({name: part.clone() for name, part in network.state_dict().items()})
        if len(rows) == 4:  # as a training that goes astray after its third epoch
            with torch.no_grad():
                for part in network.parameters():
                    part.add_(torch.randn(part.shape, generator=noise))
    noise = torch.Generator().manual_seed(0)
    config = PretrainConfig(epochs=6, batch=8, window=8, learning_rate=1e-3)
    folder = learn(drives, tmp_path, config, network, on_epoch=keep)
    best = int(np.argmin([row['validation_loss'] for row in rows[1:]])) + 1
    assert 1 <= best <= 3
    saved = load_checkpoint(folder)
    own = saved.network.state_dict()
    assert all(torch.equal(own[name], kept[best][name]) for name in own)
    assert f'epoch {best} of 6' in saved.info['notes']
    figures = saved.info['results']['pre-training, validation steps']
    assert figures['loss'] == rows[best]['validation_loss']


def test_heads_without_keys_are_left_out_and_it_says_which_and_why():
    own = ('goal_pose', 'arrival', 'distance')
    whole = Drives([drive_set(4)], ROBOT)
    parts, words = choose_parts(whole, None, own, None)
    assert set(parts) == {*own, 'cloning', 'depth', 'segmentation', 'goal_segmentation'}
    assert not words
    parts, words = choose_parts(Drives([drive_set(4, labels=False)], ROBOT), None, own, None)
    assert 'segmentation' not in parts and 'depth' in parts and 'reconstruction' not in parts
    assert len(words) == 2 and all('labels/image_raw' in line for line in words)
    bare = Drives([drive_set(4, labels=False, depth=False)], ROBOT)
    parts, words = choose_parts(bare, None, (), None)
    assert parts == ('reconstruction', 'cloning') and len(words) == 3
    mixed = Drives([drive_set(4), drive_set(4, seed=1, depth=False)], ROBOT)
    parts, words = choose_parts(mixed, ('depth', 'goal_pose'), (), False)
    assert parts == ('depth', 'goal_pose') and 'of the pictures' in words[0]
    assert 'depth' in choose_parts(mixed, None, own, None)[0]
    parts, words = choose_parts(whole, ('depth', 'arrival'), own, False)
    assert parts == ('depth',) and 'arrival is left out' in words[0]
    still = Drives([drive_set(4)], ROBOT)
    still.action[:] = -1
    assert 'cloning' not in choose_parts(still, None, own, None)[0]
    with pytest.raises(UserError, match='cloning needs'):
        choose_parts(still, None, own, True)
    with pytest.raises(UserError, match='some of'):
        choose_parts(whole, ('pixel_control',), own, None)
    with pytest.raises(UserError, match='something to pre-train'):
        choose_parts(bare, ('depth',), own, False)


def test_a_bag_without_depth_beside_one_with_teaches_the_rest(tmp_path):
    mixed = Drives([drive_set(6), drive_set(6, seed=1, depth=False)], ROBOT)
    rows = []
    learn(mixed, tmp_path, on_epoch=rows.append)
    assert all(math.isfinite(rows[-1][f'{name}_loss']) for name in ('depth', 'cloning'))


def test_unknown_depth_teaches_nothing():
    drives = Drives([drive_set(4)], ROBOT)
    objective = Objective(network_of(('depth',)), drives, ('depth',), 1)
    rows = np.arange(8)

    def loss():
        return float(objective.losses(Batch(rows, rows + 1, None), Tally())['depth'].detach())
    drives.sets[0].depth[:, :, :18] = 0
    half = loss()
    picture = drives.sets[0].depth[:, :, 18:].copy()
    drives.sets[0].depth[:, :, 18:] = 0
    assert loss() == 0.0
    drives.sets[0].depth[:, :, 18:] = picture
    assert half > 0


@pytest.mark.parametrize('options', [
    {'architecture': 'matching'}, {'frames': 4, 'pose_to_memory': False},
    {'moves': ROBOT.moves}, {'architecture': 'thesis', 'size': 84, 'pose_to_memory': False}])
def test_every_network_that_learns_can_be_pre_trained(tmp_path, options):
    drives = Drives([drive_set(4, size=options.get('size', 36))], ROBOT)
    network = network_of(**options)
    rows = []
    learn(drives, tmp_path, PretrainConfig(epochs=1, window=4), network, on_epoch=rows.append)
    assert rows[-1]['validation_loss'] < rows[0]['validation_loss']


def test_numbers_out_of_range_are_refused():
    for name, value in (('epochs', 0), ('batch', 0), ('learning_rate', 0.0), ('seed', -1),
                        ('validation_share', 1.0), ('window', math.nan)):
        with pytest.raises(UserError):
            PretrainConfig(**{name: value})


def test_the_baseline_is_a_guess_without_pictures_on_the_same_steps(tmp_path):
    """The most frequent action that was learned from, and the mean pose of overlapping pairs."""
    drives, rows = Drives([drive_set(20)], ROBOT), []
    parts = split(drives, 0.15, 0)
    learned, judged = (drives.action[rows_of(spans)] for spans in (parts.train, parts.validation))
    often = np.bincount(learned[learned >= 0]).argmax()
    folder = learn(drives, tmp_path, network=network_of(('goal_pose',)), on_epoch=rows.append)
    # Every step of the validation's windows that acts is judged once, but for where windows end.
    share = (judged[judged >= 0] == often).mean()
    assert abs(rows[0]['baseline_action_accuracy'] - share) < 0.1
    assert rows[0]['baseline_action_accuracy'] == rows[-1]['baseline_action_accuracy']
    assert 0 < rows[0]['baseline_bearing_deg'] < 120 and rows[0]['baseline_overlap_accuracy'] > 0.5
    results = load_checkpoint(folder).info['results']
    assert list(results) == ['pre-training, validation steps',
                             'the same steps, a guess without pictures']
    own, guessed = results.values()
    assert guessed['action_accuracy'] == rows[0]['baseline_action_accuracy']
    assert guessed.keys() < own.keys()


def test_of_a_tally_the_guess_is_judged_on_what_was_counted():
    tally = Tally()
    assert tally.baseline(Guess(1, np.zeros(4), True)) == {}
    tally.add('cloning', torch.tensor(1.0), 5)
    tally.add_actions(torch.tensor([True, False, True]), torch.tensor([1, 1, 0]))
    tally.add_actions(torch.tensor([True, True]), torch.tensor([3, 1]))
    again = Tally()
    again.load_state_dict(tally.state_dict())
    for own in (tally, again):
        assert own.baseline(Guess(1, np.zeros(4), True)) == {'action_accuracy': 0.6}
        assert own.baseline(Guess(2, np.zeros(4), True)) == {'action_accuracy': 0.0}
        assert own.figures(lambda part: 1.0)['action_accuracy'] == 0.8
        assert own.baseline(Guess(None, np.zeros(4), True)) == {}


def test_a_loss_that_is_not_finite_ends_it_and_the_last_save_stays_whole(tmp_path):
    config = PretrainConfig(epochs=2, window=8, learning_rate=1e30)
    with pytest.raises(UserError, match='stay finite'):
        learn(Drives([drive_set(10)], ROBOT), tmp_path, config)
    saved = read_state(tmp_path / STATE)
    assert all(torch.isfinite(part).all() for part in saved['network'].values())


SMALL = ['--set', 'channels=(8,8,8)', '--set', 'features=24', '--set', 'hidden=16']


def test_from_collected_bag_to_pre_training_to_reinforcement(tmp_path, capsys):
    bag, run = str(tmp_path / 'bag'), str(tmp_path / 'run')
    assert main(['collect', '--house', '3', '--rooms', '1', '--size', '36', '--pictures', '64',
                 '--out', bag]) == 0
    assert 'pictures/s' in capsys.readouterr().out
    words = ['pretrain', bag, '--out', run, '--size', '36', '--epochs', '1', *SMALL]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert 'from random poses' in said and 'arrival is left out' in said and 'epoch 1' in said
    saved = load_checkpoint(tmp_path / 'run' / 'checkpoint')
    assert {'goal_pose', 'depth', 'goal_segmentation'} <= set(saved.config.heads)
    assert saved.info['preset'] == 'fast' and 'pretrain' not in saved.info['results']
    assert 'a line an epoch' in said and 'bearing off by deg: median' in said
    assert 'right actions' not in said  # nothing acts
    # The card: which data, how many pictures, which losses, and no word of success.
    card = (tmp_path / 'run' / 'checkpoint' / 'README.md').read_text()
    assert re.search(r'\| 64 recorded pictures of bag: \d+ steps to learn from, \d+ others', card)
    assert '| Losses | depth, segmentation, goal segmentation, goal pose |' in card
    assert 'No episode was driven' in card and 'begin a training' in card
    assert 'success' not in card and 'Drives a robot' not in card and '0 frames' not in card
    # The policy node runs it, and training goes on from it.
    runtime = PolicyRuntime(tmp_path / 'run' / 'checkpoint')
    picture = np.zeros((3, 36, 36), np.uint8)
    runtime.set_goal(picture)
    assert 0 <= runtime.act(picture) < 4
    assert main(['train', '--init', f'{run}/checkpoint', '--house', '3', '--rooms', '1', '--size',
                 '36', '--envs', '4', '--frames', '64', '--rollout-length', '8', '--max-decisions',
                 '20', '--minibatches', '1', '--no-tensorboard', '--out', str(tmp_path / 'rl'),
                 *SMALL]) == 0
    # Pre-training goes on from a checkpoint too, with more heads.
    assert main(['pretrain', bag, '--out', str(tmp_path / 'more'), '--init',
                 str(tmp_path / 'rl' / 'checkpoint'), '--epochs', '1', '--heads',
                 'reconstruction,goal_pose', '--cache', f'{run}/decoded']) == 0
    more = load_checkpoint(tmp_path / 'more' / 'checkpoint')
    assert more.config.hidden == 16 and 'reconstruction' in more.config.heads
    assert not (tmp_path / 'more' / 'decoded').exists()
    compare([tmp_path / 'run', tmp_path / 'more'], tmp_path / 'page.html',
            metric='validation_goal_pose_loss')
    assert 'validation_goal_pose_loss' in (tmp_path / 'page.html').read_text()
    capsys.readouterr()
    for extra, expected in (
            ([], 'folder of its own'), (['--resume', '--epochs', '2'], 'numbers'),
            (['--init', f'{run}/checkpoint', '--size', '40'], '--size'),
            (['--init', f'{run}/checkpoint', '--actions', 'forward,left'], '--actions'),
            (['--actions', 'forward,fly'], 'fly'), (['--cloning'], 'cloning needs'),
            (['--preset', 'icra2017'], 'frozen'), (['--heads', 'none'], 'something'),
            (['--robot', str(tmp_path / 'none.yaml')], 'robot file')):
        assert main([*words, *extra]) == 2, extra
        message = capsys.readouterr().err
        assert expected in message and len(message.strip().splitlines()) == 1


def test_no_bag_is_one_line(tmp_path, capsys):
    assert main(['pretrain', str(tmp_path / 'none'), '--out', str(tmp_path / 'out')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
