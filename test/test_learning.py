"""Returns, network, checkpoint, trainer: against naive versions, and learning for real."""

import dataclasses
import json
import math
import signal

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.learning.curriculum import FrameCurriculum
from vn_nav.learning.returns import generalised_advantages, normalise
from vn_nav.learning.trainer import TrainConfig, train
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import NetworkConfig, Policy, RecurrentState
from vn_nav.policy.runtime import BatchedPolicy, PolicyRuntime
from vn_nav.robot import DRIVE_ACTIONS
from vn_sim_bridge.env import EnvConfig, NavigationEnv

SMALL = NetworkConfig(actions=DRIVE_ACTIONS, size=36, channels=(8, 8, 8), features=24, hidden=16)
FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def batch(steps=6, envs=3, goals=2, size=36):
    generator = torch.Generator().manual_seed(1)

    def draw(high, *shape, dtype=torch.int64):
        return torch.randint(0, high, shape, generator=generator).to(dtype)
    observation = Observation(
        draw(256, steps, envs, 3, size, size, dtype=torch.uint8),
        draw(256, goals, 3, size, size, dtype=torch.uint8), draw(goals, steps, envs),
        draw(5, steps, envs) - 1, draw(2, steps, envs, dtype=torch.float32))
    starts = torch.zeros(steps, envs, dtype=torch.bool)
    starts[0, 0] = True
    if steps > 4 and envs > 1:
        starts[3, 1] = starts[4, 1] = True
    return observation, starts


def test_advantages_equal_a_naive_loop():
    generator = torch.Generator().manual_seed(3)
    reward = torch.randn(9, 4, generator=generator)
    value = torch.randn(10, 4, generator=generator)
    terminated = torch.rand(9, 4, generator=generator) < 0.2
    truncated = (torch.rand(9, 4, generator=generator) < 0.2) & ~terminated
    fast = generalised_advantages(reward, value, terminated, truncated, gamma=0.9, lam=0.8)
    for env in range(4):
        for t in range(9):
            total, weight = 0.0, 1.0
            for k in range(t, 9):
                follows = 0.0 if terminated[k, env] else 0.9 * float(value[k + 1, env])
                total += weight * (float(reward[k, env]) + follows - float(value[k, env]))
                if terminated[k, env] or truncated[k, env]:
                    break
                weight *= 0.9 * 0.8
            assert float(fast[t, env]) == pytest.approx(total, abs=1e-5)


def test_masked_rows_do_not_count_even_when_they_are_nan():
    x = torch.tensor([1.0, 3.0, float('nan')])
    assert torch.allclose(normalise(x, torch.tensor([True, True, False]))[:2],
                          torch.tensor([-1.0, 1.0]), atol=1e-4)


@pytest.mark.parametrize('size', [36, 64, 84, 174])
def test_shapes_follow_the_configuration(size):
    network = Policy(dataclasses.replace(SMALL, size=size))
    observation, starts = batch(2, 2, size=size)
    output, state = network(observation, starts, network.initial_state(2))
    assert output.logits.shape == (2, 2, 4) and output.value.shape == (2, 2)
    assert state.hidden.shape == (2, 16)


def test_goals_encoded_once_equal_a_six_channel_convolution():
    network = Policy(SMALL)
    observation, _ = batch(1, 5)
    images = observation.image[0].float() - SMALL.pixel_mean
    goals = observation.goals[observation.goal_index[0]].float() - SMALL.pixel_mean
    weight = torch.cat([network.picture_conv.weight, network.goal_conv.weight], 1)
    naive = torch.nn.functional.conv2d(torch.cat([images, goals], 1) / SMALL.pixel_std, weight,
                                       network.picture_conv.bias, 4)
    once = (network._first(observation.image[0], network.picture_conv)
            + network.encode_goals(observation.goals)[observation.goal_index[0]])
    assert torch.allclose(naive, once, atol=1e-4)


