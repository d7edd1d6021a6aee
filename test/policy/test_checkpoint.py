"""Checkpoints: whole, verified, and the runtime that reads them."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.checkpoint_info import TRIAL
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import HEADS, NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.resources import share_file
from vn_nav.robot import DRIVE_ACTIONS

SMALL = NetworkConfig(actions=DRIVE_ACTIONS, size=36, channels=(8, 8, 8), features=24, hidden=16)
FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def pictures(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 3, 36, 36), dtype=np.uint8)


def observed(images, last_action):
    """A batch as an environment gives it; every robot has goal 0."""
    n = len(images)
    return {'image': images, 'goal_index': np.zeros(n, np.int64),
            'last_action': np.full(n, last_action), 'last_reward': np.zeros(n, np.float32)}


@pytest.mark.parametrize('changes', [
    {}, {'architecture': 'thesis', 'heads': HEADS, 'deconvolutions': 2},
    {'architecture': 'unreal', 'frames': 4}, {'blocks': 1, 'heads': ('goal_pose',),
                                              'pose_to_memory': True}])
def test_checkpoints_come_back(tmp_path, changes):
    network = Policy(dataclasses.replace(SMALL, **changes))
    save_checkpoint(tmp_path / 'model', network, FACTS)
    loaded = load_checkpoint(tmp_path / 'model', DRIVE_ACTIONS)
    assert loaded.config == network.config and loaded.info['world_version'] == '1'
    state = loaded.network.state_dict()
    assert list(state) == list(network.state_dict())
    assert all(torch.equal(tensor, state[name]) for name, tensor in network.state_dict().items())
    assert sorted(path.name for path in (tmp_path / 'model').iterdir()) == [
        'README.md', 'config.json', 'model.safetensors']


def test_a_trial_stays_with_the_policy_that_drove_it(tmp_path):
    folder, network = tmp_path / 'model', Policy(SMALL)
    save_checkpoint(folder, network, {**FACTS, 'stop_threshold': 0.5})
    (folder / TRIAL).write_text('{}')
    measured = {**FACTS, 'stop_threshold': 0.5, 'notes': 'Measured once more.'}
    save_checkpoint(folder, network, measured)
    assert (folder / TRIAL).read_text() == '{}'
    assert load_checkpoint(folder).info['notes'] == 'Measured once more.'
    for info, driver in (({**measured, 'stop_threshold': 0.9}, network),
                         ({**measured, 'world_version': '2'}, network), (measured, Policy(SMALL))):
        save_checkpoint(folder, network, measured)
        (folder / TRIAL).write_text('{}')
        save_checkpoint(folder, driver, info)
        assert not (folder / TRIAL).exists()


def test_damage_is_refused(tmp_path):
    folder = tmp_path / 'model'
    save_checkpoint(folder, Policy(SMALL), FACTS)
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
    del config['config_sha256']  # as in checkpoints from before it
    (folder / 'config.json').write_text(json.dumps(config))
    with pytest.raises(UserError, match='fits'):
        load_checkpoint(folder)


def test_a_flipped_bit_in_the_configuration_is_refused(tmp_path):
    folder = tmp_path / 'model'
    save_checkpoint(folder, Policy(SMALL), {**FACTS, 'results': {'a': {3: 0.5, 20: 1}}})
    path = folder / 'config.json'
    sound = path.read_bytes()
    meant = json.loads(sound)
    assert load_checkpoint(folder).config == SMALL
    at = sound.index(b'"pixel_std": 36') + len(b'"pixel_std": 3')  # 36.0 becomes 37.0
    for place in (at, *np.random.default_rng(0).integers(0, len(sound), 200)):
        flipped = bytearray(sound)
        flipped[place] ^= 1
        path.write_bytes(flipped)
        try:
            same = json.loads(flipped) == meant  # layout alone
        except ValueError:
            same = False
        if same:
            load_checkpoint(folder)
        else:
            with pytest.raises(UserError):
                load_checkpoint(folder)


@pytest.mark.slow
def test_the_shipped_models_and_those_from_before_the_checksum_load(tmp_path):
    for name in ('house', 'anywhere'):
        source = share_file(f'models/{name}')
        config = json.loads((source / 'config.json').read_text())
        assert config.pop('config_sha256')
        old = tmp_path / name
        old.mkdir()
        (old / 'config.json').write_text(json.dumps(config))
        (old / 'model.safetensors').symlink_to(source / 'model.safetensors')
        new, before = load_checkpoint(source), load_checkpoint(old)
        assert new.info == before.info and new.config == before.config


@pytest.mark.parametrize('change, word', [
    (lambda c: c['network'].update(hidden='16'), 'hidden'),
    (lambda c: c['network'].update(hidden=10**9), 'hidden'),
    (lambda c: c['network'].update(features=65_000, hidden=65_000), 'fits'),
    (lambda c: c['network'].update(pixel_std=True), 'pixel_std'),
    (lambda c: c['network'].update(heads=5), 'heads'),
    (lambda c: c['network'].update(channels=['a', 'b', 'c']), 'can be built'),
    (lambda c: c['network'].update(layers=3), 'only the fields'),
    (lambda c: c.update(network=[]), 'mapping'),
    (lambda c: c.update(action_names=[1, 2]), 'action_names'),
    (lambda c: c.update(action_names=5), 'action_names'),
    (lambda c: c.update(houses='7'), 'houses'),
    (lambda c: c.update(houses=[1.5]), 'houses'),
    (lambda c: c.update(scenes=[7]), 'scenes'), (lambda c: c.update(scenes='house:7'), 'scenes'),
    (lambda c: c.update(frames='many'), 'frames'),
    (lambda c: c.update(camera_fov_deg=10**400), 'camera_fov_deg'),
    (lambda c: c.update(stop_threshold=[]), 'stop_threshold'),
    (lambda c: c.update(decoding={}), 'decoding'),
    (lambda c: c.update(format=[2]), 'format'),
    (lambda c: c.update(results=[]), 'results'),
])
def test_values_of_a_wrong_type_or_size_are_one_line(tmp_path, change, word):
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    path = tmp_path / 'model' / 'config.json'
    config = json.loads(path.read_text())
    del config['config_sha256']
    change(config)
    path.write_text(json.dumps(config))
    with pytest.raises(UserError, match=word) as caught:
        load_checkpoint(tmp_path / 'model')
    assert len(str(caught.value)) < 700 and '\n' not in str(caught.value)


@pytest.mark.parametrize('content, word', [
    (b'{"format": 2, "notes": "\xe9"}', 'UTF-8'),  # Latin-1
    (b'{"format": 2, "format": 2}', 'twice'),
    (b'{"format": 2, "minutes": NaN}', 'NaN'),
    (b'[' * 200_000, 'JSON'),
    (b'[1, 2]', 'mapping'),
    (b'{"format": ' + b'9' * 5_000 + b'}', 'JSON'),
    (b'"' + b'a' * 5_000_000 + b'"', '4 MB'),
])
def test_a_configuration_that_is_no_document_is_one_line(tmp_path, content, word):
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    (tmp_path / 'model' / 'config.json').write_bytes(content)
    with pytest.raises(UserError, match=word) as caught:
        load_checkpoint(tmp_path / 'model')
    assert len(str(caught.value)) < 700 and '\n' not in str(caught.value)


def test_weights_of_an_absurd_size_are_not_read(tmp_path):
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    with (tmp_path / 'model' / 'model.safetensors').open('r+b') as file:
        file.truncate(1 << 40)  # a terabyte of nothing
    with pytest.raises(UserError, match='at most'):
        load_checkpoint(tmp_path / 'model')


@pytest.mark.parametrize('actions', [
    ('forward', 'rotate_left'), tuple(reversed(DRIVE_ACTIONS)),
    (DRIVE_ACTIONS[1], DRIVE_ACTIONS[0], *DRIVE_ACTIONS[2:])])
def test_other_actions_or_another_order_are_refused(tmp_path, actions):
    """Trap 8: names and order are in the checkpoint, and checked."""
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    stored = json.loads((tmp_path / 'model' / 'config.json').read_text())['action_names']
    assert tuple(stored) == DRIVE_ACTIONS
    with pytest.raises(UserError, match='in that order'):
        load_checkpoint(tmp_path / 'model', actions)


@pytest.mark.parametrize('frames', [1, 3])
def test_runtime_and_batched_policy_agree(tmp_path, frames):
    save_checkpoint(tmp_path / 'model', Policy(dataclasses.replace(SMALL, frames=frames)), FACTS)
    runtime = PolicyRuntime(tmp_path / 'model', decoding='greedy')
    goals = pictures(1, seed=1)
    runtime.set_goal(goals[0])
    policy = BatchedPolicy(load_checkpoint(tmp_path / 'model').network, 1, 'greedy')
    last = -1
    for t, image in enumerate(pictures(5)):
        action = runtime.act(image)
        same = policy.act(observed(image[None], last), goals, np.array([t == 0]))
        assert action == same[0]
        last = action
    with pytest.raises(UserError, match='picture'):
        runtime.act(np.zeros((3, 20, 20), np.uint8))


def test_odometry_reaches_a_runtime_and_a_network_ignores_it(tmp_path):
    save_checkpoint(tmp_path / 'model', Policy(SMALL), FACTS)
    chosen = []
    for tells in (False, True):
        runtime = PolicyRuntime(tmp_path / 'model', decoding='greedy')
        runtime.set_goal(pictures(1, seed=1)[0])
        for t, image in enumerate(pictures(4)):
            if tells:
                runtime.reset_odometry()
            chosen.append(runtime.act(image, np.array([0.1 * t, 2.0, 0.5]) if tells else None))
    assert chosen[:4] == chosen[4:]
    for wrong in (np.zeros(2), np.array([0.0, np.nan, 0.0])):
        with pytest.raises(UserError, match='x, y and yaw'):
            runtime.act(image, wrong)


def test_a_policy_that_knows_its_moves_does_not_repeat_a_contact(tmp_path):
    config = dataclasses.replace(
        SMALL, heads=('goal_pose',), pose_to_memory=True,
        moves=((0.5, 0, 0), (-0.2, 0, 0), (0, 0, 0.5236), (0, 0, -0.5236)))
    network = Policy(config)
    with torch.no_grad():
        network.actor.bias.copy_(torch.tensor([9.0, 6.0, 3.0, 0.0]))
    save_checkpoint(tmp_path / 'model', network, FACTS)
    picture, goals = pictures(1)[0], pictures(1, seed=1)
    runtime = PolicyRuntime(tmp_path / 'model', decoding='greedy')
    runtime.set_goal(goals[0])
    policy = BatchedPolicy(network, 1, 'greedy')
    done = [-1]
    for _ in range(4):
        done.append(runtime.act(picture))
        same = policy.act(observed(picture[None], done[-2]), goals, np.array([done[-2] < 0]))
        assert done[-1] == same[0]
    assert done[1:] == [0, 1, 2, 0]  # the turn showed the same, too, but is no contact


def test_not_finite_output_is_an_error():
    network = Policy(SMALL)
    with torch.no_grad():
        network.actor.bias[0] = math.nan
    policy = BatchedPolicy(network, 1)
    with pytest.raises(FloatingPointError, match='finite'):
        policy.act(observed(pictures(1), -1), pictures(2), np.array([True]))


def test_every_key_has_a_type():
    from vn_nav.policy import checkpoint_info as checkpoint
    assert checkpoint.INFO.keys() == checkpoint.INFO_TYPES.keys()
