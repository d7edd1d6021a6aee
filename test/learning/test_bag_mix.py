"""Bags beside rollouts: they teach the very step, and an interrupted training repeats itself."""

import csv
import dataclasses

import numpy as np
import pytest
import torch
from round_room import ROBOT, drive_set
from small_bags import FIXTURE

from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.cli import main
from vn_nav.errors import EnvironmentLost, UserError
from vn_nav.learning.bag_mix import WINDOW, BagMix, _Endless
from vn_nav.learning.hindsight import Drives, rows_of
from vn_nav.learning.learner import Learner
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.rollout import Collector
from vn_nav.learning.trainer import train
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.network import Policy
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
CONFIG = TrainConfig(frames=900, rollout_length=16, channels=(8, 8, 8), features=24, hidden=16,
                     minibatches=2, epochs=1, bf16=False, goal_pose=0.5, pose_to_memory=True,
                     bag_share=0.5)
EVERYTHING = ('depth', 'segmentation', 'goal_segmentation', 'goal_pose', 'cloning', 'arrival',
              'distance')


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def make_env():
    return NavigationEnv(EnvConfig(scenes=('house:3?rooms=1',), num_envs=8, size=36,
                                   max_decisions=40,
                                   actions=ROBOT.action_names,
                                   privileged=('goal_pose', 'overlap')))


def mix(config=CONFIG, **options):
    return BagMix(Drives([drive_set(8, **options)], ROBOT), config)


def learner_of(bags, config=CONFIG):
    """A learner whose steps learn from the bags, and a rollout for it."""
    env = make_env()
    config = dataclasses.replace(config, extra_heads=bags.heads)
    torch.manual_seed(0)
    network = Policy(config.network(env.action_names, 36))
    bags.attach(network)
    generator = torch.Generator().manual_seed(0)
    collector = Collector(env, network, generator, config.privileged)
    collector.begin(0)
    return (Learner(network, config, generator, auxiliary_loss=bags.loss),
            collector.collect(config.rollout_length)[0])


def test_every_row_is_drawn_once_an_epoch_and_the_order_is_a_function_of_where_it_stands():
    bags = mix()
    bags.attach(Policy(dataclasses.replace(CONFIG, extra_heads=bags.heads).network(
        ROBOT.action_names, 36)))
    rows, goals = bags._pairs.take(len(bags.drives)).T
    assert sorted(rows) == sorted(rows_of(bags.drives.episodes)) and (rows != goals).all()
    assert bags._pairs.state == [1, 0]
    bags._pairs.take(5)
    state = bags.state_dict()
    following = bags._pairs.take(2 * len(bags.drives)), bags._windows.take(9)
    assert not np.array_equal(following[0][:len(rows), 0], rows)
    again = mix()
    again.attach(bags._objective.network)
    again.load_state_dict(state)
    for one, two in zip(following, (again._pairs.take(2 * len(bags.drives)),
                                    again._windows.take(9)), strict=True):
        assert np.array_equal(one, two)
    other = _Endless(bags._epoch_of_pairs, (0, 1, 0))  # of another process
    assert not np.array_equal(other.take(len(rows))[:, 0], rows)


def test_the_loss_of_the_bags_is_part_of_the_step():
    """Its gradient is added before the one clipping of the norm; heads of the bags alone learn."""
    config = dataclasses.replace(CONFIG, minibatches=1, max_gradient_norm=1e9)
    gradients = {}
    for share in (0.0, 1.0):
        weights = {name: share * getattr(config, name) for name in (
            'bag_imitation', 'bag_goal_pose', 'bag_arrival', 'bag_distance', 'bag_image')}
        bags = mix(config)
        learner, rollout = learner_of(bags, config)
        bags.config = dataclasses.replace(config, **weights)
        bags.begin_update(0.0)
        learner.update(rollout)
        gradients[share] = {name: p.grad.clone()
                            for name, p in learner.network.named_parameters()}
    change = {name: rows - gradients[0.0][name] for name, rows in gradients[1.0].items()}
    bags = mix(config)
    learner, rollout = learner_of(bags, config)
    bags.begin_update(0.0)
    bags.loss(rollout).backward()
    for name, parameter in learner.network.named_parameters():
        alone = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        assert torch.allclose(change[name], alone, atol=1e-5), name
        if name.startswith(('encoder', 'memory', 'actor', 'heads')):
            assert alone.abs().max() > 0, name


def test_losses_fall_and_are_figures():
    bags = mix()
    assert bags.parts == EVERYTHING
    config = dataclasses.replace(CONFIG, bag_share=1.0, learning_rate=3e-3)
    learner, rollout = learner_of(bags, config)
    rows = []
    for _ in range(30):
        bags.begin_update(0.0)
        learner.update(rollout)
        rows.append(bags.figures())
    assert set(rows[0]) == set(bags.columns)
    for name in ('bag_loss', 'bag_goal_pose_loss', 'bag_depth_loss'):
        first, last = (np.mean([row[name] for row in part]) for part in (rows[:4], rows[-4:]))
        assert last < 0.8 * first, name


