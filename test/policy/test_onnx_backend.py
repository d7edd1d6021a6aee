"""Policies by ONNX Runtime: they do what they do by PyTorch, which need not be installed."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from paths import ROOT
from small_search import ROBOT, small_search
from without import BLOCKED

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.checkpoint_info import CONFIG, read_config
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.onnx_backend import _chosen
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.eyes import goal_places
from vn_nav.policy.search.taught import TaughtPlace
from vn_nav.policy.search.torch_eyes import TorchEyes
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import DRIVE_ACTIONS

pytest.importorskip('onnx', reason='expected: onnx, of the extra `onnx`, is not installed')
pytest.importorskip('onnxruntime', reason='expected: onnxruntime is not installed')

INFO = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0, 'decoding': 'greedy',
        'stop_threshold': 0.9}
LEARNED = {
    'fused': {'heads': ('goal_pose', 'arrival'), 'pose_to_memory': True},
    'matching': {'architecture': 'matching', 'heads': ('goal_pose', 'arrival'),
                 'pose_to_memory': True, 'moves': ROBOT.moves},  # behind an action filter
    'framestack': {'architecture': 'thesis', 'frames': 4},
    'unreal': {'architecture': 'unreal'},  # it looks at no goal
}


def pictures(count, size=48, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 3, size, size), dtype=np.uint8)


def learned(name):
    torch.manual_seed(0)
    network = build_policy(NetworkConfig(**{'actions': DRIVE_ACTIONS, 'size': 64, 'hidden': 32,
                                            **LEARNED[name]})).eval()
    for part in network.actor.parameters():
        part.data.normal_()
    return network


def taught():
    """It has been taught a place of five key pictures, and recognises everything."""
    network = small_search().eval()
    with torch.no_grad():
        network.recogniser.out.bias[4] = 3.0
    poses = np.column_stack([np.linspace(0.5, 2.5, 5), np.full(5, 2.0), np.zeros(5)])
    maps = [np.full((40, 60), value, np.float32) for value in (-2.0, 2.0, 0.0)]
    network.taught = TaughtPlace(pictures(5), poses.astype(np.float32), *maps,
                                 np.zeros(2, np.float32), np.ones(1, np.float32))
    return network


def both(network, folder, **info):
    """Folders of the checkpoint and of its export."""
    from vn_nav.policy.export import export_onnx
    if 'arrival' not in network.config.heads and network.config.architecture != 'search':
        info = {'stop_threshold': None} | info
    save_checkpoint(folder / 'checkpoint', network, INFO | info)
    export_onnx(load_checkpoint(folder / 'checkpoint'), folder / 'onnx')
    return folder / 'checkpoint', folder / 'onnx'


@pytest.mark.parametrize('name', LEARNED)
def test_a_learned_policy_acts_alike(name, tmp_path):
    runtimes = [PolicyRuntime(folder) for folder in both(learned(name), tmp_path)]
    one, other = runtimes
    assert one.info == other.info and one.action_names == other.action_names
    for episode in range(2):
        for runtime in runtimes:
            runtime.set_goal(pictures(1, 64, episode)[0])
        for picture in pictures(12, 64, 5 + episode):
            assert one.act(picture) == other.act(picture)
            assert other.arrival == pytest.approx(one.arrival, abs=1e-5, nan_ok=True)
    assert one.filter_counts == other.filter_counts


@pytest.mark.parametrize('network', [small_search, taught])
def test_a_policy_that_searches_acts_alike(network, tmp_path):
    runtimes = [PolicyRuntime(folder) for folder in both(network().eval(), tmp_path)]
    one, other = runtimes
    for runtime in runtimes:
        runtime.set_goal(pictures(1, seed=1)[0])
    pose = np.zeros(3)
    for picture in pictures(10, seed=2):
        assert one.act(picture, pose) == other.act(picture, pose)
        assert other.arrival == pytest.approx(one.arrival, abs=1e-5)
        pose = pose + np.array([0.1, 0.0, 0.1])
    for a, b in zip(*(runtime.search.searchers[0].hypotheses.all for runtime in runtimes),
                    strict=True):
        assert a.pose == pytest.approx(b.pose, abs=1e-3)
    if network is taught:
        assert one.search.recalls[0].localiser.poses
        assert len(one.search.recalls[0].localiser.poses) == len(
            other.search.recalls[0].localiser.poses)


def test_many_pictures_at_once_say_what_each_says_alone(tmp_path):
    _, folder = both(small_search().eval(), tmp_path)
    eyes, shown = PolicyRuntime(folder).search.eyes, pictures(5)
    maps = eyes.encode_goals(pictures(5, seed=1))
    together = eyes.look(shown, maps)
    for k in range(5):
        for whole, part in zip(together, eyes.look(shown[k:k + 1], maps[k:k + 1]), strict=True):
            assert np.allclose(whole[k:k + 1], part, atol=1e-5)


def test_places_of_goals_are_as_those_of_pictures():
    """Of one network, they would be the same; here the keys are made the queries."""
    network = small_search().eval()
    network.encoder.key.load_state_dict(network.encoder.query.state_dict())
    eyes, shown = TorchEyes(network), pictures(3)
    seen = eyes.see(shown)
    assert np.allclose(goal_places(eyes.encode_goals(shown), seen.features.shape[2:]),
                       seen.places, atol=1e-5)


def test_drawn_actions_have_the_probabilities_that_the_logits_say():
    logits = np.log(np.array([0.2, 0.5, 0.3], np.float32))
    assert [_chosen(logits, 'sample', number) for number in (0.0, 0.19, 0.21, 0.69, 0.71, 1 - 1e-9)
            ] == [0, 0, 1, 1, 2, 2]
    assert _chosen(logits, 'greedy', 0.9) == 1


def test_what_is_wrong_with_an_export_is_said(tmp_path, monkeypatch):
    _, folder = both(small_search().eval(), tmp_path)
    other = small_search(seed=1).eval()
    _, second = both(other, tmp_path / 'second')
    shutil.copy(second / 'compare.onnx', folder / 'compare.onnx')
    with pytest.raises(UserError, match='compare.onnx is of the weights'):
        PolicyRuntime(folder)
    (folder / 'compare.onnx').write_bytes(b'no model')
    with pytest.raises(UserError, match='is a model of ONNX'):
        PolicyRuntime(folder)
    (folder / 'compare.onnx').unlink()
    with pytest.raises(UserError, match='holds compare.onnx'):
        PolicyRuntime(folder)
    (second / CONFIG).unlink()
    with pytest.raises(UserError, match=CONFIG):
        PolicyRuntime(second)
    monkeypatch.setitem(sys.modules, 'onnxruntime', None)
    with pytest.raises(UserError, match='pip install onnxruntime'):
        PolicyRuntime(folder)


def test_what_it_says_of_itself_is_read_without_any_network(tmp_path):
    checkpoint, folder = both(learned('fused'), tmp_path)
    assert read_config(folder) == read_config(checkpoint)
    with pytest.raises(UserError, match='model.safetensors'):
        load_checkpoint(folder)  # it cannot be trained further


def test_another_export_takes_the_place_of_the_first(tmp_path):
    from vn_nav.policy.export import export_onnx
    _, folder = both(taught(), tmp_path)
    save_checkpoint(tmp_path / 'learned', learned('fused'), INFO)
    export_onnx(load_checkpoint(tmp_path / 'learned'), folder)
    assert {path.name for path in folder.iterdir()} == {
        'policy.onnx', 'goal.onnx', 'config.json', 'README.md'}
    assert PolicyRuntime(folder).search is None


def test_an_export_in_its_folder_computes_a_checkpoint_while_it_is_of_that_state(tmp_path):
    from vn_nav.cli import main
    folder = tmp_path / 'checkpoint'
    network = learned('fused')
    save_checkpoint(folder, network, INFO)
    assert PolicyRuntime(folder).engine.startswith(f'PyTorch ({folder}')
    assert main(['export', str(folder)]) == 0
    assert PolicyRuntime(folder).engine == f'ONNX Runtime ({folder / "onnx"})'
    assert load_checkpoint(folder).network.state_dict().keys() == network.state_dict().keys()
    save_checkpoint(folder, network, INFO | {'stop_threshold': 0.8})  # the card says another one
    stale = PolicyRuntime(folder)
    assert stale.engine.startswith('PyTorch') and stale.stop_threshold == 0.8
    assert main(['export', str(folder)]) == 0
    assert PolicyRuntime(folder).engine.startswith('ONNX Runtime')
    with torch.no_grad():
        next(network.parameters()).add_(0.1)
    save_checkpoint(folder, network, INFO | {'stop_threshold': 0.8})  # other weights
    assert PolicyRuntime(folder).engine.startswith('PyTorch')


DRIVE = """
import numpy as np
from vn_nav.policy.runtime import PolicyRuntime
policy = PolicyRuntime({folder!r})
policy.set_goal(np.zeros((3, policy.size, policy.size), np.uint8))
print(policy.act(np.full((3, policy.size, policy.size), 90, np.uint8), np.zeros(3)))
print(*{{name.partition('.')[0] for name, module in sys.modules.items()
        if 'site-packages' in (getattr(module, '__file__', None) or '')
        and not name.startswith(('_', 'vn_', 'ros_'))}})
"""


@pytest.mark.parametrize(('network', 'modules'), [
    (small_search, ('torch', 'gymnasium')), (lambda: learned('matching'),
                                             ('torch', 'gymnasium', 'numba'))])
def test_a_robot_needs_no_pytorch(network, modules, tmp_path):
    checkpoint, folder = both(network().eval(), tmp_path)

    def run(folder):
        script = BLOCKED.format(modules=modules) + DRIVE.format(folder=str(folder))
        return subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                              cwd=ROOT, timeout=100)
    done = run(folder)
    assert done.returncode == 0, done.stderr
    action, others = done.stdout.splitlines()
    assert action.isdigit() and set(others.split()) <= {
        'numpy', 'cv2', 'onnxruntime', 'yaml', 'safetensors', 'numba', 'llvmlite', 'coverage'}
    refused = run(checkpoint)
    assert 'vn_nav export' in refused.stderr.splitlines()[-1], refused.stderr
