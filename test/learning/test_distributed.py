"""Two real processes that train one policy: the same gradient, the same weights, one run."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from two_bars import TwoBars, collected

from vn_nav.learning import returns
from vn_nav.learning.distributed import Processes
from vn_nav.learning.learner import Learner
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.learning.presets import TrainConfig, preset
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Rollout
from vn_nav.learning.state_file import read_state
from vn_nav.learning.trainer import train
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig

FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
TASKS = {'goal_pose': 0.5, 'arrival': 0.2, 'distance': 0.1, 'imitation': 1.0, 'depth': 0.1}
LEARNED = {
    'a2c': LearnerConfig(optimiser='rmsprop', clip=None, epochs=1, minibatches=1,
                         normalise_advantage=False),
    'tasks': LearnerConfig(epochs=2, minibatches=1, images_from_replay=False, **TASKS),
}
REPLAYED = preset('thesis', hidden=16, replay_steps=120, replay_batch=4, replay_length=4)
RUN = TrainConfig(frames=900, rollout_length=16, channels=(8, 8, 8), features=24, hidden=16,
                  epochs=1, minibatches=2, bf16=False, curriculum='success', advance_window=20,
                  success_to_advance=0.05)
ENVS = 4
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]  # two more processes have to start


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def small_network(config, seed=0):
    torch.manual_seed(seed)
    return Policy(NetworkConfig(actions=TwoBars.action_names, size=36, channels=(8, 8, 8),
                                features=24, hidden=16, heads=config.heads))


def learn(config, network, rollout, processes=None):
    """Weights after an update, and the gradients of its steps before they are clipped."""
    gradients = []

    def note(_):
        gradients.append({name: part.grad.clone() for name, part in network.named_parameters()
                          if part.grad is not None})
    losses = Learner(network, config, torch.Generator().manual_seed(0), average_gradients=note,
                     processes=processes).update(rollout)
    return {'weights': network.state_dict(), 'gradients': gradients, 'losses': losses}


def learn_replayed(processes):
    """Weights after two updates of the thesis's preset, each process with its own replay."""
    torch.manual_seed(processes.rank)  # rank 0's weights are taken
    network = Policy(REPLAYED.network(TwoBars.action_names, 36))
    env = TwoBars(6)
    memory = Replay(20, 6, 36, torch.from_numpy(env.goals), privileged=('depth', 'segmentation'),
                    goal_segmentation=torch.from_numpy(env.goal_segmentation))
    learner = Learner(network, REPLAYED, torch.Generator().manual_seed(processes.rank),
                      replay=memory, processes=processes)
    for _ in range(2):
        learner.update(collected(network, seed=processes.rank))
    return network.state_dict()


def work(rank, folder):
    """What each of two processes does; it leaves what came of it in a file."""
    torch.set_num_threads(1)
    dist.init_process_group('gloo', init_method=f'file://{folder}/store', rank=rank, world_size=2)
    processes = Processes.join()
    result = {}
    for name, config in LEARNED.items():
        network = small_network(config)
        result[name] = learn(config, network, collected(network, seed=rank), processes)
    result['replayed'] = learn_replayed(processes)
    rows, before = [], set(os.listdir(folder))
    env = TwoBars(ENVS)
    train(env, RUN, Path(folder) / 'run', info=FACTS, on_update=rows.append)
    result['rows'], result['tau'], result['made'] = rows, env.tau, os.listdir(folder)
    result['before'] = before
    torch.save(result, f'{folder}/result-{rank}')
    dist.barrier()
    dist.destroy_process_group()


@pytest.fixture(scope='module')
def both(tmp_path_factory):
    """The results of two processes, and the folder of what they trained together."""
    folder = tmp_path_factory.mktemp('both')
    torch.multiprocessing.spawn(work, (str(folder),), nprocs=2)
    return [torch.load(folder / f'result-{rank}', weights_only=False) for rank in (0, 1)], folder


def side_by_side(one, other):
    """Two rollouts of equal length as one of all their environments."""
    def joined(name):
        return torch.cat([getattr(one, name), getattr(other, name)], 1)
    seen = Observation(
        torch.cat([one.observation.image, other.observation.image], 1), one.observation.goals,
        *(None if parts[0] is None else torch.cat(parts, 1)
          for parts in zip(one.observation[2:], other.observation[2:], strict=True)))
    return Rollout(
        seen, *(joined(name) for name in ('starts', 'action', 'reward', 'terminated', 'truncated',
                                          'valid')),
        state=RecurrentState(*(torch.cat(parts) for parts in zip(one.state, other.state,
                                                                 strict=True))),
        privileged={key: torch.cat([rows, other.privileged[key]], 1)
                    for key, rows in one.privileged.items()},
        log_probability=joined('log_probability'), value=joined('value'))


@pytest.mark.parametrize('name', list(LEARNED))
def test_two_processes_have_the_gradient_of_one_with_both_batches(name, both):
    config = LEARNED[name]
    network = small_network(config)
    parts = [collected(network, seed=rank) for rank in (0, 1)]
    counts = [rollout.frames for rollout in parts]
    assert counts[0] != counts[1]  # else a mean of means were the mean
    alone = learn(config, network, side_by_side(*parts))
    results = [result[name] for result in both[0]]
    assert len(alone['gradients']) == config.epochs
    for result in results:
        for mine, theirs in zip(result['gradients'], alone['gradients'], strict=True):
            assert mine.keys() == theirs.keys()
            for key, gradient in theirs.items():
                scale = float(gradient.abs().max())
                assert torch.allclose(mine[key], gradient, rtol=1e-4, atol=1e-5 * scale), key
        for key, weight in alone['weights'].items():
            assert torch.allclose(result['weights'][key], weight, atol=2e-5), key
    # What each says of its share adds up to what the one says.
    for key in ('policy_loss', 'value_loss', 'entropy', 'kl'):
        mean = (results[0]['losses'][key] + results[1]['losses'][key]) / 2
        assert mean == pytest.approx(alone['losses'][key], rel=1e-3, abs=1e-6), key


