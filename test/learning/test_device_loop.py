"""The training loop on a device, in Warp's CPU mode: as on the host, and without the host."""

import contextlib
import copy
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.learning.learner import Learner
from vn_nav.learning.presets import preset
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector
from vn_nav.learning.state_file import read_state
from vn_nav.learning.trainer import train
from vn_nav.learning.training import STATE
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
TOLD = ('depth', 'segmentation', 'goal_segmentation', 'goal_pose', 'overlap')
CONFIG = EnvConfig(scenes=house_scenes((3, 7), 2), num_envs=6, size=36, max_decisions=12, seed=0,
                   progress_reward=1.0, collision_reward=-0.02, step_reward=-0.01, goal_bonus=9.0,
                   privileged=TOLD)
KEYS = (*TOLD, 'arrived', 'distance')
FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def device_env(config=CONFIG):
    from vn_sim_bridge.navigation.warp_env import WarpNavigationEnv
    return WarpNavigationEnv(config, device='cpu')


def learning(name, env, **changes):
    """Collector and learner of a preset, as the trainer makes them."""
    torch.manual_seed(0)
    config = preset(name, imitation=0.0, teacher_share=0.0, pair_minutes=0.0, features=32,
                    hidden=32, **changes)
    network = Policy(config.network(tuple(env.action_names), env.goals.shape[-1]))
    draws = torch.Generator().manual_seed(1)
    collector = Collector(env, network, draws, config.privileged)
    replay = None
    if config.from_replay:
        replay = Replay(
            60, env.num_envs, env.goals.shape[-1], env.goals,
            privileged=tuple({'depth', 'segmentation'} & set(config.privileged)),
            goal_segmentation=(env.goal_segmentation if 'goal_segmentation' in config.privileged
                               else None))
    collector.begin(5)
    return collector, Learner(network, config, draws, replay=replay)


class Scripted(Collector):
    """Collects with given actions: sampled ones would follow a picture's single grey level."""

    def _sample(self, log_probability):
        self.drawn = getattr(self, 'drawn', 0) + 1
        return torch.from_numpy(self.script[self.drawn - 1]).unsqueeze(1)


def some_actions():
    """[40,N]: random ones, and among them those that lead to the goal."""
    env, rng, actions = NavigationEnv(CONFIG), np.random.default_rng(0), []
    env.set_difficulty(0.3)
    env.reset(seed=5)
    for step in range(40):
        random = rng.integers(0, len(env.action_names), CONFIG.num_envs)
        actions.append(env.oracle_actions() if step % 4 else random)
        env.step(actions[-1])
    return np.array(actions)


def test_a_rollout_is_that_of_the_host():
    host, device = NavigationEnv(CONFIG), device_env()
    network = Policy(preset('a2c').network(tuple(host.action_names), CONFIG.size))
    script, found = some_actions(), []
    for env in (host, device):
        collector = Scripted(env, network, torch.Generator(), KEYS)
        collector.script = script
        env.set_difficulty(0.3)
        collector.begin(5)
        found.append([collector.collect(20) for _ in range(2)])
        found[-1].append(collector.state_dict())
    for (one, ended), (other, other_ended) in zip(found[0][:2], found[1][:2], strict=True):
        gap = one.observation.image.int() - other.observation.image.int()
        assert gap.abs().max() <= 1 and (gap == 0).float().mean() > 0.99
        assert one.observation.image.stride() == other.observation.image.stride()
        for name in ('goal_index', 'last_action', 'last_reward'):
            assert torch.equal(getattr(one.observation, name), getattr(other.observation, name))
        for name in ('starts', 'action', 'terminated', 'truncated', 'valid'):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        assert torch.allclose(one.reward, other.reward, atol=1e-5)
        assert torch.allclose(one.value, other.value, atol=0.01)
        for key in KEYS:
            mine, theirs = one.privileged[key], other.privileged[key]
            assert mine.dtype == theirs.dtype, key
            assert torch.allclose(mine.float(), theirs.float(), atol=1e-4), key
        assert [(e[:3], e[4:]) for e in ended] == [(e[:3], e[4:]) for e in other_ended]
        assert np.allclose([e.reward for e in ended], [e.reward for e in other_ended], atol=1e-4)
    assert sum(len(ended) for _, ended in found[0][:2]) > 10
    rollouts = [rollout for rollout, _ in found[0][:2]]
    assert any((rollout.privileged['overlap'] > 0.2).any() for rollout in rollouts)
    assert any(rollout.terminated.any() for rollout in rollouts)  # with its bonus
    for one, other in zip(found[0][2]['totals'], found[1][2]['totals'], strict=True):
        assert torch.allclose(one.double(), other.double(), atol=1e-4)


