"""The training loop: saving, resuming, repeating, and learning for real."""

import dataclasses
import math
import signal

import pytest
import torch
from two_bars import TwoBars

from vn_nav.errors import UserError
from vn_nav.learning.presets import TrainConfig, preset
from vn_nav.learning.state_file import own_folder, read_state
from vn_nav.learning.trainer import train
from vn_nav.learning.training import STATE
from vn_nav.policy.checkpoint import load_checkpoint
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
QUICK = TrainConfig(frames=800, rollout_length=16, channels=(8, 8, 8), features=24, hidden=16,
                    minibatches=2, epochs=1)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def make_env(**options):
    return NavigationEnv(EnvConfig(**{
        'scenes': ('house:3?rooms=1',), 'num_envs': 8, 'size': 36, 'max_decisions': 40} | options))


def weights_of(folder):
    return load_checkpoint(folder).network.state_dict()


def assert_equal_weights(one, other):
    one, other = weights_of(one), weights_of(other)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_training_resumes_and_refuses_what_does_not_fit(tmp_path):
    rows = []
    folder = train(make_env(), QUICK, tmp_path / 'run', info=FACTS, on_update=rows.append)
    assert load_checkpoint(folder).info['frames'] == rows[-1]['frames'] >= 800
    header, *lines = (tmp_path / 'run' / 'metrics.csv').read_text().splitlines()
    assert 'success' in header and len(lines) == len(rows)
    # The first episodes to end are successes: nothing is said until all robots have ended one.
    known = [math.isfinite(row['success']) for row in rows]
    assert known == sorted(known) and not known[0] and known[-1]
    with pytest.raises(UserError, match='folder'):
        train(make_env(), QUICK, tmp_path / 'run', info=FACTS)
    more = dataclasses.replace(QUICK, frames=1600)
    rows = []
    train(make_env(), more, tmp_path / 'run', info=FACTS, resume=True, on_update=rows.append)
    assert rows[0]['frames'] > 800 and rows[-1]['frames'] >= 1600
    with pytest.raises(UserError, match='network'):
        train(make_env(), dataclasses.replace(more, hidden=20), tmp_path / 'run', info=FACTS,
              resume=True)
    state = tmp_path / 'run' / 'training_state'
    state.write_bytes(state.read_bytes()[:-1] + b'x')
    with pytest.raises(UserError, match='SHA-256'):
        train(make_env(), more, tmp_path / 'run', info=FACTS, resume=True)


def test_a_folder_has_one_training_at_a_time(tmp_path):
    folder = tmp_path / 'run'
    with own_folder(folder), pytest.raises(UserError, match='another process'):
        train(TwoBars(6), QUICK, folder, info=FACTS)
    assert not folder.exists()
    train(TwoBars(6), QUICK, folder, info=FACTS)
    with own_folder(folder), pytest.raises(UserError, match='another process'):
        train(TwoBars(6), QUICK, folder, info=FACTS, resume=True)


def test_another_order_of_actions_is_refused(tmp_path):
    """Trap 8: neither a resumed training nor one with given weights swaps actions silently."""
    folder = train(TwoBars(6), QUICK, tmp_path / 'run', info=FACTS)
    swapped = TwoBars(6)
    swapped.action_names = ('right', 'left')
    with pytest.raises(UserError, match='action'):
        train(swapped, dataclasses.replace(QUICK, frames=1600), tmp_path / 'run', info=FACTS,
              resume=True)
    with pytest.raises(UserError, match='action'):
        train(swapped, QUICK, tmp_path / 'other', info=FACTS, init=folder)


def test_a_training_begins_with_the_weights_of_a_checkpoint(tmp_path):
    config = dataclasses.replace(QUICK, frames=1)
    folder = train(TwoBars(6), config, tmp_path / 'one', info=FACTS)
    # No step to speak of, another seed, and a head that the checkpoint lacks.
    again = dataclasses.replace(config, learning_rate=1e-12, final_learning_rate=0.0, seed=5,
                                distance=0.1)
    one, two = weights_of(folder), weights_of(
        train(TwoBars(6), again, tmp_path / 'two', info=FACTS, init=folder))
    assert all(torch.allclose(two[name], part, atol=1e-9) for name, part in one.items())
    assert set(two) - set(one) == {'heads.distance.out.weight', 'heads.distance.out.bias'}
    with pytest.raises(UserError, match='same network'):
        train(TwoBars(6), dataclasses.replace(config, hidden=20), tmp_path / 'three', info=FACTS,
              init=folder)


