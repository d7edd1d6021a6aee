"""Exports: ONNX Runtime says what PyTorch says, and the files describe themselves."""

import json
import sys

import numpy as np
import pytest
import torch

from vn_nav import cli
from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import LoadedCheckpoint, save_checkpoint
from vn_nav.policy.checkpoint_info import INFO
from vn_nav.policy.export import OPSET, export_onnx
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

onnx = pytest.importorskip('onnx', reason='expected: onnx, of the extra `onnx`, is not installed')
onnxruntime = pytest.importorskip('onnxruntime', reason='expected: onnxruntime is not installed')

STEPS, RESET = 20, 11
FACTS = {'world_version': '1', 'camera_fov_deg': 75.0, 'camera_height': 0.4,
         'decoding': 'greedy', 'stop_threshold': 0.5}
NETWORKS = {
    'fused': {'heads': ('goal_pose', 'arrival', 'distance'), 'pose_to_memory': True, 'blocks': 1},
    'matching': {'architecture': 'matching', 'heads': ('goal_pose', 'arrival'),
                 'pose_to_memory': True, 'moves': RobotSpec().with_actions(DRIVE_ACTIONS).moves},
    'thesis': {'architecture': 'thesis', 'heads': ('pixel_control', 'depth')},
    'thesis at 174': {'architecture': 'thesis', 'size': 174},
    'unreal': {'architecture': 'unreal'},
    'framestack': {'architecture': 'thesis', 'frames': 4},
    'taught a place': {'architecture': 'matching', 'places': 8},
    'and knows its moves': {'architecture': 'matching', 'heads': ('goal_pose',), 'places': 8,
                            'pose_to_memory': True,
                            'moves': RobotSpec().with_actions(DRIVE_ACTIONS).moves},
    'icra2017': {'architecture': 'icra2017', 'frames': 4},
    'icra2017 in scenes': {'architecture': 'icra2017', 'frames': 4, 'scenes': 3},
    'icra2017 of one frame': {'architecture': 'icra2017'},
}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network_of(name):
    """A network whose actions differ clearly, unlike those of a new one."""
    network = build_policy(NetworkConfig(**{'actions': DRIVE_ACTIONS, 'size': 64, 'hidden': 32,
                                            **NETWORKS[name]})).eval()
    for part in network.actor.parameters():
        part.data.normal_()
    return network


def exported(network, folder, **info):
    """The sessions of an exported network's files, by their stems."""
    facts = INFO | FACTS | {'sha256': 'of the weights'} | info
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return {path.stem: onnxruntime.InferenceSession(str(path), options)
            for path in export_onnx(LoadedCheckpoint(network, network.config, facts), folder)}


class OnnxRobot:
    """Drives as the documentation of `vn_nav.policy.export` says."""

    def __init__(self, sessions, goal):
        self.policy = sessions['policy']
        self.values = {part.name: np.zeros(part.shape, {
            'tensor(float)': np.float32, 'tensor(uint8)': np.uint8, 'tensor(int64)': np.int64,
            'tensor(bool)': bool}[part.type]) for part in self.policy.get_inputs()}
        if 'goal' in sessions:
            (self.values['goal'],) = sessions['goal'].run(None, {'picture': goal})

    def act(self, **given):
        self.values |= {name: value for name, value in given.items() if name in self.values}
        names = [part.name for part in self.policy.get_outputs()]
        said = dict(zip(names, self.policy.run(None, self.values), strict=True))
        self.values |= {name.removeprefix('next_'): value for name, value in said.items()
                        if name.startswith('next_')}
        return said


@pytest.mark.parametrize('name', NETWORKS)
def test_onnx_says_what_torch_says(name, tmp_path):
    network = network_of(name)
    side, scenes = network.config.size, network.config.scenes
    random = np.random.default_rng(0)
    goal = random.integers(0, 256, (1, 3, side, side), np.uint8)
    robot = OnnxRobot(exported(network, tmp_path), goal)
    action, said_before = -1, None
    with torch.inference_mode():
        goal_maps, state = network.encode_goals(torch.from_numpy(goal)), network.initial_state(1)
        for t in range(STEPS):
            start = t in (0, RESET)
            image = random.integers(0, 256, (1, 3, side, side), np.uint8)
            reward = np.array([0.0 if start else random.uniform(-2, 2)], np.float32)
            scene = np.array([t % scenes])
            action = -1 if start else action
            seen = Observation(
                torch.from_numpy(image)[None], None, None, torch.tensor([[action]]),
                torch.from_numpy(reward)[None], {'scene': torch.from_numpy(scene)[None]})
            output, state = network(seen, torch.tensor([[start]]), state, goal_maps)
            said = robot.act(image=image, last_action=np.array([action]), last_reward=reward,
                             start=np.array([start]), scene=scene)
            assert np.allclose(said['logits'], output.logits[0], atol=1e-4)
            assert np.allclose(said['value'], output.value[0], atol=1e-4)
            assert ('arrival' in said) == (output.arrival is not None)
            if output.arrival is not None:
                assert np.allclose(said['arrival'], output.arrival[0], atol=1e-4)
            assert said_before is None or not np.allclose(said['logits'], said_before, atol=1e-3)
            said_before = said['logits']
            action = int(said['logits'][0].argmax())


