"""Every preset learns the smallest task that needs both pictures (`two_bars`)."""

import signal

import numpy as np
import pytest
import torch
from two_bars import BLANK, LIMIT, SLIP, TwoBars, success

from vn_nav.learning.presets import PRESETS, preset
from vn_nav.learning.trainer import train
from vn_nav.policy.checkpoint import load_checkpoint

FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
# A small budget: short rollouts, a rate that suits them, and windows no longer than episodes.
A2C = {'frames': 20_000, 'rollout_length': 5, 'learning_rate': 1e-3, 'hidden': 128,
       'replay_steps': 2000, 'replay_length': LIMIT + 1}
BUDGETS: dict[str, dict] = {
    'a2c': A2C, 'unreal': A2C, 'framestack': A2C, 'thesis': A2C,
    'icra2017': {'frames': 20_000, 'hidden': 128},
    # By reinforcement alone: a teacher would give the answer away.
    'fast': {'frames': 8000, 'imitation': 0.0, 'teacher_share': 0.0, 'pair_minutes': 0.0},
    # Turns are all that is decided here: there is no way to reckon.
    'anywhere': {'frames': 16_000, 'imitation': 0.0, 'teacher_share': 0.0, 'pair_minutes': 0.0,
                 'track_goal': False, 'features': 128, 'hidden': 128, 'rollout_length': 32},
}


def test_neither_picture_alone_tells_the_turn():
    env = TwoBars(64)
    observation, info = env.reset(seed=0)
    assert env.goals.shape == (3, 3, 36, 36) and observation['image'].shape == (64, 3, 36, 36)
    turns, ends = [], 0
    for _ in range(40):
        begun = info['reset']
        turns += [*zip(env.red_left[begun], observation['goal_index'][begun],
                       info['oracle_action'][begun], strict=True)]
        observation, reward, terminated, _, info = env.step(info['oracle_action'])
        assert np.array_equal(reward, terminated.astype(np.float32))
        ends += terminated.sum()
    turns = np.array(turns)
    assert ends > 800
    for column in (0, 1):
        for value in (0, 1):
            assert abs(turns[turns[:, column] == value, 2].mean() - 0.5) < 0.08
    assert np.array_equal(turns[:, 2], (turns[:, 0] == turns[:, 1]))


def test_slips_are_cut_off_and_the_other_bar_earns_nothing():
    env = TwoBars(64)
    observation, info = env.reset(seed=0)
    cut = 0
    for _ in range(20):
        wrong = 1 - info['oracle_action']
        before, seen = env.step_count.copy(), observation['image']
        observation, reward, terminated, truncated, info = env.step(wrong)
        assert not reward.any() and not info['success'].any()
        slipped = ~terminated & ~info['reset']
        assert np.array_equal(truncated, slipped & (before == LIMIT - 1))
        assert (observation['image'] != seen).reshape(64, -1).any(axis=1)[slipped].all()
        cut += truncated.sum()
    assert cut > 30


def test_no_preset_is_left_out():
    assert set(BUDGETS) == set(PRESETS) - {'search'}  # it drives nowhere: supervised


def stop_when_learned(row):
    """End a training early, as a user would, once nearly all of the last 200 episodes succeed."""
    most = 1 - SLIP**LIMIT  # the others are cut off
    if row['tau'] == 1.0 and row['success'] >= 0.96 * most:
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.slow  # 5 to 20 seconds each on a core of its own
@pytest.mark.timeout(300)
@pytest.mark.parametrize('name', BUDGETS)
def test_each_preset_learns_it(name, tmp_path):
    torch.set_num_threads(1)
    folder = train(TwoBars(16), preset(name, bf16=False, **BUDGETS[name]), tmp_path / 'run',
                   info=FACTS, on_update=stop_when_learned)
    loaded = load_checkpoint(folder)
    learned, blind = success(loaded.network, 256), success(loaded.network, 256, BLANK)
    print(f'{name}, {loaded.info["frames"]} frames: {learned:.2f} of the turns are right, '
          f'{blind:.2f} with a grey goal')
    assert learned >= 0.9
    assert 0.35 < blind < 0.65  # it does look at the goal: chance without