def test_the_weight_of_the_actions_falls_and_a_share_is_a_share():
    bags = mix()
    learner, rollout = learner_of(bags)
    drawn = []
    take = bags._pairs.take
    bags._pairs.take = lambda count: drawn.append(count) or take(count)
    for progress, weight in ((0.0, 0.1), (0.35, 0.05), (0.9, 0.0)):
        bags.begin_update(progress)
        assert bags._weight('cloning') == pytest.approx(weight)
    bags.begin_update(0.0)
    learner.update(rollout)
    minibatch = 16 * 8 // 2
    assert drawn == [minibatch // 2] * 2  # half a step of a drive for each of the rollout
    assert bags._windows.state[1] == 2 * (minibatch // 2 // WINDOW)


def test_what_bags_cannot_teach_is_left_out_and_said():
    bags = mix(depth=False, labels=False)
    assert bags.parts == ('goal_pose', 'cloning', 'arrival', 'distance')
    assert any('depth is left out' in note for note in bags.notes)
    still = drive_set(4)
    still.action[:] = NO_ACTION
    assert BagMix(Drives([still], ROBOT), CONFIG).parts == (
        'depth', 'segmentation', 'goal_segmentation', 'goal_pose')
    alone = dataclasses.replace(CONFIG, bag_imitation=0.0, bag_goal_pose=0.0, bag_image=0.0,
                                bag_distance=0.0)
    assert mix(alone).parts == ('arrival',)
    with pytest.raises(UserError, match='weight'):
        mix(dataclasses.replace(alone, bag_arrival=0.0))
    with pytest.raises(UserError, match='frozen'):
        mix(TrainConfig(architecture='icra2017', stacked_frames=4))
    with pytest.raises(UserError, match='bag_share'):
        dataclasses.replace(CONFIG, bag_share=0.0)


@pytest.mark.parametrize('overlap', [False, True])
def test_an_interrupted_training_ends_as_an_uninterrupted_one(tmp_path, overlap):
    config = dataclasses.replace(CONFIG, overlap=overlap)
    rows = []
    whole = train(make_env(), config, tmp_path / 'whole', info=FACTS, bags=mix(),
                  on_update=rows.append)
    assert all(np.isfinite(row['bag_loss']) for row in rows)
    updates = []

    def interrupt(row):
        updates.append(row)
        if len(updates) == 3:
            raise EnvironmentLost('this is a test', 'the third update', 'resume')
    with pytest.raises(EnvironmentLost):
        train(make_env(), dataclasses.replace(config, checkpoint_seconds=1e-9),
              tmp_path / 'parts', info=FACTS, bags=mix(), on_update=interrupt)
    parts = train(make_env(), config, tmp_path / 'parts', info=FACTS, bags=mix(), resume=True)
    one, other = (load_checkpoint(folder).network.state_dict() for folder in (whole, parts))
    assert all(torch.equal(one[name], other[name]) for name in one)
    header, *lines = (tmp_path / 'whole' / 'metrics.csv').read_text().splitlines()
    assert header.endswith(','.join(mix().columns)) and len(lines) == len(rows)
    for bags in (None, BagMix(Drives([drive_set(7)], ROBOT), config)):
        with pytest.raises(UserError, match='bags'):
            train(make_env(), config, tmp_path / 'parts', info=FACTS, bags=bags, resume=True)


def test_the_command_line(tmp_path, capsys):
    """The shipped bag beside rollouts in a house; a head that only the bag teaches is there."""
    words = ['train', '--out', str(tmp_path / 'run'), '--envs', '4', '--size', '36', '--frames',
             '200', '--channels', '8', '8', '8', '--features', '24', '--hidden', '16',
             '--pair-minutes', '0', '--set', 'arrival=0', '--no-tensorboard']
    assert main([*words, '--bags', str(FIXTURE), '--bag-share', '0.5']) == 0
    said = capsys.readouterr().out
    assert str(FIXTURE) in said and 'goal pose' in said
    loaded = load_checkpoint(tmp_path / 'run' / 'checkpoint')
    assert 'arrival' in loaded.config.heads and 'bag' in loaded.info['notes']
    with open(tmp_path / 'run' / 'metrics.csv') as file:
        assert all(float(row['bag_loss']) > 0 for row in csv.DictReader(file))
    assert main([*words[:1], '--out', str(tmp_path / 'other'), '--bag-share', '0.5']) == 2
    assert '--bags' in capsys.readouterr().err
