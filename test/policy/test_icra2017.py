"""Zhu et al. 2017: the network against its layers by hand, and scenes."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from two_bars import TwoBars, collected

from vn_nav.errors import UserError
from vn_nav.learning.learner import Learner
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.learning.presets import ENVIRONMENT, PRESETS, preset
from vn_nav.learning.rollout import Collector
from vn_nav.observation import Observation
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu import scene_numbers
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import DRIVE_ACTIONS
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

ZHU = NetworkConfig(actions=DRIVE_ACTIONS, size=36, architecture='icra2017', hidden=24, frames=4)
SCENES = dataclasses.replace(ZHU, scenes=3)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def seen(steps=6, envs=3, scenes=0):
    """Observations of some steps, and where episodes start."""
    generator = torch.Generator().manual_seed(2)

    def draw(high, *shape, dtype=torch.int64):
        return torch.randint(0, high, shape, generator=generator).to(dtype)
    starts = torch.zeros(steps, envs, dtype=torch.bool)
    starts[0, 0] = starts[2, 1] = starts[3, 1] = True
    observation = Observation(
        draw(256, steps, envs, 3, 36, 36, dtype=torch.uint8),
        draw(256, 2, 3, 36, 36, dtype=torch.uint8), draw(2, steps, envs),
        draw(5, steps, envs) - 1, draw(2, steps, envs, dtype=torch.float32),
        {'scene': draw(scenes, steps, envs)} if scenes else None)
    return observation, starts


def rows(observation, part):
    """Some steps of observations."""
    extras = observation.extras and {k: v[part] for k, v in observation.extras.items()}
    return Observation(observation.image[part], observation.goals,
                       *(values[part] for values in observation[2:5]), extras)


def test_layers_have_the_papers_sizes():
    config = preset('icra2017', frozen_weights='resnet50.pth', scenes=4).network(DRIVE_ACTIONS, 84)
    network = build_policy(config)
    shapes = {name: tuple(part.shape) for name, part in network.named_parameters()
              if part.requires_grad}
    assert shapes == {
        'encoder.shared.weight': (512, 8192), 'encoder.shared.bias': (512,),
        'encoder.fuse.weight': (512, 1024), 'encoder.fuse.bias': (512,),
        'memory.weight': (4, 512, 512), 'memory.bias': (4, 512),
        'actor.weight': (4, 4, 512), 'actor.bias': (4, 4),
        'critic.weight': (4, 1, 512), 'critic.bias': (4, 1)}
    assert network.initial_state(2).hidden.shape == (2, 3, 2048)


@pytest.mark.parametrize('config', [ZHU, SCENES], ids=['one scene', 'scenes'])
def test_the_network_equals_its_layers_by_hand(config):
    network = build_policy(config)
    for part in (network.memory, network.actor, network.critic):
        torch.nn.init.normal_(part.bias)
    observation, starts = seen(scenes=config.scenes if config.scenes > 1 else 0)
    before = torch.rand(3, 3, 256)
    output, state = network(observation, starts, RecurrentState(before, torch.zeros(3, 0)))
    weights = network.state_dict()
    frozen = network.encoder.frozen

    def layer(x, name, scene=None):
        weight, bias = weights[f'{name}.weight'], weights[f'{name}.bias']
        return (weight @ x + bias) if scene is None else (weight[scene] @ x + bias[scene])

    for env in range(3):
        history = list(before[env])
        for t in range(6):
            features = frozen(observation.image[t, env, None])[0]
            if starts[t, env]:
                history = [features] * 3
            history = [*history, features][-4:]
            goal = frozen(observation.goals[observation.goal_index[t, env], None])[0]
            both = torch.cat([layer(torch.cat(history), 'encoder.shared').relu(),
                              layer(goal.repeat(4), 'encoder.shared').relu()])
            scene = int(observation.extras['scene'][t, env]) if config.scenes > 1 else 0
            x = layer(layer(both, 'encoder.fuse').relu(), 'memory', scene).relu()
            assert torch.allclose(output.logits[t, env], layer(x, 'actor', scene), atol=1e-4)
            assert torch.allclose(output.value[t, env], layer(x, 'critic', scene), atol=1e-4)
        assert torch.allclose(state.hidden[env], torch.stack(history[-3:]), atol=1e-5)


@pytest.mark.parametrize('config', [ZHU, dataclasses.replace(ZHU, frames=1), SCENES],
                         ids=['four frames', 'one frame', 'scenes'])
def test_stepwise_equals_the_sequence_across_resets(config):
    network = build_policy(config)
    observation, starts = seen(scenes=config.scenes)
    state = network.initial_state(3)
    whole, last = network(observation, starts, state)
    found = []
    for t in range(6):
        output, state = network(rows(observation, slice(t, t + 1)), starts[t:t + 1], state)
        found.append(output.logits)
    assert torch.allclose(whole.logits, torch.cat(found), atol=1e-5)
    assert torch.allclose(last.hidden, state.hidden, atol=1e-5)


def test_known_features_stand_for_pictures():
    network = build_policy(ZHU)
    observation, starts = seen()
    wanted, _ = network(observation, starts)
    known = observation._replace(image=torch.zeros_like(observation.image),
                                 goals=network.look(observation.goals),
                                 extras={'features': network.look(observation.image)})
    found, _ = network(known, starts)
    assert torch.allclose(found.logits, wanted.logits, atol=1e-5)


def test_each_picture_passes_the_frozen_encoder_once():
    counted, env = [], TwoBars(6)
    network = build_policy(dataclasses.replace(ZHU, actions=TwoBars.action_names))
    network.encoder.frozen.register_forward_pre_hook(lambda _, inputs: counted.append(
        len(inputs[0])))
    collector = Collector(env, network, torch.Generator().manual_seed(0))
    collector.begin(0)
    rollout, _ = collector.collect(5)
    Learner(network, _config(), torch.Generator()).update(rollout)
    assert counted == [len(env.goals), *[6] * 6]  # the goals, and six rows of six robots


def _config():
    numbers = PRESETS['icra2017']
    return LearnerConfig(**{field.name: numbers[field.name] for field in dataclasses.fields(
        LearnerConfig) if field.name in numbers})


def test_an_update_leaves_the_frozen_weights_alone():
    network = build_policy(dataclasses.replace(ZHU, actions=TwoBars.action_names))
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    rollout = collected(network, steps=5)
    learner = Learner(network, _config(), torch.Generator())
    learner.update(rollout)
    known = {id(part) for group in learner.optimiser.param_groups for part in group['params']}
    for name, part in network.named_parameters():
        frozen = name.startswith('encoder.frozen.')
        assert torch.equal(part, before[name]) == frozen, name
        assert (part.grad is None) == frozen and (id(part) in known) == (not frozen), name


def test_a_scene_teaches_its_own_layers_alone():
    network = build_policy(SCENES)
    observation, starts = seen(scenes=3)
    observation.extras['scene'].fill_(1)
    output, _ = network(observation, starts)
    (output.logits.square().sum() + output.value.square().sum()).backward()
    for part in (network.memory, network.actor, network.critic):
        assert part.weight.grad[1].any()
        assert not part.weight.grad[0].any() and not part.weight.grad[2].any()
    assert network.encoder.shared.weight.grad.any() and network.encoder.fuse.weight.grad.any()


def test_rollouts_know_the_house_of_every_row():
    env = NavigationEnv(EnvConfig(scenes=house_scenes((1, 2, 3), 1), num_envs=2, size=36, seed=5,
                                  max_decisions=3))
    network = build_policy(SCENES)
    collector = Collector(env, network, torch.Generator().manual_seed(0))
    collector.begin(0)
    homes = [env.place_index.copy()]
    step = env.step

    def noting(actions):
        result = step(actions)
        homes.append(env.place_index.copy())
        return result
    env.step = noting
    rollout, _ = collector.collect(24)
    scene = rollout.observation.extras['scene']
    assert scene.tolist() == [home.tolist() for home in homes]
    assert len(scene[:, 0].unique()) == 2  # robot 0 goes from house to house
    assert (rollout.starts[1:] | (scene[1:] == scene[:-1])).all()
    Learner(network, _config(), torch.Generator()).update(rollout)


def test_more_houses_than_scenes_are_refused():
    env = NavigationEnv(EnvConfig(scenes=house_scenes((1, 2, 3), 1), num_envs=3, size=36))
    collector = Collector(env, build_policy(dataclasses.replace(ZHU, scenes=2)), torch.Generator())
    collector.begin(0)
    with pytest.raises(UserError, match='scene 2'):
        collector.collect(2)


def test_unknown_scenes_are_refused():
    env = TwoBars(3)
    policy = BatchedPolicy(build_policy(dataclasses.replace(SCENES, actions=env.action_names)), 3)
    observation, info = env.reset(seed=0)
    acted = policy.act(observation, env.goals, info['reset'], np.array([0, 2, 1]))
    assert acted.shape == (3,)
    with pytest.raises(UserError, match='scene 3'):
        policy.act(observation, env.goals, info['reset'], np.array([0, 3, 1]))
    with pytest.raises(UserError, match='needs the scene'):
        policy.act(observation, env.goals, info['reset'])
    known = ['house:7', 'house:8']
    assert scene_numbers(['house:8', 'house:7', 'house:8'], known).tolist() == [1, 0, 1]
    with pytest.raises(UserError, match='house:9'):
        scene_numbers(['house:8', 'house:9'], known)


def test_scenes_change_what_a_policy_does():
    network = build_policy(SCENES)
    for scene in range(3):
        network.actor.bias.data[scene, scene] = 50.0
    env = TwoBars(3)
    observation, info = env.reset(seed=0)
    policy = BatchedPolicy(network, 3, decoding='greedy')
    assert policy.act(observation, env.goals, info['reset'],
                      np.array([2, 0, 1])).tolist() == [2, 0, 1]


def test_a_checkpoint_brings_its_frozen_weights(tmp_path):
    network = build_policy(SCENES)
    network.encoder.frozen.conv1.weight.data *= 2  # as if they came from a file
    save_checkpoint(tmp_path / 'zhu', network, {
        'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0})
    loaded = load_checkpoint(tmp_path / 'zhu')
    observation, starts = seen(scenes=3)
    assert torch.equal(loaded.network(observation, starts)[0].logits,
                       network(observation, starts)[0].logits)
    card = (tmp_path / 'zhu' / 'README.md').read_text()
    assert 'Zhu et al. 2017' in card and '3 scenes' in card and 'LSTM' not in card


def test_the_preset_has_the_papers_numbers():
    config = preset('icra2017')
    assert (config.rollout_length, config.gamma, config.stacked_frames) == (5, 0.99, 4)
    assert config.entropy_coefficient == config.final_entropy_coefficient == 0.01
    # Theirs: 0.1 under the root, of gradients summed over frames; ours are means of 16 x 5.
    assert config.optimiser == 'rmsprop'
    assert config.rmsprop_epsilon == pytest.approx(math.sqrt(0.1) / 80, rel=0.02)
    assert (config.learning_rate, config.final_learning_rate) == (7e-4, 0.0)
    group = Learner(build_policy(config.network(DRIVE_ACTIONS, 36)), config,
                    torch.Generator()).optimiser.param_groups[0]
    assert (group['alpha'], group['eps']) == (0.99, config.rmsprop_epsilon)
    default = Learner(build_policy(ZHU), LearnerConfig(optimiser='rmsprop'), torch.Generator())
    assert default.optimiser.param_groups[0]['eps'] == 1e-5


@pytest.mark.parametrize('changes', [{'goal_pose': 0.5}, {'pixel_control': 0.1},
                                     {'architecture': 'thesis', 'frozen_weights': 'file.pth'}])
def test_what_does_not_belong_to_it_is_refused(changes):
    with pytest.raises(UserError, match='icra2017'):
        preset('icra2017', **changes)


def test_rewards_of_a_step_and_of_the_goal():
    reward = tasks.shaping_reward(
        np.array([3.0, 2.0]), np.array([2.5, 2.0]), np.array([False, True]),
        np.array([False, True]), progress=2.0, collision=-0.5, step=-0.01, goal=9.0)
    assert reward.tolist() == pytest.approx([0.99, 8.5])


def test_the_network_never_sees_them():
    rewarded = {}
    for kind, terms in (('plain', {}), ('zhu', ENVIRONMENT['icra2017'])):
        terms = {name: value for name, value in terms.items() if name.endswith(
            ('_reward', '_bonus'))}
        env = NavigationEnv(EnvConfig(scenes=('house:7?rooms=2',), num_envs=8, size=36, **terms))
        observations, rewards = [env.reset(seed=3)[0]], []
        for _ in range(60):
            observation, reward, *_, info = env.step(env.oracle_actions())
            observations.append(observation)
            rewards.append((reward, info['success'], info['reset']))
        rewarded[kind] = observations, rewards
    for one, other in zip(*(rewarded[kind][0] for kind in ('plain', 'zhu')), strict=True):
        for name, part in one.items():
            assert np.array_equal(part, other[name]), name
    reward, success, reset = map(np.array, zip(*rewarded['zhu'][1], strict=True))
    assert success.any() and reset.any()
    assert np.allclose(reward, np.where(reset, 0.0, np.where(success, 10.0, -0.01)))
