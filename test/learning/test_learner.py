"""One update of the learner against textbook formulas, computed in plain loops."""

import copy
import dataclasses
import math

import pytest
import torch
from two_bars import KEYS, TwoBars, collected

from vn_nav.errors import UserError
from vn_nav.learning import auxiliary
from vn_nav.learning.batches import select
from vn_nav.learning.learner import BASIC_LOSSES, Learner
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.learning.presets import PRESETS, TrainConfig, preset
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector
from vn_nav.observation import Observation
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy

SMALL = NetworkConfig(actions=TwoBars.action_names, size=36, channels=(8, 8, 8), features=24,
                      hidden=16)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def network_of(config, size=36):
    return build_policy(config.network(TwoBars.action_names, size))


def memory_of(config, envs=6, size=36):
    """The replay memory that a trainer would make, for `TwoBars`."""
    env = TwoBars(envs, size)
    return Replay(config.replay_steps // envs, envs, size, torch.from_numpy(env.goals),
                  privileged=tuple(key for key in config.privileged
                                   if key in ('depth', 'segmentation')),
                  goal_segmentation=torch.from_numpy(env.goal_segmentation))


def learner_of(network, config, **options):
    """A learner, and the list that gets its gradients before they are clipped, step by step."""
    steps = []

    def note(parameters):
        steps.append({name: parameter.grad.clone() for name, parameter in
                      network.named_parameters() if parameter.grad is not None})
        assert len(parameters) == len(steps[-1])
    if config.from_replay:
        options.setdefault('replay', memory_of(config))
    return Learner(network, config, options.pop('generator', generator()),
                   average_gradients=note, **options), steps


def assert_equal_gradients(mine, network, rtol=1e-4):
    for name, parameter in network.named_parameters():
        if parameter.grad is None:
            assert name not in mine or not mine[name].any(), name
            continue
        scale = float(parameter.grad.abs().max())
        assert torch.allclose(mine[name], parameter.grad, rtol=rtol, atol=1e-4 * scale), name


def rows_of(rollout):
    """All observations but the last."""
    seen = rollout.observation
    return Observation(seen.image[:-1], seen.goals, *(part[:-1] for part in seen[2:5]))


def n_step_return(rollout, t, env, gamma, time_out_ends=False):
    """The reward until the episode or the rollout ends, and the value of what was cut off."""
    total, weight = 0.0, 1.0
    while True:
        total += weight * float(rollout.reward[t, env])
        weight *= gamma
        if rollout.terminated[t, env] or (time_out_ends and rollout.truncated[t, env]):
            return total
        t += 1
        if rollout.truncated[t - 1, env] or t == len(rollout.reward):
            return total + weight * float(rollout.value[t, env])


def general_advantage(rollout, t, env, gamma, lam):
    """Schulman et al. 2016, equation 16, term by term."""
    total, weight = 0.0, 1.0
    while t < len(rollout.reward):
        after = 0.0 if rollout.terminated[t, env] else float(rollout.value[t + 1, env])
        total += weight * (float(rollout.reward[t, env]) + gamma * after
                           - float(rollout.value[t, env]))
        if rollout.terminated[t, env] or rollout.truncated[t, env]:
            break
        weight *= gamma * lam
        t += 1
    return total


def frames_of(rollout):
    """Rows and environments of all decisions."""
    return [(int(t), int(env)) for t, env in torch.nonzero(rollout.valid)]