class Waits(TorchDispatchMode):
    """Counts what makes a host wait for its device, or sends rows to it."""

    NAMES = ('_local_scalar_dense', 'nonzero', '_unique2', 'unique_dim', 'masked_select', 'equal',
             'multinomial', 'repeat_interleave')

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        masks = name.startswith('index') and len(args) > 1 and isinstance(args[1], (list, tuple))
        if name in self.NAMES or (masks and any(
                part is not None and part.dtype in (torch.bool, torch.uint8) for part in args[1])):
            self.found.append(name)
        return func(*args, **(kwargs or {}))


class Transfers(TorchFunctionMode):
    """Counts tensors that become numbers, lists or arrays or go to the CPU, and the reverse."""

    NAMES = ('numpy', 'tolist', 'item', 'cpu', '__array__', 'as_tensor', 'tensor', '__bool__',
             '__int__', '__float__', '__index__')

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, '__name__', '')
        if name in self.NAMES:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def watched():
    """What the host waits for inside."""
    found = []
    with Waits() as waits, Transfers() as transfers:
        yield found
    found += waits.found + transfers.found


def test_the_watch_sees_what_a_device_would_wait_for():
    rows, mask = torch.arange(4.0), torch.tensor([True, False, True, False])
    for wait in (rows.sum().item, rows.tolist, rows.numpy, lambda: rows[mask], mask.nonzero,
                 rows.unique, lambda: bool(mask.any()), lambda: torch.multinomial(rows, 1),
                 lambda: torch.equal(rows, rows), rows.cpu, lambda: torch.tensor([1.0])):
        with watched() as found:
            wait()
        assert found, wait
    with watched() as found:
        torch.where(mask, rows, 0.0).cumsum(0)
        rows.masked_fill_(mask, 0.0)
    assert not found


@pytest.mark.parametrize('name', ['a2c', 'thesis', 'fast', 'framestack'])
def test_the_host_waits_once_a_rollout_not_once_a_step(name):
    collector, learner = learning(name, device_env())
    collector.collect(3)
    waits = []
    for steps in (5, 15):
        with watched() as found:
            rollout, _ = collector.collect(steps)
        waits.append(found)
    assert waits[0] == waits[1] == ['nonzero', 'tolist']  # the episodes that ended
    # With the environment on the host every action passes through it.
    host = Collector(NavigationEnv(CONFIG), learner.network, torch.Generator())
    host.begin(0)
    with watched() as found:
        host.collect(5)
    assert found.count('numpy') == 5


def test_the_learner_waits_as_often_with_more_steps():
    counts = []
    for changes in ({'minibatches': 1}, {'minibatches': 3, 'epochs': 4}):
        collector, learner = learning('fast', device_env(), **changes)
        learner.prompt = False  # as on a GPU
        learner.optimiser.step = lambda: None  # torch's own, which counts on the host
        rollout, _ = collector.collect(6)
        with watched() as found:
            losses = learner.update(rollout, 0.1)
        counts.append(len(found))
        assert all(map(math.isfinite, losses.values()))
    assert counts[0] == counts[1] == 2  # the goals that occur, and the losses


@pytest.mark.parametrize('name', ['a2c', 'unreal', 'thesis', 'fast'])
def test_presets_learn_on_the_device(name):
    collector, learner = learning(name, device_env())
    before = copy.deepcopy(learner.network.state_dict())
    for _ in range(2):
        rollout, _ = collector.collect(learner.config.rollout_length)
        losses = learner.update(rollout, 0.1)
    assert set(learner.config.tasks) < set(losses)
    assert all(map(math.isfinite, losses.values()))
    moved = [key for key, rows in learner.network.state_dict().items()
             if not torch.equal(rows, before[key])]
    assert len(moved) > len(before) / 2


def test_updates_that_look_once_equal_those_that_look_at_every_step():
    updates = []
    for prompt in (True, False):
        collector, learner = learning('thesis', device_env())
        learner.prompt = prompt
        rollout, _ = collector.collect(20)
        updates.append((learner.update(rollout, 0.1), learner.network.state_dict()))
    (one, weights), (two, others) = updates
    assert one == pytest.approx(two, rel=1e-4)
    assert all(torch.allclose(weights[key], others[key], atol=1e-5) for key in weights)


def test_a_loss_that_is_not_finite_is_found_at_the_end(tmp_path):
    collector, learner = learning('a2c', device_env())
    learner.prompt, learner.failed_batch = False, tmp_path / 'batch.pt'
    rollout, _ = collector.collect(5)
    rollout.reward[2, 1] = math.nan
    with pytest.raises(UserError, match='stay finite'):
        learner.update(rollout)
    assert torch.load(learner.failed_batch)['batch']['reward'].shape == (5, 6)


