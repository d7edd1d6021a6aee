"""A figure of a policy that uses odometry says which; the policy gets it on every path."""

import json

import numpy as np
import pytest
from ros_harness import write_checkpoint

from vn_nav.cli import main
from vn_nav.cli.demo import control_env
from vn_nav.cli.world import make_env, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import PolicyActor
from vn_nav.evaluation.measurement import odometry_for
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.search.driver import SearchDriver
from vn_nav.policy.search.local_features import SIDE, extract
from vn_nav.policy.search.searcher import Searcher
from vn_nav.resources import share_file


@pytest.fixture
def using(monkeypatch):
    """All networks use odometry; the observations that policies act on."""
    monkeypatch.setattr(Policy, 'uses_odometry', True)
    seen, act = [], BatchedPolicy.act

    def recording(self, obs, *rest):
        seen.append(obs)
        return act(self, obs, *rest)
    monkeypatch.setattr(BatchedPolicy, 'act', recording)
    return seen


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'model', size=36)


def measured(folder, tmp_path, *options):
    out = tmp_path / 'figures.json', tmp_path / 'page.html'
    assert main(['evaluate', str(folder), '--episodes', '2', '--max-decisions', '4',
                 '--no-controls', '--maps', '0', '--json', str(out[0]), '--html', str(out[1]),
                 *options]) == 0
    return json.loads(out[0].read_text()), out[1].read_text()


@pytest.mark.parametrize(('options', 'kind'), [
    ((), 'drift'), (('--odometry', 'commanded'), 'commanded'), (('--odometry', 'none'), 'none')])
def test_evaluate_names_the_odometry_that_the_policy_got(folder, tmp_path, using, options, kind):
    result, page = measured(folder, tmp_path, *options)
    assert result['odometry'] == kind
    assert f'odometry:\n{kind}, ranges: picture,' in page
    assert using and all(('odometry' in seen) == (kind != 'none') for seen in using)
    if kind != 'none':
        assert not using[0]['odometry'].any() and any(s['odometry'].any() for s in using)


def test_other_policies_get_none_and_take_none(folder, tmp_path):
    result, page = measured(folder, tmp_path)
    assert result['odometry'] == 'none' and 'odometry:\nnone, ranges: picture,' in page
    network = load_checkpoint(folder).network
    assert network.uses_odometry is False and odometry_for(network, 'none') == 'none'
    with pytest.raises(UserError, match='leave it out'):
        odometry_for(network, 'true')


@pytest.mark.parametrize('kind', ['scan', 'depth'])
def test_evaluate_names_the_ranges_that_the_map_got(tmp_path, capsys, kind):
    searching = share_file('models/search')
    result, page = measured(searching, tmp_path, '--house', '7', '--ranges', kind)
    assert result['ranges'] == kind and f'ranges: {kind},' in page
    assert f'ranges: {kind}' in ' '.join(capsys.readouterr().out.split())


def test_a_map_takes_the_ranges_that_are_measured(monkeypatch):
    checkpoint = load_checkpoint(share_file('models/search'))
    seen, step = [], Searcher.step
    monkeypatch.setattr(Searcher, 'step', lambda self, *given, **named: (
        seen.append(named.get('scan')), step(self, *given, **named))[1])
    for kind in ('picture', 'scan'):
        env = make_env_for(checkpoint, ['house:7'], 2, stop='declared', own=False, ranges=kind)
        observation, info = env.reset(seed=0)
        actor = PolicyActor(env, checkpoint.network, 'greedy', 0)
        seen.clear()
        actor(observation, info['reset'])
        if kind == 'picture':
            assert seen == [None, None] and 'scan' not in observation
        else:
            assert [np.array_equal(scan.ranges, row) and scan.scanner is env.scanner
                    for scan, row in zip(seen, observation['scan'], strict=True)] == [True] * 2


def test_a_robot_verifies_by_pictures_larger_than_the_networks(monkeypatch):
    checkpoint = load_checkpoint(share_file('models/search'))
    shown, act = [], SearchDriver.act
    monkeypatch.setattr(SearchDriver, 'act', lambda self, *given: (
        shown.append((given[0], given[-1])), act(self, *given))[1])
    env = make_env_for(checkpoint, ['house:7'], 2, stop='declared', own=False, smallest=SIDE)
    observation, info = env.reset(seed=0)
    assert observation['image'].shape[-1] == SIDE
    PolicyActor(env, checkpoint.network, 'greedy', 0, verify='sift')(observation, info['reset'])
    image, pairs = shown[-1]
    assert image.shape[-1] == checkpoint.config.size
    assert all(len(pair.own.rays) > 20 for pair in pairs)
    own = extract(observation['image'][1].transpose(1, 2, 0), env.robot.camera_fov)
    assert np.array_equal(pairs[1].own.descriptors, own.descriptors)
    goal = extract(env.goals[observation['goal_index'][1]].transpose(1, 2, 0),
                   env.robot.camera_fov)
    assert np.array_equal(pairs[1].goal.rays, goal.rays)


def test_ranges_are_for_policies_with_a_map(folder, tmp_path, capsys):
    assert main(['evaluate', str(folder), '--ranges', 'scan']) == 2
    assert main(['evaluate', str(share_file('models/search')), '--ranges', 'scan', '--bag',
                 str(tmp_path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and 'search with a map' in lines[0] and '--bag' in lines[1]


def test_figures_of_publish_and_demo_have_it(folder, using):
    """`publish` measures in `make_env_for`; the demo's control as the bridge reports."""
    checkpoint = load_checkpoint(folder)
    env = make_env_for(checkpoint, ['house:7'], 2, stop='arrival', own=True)
    observation, info = env.reset(seed=0)
    assert env.config.odometry == 'drift' and observation['odometry'].shape == (2, 3)
    policy = BatchedPolicy(checkpoint.network, 2)
    policy.act(observation, env.goals, info['reset'])
    assert np.array_equal(using[0]['odometry'], observation['odometry'])
    env = control_env(make_env, checkpoint, 'house:7', 1, 5)
    assert env.config.odometry == 'commanded'