@pytest.mark.parametrize('name', ['a2c', 'framestack'])
@pytest.mark.parametrize('time_out_ends', [False, True])
def test_a2c_has_the_textbook_gradient(name, time_out_ends):
    """-log pi(a) A + 0.5 (R - V)^2 - 0.001 H, with n-step returns (thesis, 5.3)."""
    config = preset(name, hidden=32, truncation_is_terminal=time_out_ends,
                    value_replay=0.0, pixel_control=0.0, reward_prediction=0.0)
    network = network_of(config)
    rollout = collected(network, rollouts=3)
    assert rollout.terminated.any() and rollout.truncated.any() and not rollout.valid.all()
    plain = copy.deepcopy(network)
    learner, gradients = learner_of(network, config)
    losses = learner.update(rollout)
    output, _ = plain(rows_of(rollout), rollout.starts[:-1], rollout.state)
    frames = frames_of(rollout)
    actor = critic = entropy = 0.0
    for t, env in frames:
        target = n_step_return(rollout, t, env, 0.99, time_out_ends)
        probability = torch.softmax(output.logits[t, env], 0)
        advantage = target - float(rollout.value[t, env])
        actor = actor - probability[rollout.action[t, env]].log() * advantage / len(frames)
        critic = critic + (target - output.value[t, env]) ** 2 / len(frames)
        entropy = entropy - (probability * probability.log()).sum() / len(frames)
    (actor + 0.5 * critic - 0.001 * entropy).backward()
    assert len(gradients) == 1
    assert_equal_gradients(gradients[0], plain)
    assert losses['value_loss'] == pytest.approx(float(critic.detach()), rel=1e-4)
    assert losses['entropy'] == pytest.approx(float(entropy.detach()), rel=1e-4)
    assert losses['kl'] == pytest.approx(0.0, abs=1e-6) and losses['clipped'] == 0.0


def test_ppo_is_the_naive_algorithm():
    """Schulman et al. 2017, equation 7, in two epochs of three minibatches by Adam."""
    config = LearnerConfig(epochs=2, minibatches=3, clip=0.02, learning_rate=3e-3, lam=0.9,
                           entropy_coefficient=0.02, max_gradient_norm=0.5)
    network = Policy(SMALL)
    with torch.no_grad():
        network.actor.weight *= 100  # so that probabilities move within an update
    rollout = collected(network, steps=12, rollouts=2)
    assert rollout.terminated.any() and rollout.truncated.any()
    plain = copy.deepcopy(network)
    learner, _ = learner_of(network, config)
    losses = learner.update(rollout)

    frames = frames_of(rollout)
    advantage = {at: general_advantage(rollout, *at, 0.99, 0.9) for at in frames}
    target = {at: value + float(rollout.value[at]) for at, value in advantage.items()}
    mean = sum(advantage.values()) / len(frames)
    deviation = (sum((value - mean) ** 2 for value in advantage.values()) / len(frames)) ** 0.5
    optimiser = torch.optim.Adam(plain.parameters(), 3e-3, eps=1e-5)
    draws, totals, far = generator(), {name: 0.0 for name in BASIC_LOSSES}, 0
    for _ in range(2):
        order = torch.randperm(6, generator=draws).tolist()
        for first in range(0, 6, 2):
            output, _ = plain(rows_of(rollout), rollout.starts[:-1], rollout.state)
            batch = [at for at in frames if at[1] in order[first:first + 2]]
            surrogate, critic, entropy, kl = [], [], [], []
            for at in batch:
                probability = torch.softmax(output.logits[at], 0)
                new = probability[rollout.action[at]].log()
                ratio = (new - rollout.log_probability[at]).exp()
                number, scaled = ratio.item(), (advantage[at] - mean) / deviation
                bounded = min(max(number, 0.98), 1.02) * scaled
                surrogate.append(ratio * scaled if number * scaled <= bounded
                                 else torch.tensor(bounded))
                critic.append((output.value[at] - target[at]) ** 2)
                entropy.append(-(probability * probability.log()).sum())
                kl.append(ratio - 1 - ratio.log())
                far += abs(number - 1) > 0.02
            means = [torch.stack(part).mean() for part in (surrogate, critic, entropy, kl)]
            optimiser.zero_grad()
            (-means[0] + 0.5 * means[1] - 0.02 * means[2]).backward()
            norm = torch.stack([p.grad.square().sum() for p in plain.parameters()]).sum().sqrt()
            for parameter in plain.parameters():
                parameter.grad *= min(1.0, 0.5 / (float(norm) + 1e-6))
            optimiser.step()
            for name, value in zip(('policy_loss', 'value_loss', 'entropy', 'kl'), means,
                                   strict=True):
                totals[name] += (1 if name != 'policy_loss' else -1) * value.item() / 6
            totals['gradient_norm'] += float(norm) / 6
    assert far > 10  # the clipping had something to do
    for (name, one), other in zip(network.named_parameters(), plain.parameters(), strict=True):
        assert torch.allclose(one, other, atol=2e-5), name
    for name in ('policy_loss', 'value_loss', 'entropy', 'kl', 'gradient_norm'):
        assert losses[name] == pytest.approx(totals[name], rel=2e-3, abs=2e-6), name
    assert losses['clipped'] > 0


