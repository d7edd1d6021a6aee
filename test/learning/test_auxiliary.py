"""Losses of the auxiliary tasks against naive loops, and where their gradients go."""

import dataclasses
import math

import pytest
import torch
from torch.nn import functional as F
from two_bars import ACTIONS, GREEN, RED, collected

from vn_nav.errors import UserError
from vn_nav.learning import auxiliary
from vn_nav.learning.auxiliary import image_target
from vn_nav.learning.pixel_change import label_colours, pixel_change
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import HEADS, NetworkConfig

GREY = (0.299, 0.587, 0.114)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network_of(architecture='thesis', size=36, **changes):
    return Policy(NetworkConfig(**{
        'actions': ACTIONS, 'size': size, 'architecture': architecture, 'channels': (8, 8, 8),
        'features': 24, 'hidden': 16, 'heads': HEADS, 'blocks': int(architecture == 'fused'),
        'pixel_mean': 0.0, 'pixel_std': 255.0} | changes))


def looked_at(network, **options):
    """A batch, and what the network makes of all its T+1 observations."""
    rollout = collected(network, rollouts=3, **options)
    latents, _ = network.latents(rollout.observation, rollout.starts, rollout.state)
    return rollout, latents


def window_of(network):
    """Windows inside one episode each, from the memory of the last rollouts, some padded."""
    from vn_nav.learning.replay import Replay
    rollout = collected(network, steps=30)
    replay = Replay(40, 6, network.config.size, rollout.observation.goals, privileged=())
    replay.extend(rollout)
    window = replay.windows(12, 5, torch.Generator().manual_seed(0))
    assert window.terminated.any() and window.truncated.any() and not window.valid.all()
    assert (window.valid.all(0) & ~window.terminated.any(0)).any() or window.valid[1].any()
    return window, network.latents(window.observation, window.starts)[0]


def last_frame(window, column):
    """Row after the last valid one."""
    return int(window.valid[:, column].sum())


def test_value_replay_is_the_squared_error_to_the_n_step_return():
    network = network_of()
    window, latents = window_of(network)
    for time_out_ends in (False, True):
        loss = auxiliary.value_replay_loss(network, latents, window, gamma=0.9,
                                           truncation_is_terminal=time_out_ends)
        value = network.critic(latents.hidden)[..., 0].detach()
        errors = []
        for column in range(12):
            end = last_frame(window, column)
            over = window.terminated[:, column].any() or (
                time_out_ends and window.truncated[:, column].any())
            for t in range(end):
                target = sum(0.9 ** (k - t) * float(window.reward[k, column])
                             for k in range(t, end))
                if not over:
                    target += 0.9 ** (end - t) * float(value[end, column])
                errors.append((target - float(value[t, column])) ** 2)
        assert float(loss.detach()) == pytest.approx(sum(errors) / len(errors), rel=1e-4)


def test_pixel_control_is_n_step_q_learning_of_pixel_changes():
    network = network_of()
    window, latents = window_of(network)
    loss = auxiliary.pixel_control_loss(network, latents, window, gamma=0.9)
    q = network.heads['pixel_control'](latents.hidden.flatten(0, 1)).detach().view(
        6, 12, len(ACTIONS), 8, 8)
    pictures = window.observation.image.float() / 255
    grey = sum(weight * pictures[:, :, k] for k, weight in enumerate(GREY))
    grey = grey[..., 2:-2, 2:-2]  # 8 cells of 4 pixels
    change = F.avg_pool2d((grey[1:] - grey[:-1]).abs(), 4)
    assert torch.allclose(change, pixel_change(window.observation.image, cells=8), atol=1e-6)
    errors = []
    for column in range(12):
        end = last_frame(window, column)
        ends = bool(window.terminated[:, column].any())
        for t in range(end):
            target = sum(0.9 ** (k - t) * change[k, column] for k in range(t, end))
            if not ends:
                target = target + 0.9 ** (end - t) * q[end, column].amax(0)
            taken = q[t, column, int(window.action[t, column])]
            errors.append(float(((target - taken) ** 2).mean()))
    assert float(loss.detach()) == pytest.approx(sum(errors) / len(errors), rel=1e-4)


def test_reward_prediction_is_the_cross_entropy_of_three_frames():
    network = network_of()
    rollout, _ = looked_at(network)
    maps = network.maps(rollout.observation._replace(
        image=rollout.observation.image[:3], goal_index=rollout.observation.goal_index[:3],
        last_action=rollout.observation.last_action[:3],
        last_reward=rollout.observation.last_reward[:3]))
    label = torch.tensor([0, 1, 2, 0, 2, 1])
    loss = auxiliary.reward_prediction_loss(network, maps, label)
    layer = network.heads['reward_prediction'].classify
    total = 0.0
    for env in range(6):
        frames = [maps.view(3, 6, 32, 3, 3)[k, env].flatten() for k in range(3)]
        logits = layer(torch.cat(frames))  # oldest frame first
        total -= torch.log_softmax(logits, 0)[label[env]].item()
    assert float(loss.detach()) == pytest.approx(total / 6, rel=1e-5)