def test_equal_seeds_give_equal_trainings(tmp_path):
    config = dataclasses.replace(QUICK, bf16=False)
    assert_equal_weights(*(train(make_env(), config, tmp_path / name, info=FACTS)
                           for name in ('one', 'two')))


@pytest.mark.parametrize('overlap', [False, True])
def test_an_interrupted_training_ends_as_an_uninterrupted_one(tmp_path, overlap):
    """Bit for bit, on one thread: the schedule's end is the same, only the process is not.

    With a second thread that collects ahead as well: what it has collected is saved too.
    """
    config = dataclasses.replace(QUICK, bf16=False, frames=1500, overlap=overlap)
    whole = train(make_env(), config, tmp_path / 'whole', info=FACTS)
    updates = []

    def interrupt(row):
        updates.append(row)
        if len(updates) == 5:
            signal.raise_signal(signal.SIGTERM)
    train(make_env(), config, tmp_path / 'parts', info=FACTS, on_update=interrupt)
    assert len(updates) == 5 and updates[-1]['frames'] < 1500
    assert_equal_weights(whole, train(make_env(), config, tmp_path / 'parts', info=FACTS,
                                      resume=True))


def test_the_rollout_ahead_was_collected_by_the_weights_before(tmp_path):
    """Off-policy by one step: its ratios differ from 1 from the second update on."""
    kl = {}
    for overlap in (False, True):
        rows = []
        config = dataclasses.replace(QUICK, bf16=False, overlap=overlap, minibatches=1,
                                     learning_rate=0.01, final_learning_rate=0.01)
        train(make_env(), config, tmp_path / str(overlap), info=FACTS, on_update=rows.append)
        kl[overlap] = [row['kl'] for row in rows]
    assert max(kl[False]) < 1e-6 < 1e-5 < min(kl[True][1:])
    assert kl[True][0] < 1e-6


def test_a_failure_of_the_actor_ends_the_training(tmp_path):
    env = make_env()
    step, calls = env.step, []

    def fails(actions):
        calls.append(actions)
        if len(calls) == 40:  # in the third rollout
            raise RuntimeError('the simulator has gone')
        return step(actions)
    env.step = fails
    with pytest.raises(RuntimeError, match='gone'):
        train(env, dataclasses.replace(QUICK, overlap=True), tmp_path / 'run', info=FACTS)


def test_learning_rate_and_curriculum_follow_the_frames(tmp_path):
    """Thesis, table 5.1 and 5.7: 7e-4 (fmax - f) / fmax; tau from an eighth to a quarter."""
    env = TwoBars(8)
    config = preset('a2c', frames=2000, hidden=16)
    rows = []
    train(env, config, tmp_path / 'run', info=FACTS, on_update=rows.append)
    frames = [0, *(row['frames'] for row in rows)]
    for before, row in zip(frames, rows, strict=False):
        share = min(max((before / 2000 - 0.125) / 0.125, 0.0), 1.0)
        assert row['tau'] == pytest.approx(0.3 + 0.7 * share)
    assert env.tau == 1.0
    rate = read_state(tmp_path / 'run' / STATE)['optimiser']['param_groups'][0]['lr']
    assert rate == pytest.approx(7e-4 * (2000 - frames[-2]) / 2000)


@pytest.mark.slow  # a minute
@pytest.mark.timeout(200)
def test_a_small_room_is_learned(tmp_path):
    """From the random level to three quarters of all episodes, in about a minute."""
    options = {'num_envs': 32, 'max_decisions': 60, 'size': 44}
    env = make_env(progress_reward=1.0, collision_reward=-0.02, **options)
    config = TrainConfig(frames=170_000, minutes=2.0, rollout_length=32, epochs=2, minibatches=4,
                         channels=(16, 32, 32), features=128, hidden=128, learning_rate=1e-3,
                         final_learning_rate=2e-4, start_difficulty=1.0)
    folder = train(env, config, tmp_path / 'run', info=FACTS)
    from vn_nav.evaluation.evaluator import PolicyActor, random_actor, run_episodes
    from vn_nav.evaluation.metrics import summarise
    from vn_nav.robot import RobotSpec
    test = make_env(**options)
    network = load_checkpoint(folder).network
    learned, chance = (summarise(run_episodes(test, actor, 128, seed=9, robot=RobotSpec()))
                       for actor in (PolicyActor(test, network, 'sample', 0),
                                     random_actor(test, 0)))
    print(f'learned {learned["success"]:.2f}, random {chance["success"]:.2f}')
    assert learned['success'] >= 0.75 and learned['success'] > chance['success'] + 0.25