def test_rmsprop_follows_its_formula_with_clipped_gradients_and_a_falling_rate():
    """Thesis, table 5.1: alpha 0.99, epsilon 1e-5, norm 0.5, 7e-4 (fmax - f) / fmax."""
    config = preset('a2c', hidden=32)
    network = network_of(config)
    with torch.no_grad():
        network.critic.weight *= 0.1  # a first gradient that need not be clipped
    learner, gradients = learner_of(network, config)
    average = {name: torch.zeros_like(p) for name, p in network.named_parameters()}
    norms = []
    for number, progress in enumerate((0.0, 0.25, 0.9)):
        rollout = collected(network, seed=number)
        rollout.reward *= 0.3 if number == 0 else 30.0
        before = {name: p.detach().clone() for name, p in network.named_parameters()}
        losses = learner.update(rollout, progress)
        raw = gradients[-1]
        norm = math.sqrt(sum(float(part.double().square().sum()) for part in raw.values()))
        norms.append(norm)
        assert losses['gradient_norm'] == pytest.approx(norm, rel=1e-4)
        for name, parameter in network.named_parameters():
            part = raw[name] * min(1.0, 0.5 / (norm + 1e-6))
            average[name] = 0.99 * average[name] + 0.01 * part**2
            rate = 7e-4 * (1 - progress)
            expected = before[name] - rate * part / (average[name].sqrt() + 1e-5)
            assert torch.allclose(parameter, expected, atol=1e-7), name
        kept = math.sqrt(sum(float(p.grad.double().square().sum()) for p in network.parameters()))
        assert kept == pytest.approx(min(norm, 0.5), rel=1e-4)
    assert norms[0] < 0.5 < min(norms[1:])


def test_schedules_are_linear():
    config = LearnerConfig(learning_rate=1e-3, final_learning_rate=1e-4, epochs=1, minibatches=1,
                           entropy_coefficient=0.5, final_entropy_coefficient=0.1)
    network = Policy(SMALL)
    rollout = collected(network)
    for progress, rate, coefficient in ((-1.0, 1e-3, 0.5), (0.0, 1e-3, 0.5), (0.25, 7.75e-4, 0.4),
                                        (1.0, 1e-4, 0.1), (2.0, 1e-4, 0.1)):
        learner, gradients = learner_of(copy.deepcopy(network), config)
        learner.update(rollout, progress)
        assert learner.optimiser.param_groups[0]['lr'] == pytest.approx(rate)
        same, expected = learner_of(copy.deepcopy(network), dataclasses.replace(
            config, entropy_coefficient=coefficient, final_entropy_coefficient=coefficient))
        same.update(rollout)
        for name, part in gradients[0].items():
            assert torch.allclose(part, expected[0][name], rtol=1e-4, atol=1e-6), name


def test_the_rate_rises_in_the_first_updates():
    config = LearnerConfig(learning_rate=1e-3, final_learning_rate=0.0, epochs=1, minibatches=1,
                           warmup_updates=4)
    network = Policy(SMALL)
    learner, _ = learner_of(network, config)
    for updates, progress, rate in ((0, 0.0, 2.5e-4), (2, 0.5, 3.75e-4), (9, 0.5, 5e-4)):
        learner.update(collected(network), progress, updates)
        assert learner.optimiser.param_groups[0]['lr'] == pytest.approx(rate)


