"""The networks of `search` learn to see: losses, figures, training, resumption, beginnings."""

import csv
import dataclasses
import functools
import json
import math

import numpy as np
import pytest
import torch

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.learning import sight_training
from vn_nav.learning.pretrain_config import PretrainConfig
from vn_nav.learning.pretrain_job import PretrainJob, pretrain
from vn_nav.learning.sight_figures import (
    FIGURES,
    HALF_RADIUS,
    Judged,
    auc,
    calibration_error,
    figures,
    judge,
    roc,
)
from vn_nav.learning.sight_losses import losses, range_loss, recognition_losses
from vn_nav.learning.sight_training import SightConfig, begin_with, train_sight
from vn_nav.learning.state_file import read_state
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.search.look import BINS, COLUMNS, Recognition, column_bearings
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.report.sight_page import sight_page
from vn_nav.robot import RobotSpec
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.pair_poses import RECOGNITION
from vn_sim_bridge.datasets.view_pairs import PairSampler

ROBOT = RobotSpec().with_actions(('forward', 'rotate_left', 'rotate_right'))
CONFIG = NetworkConfig(
    actions=ROBOT.action_names, moves=ROBOT.moves, size=40, architecture='search',
    channels=(8, 12, 8), features=24, blocks=1, view=ROBOT.camera_fov,
    footprint=ROBOT.footprint_radius)
MATCHING = dataclasses.replace(CONFIG, architecture='matching', heads=('goal_pose', 'arrival'),
                               pose_to_memory=True, hidden=16, view=0.0, footprint=0.0)
FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
SMALL = SightConfig(groups=8, pairs=16 * 12, report_every=5, validation_groups=16, page_groups=24)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def network(config=CONFIG, seed=0) -> SearchPolicy:
    torch.manual_seed(seed)
    return build_policy(config)


def sampler(seed=0, count=1):
    return PairSampler(house_scenes(range(7, 7 + count), 2), size=40, seed=seed, mix=RECOGNITION)


def batch(groups=8):
    return sampler().draw_groups(groups, 1, bearings=column_bearings(CONFIG.view))


def said(count, **parts):
    zeros, ahead = torch.zeros(count), torch.tensor([[1.0, 0.0]]).expand(count, 2)
    return Recognition(**{'position': ahead, 'log_scale': zeros, 'heading': ahead,
                          'log_concentration': zeros, 'co_visible': zeros, 'arrived': zeros,
                          **parts})


def truth(count, overlap=1.0, arrived=True):
    return {'goal_pose': np.tile(np.float32([1, 0, 1, 0]), (count, 1)),
            'overlap': np.full(count, overlap, np.float32), 'arrived': np.full(count, arrived),
            'zoom': np.ones(count, np.float32)}


def test_the_losses_are_those_of_distributions():
    pairs = truth(1)
    pairs['goal_pose'][0] = (1.0, 0.6, math.cos(0.5), math.sin(0.5))
    # 0.6 m off: of a density exp(-r / s) in the plane the likeliest s is half of that.
    scales = torch.linspace(-2.5, 0.5, 601)
    found = torch.stack([recognition_losses(said(1, log_scale=scale[None]), pairs)['position']
                         for scale in scales])
    assert abs(scales[found.argmin()].exp() - 0.3) < 0.005
    for log_kappa in (-2.0, 0.0, 3.0):
        kappa = torch.tensor([log_kappa]).exp()
        own = recognition_losses(said(1, log_concentration=torch.tensor([log_kappa])), pairs)
        wanted = -torch.distributions.VonMises(torch.zeros(1), kappa).log_prob(torch.tensor(0.5))
        assert torch.isclose(own['heading'] + math.log(2 * math.pi), wanted, atol=1e-4).all()


def test_what_is_not_known_teaches_nothing():
    some = truth(2)
    some['overlap'][1] = 0.0  # not in view: its pose is nothing to learn from
    some['goal_pose'][1] = 99
    assert recognition_losses(said(2), some)['position'] < 0.1
    some['overlap'][1] = -1.0
    logits = torch.tensor([3.0, 50.0])
    assert recognition_losses(said(2, co_visible=logits), some)['co_visible'] < 0.1
    some['zoom'][1] = 1.5  # through another lens arrival follows from the pose
    some['arrived'][1] = False
    assert recognition_losses(said(2, arrived=logits), some)['arrived'] < 0.1
    flat = torch.full((1, COLUMNS, BINS), -math.log(BINS))
    ranges = np.full((1, COLUMNS), np.nan, np.float32)
    assert range_loss(flat, ranges) == 0
    ranges[0, 3] = 2.0
    assert torch.isclose(range_loss(flat, ranges), torch.tensor(math.log(BINS)))