@pytest.mark.parametrize('name', ['fused', 'framestack', 'icra2017'])
def test_a_start_empties_the_memory(name, tmp_path):
    network = network_of(name)
    random = np.random.default_rng(1)
    goal, first, second = random.integers(0, 256, (3, 1, 3, 64, 64), np.uint8)
    robot = OnnxRobot(exported(network, tmp_path), goal)
    yes, no = np.array([True]), np.array([False])
    fresh = robot.act(image=first, start=yes)['logits']
    robot.act(image=second, start=no)
    assert not np.allclose(robot.act(image=first, start=no)['logits'], fresh, atol=1e-3)
    assert np.allclose(robot.act(image=first, start=yes)['logits'], fresh, atol=1e-6)


def test_the_files_describe_themselves(tmp_path):
    sessions = exported(network_of('fused'), tmp_path)
    for session in sessions.values():
        told = session.get_modelmeta().custom_metadata_map
        assert tuple(json.loads(told['action_names'])) == DRIVE_ACTIONS
        assert {name: told[name] for name in (*FACTS, 'size', 'task', 'sha256')} == {
            'world_version': '1', 'camera_fov_deg': '75.0', 'camera_height': '0.4',
            'decoding': 'greedy', 'stop_threshold': '0.5', 'size': '64', 'task': 'image',
            'sha256': 'of the weights'}
        for kind, parts in (('inputs', session.get_inputs()), ('outputs', session.get_outputs())):
            assert {name: shape for name, (_, shape) in json.loads(told[kind]).items()} == {
                part.name: part.shape for part in parts}
    assert list(json.loads(told['inputs'])) == ['picture']
    for name in ('policy', 'goal'):
        model = onnx.load(tmp_path / f'{name}.onnx')
        assert [part.version for part in model.opset_import] == [OPSET]


@pytest.mark.parametrize('name, filtered', [('matching', True), ('fused', False)])
def test_the_example_beside_the_files_acts_as_the_runtime_does(name, filtered, tmp_path,
                                                               monkeypatch):
    network = network_of(name)
    network.actor.weight.data *= 0.01
    network.actor.bias.data = torch.tensor([9.0, 6.0, 3.0, 0.0])  # at a wall: forward again
    facts = {**FACTS, 'stop_threshold': None}
    save_checkpoint(tmp_path / 'checkpoint', network, facts)
    session = exported(network, tmp_path / 'onnx', **facts)['policy']
    told = session.get_modelmeta().custom_metadata_map
    assert told['action_filter'] == ('blocked_actions' if filtered else 'none')
    assert len(json.loads(told['moves'])) == (len(DRIVE_ACTIONS) if filtered else 0)
    card = (tmp_path / 'onnx' / 'README.md').read_text()
    assert ('behind it' in card) == ('BlockedActionFilter' in card) == filtered
    picture, goal = np.random.default_rng(0).integers(0, 256, (2, 3, 64, 64), np.uint8)
    monkeypatch.chdir(tmp_path / 'onnx')
    scope = {'goal_picture': goal[None]}
    exec(card.split('```python')[1].split('```')[0], scope)
    runtime = PolicyRuntime(tmp_path / 'checkpoint', decoding='greedy')
    runtime.set_goal(goal)
    last, acted = -1, []
    for _ in range(5):
        last = int(scope['decide'](picture[None], last).argmax())
        acted.append(last)
        assert last == runtime.act(picture)
    assert acted == ([0, 1, 2, 0, acted[4]] if filtered else [0] * 5)


def test_a_policy_that_looks_at_no_goal_has_no_model_of_it(tmp_path):
    assert set(exported(network_of('fused'), tmp_path)) == {'policy', 'goal'}
    sessions = exported(network_of('unreal'), tmp_path, stop_threshold=None)
    assert set(sessions) == {'policy'}
    assert {path.name for path in tmp_path.iterdir()} == {
        'policy.onnx', 'config.json', 'README.md'}
    assert sessions['policy'].get_modelmeta().custom_metadata_map['stop_threshold'] == ''


def test_the_command(tmp_path, capsys):
    facts = {name: value for name, value in FACTS.items() if name != 'stop_threshold'}
    save_checkpoint(tmp_path / 'checkpoint', network_of('fused'), facts)
    target = tmp_path / 'a' / 'b'
    assert cli.main(['export', str(tmp_path / 'checkpoint'), '--onnx', str(target)]) == 0
    assert str(target / 'policy.onnx') in capsys.readouterr().out
    weights = json.loads((tmp_path / 'checkpoint' / 'config.json').read_text())['sha256']
    session = onnxruntime.InferenceSession(str(target / 'policy.onnx'))
    assert session.get_modelmeta().custom_metadata_map['sha256'] == weights
    (tmp_path / 'file').write_text('in the way')
    assert cli.main(['export', str(tmp_path / 'checkpoint'), '--onnx',
                     str(tmp_path / 'file')]) == 2
    assert 'a folder' in capsys.readouterr().err


def test_without_onnx_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'onnx', None)
    with pytest.raises(UserError, match='package onnx') as caught:
        exported(network_of('unreal'), tmp_path)
    assert 'vn_nav[onnx]' in str(caught.value)