@pytest.mark.parametrize('size', [36, 128])
def test_the_total_gradient_is_the_weighted_sum(size):
    """Of the thesis's nine losses, each on a draw of its own (thesis, 5.3 and table 5.1)."""
    config = preset('thesis', hidden=32, replay_steps=240, replay_length=8, replay_batch=5)
    network = network_of(config, size)
    rollout = collected(network, rollouts=2)
    plain, memory = copy.deepcopy(network), memory_of(config, size=size)
    for replay in (memory, twin := memory_of(config, size=size)):
        replay.extend(collected(network))
    learner, gradients = learner_of(network, config, replay=memory, generator=generator(5))
    losses = learner.update(rollout)
    twin.extend(rollout)
    draws = generator(5)
    torch.randperm(6, generator=draws)

    output, _ = plain(rows_of(rollout), rollout.starts[:-1], rollout.state)
    frames = frames_of(rollout)
    parts = dict.fromkeys(('actor', 'critic', 'entropy'), 0.0)
    for t, env in frames:
        target = n_step_return(rollout, t, env, 0.99)
        probability = torch.softmax(output.logits[t, env], 0)
        advantage = target - float(rollout.value[t, env])
        parts['actor'] -= probability[rollout.action[t, env]].log() * advantage / len(frames)
        parts['critic'] += (target - output.value[t, env]) ** 2 / len(frames)
        parts['entropy'] -= (probability * probability.log()).sum() / len(frames)

    def window():
        drawn = twin.windows(5, 8, draws)
        return plain.latents(drawn.observation, drawn.starts)[0], drawn
    parts['pixel_control'] = auxiliary.pixel_control_loss(plain, *window(), gamma=0.9)
    parts['value_replay'] = auxiliary.value_replay_loss(plain, *window(), gamma=0.99)
    seen, label = twin.reward_frames(5, draws)
    parts['reward_prediction'] = auxiliary.reward_prediction_loss(plain, plain.maps(seen), label)
    latents, drawn = window()  # the image heads share one draw
    maps = latents.maps[:drawn.valid.numel()]
    for name in ('depth', 'segmentation', 'goal_segmentation'):
        parts[name] = auxiliary.image_loss(plain, name, maps, drawn)
    weights = {'actor': 1.0, 'critic': 0.5, 'entropy': -0.001, 'value_replay': 1.0,
               'pixel_control': 0.05, 'reward_prediction': 1.0, 'depth': 0.1,
               'segmentation': 0.1, 'goal_segmentation': 0.1}
    assert set(weights) == set(parts)
    sum(weights[name] * loss for name, loss in parts.items()).backward()
    assert_equal_gradients(gradients[0], plain, rtol=1e-3)
    for name in config.tasks:
        assert losses[name] == pytest.approx(float(parts[name].detach()), rel=1e-4), name


@pytest.mark.parametrize('name', [pytest.param(name, marks=pytest.mark.slow) if name == 'anywhere'
                                  else name for name in PRESETS if name != 'search'])
def test_equal_seeds_give_equal_updates(name):
    """Bit for bit on one thread: two rollouts and updates, run twice."""
    def run():
        torch.manual_seed(3)
        config = preset(name, replay_steps=240)
        network, draws = network_of(config), generator(4)
        collector = Collector(TwoBars(6), network, draws, KEYS)
        collector.begin(7)
        learner, _ = learner_of(network, config, generator=draws)
        losses = []
        for _ in range(2):
            rollout, _ = collector.collect(config.rollout_length)
            losses.append(learner.update(rollout, 0.1))
        return losses, network.state_dict()
    (first, one), (second, two) = run(), run()
    assert first == second and first[0] != first[1]
    assert set(first[0]) == {*BASIC_LOSSES, *preset(name).tasks}
    assert all(math.isfinite(value) for losses in first for value in losses.values())
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_time_outs_bootstrap_unless_asked_otherwise():
    """Trap 7: what the option does is what real ends at the time-outs would do."""
    network = Policy(SMALL)
    rollout = collected(network, rollouts=3)
    assert rollout.truncated.any()
    ended = dataclasses.replace(rollout, terminated=rollout.terminated | rollout.truncated,
                                truncated=torch.zeros_like(rollout.truncated))
    value_loss = {}
    for name, batch, option in (('bootstraps', rollout, False), ('ends', ended, False),
                                ('option', rollout, True)):
        config = LearnerConfig(epochs=1, minibatches=1, truncation_is_terminal=option)
        learner, _ = learner_of(copy.deepcopy(network), config)
        value_loss[name] = learner.update(batch)['value_loss']
    assert value_loss['option'] == value_loss['ends'] != value_loss['bootstraps']