def test_roc_and_calibration_by_counting():
    random = np.random.default_rng(0)
    true = random.random(300) < 0.4
    score = np.round(random.random(300) + 0.4 * true, 1)  # with ties
    high, low = score[true][:, None], score[~true][None]
    assert np.isclose(auc(score, true), ((high > low) + 0.5 * (high == low)).mean())
    false_rate, true_rate, threshold = roc(score, true)
    for k in (1, len(threshold) // 2):
        called = score >= threshold[k]
        assert np.isclose(false_rate[k], called[~true].mean())
        assert np.isclose(true_rate[k], called[true].mean())
    assert math.isnan(auc(score, np.ones(300, bool)))
    assert calibration_error(np.full(100, 0.3), np.arange(100) < 30) < 1e-9
    assert np.isclose(calibration_error(np.full(100, 0.9), np.arange(100) < 30), 0.6)


def test_figures_of_a_perfect_eye():
    distance = np.array([0.3, 1.0, 0.3, 5.0, 1.6])
    turn = np.radians([10, 20, 45, 170, 50])
    there = np.array([True, False, False, False, False])
    perfect = Judged(
        np.zeros(5), np.ones(5), np.zeros(5), np.zeros(5), np.array([1, 1, 1, 0, 1.0]),
        there.astype(float), there.astype(float), np.array([0.9, 0.3, 0.4, 0.0, 0.2]),
        distance, turn, there, np.ones((3, COLUMNS)), dict.fromkeys(sight_training.WEIGHTS, 0.0))
    assert perfect.ring.tolist() == [False, True, True, False, False]
    found = figures(perfect)
    assert set(found) == set(FIGURES)
    assert found['co_visible_auc'] == found['arrived_auc'] == found['arrived_ring_auc'] == 1
    assert found['position_coverage'] == found['range_within_fifth'] == 1
    assert all(found[name] == 0 for name in FIGURES if name.endswith(('_deg', '_loss', 'error'))
               or name.startswith('position_m') or name.endswith('_calibration'))
    off = perfect._replace(range_ratio=np.full((3, COLUMNS), 1.3),
                           position_error=np.full(5, 1.1 * HALF_RADIUS))
    assert figures(off)['range_within_fifth'] == figures(off)['position_coverage'] == 0


def test_half_of_the_density_lies_within_the_half_radius():
    random = np.random.default_rng(0)
    radius = random.gamma(2.0, size=100_000)  # r exp(-r)
    assert abs((radius <= HALF_RADIUS).mean() - 0.5) < 0.01


@pytest.mark.slow
def test_judging_in_parts_is_judging_at_once(monkeypatch):
    policy, pairs = network(), batch(12)
    policy.compute_dtype = torch.bfloat16
    whole = judge(policy, pairs)
    assert policy.compute_dtype == torch.bfloat16
    monkeypatch.setattr('vn_nav.learning.sight_figures.BATCH', 5)
    for one, other in zip(judge(policy, pairs)[:-1], whole[:-1], strict=True):
        assert np.allclose(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_a_batch_learned_by_heart():
    policy, pairs = network(), batch()
    optimiser = torch.optim.Adam(policy.parameters(), 3e-3)
    first = None
    for _ in range(25):
        found = losses(policy, pairs)
        optimiser.zero_grad()
        sum(found.values()).backward()
        optimiser.step()
        first = first or {name: value.item() for name, value in found.items()}
    assert all(found[name].item() < 0.9 * value for name, value in first.items()), (first, found)


def rows(folder):
    with open(folder / 'metrics.csv', newline='') as file:
        return [{name: value for name, value in row.items() if name != 'minutes'}
                for row in csv.DictReader(file)]


def weights(folder):
    return read_state(folder / 'sight_state')['network']


@pytest.mark.slow
def test_a_training_resumes_bit_for_bit(tmp_path):
    def go(folder, policy, **options):
        source = sampler()
        train_sight(policy, source, sampler(seed=1), tmp_path / folder, SMALL, info=FACTS,
                    say=lambda line: None, **options)

    go('whole', network())
    steps = []

    def interrupt(share):
        steps.append(share)
        if len(steps) == 7:
            raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        go('parts', network(), on_step=interrupt)
    assert len(rows(tmp_path / 'parts')) == 2
    go('parts', network(seed=5), resume=True,
       page=lambda *args: sight_page(*args, name='run', places='a house'))
    whole, parts = weights(tmp_path / 'whole'), weights(tmp_path / 'parts')
    assert all(torch.equal(tensor, parts[name]) for name, tensor in whole.items())
    assert rows(tmp_path / 'whole') == rows(tmp_path / 'parts')
    assert [row['frames'] for row in rows(tmp_path / 'whole')] == ['0', '80', '160', '192']
    loaded = load_checkpoint(tmp_path / 'parts' / 'checkpoint')
    assert all(torch.equal(tensor, whole[name])
               for name, tensor in loaded.network.state_dict().items())
    assert loaded.info['data'].startswith('192 picture pairs')
    assert {'held-out pairs', 'held-out pairs, before training'} == set(loaded.info['results'])
    text = (tmp_path / 'parts' / 'sight.html').read_text()
    assert text.count('<svg') == 3 and 'http' not in text.replace('http://www.w3.org', '')
    for options, rule in (({}, 'folder of its own'), ({'resume': True}, 'its own network')):
        with pytest.raises(UserError, match=rule):
            go('parts', network(dataclasses.replace(CONFIG, features=32)), **options)
    with pytest.raises(UserError, match='resumed from its folder'):
        go('nothing', network(), resume=True)


def saved(folder, config, seed=3):
    torch.manual_seed(seed)
    policy = build_policy(config).eval()
    save_checkpoint(folder, policy, FACTS)
    return policy


def test_it_begins_with_what_matching_has_learned(tmp_path):
    given = saved(tmp_path / 'matching', MATCHING)
    policy = network(dataclasses.replace(CONFIG, blocks=2))
    assert len(begin_with(policy, tmp_path / 'matching')) == 1
    image = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (4, 3, 40, 40), np.uint8))
    with torch.inference_mode():
        pose = given.heads['goal_pose'](given.encode(image, given.encode_goals(image), None)[1])
        goals = policy.encoder.encode_goals(image, torch.float32)
        look = policy.recogniser(policy.encode(image, goals, None)[1])
    assert torch.allclose(look.position, pose.position, atol=1e-5)
    assert torch.allclose(look.co_visible, pose.co_visible, atol=1e-5)
    assert torch.allclose(look.heading, torch.nn.functional.normalize(pose.heading), atol=1e-5)