def test_stepwise_equals_the_sequence_across_resets():
    network = Policy(SMALL)
    observation, starts = batch()
    state = RecurrentState(torch.randn(3, 16), torch.randn(3, 16))
    whole, last = network(observation, starts, state)
    rows = []
    for t in range(6):
        row = Observation(observation.image[t:t + 1], observation.goals,
                          *(part[t:t + 1] for part in observation[2:]))
        output, state = network(row, starts[t:t + 1], state)
        rows.append(output.logits)
    assert torch.allclose(whole.logits, torch.cat(rows), atol=1e-5)
    assert torch.allclose(last.cell, state.cell, atol=1e-5)


def test_the_hand_written_lstm_gradient_equals_autograd():
    network = Policy(SMALL)
    observation, starts = batch()
    output, _ = network(observation, starts, network.initial_state(3))
    (output.logits.square().sum() + output.value.sum()).backward()
    mine = {name: parameter.grad.clone() for name, parameter in network.named_parameters()}
    network.zero_grad()
    features = network.encode(observation.image.flatten(0, 1),
                              network.encode_goals(observation.goals),
                              observation.goal_index.flatten()).view(6, 3, -1)
    actions = torch.arange(4)
    inputs = torch.cat([features, (observation.last_action[..., None] == actions).float(),
                        observation.last_reward[..., None]], -1)
    memory, hidden, cell = network.memory, torch.zeros(3, 16), torch.zeros(3, 16)
    outputs = []
    for t in range(6):
        keep = (~starts[t]).float()[:, None]
        hidden, cell = hidden * keep, cell * keep
        gates = (inputs[t] @ memory.input_weight.T + hidden @ memory.recurrent_weight.T
                 + memory.bias)
        i, f, o, g = gates.chunk(4, -1)
        cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
        hidden = o.sigmoid() * cell.tanh()
        outputs.append(hidden)
    hidden = torch.stack(outputs)
    (network.actor(hidden).square().sum() + network.critic(hidden).sum()).backward()
    for name, parameter in network.named_parameters():
        assert torch.allclose(mine[name], parameter.grad, rtol=1e-3, atol=1e-4), name
        assert parameter.grad.abs().sum() > 0, f'no gradient reaches {name}'


def test_checkpoints_come_back_and_damage_is_refused(tmp_path):
    network = Policy(SMALL)
    folder = tmp_path / 'model'
    save_checkpoint(folder, network, FACTS)
    loaded = load_checkpoint(folder, DRIVE_ACTIONS)
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, loaded.network.state_dict()[name])
    assert loaded.info['world_version'] == '1'
    assert sorted(path.name for path in folder.iterdir()) == [
        'README.md', 'config.json', 'model.safetensors']
    with pytest.raises(UserError, match='actions'):
        load_checkpoint(folder, ('forward', 'rotate_left'))
    with pytest.raises(UserError, match='checkpoint'):
        load_checkpoint(tmp_path / 'nothing')
    weights = folder / 'model.safetensors'
    sound = weights.read_bytes()
    for at in np.random.default_rng(0).integers(0, len(sound), 25):
        flipped = bytearray(sound)
        flipped[at] ^= 1
        weights.write_bytes(flipped)
        with pytest.raises(UserError, match='SHA-256'):
            load_checkpoint(folder)
    weights.write_bytes(sound)
    config = json.loads((folder / 'config.json').read_text())
    config['network']['hidden'] = 99
    (folder / 'config.json').write_text(json.dumps(config))
    with pytest.raises(UserError, match='fits'):
        load_checkpoint(folder)


def test_runtime_and_batched_policy_agree(tmp_path):
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    observation, _ = batch(5, 1)
    runtime = PolicyRuntime(tmp_path / 'model', decoding='greedy')
    goals = observation.goals[:1].numpy()
    runtime.set_goal(goals[0])
    policy = BatchedPolicy(load_checkpoint(tmp_path / 'model').network, 1, 'greedy')
    last = -1
    for t in range(5):
        image = observation.image[t, 0].numpy()
        action = runtime.act(image)
        same = policy.act({'image': image[None], 'goal_index': np.zeros(1, np.int64),
                           'last_action': np.array([last]),
                           'last_reward': np.zeros(1, np.float32)}, goals, np.array([t == 0]))
        assert action == same[0]
        last = action
    with pytest.raises(UserError, match='picture'):
        runtime.act(np.zeros((3, 20, 20), np.uint8))