def test_rows_that_are_no_frames_change_nothing():
    network = Policy(SMALL)
    rollout = collected(network, rollouts=3)
    spoilt = dataclasses.replace(rollout, action=rollout.action.clone(),
                                 log_probability=rollout.log_probability.clone())
    spoilt.action[~rollout.valid] = 1 - spoilt.action[~rollout.valid]
    spoilt.log_probability[~rollout.valid] = -30.0
    assert not rollout.valid.all()
    results = []
    for batch in (rollout, spoilt):
        learner, gradients = learner_of(copy.deepcopy(network), LearnerConfig(minibatches=1))
        results.append((learner.update(batch), gradients))
    assert results[0][0] == results[1][0]
    for one, two in zip(*(gradients for _, gradients in results), strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_selection_keeps_its_columns_and_only_its_goals():
    network = Policy(SMALL)
    rollout = collected(network)
    columns = torch.tensor([4, 1])
    part = select(rollout, columns)
    for name in ('starts', 'action', 'reward', 'terminated', 'truncated', 'valid',
                 'log_probability', 'value'):
        assert torch.equal(getattr(part, name), getattr(rollout, name)[:, columns]), name
    seen, whole = part.observation, rollout.observation
    assert torch.equal(seen.image, whole.image[:, columns])
    assert torch.equal(seen.goals[seen.goal_index], whole.goals[whole.goal_index[:, columns]])
    assert len(seen.goals) == len(torch.unique(whole.goal_index[:, columns]))
    for name, rows in rollout.privileged.items():
        assert torch.equal(part.privileged[name], rows[:, columns]), name
    assert torch.equal(part.state.hidden, rollout.state.hidden[columns])


def test_a_loss_that_is_not_finite_stops_before_the_step(tmp_path):
    network = Policy(SMALL)
    rollout = collected(network)
    frame = tuple(torch.nonzero(rollout.valid)[3].tolist())
    rollout.reward[frame] = math.nan
    before = copy.deepcopy(network.state_dict())
    learner, _ = learner_of(network, LearnerConfig(epochs=1, minibatches=1))
    learner.failed_batch = tmp_path / 'batch.pt'
    with pytest.raises(UserError, match='finite.*batch.pt'):
        learner.update(rollout)
    assert all(torch.equal(before[name], part) for name, part in network.state_dict().items())
    kept = torch.load(tmp_path / 'batch.pt')
    assert torch.isnan(kept['batch']['reward']).sum() == 1
    assert math.isnan(kept['losses']['value'])
    assert all(torch.equal(before[name], part) for name, part in kept['network'].items())


def test_what_a_learner_needs_is_asked_for():
    with pytest.raises(UserError, match='a head for every auxiliary task'):
        Learner(Policy(SMALL), LearnerConfig(depth=1.0), generator())
    config = TrainConfig(value_replay=1.0)
    with pytest.raises(UserError, match='replay memory'):
        Learner(network_of(config), config, generator())


@pytest.mark.parametrize('field', [
    {'learning_rate': 0.0}, {'final_learning_rate': -1.0}, {'clip': 0.0}, {'gamma': 1.1},
    {'lam': -0.1}, {'depth': -1.0}, {'optimiser': 'sgd'}, {'epochs': 0}, {'minibatches': 0},
    {'max_gradient_norm': 0.0}, {'replay_batch': 0}, {'unrewarded': 2.0},
    {'learning_rate': math.nan}, {'goal_pose': math.nan}, {'warmup_updates': -1}])
def test_bad_numbers_are_refused(field):
    with pytest.raises(UserError, match=next(iter(field))):
        LearnerConfig(**field)
