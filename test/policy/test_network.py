"""The network: every short cut against the plain computation."""

import dataclasses

import pytest
import torch
from random_batch import batch, thesis
from test_thesis_network import plain_thesis_base
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.memory import RecurrentState, stack_frames
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import ARCHITECTURES, HEADS, SEARCH, NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS

SMALL = NetworkConfig(actions=DRIVE_ACTIONS, size=36, channels=(8, 8, 8), features=24, hidden=16)
# Of icra2017, which has no heads, test_icra2017.py says the same.
# Those with an actor and a memory of their own; search has neither (test_search_network.py).
OURS = [name for name in ARCHITECTURES if name not in ('icra2017', SEARCH)]
MOVES = ((0.5, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, -0.5))
EVERY = [(name, frames) for name in OURS for frames in (1, 3)]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def test_goals_encoded_once_equal_a_six_channel_convolution():
    network = Policy(dataclasses.replace(SMALL, blocks=1))
    observation, _ = batch(1, 5)
    encoder, goals = network.encoder, observation.goals[observation.goal_index[0]]
    stacked = torch.cat([observation.image[0], goals], dim=1).float()
    x = F.relu(F.conv2d((stacked - SMALL.pixel_mean) / SMALL.pixel_std,
                        encoder.first.conv.weight, encoder.first.conv.bias, 4))
    x = F.relu(encoder.conv2(encoder.stage1[0](x)))
    x = F.relu(encoder.conv3(encoder.stage2[0](x)))
    maps, features = network.encode(observation.image[0],
                                    network.encode_goals(observation.goals),
                                    observation.goal_index[0])
    rows = x.permute(0, 2, 3, 1).flatten(1)  # as the maps lie in memory
    assert torch.allclose(maps, x, atol=1e-4)
    assert torch.allclose(features, F.relu(encoder.trunk(rows)), atol=1e-4)


@pytest.mark.parametrize('deconvolutions', [1, 2])
def test_pixel_control_is_dueling_over_actions(deconvolutions):
    """Wang et al. 2015, equation 9: both branches by themselves, then joined."""
    network = thesis(84, deconvolutions=deconvolutions)
    head, hidden = network.heads['pixel_control'], torch.randn(3, 512)
    x = F.relu(head.expand(hidden)).view(3, 32, 9, 9)
    for layer in head.grow:
        x = F.relu(layer(x))
    value, advantage = head.value(x), head.advantage(x)
    expected = value + advantage - sum(advantage[:, a:a + 1] for a in range(4)) / 4
    assert torch.allclose(head(hidden), expected, atol=1e-5)
    with torch.no_grad():
        head.advantage.bias += 3.0  # says nothing about any action
    assert torch.allclose(head(hidden), expected, atol=1e-5)


def test_the_memory_sees_last_action_and_clipped_reward():
    network = thesis(84)
    observation, starts = batch(1, 6, size=84)
    actions = torch.tensor([[-1, 0, 1, 2, 3, 3]])
    rewards = torch.tensor([[0.0, 0.5, 10.0, -7.0, 1.0, -1.0]])
    observation = observation._replace(last_action=actions, last_reward=rewards)
    given = []
    network.memory.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    network(observation, starts)
    _, features, _ = plain_thesis_base(network, observation.image[0],
                                       observation.goals[observation.goal_index[0]])
    one_hot = torch.tensor([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1],
                            [0, 0, 0, 1]])
    clipped = torch.tensor([[0.0], [0.5], [1.0], [-1.0], [1.0], [-1.0]])
    assert torch.allclose(given[0][0], torch.cat([features, one_hot, clipped], dim=1), atol=1e-5)


def test_actor_and_critic_are_affine_in_what_the_memory_says():
    network = thesis(84)
    latents, _ = network.latents(*batch(2, 3, size=84))
    output = network.read(latents)
    assert torch.allclose(output.logits, latents.hidden @ network.actor.weight.T
                          + network.actor.bias, atol=1e-6)
    assert torch.allclose(output.value, latents.hidden @ network.critic.weight[0]
                          + network.critic.bias, atol=1e-6)
    assert output.arrival is None