@pytest.mark.parametrize('name', [*LEARNED, 'replayed'])
def test_both_processes_have_the_same_weights(name, both):
    one, two = (result[name] if name == 'replayed' else result[name]['weights']
                for result in both[0])
    assert all(torch.equal(one[key], two[key]) for key in one)
    before = small_network(LEARNED[name]).state_dict() if name in LEARNED else one
    assert name == 'replayed' or any(not torch.equal(one[key], before[key]) for key in one)


def test_two_processes_train_one_run(both):
    (one, two), folder = both
    steps = RUN.rollout_length * ENVS
    assert steps < one['rows'][0]['frames'] <= 2 * steps  # frames are those of both
    assert one['rows'][-1]['frames'] >= RUN.frames
    same = ('frames', 'tau', 'success', 'return', 'policy_loss', 'gradient_norm')
    for mine, theirs in zip(one['rows'], two['rows'], strict=True):
        assert {key: str(mine[key]) for key in same} == {key: str(theirs[key]) for key in same}
    assert one['tau'] == two['tau'] > RUN.start_difficulty  # both environments follow
    lines = (folder / 'run' / 'metrics.csv').read_text().splitlines()
    assert len(lines) == 1 + len(one['rows'])
    assert sorted(path.name for path in (folder / 'run').iterdir()) == [
        'checkpoint', 'metrics.csv', 'training_state']
    state = read_state(folder / 'run' / 'training_state')
    assert state['frames'] == one['rows'][-1]['frames']
    assert len(state['curriculum']['first']) == 2 * ENVS


def test_one_process_goes_on_with_what_two_began(both, tmp_path, capsys):
    shutil.copytree(both[1] / 'run', tmp_path / 'run')
    train(TwoBars(ENVS), dataclasses.replace(RUN, frames=1200), tmp_path / 'run', info=FACTS,
          resume=True)
    assert 'episodes begin anew' in capsys.readouterr().out
    assert load_checkpoint(tmp_path / 'run' / 'checkpoint').info['frames'] >= 1200


def test_advantages_are_normalised_over_all_processes():
    """With one process it is the plain normalisation."""
    x, mask = torch.randn(5, 3), torch.rand(5, 3) < 0.7
    assert torch.equal(Processes().normalise(x, mask), returns.normalise(x, mask))


# torchrun itself.

COMMAND = [
    '-m', 'vn_nav.cli', 'train', '--preset', 'fast', '--house', '3', '--rooms', '1',
    '--size', '36', '--envs', '4', '--max-decisions', '40', '--hidden', '16',
    '--rollout-length', '8', '--channels', '8', '8', '8', '--features', '24',
    '--minibatches', '2', '--pair-minutes', '0', '--no-bf16', '--no-tensorboard',
    '--set', 'checkpoint_seconds=0.5']


def workers(torchrun):
    """Process ids of torchrun's workers, by rank."""
    found = {}
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            parent = int((folder / 'stat').read_text().rsplit(')', 1)[1].split()[1])
            words = (folder / 'environ').read_bytes().split(b'\0')
        except OSError:  # it has ended
            continue
        if parent == torchrun.pid:
            ranks = [int(word[5:]) for word in words if word.startswith(b'RANK=')]
            found.update({rank: int(folder.name) for rank in ranks})
    return found


@pytest.mark.timeout(400)
def test_torchrun_replaces_a_killed_worker_and_the_run_ends(tmp_path):
    folder, frames = tmp_path / 'run', 6000
    with (tmp_path / 'output').open('w') as output:
        torchrun = subprocess.Popen(
            [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node',
             '2', '--max-restarts', '2', *COMMAND, '--frames', str(frames), '--out', str(folder)],
            stdout=output, stderr=subprocess.STDOUT, env={**os.environ, 'OMP_NUM_THREADS': '1'})
    try:
        path = folder / 'training_state'
        while not path.exists() or read_state(path)['frames'] < 500:
            assert torchrun.poll() is None, (tmp_path / 'output').read_text()
            time.sleep(0.05)
        committed = read_state(path)['frames']
        os.kill(workers(torchrun)[1], signal.SIGKILL)
        assert torchrun.wait() == 0, (tmp_path / 'output').read_text()
    finally:
        torchrun.kill()
        torchrun.wait()
    words = (tmp_path / 'output').read_text()
    (line,) = [line for line in words.splitlines() if line.startswith('resumed at ')]
    resumed = int(line.split()[2].replace(',', ''))
    assert committed <= resumed < frames and 'episodes begin anew' in line
    rows = (folder / 'metrics.csv').read_text().splitlines()[1:]
    numbers = [int(row.split(',')[0]) for row in rows]
    assert numbers == sorted(set(numbers)) and resumed in numbers
    assert 32 < numbers[0] <= 64  # both processes' frames
    assert load_checkpoint(folder / 'checkpoint').info['frames'] == numbers[-1] >= frames