def maps_of(latents, rollout):
    """Of all rows but the last."""
    return latents.maps[:rollout.valid.numel()]


def target_of(network, name, rollout):
    """What an image head shall draw of all rows."""
    shown = (rollout.observation.image if name == 'reconstruction'
             else rollout.privileged[name])
    return image_target(network, name, shown.flatten(0, 1))


@pytest.mark.parametrize('name', ['depth', 'segmentation', 'goal_segmentation',
                                  'reconstruction'])
def test_image_losses_are_mean_squared_errors_of_averaged_pictures(name):
    network = network_of()
    rollout, latents = looked_at(network)
    loss = auxiliary.image_loss(network, name, maps_of(latents, rollout), rollout)
    drawn = network.heads[name](latents.maps).detach().view(10, 6, -1, 8, 8)
    target = target_of(network, name, rollout).view(10, 6, -1, 8, 8)
    colours = label_colours(network.config.classes)
    errors = []
    for t, env in torch.nonzero(rollout.valid).tolist():
        if name == 'depth':
            picture = rollout.privileged['depth'][t, env][None] / 10
        elif name == 'reconstruction':
            picture = rollout.observation.image[t, env].float() / 255
        else:
            picture = colours[rollout.privileged[name][t, env].long()].permute(2, 0, 1)
        expected = F.avg_pool2d(picture[:, 2:-2, 2:-2], 4)
        assert torch.allclose(target[t, env], expected, atol=1e-6)
        errors.append(float(((drawn[t, env] - expected) ** 2).mean()))
    assert float(loss.detach()) == pytest.approx(sum(errors) / len(errors), rel=1e-4)
    assert target.min() >= 0 and target.max() <= 1 and target.std() > 0.01


def test_the_goal_is_what_goal_segmentation_draws():
    network = network_of()
    rollout, _ = looked_at(network)
    shown = rollout.observation.goal_index.flatten()
    target = target_of(network, 'goal_segmentation', rollout)
    for goal in (0, 1):
        assert torch.equal(target[shown == goal], target[shown == goal][:1].expand(
            int((shown == goal).sum()), -1, -1, -1))
    assert not torch.equal(target[shown == 0][0], target[shown == 1][0])
    assert RED != GREEN and len(shown.unique()) == 2


def test_depth_from_the_replay_equals_depth_in_metres():
    network = network_of()
    rollout, _ = looked_at(network)
    metres = target_of(network, 'depth', rollout)
    rollout.privileged['depth'] = (rollout.privileged['depth'] * 25.5).round().to(torch.uint8)
    assert torch.allclose(target_of(network, 'depth', rollout), metres, atol=0.5 / 255 + 1e-6)


def test_goal_pose_loss_counts_only_what_is_in_view():
    network = network_of()
    rollout, latents = looked_at(network)
    loss = auxiliary.goal_pose_loss(latents, rollout)

    def huber(x):
        return 0.5 * x * x if abs(x) < 1 else abs(x) - 0.5
    seen, crossed = [], []
    for t, env in torch.nonzero(rollout.valid).tolist():
        row = 6 * t + env
        truth = rollout.privileged['goal_pose'][t, env].tolist()
        said = [*latents.pose.position[row].tolist(), *latents.pose.heading[row].tolist()]
        error = [huber(a - b) for a, b in zip(said, truth, strict=True)]
        overlaps = rollout.privileged['overlap'][t, env] >= 0.1
        if overlaps:
            seen.append(error[0] + error[1] + 2 * (error[2] + error[3]))
        probability = 1 / (1 + math.exp(-latents.pose.co_visible[row].item()))
        crossed.append(-math.log(probability if overlaps else 1 - probability))
    expected = sum(seen) / len(seen) + sum(crossed) / len(crossed)
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-4)


def test_where_nobody_knows_the_overlap_nothing_is_learned():
    network = network_of()
    rollout, latents = looked_at(network)
    known = auxiliary.goal_pose_loss(latents, rollout)
    half = torch.arange(6) < 3
    unknown = dataclasses.replace(rollout, privileged={
        **rollout.privileged, 'overlap': torch.where(half, rollout.privileged['overlap'], -1.0)})
    part = dataclasses.replace(rollout, valid=rollout.valid & half)
    loss = auxiliary.goal_pose_loss(latents, unknown)
    assert torch.equal(loss, auxiliary.goal_pose_loss(latents, part)) and loss != known