def changed(architecture, frames, **more):
    return Policy(dataclasses.replace(SMALL, architecture=architecture, frames=frames, **more))


def somewhere(network, envs):
    """A memory in the middle of an episode."""
    if network.config.frames > 1:
        before = torch.randint(0, 256, (envs, network.config.frames - 1, 3, 36, 36),
                               dtype=torch.uint8)
        return RecurrentState(before, torch.zeros(envs, 0))
    state = network.initial_state(envs)
    return RecurrentState(*(torch.randn_like(part) for part in state))


@pytest.mark.parametrize('architecture, frames', EVERY)
def test_stepwise_equals_the_sequence_across_resets(architecture, frames):
    network = changed(architecture, frames, heads=('goal_pose', 'arrival'), pose_to_memory=True,
                      moves=MOVES if frames == 1 else (), places=5 if frames == 1 else 0)
    observation, starts = batch()
    state = somewhere(network, 3)
    whole, last = network(observation, starts, state)
    rows = []
    for t in range(6):
        row = Observation(observation.image[t:t + 1], observation.goals,
                          *(part[t:t + 1] for part in observation[2:5]))
        output, state = network(row, starts[t:t + 1], state)
        rows.append(output)
    for name in ('logits', 'value', 'arrival'):
        stepwise = torch.cat([getattr(row, name) for row in rows])
        assert torch.allclose(getattr(whole, name), stepwise, atol=1e-5), name
    assert torch.allclose(last.hidden.float(), state.hidden.float(), atol=1e-5)
    assert torch.allclose(last.cell, state.cell, atol=1e-5)


@pytest.mark.parametrize('architecture, frames', EVERY)
def test_nothing_of_an_episode_reaches_the_next(architecture, frames):
    network = changed(architecture, frames)
    observation, starts = batch()
    starts[3] = True
    whole, _ = network(observation, starts, somewhere(network, 3))
    later = Observation(observation.image[3:], observation.goals,
                        *(part[3:] for part in observation[2:5]))
    alone, _ = network(later, starts[3:])
    assert torch.allclose(whole.logits[3:], alone.logits, atol=1e-5)
    assert torch.allclose(whole.value[3:], alone.value, atol=1e-5)


def test_the_correlation_volume_is_every_cosine():
    network = changed('matching', 1)
    encoder, (observation, _) = network.encoder, batch(1, 2)
    seen = encoder.see(observation.image[0], torch.float32)
    goals = network.encode_goals(observation.goals[:2])
    query = torch.nn.functional.conv2d(seen, encoder.query.weight, encoder.query.bias)
    volume = torch.empty(2, goals.shape[2] * goals.shape[3], *seen.shape[2:])
    for n in range(2):
        for place in range(volume.shape[1]):
            goal = goals[n].flatten(1)[:, place]
            for row in range(volume.shape[2]):
                for column in range(volume.shape[3]):
                    volume[n, place, row, column] = torch.nn.functional.cosine_similarity(
                        query[n, :, row, column], goal, dim=0)
    x = torch.relu(encoder.fuse(torch.cat([seen, encoder.SCALE * volume], dim=1)))
    for block in encoder.stage:
        x = block(x)
    assert torch.allclose(x, encoder.meet(seen, goals, None)[0], atol=1e-5)
    swapped = encoder.meet(seen, goals, torch.tensor([1, 0]))[0]
    assert torch.equal(swapped, encoder.meet(seen, goals[[1, 0]], None)[0])