def test_trains_saves_and_resumes_as_without_an_interruption(tmp_path):
    def run(folder, frames, **options):
        config = preset('thesis', frames=240, rollout_length=10, hidden=32, start_difficulty=1.0)
        train(device_env(), config, tmp_path / folder, info=FACTS, on_update=stop_at(frames),
              **options)
        return load_checkpoint(tmp_path / folder / 'checkpoint')

    def stop_at(frames):
        def look(row):
            if row['frames'] >= frames:
                raise KeyboardInterrupt
        return look
    whole = run('whole', math.inf)
    with pytest.raises(KeyboardInterrupt):
        run('parts', 100)  # killed: what is saved is the beginning
    parts = run('parts', math.inf, resume=True)
    assert all(torch.equal(rows, parts.network.state_dict()[key])
               for key, rows in whole.network.state_dict().items())
    state = read_state(tmp_path / 'parts' / STATE)
    assert state['env']['pose'].shape == (6, 4)
    output, _ = parts.network(*_one_row(parts.network))  # loads, and acts, anywhere
    assert torch.isfinite(output.logits).all()


def _one_row(network):
    from vn_nav.observation import Observation
    size = network.config.size
    picture = torch.zeros(1, 1, 3, size, size, dtype=torch.uint8)
    zeros = torch.zeros(1, 1, dtype=torch.int64)
    return (Observation(picture, picture[0], zeros, zeros, zeros.float()),
            torch.ones(1, 1, dtype=torch.bool))


def test_states_go_on_exactly():
    env = device_env()
    actions = torch.from_numpy(np.random.default_rng(0).integers(0, 4, (30, 6)))
    env.reset(seed=4)
    for row in actions[:10]:
        env.step(row)
    saved = env.get_state()
    seen = [env.step(row)[0]['image'].clone() for row in actions[10:]]
    other = device_env()
    other.reset(seed=9)
    other.set_state(saved)
    assert all(torch.equal(picture, other.step(row)[0]['image'])
               for picture, row in zip(seen, actions[10:], strict=True))


def test_what_the_device_lacks_is_said(capsys, monkeypatch):
    with pytest.raises(UserError, match='imitation=0'):
        device_env(EnvConfig(scenes=('house:3?rooms=1',), num_envs=1,
                             privileged=('explorer_action',)))
    with pytest.raises(UserError, match='cuda:0'):
        preset('fast', device='gpu')
    monkeypatch.setattr(torch.cuda, 'device_count', lambda: 0)
    words = ['train', '--preset', 'fast', '--device', 'cuda:0', '--out', 'nowhere']
    assert main(words) == 2
    assert 'nvidia-smi' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'warp', None)
    assert main([*words, '--set', 'imitation=0', '--set', 'teacher_share=0']) == 2
    assert 'vn_nav[gpu]' in capsys.readouterr().err


def test_the_gpu_script_trains_and_writes_a_curve(tmp_path):
    done = subprocess.run(
        [sys.executable, 'bench/gpu/run.py', '--device', 'cpu', '--parts', 'train', 'learn',
         'export', '--train-envs', '8', '--train-size', '36', '--train-seconds', '2',
         '--presets', 'thesis', '--learn-minutes', '0.05', '--learn-envs', '8',
         '--curves', str(tmp_path / 'curves'), '--out', str(tmp_path / 'lines.jsonl')],
        capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / 'lines.jsonl').read_text()
    assert '"error"' not in text, text
    assert 'training on the device, thesis' in text
    assert (tmp_path / 'curves' / 'thesis' / 'metrics.csv').read_text().count('\n') > 1


def test_a_job_of_the_gpu_script_that_takes_too_long_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / 'bench' / 'gpu')
    import run
    ended, script = tmp_path / 'ended', tmp_path / 'child.py'
    script.write_text(f"""
import pathlib, signal, sys, time
def end(*_):
    pathlib.Path({str(ended)!r}).write_text('saved')
    sys.exit()
signal.signal(signal.SIGTERM, end)
time.sleep(600)
""")
    begun = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        run.run_job([sys.executable, '-c', 'import subprocess, sys\n'
                     f'subprocess.run([sys.executable, {str(script)!r}])'], 4.0)
    assert ended.read_text() == 'saved' and time.monotonic() - begun < 60
    with pytest.raises(subprocess.CalledProcessError):
        run.run_job([sys.executable, '-c', 'raise SystemExit(3)'], math.inf)
