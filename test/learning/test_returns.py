"""Returns, advantages and Q targets against naive loops."""

import pytest
import torch

from vn_nav.learning.returns import (
    generalised_advantages,
    n_step_q,
    n_step_returns,
    normalise,
)
from vn_nav.policy.heads import dueling

STEPS, ENVS = 24, 7


def rollout(seed, steps=STEPS, envs=ENVS):
    """Rows as NEXT_STEP autoreset gives them: after an episode's last step a row is no frame."""
    generator = torch.Generator().manual_seed(seed)

    def chance(share):
        return torch.rand(steps, envs, generator=generator) < share
    reward = torch.randn(steps, envs, generator=generator)
    value = torch.randn(steps + 1, envs, generator=generator)
    terminated, truncated = chance(0.12), chance(0.12)
    truncated &= ~terminated
    valid = torch.ones(steps, envs, dtype=torch.bool)
    for t in range(1, steps):
        ended = (terminated | truncated)[t - 1]
        valid[t] = ~ended
        terminated[t] &= ~ended
        truncated[t] &= ~ended
    assert terminated.any() and truncated.any() and not valid.all()
    return reward, value, terminated, truncated, valid


def naive_return(t, env, reward, value, terminated, truncated, valid, gamma):
    total, weight = 0.0, 1.0
    while True:
        total += weight * float(reward[t, env])
        weight *= gamma
        if terminated[t, env]:
            return total
        t += 1
        if truncated[t - 1, env] or t == len(reward) or not valid[t, env]:
            return total + weight * float(value[t, env])


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_returns_equal_a_naive_loop(seed):
    parts = rollout(seed)
    fast = n_step_returns(*parts, gamma=0.9)
    for env in range(ENVS):
        for t in range(STEPS):
            if parts[4][t, env]:
                assert float(fast[t, env]) == pytest.approx(
                    naive_return(t, env, *parts, 0.9), abs=1e-5)


def test_advantages_equal_a_naive_loop():
    reward, value, terminated, truncated, valid = rollout(3)
    fast = generalised_advantages(reward, value, terminated, truncated, gamma=0.9, lam=0.8)
    for env in range(ENVS):
        for t in range(STEPS):
            total, weight = 0.0, 1.0
            for k in range(t, STEPS):
                follows = 0.0 if terminated[k, env] else 0.9 * float(value[k + 1, env])
                total += weight * (float(reward[k, env]) + follows - float(value[k, env]))
                if terminated[k, env] or truncated[k, env]:
                    break
                weight *= 0.9 * 0.8
            assert not valid[t, env] or float(fast[t, env]) == pytest.approx(total, abs=1e-5)


def test_masked_rows_do_not_count_even_when_they_are_nan():
    x = torch.tensor([1.0, 3.0, float('nan')])
    assert torch.allclose(normalise(x, torch.tensor([True, True, False]))[:2],
                          torch.tensor([-1.0, 1.0]), atol=1e-4)


def test_returns_equal_monte_carlo_advantages_plus_value():
    reward, value, terminated, truncated, valid = rollout(3)
    returns = n_step_returns(reward, value, terminated, truncated, valid, gamma=0.97)
    advantage = generalised_advantages(reward, value, terminated, truncated, gamma=0.97, lam=1.0)
    assert torch.allclose(returns[valid], (advantage + value[:-1])[valid], atol=1e-5)


def test_trap_7_a_time_out_bootstraps_unless_asked_otherwise():
    reward = torch.tensor([[1.0], [2.0], [50.0], [4.0]])
    value = torch.tensor([[0.0], [0.0], [10.0], [0.0], [30.0]])
    truncated = torch.tensor([[False], [True], [False], [False]])
    valid = torch.tensor([[True], [True], [False], [True]])
    none = torch.zeros_like(truncated)
    returns = n_step_returns(reward, value, none, truncated, valid, gamma=0.5)
    assert returns[valid].tolist() == [1 + 0.5 * (2 + 0.5 * 10), 2 + 0.5 * 10, 4 + 0.5 * 30]
    published = n_step_returns(reward, value, none, truncated, valid, gamma=0.5,
                               truncation_is_terminal=True)
    assert published[valid].tolist() == [1 + 0.5 * 2, 2.0, 4 + 0.5 * 30]


def test_returns_bootstrap_where_padding_begins():
    reward = torch.tensor([[1.0, 1.0], [2.0, 2.0], [99.0, 99.0]])
    value = torch.tensor([[7.0, 7.0], [8.0, 8.0], [10.0, 10.0], [float('nan')] * 2])
    terminated = torch.tensor([[False, False], [False, True], [False, False]])
    valid = torch.tensor([[True, True], [True, True], [False, False]])
    returns = n_step_returns(reward, value, terminated, torch.zeros_like(valid), valid, gamma=0.5)
    assert returns[:2].T.tolist() == [[1 + 0.5 * 7, 2 + 0.5 * 10], [1 + 0.5 * 2, 2.0]]


def test_q_targets_equal_a_naive_loop():
    generator = torch.Generator().manual_seed(4)
    steps, envs, gamma = 9, 12, 0.9
    reward = torch.rand(steps, envs, 3, 2, generator=generator)
    bootstrap = torch.randn(envs, 3, 2, generator=generator)
    length = torch.randint(1, steps + 1, (envs,), generator=generator)
    length[0] = steps
    ends = torch.rand(envs, generator=generator) < 0.5
    rows = torch.arange(steps)[:, None]
    valid, terminated = rows < length, (rows == length - 1) & ends
    assert 0 < ends.sum() < envs and not valid.all()
    fast = n_step_q(reward, bootstrap, terminated, valid, gamma=gamma)
    assert fast.shape == reward.shape
    for env in range(envs):
        for t in range(int(length[env])):
            for y in range(3):
                for x in range(2):
                    total, weight = 0.0, 1.0
                    for k in range(t, int(length[env])):
                        total += weight * float(reward[k, env, y, x])
                        weight *= gamma
                    if not ends[env]:
                        total += weight * float(bootstrap[env, y, x])
                    assert float(fast[t, env, y, x]) == pytest.approx(total, abs=1e-5)


def test_q_of_a_terminated_episode_ignores_what_follows():
    reward = torch.ones(2, 1, 1, 1)
    ends = torch.tensor([[False], [True]])
    targets = n_step_q(reward, torch.full((1, 1, 1), float('nan')), ends, torch.ones_like(ends),
                       gamma=0.5)
    assert targets.flatten().tolist() == [1.5, 1.0]


def test_trap_1_dueling_takes_the_mean_over_actions():
    generator = torch.Generator().manual_seed(5)
    value = torch.randn(2, 3, 1, 4, 5, generator=generator)
    advantage = torch.randn(2, 3, 6, 4, 5, generator=generator)
    q = dueling(value, advantage)
    assert q.shape == advantage.shape
    for y in range(4):
        for x in range(5):
            of_cell = advantage[1, 2, :, y, x]
            expected = value[1, 2, 0, y, x] + of_cell - sum(of_cell.tolist()) / 6
            assert torch.allclose(q[1, 2, :, y, x], expected, atol=1e-6)
    # What the trap loses: a constant added to all advantages must not change Q.
    assert torch.allclose(dueling(value, advantage + 3.0), q, atol=1e-5)