def test_it_begins_with_search_and_with_nothing_else(tmp_path):
    given = saved(tmp_path / 'search', CONFIG)
    policy = network()
    assert begin_with(policy, tmp_path / 'search') == []
    assert all(torch.equal(tensor, given.state_dict()[name])
               for name, tensor in policy.state_dict().items())
    for name, config in {
            'headless': dataclasses.replace(MATCHING, heads=(), pose_to_memory=False, moves=()),
            'fused': dataclasses.replace(MATCHING, architecture='fused'),
            'wide': dataclasses.replace(MATCHING, features=32),
            'deep': dataclasses.replace(MATCHING, blocks=2),
            'other': dataclasses.replace(CONFIG, blocks=2)}.items():
        saved(tmp_path / name, config)
        with pytest.raises(UserError, match='begins with a checkpoint of search'):
            begin_with(policy, tmp_path / name)


@pytest.mark.parametrize('options', [
    ['--env', 'ros'], ['--envs', '8'], ['--bags', 'drive'], ['--task', 'object'],
    ['--device', 'cuda:0'], ['--hidden', '64']])
def test_options_of_driving_are_refused(options, tmp_path, capsys):
    assert main(['train', '--preset', 'search', '--out', str(tmp_path / 'run'), *options]) == 2
    error = capsys.readouterr().err.strip()
    assert options[-1] in error or options[0] in error
    assert len(error.splitlines()) == 1 and not (tmp_path / 'run').exists()


@pytest.mark.parametrize('numbers', [{'groups': 0}, {'minutes': -1.0}, {'learning_rate': 0.0}])
def test_numbers_are_positive(numbers):
    with pytest.raises(UserError, match='is positive'):
        SightConfig(**numbers)


def test_nothing_else_teaches_it(tmp_path):
    saved(tmp_path / 'search', CONFIG)
    for job in (PretrainJob(tmp_path, tmp_path / 'run', preset='search'),
                PretrainJob(tmp_path, tmp_path / 'run', init=tmp_path / 'search', preset='fast',
                            numbers=PretrainConfig())):
        with pytest.raises(UserError, match='no actor and no memory'):
            pretrain(job)


@pytest.mark.slow
def test_the_command_trains_in_houses(tmp_path, monkeypatch):
    monkeypatch.setattr('vn_nav.cli.sight.VALIDATION_SCENES', 1)
    monkeypatch.setattr('vn_nav.cli.sight.SightConfig', functools.partial(
        SightConfig, groups=8, validation_groups=8, page_groups=8))
    assert main(['train', '--preset', 'search', '--house', '7', '--rooms', '2', '--size', '40',
                 '--frames', '256', '--channels', '8', '12', '8', '--features', '24',
                 '--randomisation', 'standard', '--out', str(tmp_path / 'run')]) == 0
    loaded = load_checkpoint(tmp_path / 'run' / 'checkpoint')
    assert isinstance(loaded.network, SearchPolicy) and loaded.info['preset'] == 'search'
    assert math.isclose(loaded.config.view, math.radians(90)) and loaded.config.blocks == 2
    assert loaded.info['scenes'] == ['house:7?rooms=2'] and loaded.info['frames'] == 0
    assert json.loads((tmp_path / 'run' / 'checkpoint' / 'config.json').read_text())['losses']