def test_arrival_distance_and_imitation():
    network = network_of()
    rollout, latents = looked_at(network)
    arrived = rollout.privileged['arrived'][:-1]
    logit = network.heads['arrival'](latents.hidden[:-1]).detach()
    probability = torch.sigmoid(logit)
    crossed = -torch.where(arrived, probability, 1 - probability).log()
    assert arrived.any() and not arrived[rollout.valid].any()  # it shows on reset rows alone
    loss = auxiliary.arrival_loss(network, latents, rollout)
    assert float(loss.detach()) == pytest.approx(float(crossed.mean()), rel=1e-4)

    rollout.privileged['distance'] = torch.linspace(0, 20, 60).view(10, 6)
    said = network.heads['distance'](latents.hidden[:-1]).detach()
    errors = []
    for t, env in torch.nonzero(rollout.valid).tolist():
        truth = math.log1p(min(float(rollout.privileged['distance'][t, env]), auxiliary.FAR))
        x = float(said[t, env]) - truth
        errors.append(0.5 * x * x if abs(x) < 1 else abs(x) - 0.5)
    loss = auxiliary.distance_loss(network, latents, rollout)
    assert float(loss.detach()) == pytest.approx(sum(errors) / len(errors), rel=1e-4)

    logits = network.actor(latents.hidden).detach()
    teacher = rollout.privileged['explorer_action']
    crossed = [-float(torch.log_softmax(logits[t, env], 0)[teacher[t, env]])
               for t, env in torch.nonzero(rollout.valid).tolist()]
    loss = auxiliary.imitation_loss(network, latents, rollout, 'explorer_action')
    assert float(loss.detach()) == pytest.approx(sum(crossed) / len(crossed), rel=1e-4)


def test_a_batch_without_what_a_task_needs_is_refused():
    network = network_of()
    rollout, latents = looked_at(network)
    rollout.privileged.clear()
    for loss in (lambda: auxiliary.image_loss(
                    network, 'depth', maps_of(latents, rollout), rollout),
                 lambda: auxiliary.goal_pose_loss(latents, rollout),
                 lambda: auxiliary.arrival_loss(network, latents, rollout)):
        with pytest.raises(UserError, match='in every batch'):
            loss()


CONVOLUTIONS = {
    'thesis': ('encoder.first', 'encoder.fuse', 'encoder.mix'),
    'thesis, 128 px': ('encoder.first', 'encoder.second', 'encoder.fuse', 'encoder.mix'),
    'unreal': ('encoder.first', 'encoder.conv2'),
    'fused': ('encoder.first', 'encoder.stage1', 'encoder.conv2', 'encoder.stage2',
              'encoder.conv3'),
    'matching': ('encoder.first', 'encoder.conv2', 'encoder.query', 'encoder.key', 'encoder.fuse',
                 'encoder.stage'),
}
MAPS, FEATURES, MEMORY = 'the convolutions', 'encoder.trunk', 'memory'
# Which parameters each loss teaches: these and no others.
REACHES = {
    'policy': (MAPS, FEATURES, MEMORY, 'actor'),
    'value': (MAPS, FEATURES, MEMORY, 'critic'),
    'entropy': (MAPS, FEATURES, MEMORY, 'actor'),
    'imitation': (MAPS, FEATURES, MEMORY, 'actor'),
    'value_replay': (MAPS, FEATURES, MEMORY, 'critic'),
    'pixel_control': (MAPS, FEATURES, MEMORY, 'heads.pixel_control'),
    'reward_prediction': (MAPS, 'heads.reward_prediction'),
    'depth': (MAPS, 'heads.depth'),
    'segmentation': (MAPS, 'heads.segmentation'),
    'goal_segmentation': (MAPS, 'heads.goal_segmentation'),
    'reconstruction': (MAPS, 'heads.reconstruction'),
    'goal_pose': (MAPS, FEATURES, 'heads.goal_pose'),
    'arrival': (MAPS, FEATURES, MEMORY, 'heads.arrival'),
    'distance': (MAPS, FEATURES, MEMORY, 'heads.distance'),
}