def test_stacked_frames_equal_a_naive_loop():
    steps, envs, kept = 9, 4, 3
    image = torch.randint(0, 256, (steps, envs, 3, 2, 2), dtype=torch.uint8)
    before = torch.randint(0, 256, (envs, kept, 3, 2, 2), dtype=torch.uint8)
    starts = torch.rand(steps, envs) < 0.25
    starts[0] = torch.tensor([True, False, False, True])
    starts[:, 2] = False
    assert starts.any(1).sum() > 3
    stack, last = stack_frames(image, starts, before)
    assert stack.shape == (steps * envs, 3 * (kept + 1), 2, 2)
    stack = stack.view(steps, envs, kept + 1, 3, 2, 2)
    for env in range(envs):
        seen = list(before[env])
        for t in range(steps):
            if starts[t, env]:  # the first picture stands for those before it
                seen = [image[t, env]] * kept
            seen.append(image[t, env])
            assert torch.equal(stack[t, env], torch.stack(seen[-kept - 1:]))
        assert torch.equal(last[env], torch.stack(seen[-kept:]))


def test_the_hand_written_lstm_gradient_equals_autograd():
    network = Policy(SMALL)
    observation, starts = batch()
    output, _ = network(observation, starts, network.initial_state(3))
    (output.logits.square().sum() + output.value.sum()).backward()
    mine = {name: parameter.grad.clone() for name, parameter in network.named_parameters()}
    network.zero_grad()
    _, features = network.encode(observation.image.flatten(0, 1),
                                 network.encode_goals(observation.goals),
                                 observation.goal_index.flatten())
    actions = torch.arange(4)
    inputs = torch.cat([features.view(6, 3, -1),
                        (observation.last_action[..., None] == actions).float(),
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


@pytest.mark.parametrize('architecture, frames', EVERY)
def test_bfloat16_stays_close_to_float32(architecture, frames):
    network = changed(architecture, frames, heads=HEADS)
    observation, starts = batch()
    outputs = {}
    for dtype in (torch.float32, torch.bfloat16):
        network.compute_dtype = dtype
        latents, _ = network.latents(observation, starts)
        output = network.read(latents)
        rows = latents.hidden.flatten(0, 1)
        outputs[dtype] = {
            'logits': output.logits, 'value': output.value, 'hidden': latents.hidden,
            'position': latents.pose.position, 'overlap': latents.pose.co_visible,
            'pixel_control': network.heads['pixel_control'](rows),
            'depth': network.heads['depth'](latents.maps),
            'distance': network.heads['distance'](latents.hidden)}
    for name, exact in outputs[torch.float32].items():
        rounded = outputs[torch.bfloat16][name]
        assert rounded.dtype == torch.float32, name
        error = float((rounded - exact).detach().abs().max())
        # Similarities of noise are small differences of products.
        share = 0.06 if architecture == 'matching' else 0.03
        assert 0 < error < share * float(exact.detach().abs().max()) + 0.003, name


@pytest.mark.parametrize('architecture', OURS)
@pytest.mark.parametrize('size', [36, 64, 84, 174])
def test_shapes_follow_the_configuration(size, architecture):
    network = Policy(dataclasses.replace(SMALL, size=size, architecture=architecture))
    observation, starts = batch(2, 2, size=size)
    output, state = network(observation, starts, network.initial_state(2))
    assert output.logits.shape == (2, 2, 4) and output.value.shape == (2, 2)
    assert state.hidden.shape == (2, 16)


@pytest.mark.parametrize('field', [
    {'actions': ('forward',)}, {'actions': ('left', 'left')}, {'size': 20},
    {'architecture': 'resnet'}, {'channels': (8, 8)}, {'hidden': 0}, {'blocks': 9},
    {'frames': 0}, {'heads': ('pose',)}, {'heads': ('depth', 'depth')}, {'deconvolutions': 3},
    {'pose_to_memory': True}, {'pixel_std': 0.0}, {'places': 1}, {'places': 4, 'frames': 2}])
def test_bad_networks_are_refused(field):
    with pytest.raises(UserError, match='correct the network configuration'):
        dataclasses.replace(SMALL, **field)