def test_not_finite_output_is_an_error(tmp_path):
    network = Policy(SMALL)
    with torch.no_grad():
        network.actor.bias[0] = math.nan
    policy = BatchedPolicy(network, 1)
    observation, _ = batch(1, 1)
    with pytest.raises(FloatingPointError, match='finite'):
        policy.act({'image': observation.image[0].numpy(), 'goal_index': np.zeros(1, np.int64),
                    'last_action': np.array([-1]), 'last_reward': np.zeros(1, np.float32)},
                   observation.goals.numpy(), np.array([True]))


def make_env(**options):
    return NavigationEnv(EnvConfig(**{
        'houses': (3,), 'rooms': 1, 'num_envs': 8, 'size': 36, 'max_decisions': 40} | options))


QUICK = TrainConfig(frames=800, rollout_length=16, channels=(8, 8, 8), features=24, hidden=16,
                    minibatches=2, epochs=1)


def test_a_training_resumes_and_refuses_what_does_not_fit(tmp_path):
    rows = []
    folder = train(make_env(), QUICK, tmp_path / 'run', info=FACTS, on_update=rows.append)
    assert load_checkpoint(folder).info['frames'] == rows[-1]['frames'] >= 800
    header, *lines = (tmp_path / 'run' / 'metrics.csv').read_text().splitlines()
    assert 'success' in header and len(lines) == len(rows)
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


def test_equal_seeds_give_equal_trainings(tmp_path):
    weights = []
    for name in ('one', 'two'):
        folder = train(make_env(), dataclasses.replace(QUICK, bf16=False), tmp_path / name,
                       info=FACTS)
        weights.append(load_checkpoint(folder).network.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_an_interrupted_training_ends_as_an_uninterrupted_one(tmp_path):
    """Bit for bit, on one thread: the schedule's end is the same, only the process is not."""
    config = dataclasses.replace(QUICK, bf16=False, frames=1500)
    whole = train(make_env(), config, tmp_path / 'whole', info=FACTS)
    updates = []

    def interrupt(row):
        updates.append(row)
        if len(updates) == 5:
            signal.raise_signal(signal.SIGTERM)
    train(make_env(), config, tmp_path / 'parts', info=FACTS, on_update=interrupt)
    assert len(updates) == 5 and updates[-1]['frames'] < 1500
    parts = train(make_env(), config, tmp_path / 'parts', info=FACTS, resume=True)
    one, two = (load_checkpoint(folder).network.state_dict() for folder in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)


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
    from vn_nav.evaluation.evaluator import policy_actor, random_actor, run_episodes
    from vn_nav.evaluation.metrics import summarise
    from vn_nav.robot import RobotSpec
    test = make_env(**options)
    network = load_checkpoint(folder).network
    learned, chance = (summarise(run_episodes(test, actor, 128, seed=9, robot=RobotSpec()))
                       for actor in (policy_actor(test, network, 'sample', 0),
                                     random_actor(test, 0)))
    print(f'learned {learned["success"]:.2f}, random {chance["success"]:.2f}')
    assert learned['success'] >= 0.75 and learned['success'] > chance['success'] + 0.25


def test_the_frame_curriculum_follows_the_thesis():
    # Thesis: 0.3 until 5e6 of 4e7 frames, 1.0 from 1e7 on.
    curriculum = FrameCurriculum()
    taus = []
    for frames in (0, 4.9e6, 7.5e6, 1e7, 4e7):
        curriculum.update([], np.zeros(1), frames / 4e7)
        taus.append(curriculum.tau)
    assert taus == pytest.approx([0.3, 0.3, 0.65, 1.0, 1.0])
    assert not curriculum.update([], np.zeros(1), 1.0)
    other = FrameCurriculum()
    other.load_state_dict(curriculum.state_dict())
    assert other.tau == 1.0