def losses(network, rollout, latents):
    """Every loss of `REACHES` on one batch."""
    output = network.read(latents)
    log = torch.log_softmax(output.logits[:-1], -1)
    frames = rollout.observation
    three = frames._replace(image=frames.image[:3], **{
        name: getattr(frames, name)[:3] for name in ('goal_index', 'last_action', 'last_reward')})
    return {
        'policy': log.gather(-1, rollout.action[..., None]).mean(),
        'value': output.value.square().mean(),
        'entropy': (log.exp() * log).sum(-1).mean(),
        'imitation': auxiliary.imitation_loss(network, latents, rollout, 'oracle_action'),
        'value_replay': auxiliary.value_replay_loss(network, latents, rollout, gamma=0.9),
        'pixel_control': auxiliary.pixel_control_loss(network, latents, rollout, gamma=0.9),
        'reward_prediction': auxiliary.reward_prediction_loss(
            network, network.maps(three), torch.tensor([0, 1, 2, 0, 1, 2])),
        **{name: auxiliary.image_loss(network, name, maps_of(latents, rollout), rollout)
           for name in ('depth', 'segmentation', 'goal_segmentation', 'reconstruction')},
        'goal_pose': auxiliary.goal_pose_loss(latents, rollout),
        'arrival': auxiliary.arrival_loss(network, latents, rollout),
        'distance': auxiliary.distance_loss(network, latents, rollout),
    }


@pytest.mark.parametrize('kind, changes', [
    ('thesis', {}), ('thesis', {'frames': 3}), ('thesis, 128 px', {'deconvolutions': 2}),
    ('unreal', {}), ('fused', {}), ('fused', {'pose_to_memory': True}),
    ('matching', {'pose_to_memory': True, 'moves': ((0.5, 0.0, 0.0), (0.0, 0.0, 0.5))})])
def test_gradients_reach_the_layers_they_should_and_no_others(kind, changes):
    network = network_of(kind.split(',')[0], 128 if '128' in kind else 36, **changes)
    for block in (module for name, module in network.named_modules() if name.endswith('stage1.0')
                  or name.endswith(('stage2.0', 'stage.0'))):
        torch.nn.init.normal_(block.conv2.weight, std=0.1)  # its zeros would stop the gradient
    groups = {*CONVOLUTIONS[kind], FEATURES, MEMORY, 'actor', 'critic',
              *(f'heads.{name}' for name in HEADS)}
    names = [name for name, _ in network.named_parameters()]
    assert all(sum(name.startswith(f'{group}.') for group in groups) == 1 for name in names)
    assert set(REACHES) - {'policy', 'value', 'entropy', 'imitation', 'value_replay'} == set(HEADS)
    rollout, latents = looked_at(network)
    for task, loss in losses(network, rollout, latents).items():
        network.zero_grad(set_to_none=True)
        loss.backward(retain_graph=True)
        reached = {group for group in groups
                   for name, parameter in network.named_parameters()
                   if name.startswith(f'{group}.') and parameter.grad is not None
                   and parameter.grad.any()}
        expected = {part for group in REACHES[task]
                    for part in (CONVOLUTIONS[kind] if group == MAPS else (group,))}
        assert reached == expected, task


@pytest.mark.parametrize('architecture', ['thesis', 'fused', 'matching'])
def test_the_goal_stream_learns_from_every_task_that_looks_at_the_goal(architecture):
    network = network_of(architecture)
    rollout = collected(network)
    goal_maps = network.encode_goals(rollout.observation.goals)
    goal_maps.retain_grad()
    latents, _ = network.latents(rollout.observation, rollout.starts, rollout.state, goal_maps)
    for task in ('goal_segmentation', 'goal_pose', 'policy'):
        goal_maps.grad = None
        losses(network, rollout, latents)[task].backward(retain_graph=True)
        shown = rollout.observation.goal_index.unique()
        assert set(shown.tolist()) == {0, 1}
        assert all(goal_maps.grad[goal].any() for goal in shown), task
        assert not goal_maps.grad[2].any()  # the grey picture was not shown


def test_replayed_targets_bear_no_gradient():
    """Bootstraps are numbers: the critic is not taught to make its own target come true."""
    network = network_of()
    window, latents = window_of(network)
    value = network.critic(latents.hidden)[..., 0]
    loss = auxiliary.value_replay_loss(network, latents, window, gamma=0.9)
    weight, = torch.autograd.grad(loss, network.critic.weight, retain_graph=True)
    by_hand = torch.zeros_like(weight)
    count = int(window.valid.sum())
    for column in range(12):
        end = last_frame(window, column)
        ended = window.terminated[:, column].any()
        following = 0.0 if ended else float(value[end, column].detach())
        for t in reversed(range(end)):
            following = float(window.reward[t, column]) + 0.9 * following
            error = value[t, column].item() - following
            by_hand += 2 * error * latents.hidden[t, column].detach() / count
    assert torch.allclose(weight, by_hand, atol=1e-5)
