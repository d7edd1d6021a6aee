"""Trainings that are killed, that run out of disk, that diverge: what was saved stays, whole."""

import csv
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from faults import no_file_beyond, own_mounts
from two_bars import TwoBars, collected

from vn_nav.errors import UserError
from vn_nav.learning.learner import Learner
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.learning.log import Log
from vn_nav.learning.presets import TrainConfig, preset
from vn_nav.learning.replay import Replay
from vn_nav.learning.state_file import read_state, remove_partial
from vn_nav.learning.trainer import train
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

KILLS = int(os.environ.get('VN_NAV_KILLS', 20))  # of all presets together; more in `make soak`
FACTS = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0}
TINY = ['--house', '3', '--rooms', '1', '--size', '36', '--envs', '4', '--max-decisions', '40',
        '--hidden', '16', '--rollout-length', '8', '--no-bf16', '--no-tensorboard',
        '--set', 'checkpoint_seconds=0.2']
# Preset: its options, and frames a kill, so many that no life comes to the end.
KILLED = {
    'fast': ([*TINY, '--channels', '8', '8', '8', '--features', '24', '--minibatches', '2',
              '--pair-minutes', '0'], 800),
    'thesis': ([*TINY, '--set', 'replay_steps=4000', '--set', 'replay_batch=2',
                '--set', 'replay_length=8'], 400),
}
TIMES = ('minutes', 'fps', 'collect_seconds', 'update_seconds')  # columns that no two runs share
QUICK = TrainConfig(frames=800, rollout_length=16, channels=(8, 8, 8), features=24, hidden=16,
                    minibatches=1, epochs=1, bf16=False, checkpoint_seconds=0.001)
pytestmark = pytest.mark.slow  # faults


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def start(preset_name, folder, *more, output=None):
    """A child process that trains."""
    options, _ = KILLED[preset_name]
    return subprocess.Popen(
        [sys.executable, '-m', 'vn_nav.cli', 'train', '--preset', preset_name, *options,
         '--out', str(folder), *map(str, more)], stdout=output, stderr=subprocess.STDOUT)


def rows_of(folder):
    """The whole rows of a run's metrics."""
    path = folder / 'metrics.csv'
    if not path.exists():
        return []
    lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith('\n')]
    return list(csv.DictReader(lines))


def untimed(rows):
    return [{name: value for name, value in row.items() if name not in TIMES} for row in rows]


def saved_frames(folder):
    """Frames of the last committed state, -1 while there is none; it has to be whole."""
    path = folder / 'training_state'
    return read_state(path)['frames'] if path.exists() else -1


def wait_until(holds, process, output, seconds=90.0):
    end = time.monotonic() + seconds
    while not holds():
        assert process.poll() is None, f'the training ended by itself: {output.read_text()}'
        assert time.monotonic() < end, f'nothing happened: {output.read_text()}'
        time.sleep(0.02)


def kill_at_random(preset_name, folder, frames, chance, output):
    """Start or resume a training and kill it; the least frames that it must not lose."""
    before = saved_frames(folder)
    resume = ['--resume'] if before >= 0 else []
    with output.open('w') as file:
        process = start(preset_name, folder, '--frames', frames, *resume, output=file)
        try:
            if chance.random() < 0.2:  # at any moment: imports, resuming, the first frames
                time.sleep(chance.uniform(0.0, 4.0))
            else:
                wait_until(lambda: saved_frames(folder) > max(before, 0), process, output)
                time.sleep(chance.uniform(0.0, 0.5))
            committed = saved_frames(folder)
            assert process.poll() is None, output.read_text()
        finally:
            process.kill()
            process.wait()
    assert process.returncode == -signal.SIGKILL
    words = output.read_text()
    if before >= 0 and 'resumed' in words:
        assert f'resumed at {before:,} frames' in words
    return committed, words


@pytest.mark.timeout(120 * KILLS)
@pytest.mark.parametrize('name', list(KILLED))
def test_a_killed_training_loses_no_committed_update(name, tmp_path):
    kills = math.ceil(KILLS / len(KILLED))
    folder, frames = tmp_path / 'run', KILLED[name][1] * kills
    chance = random.Random(name)
    committed_rows, checkpoint_frames, said = [], 0, ''
    for kill in range(kills):
        committed, words = kill_at_random(name, folder, frames, chance, tmp_path / 'output')
        said += words
        now = saved_frames(folder)
        assert now >= committed, f'kill {kill}'
        if (folder / 'checkpoint').exists():
            of_checkpoint = load_checkpoint(folder / 'checkpoint').info['frames']
            assert checkpoint_frames <= of_checkpoint <= max(now, 0)
            checkpoint_frames = of_checkpoint
        else:
            assert now <= 0
        rows = [row for row in rows_of(folder) if int(row['frames']) <= now]
        numbers = [int(row['frames']) for row in rows]
        assert numbers == sorted(set(numbers)) and (now <= 0 or numbers[-1] == now)
        assert rows[:len(committed_rows)] == committed_rows
        committed_rows = rows
    with (tmp_path / 'output').open('w') as file:
        assert start(name, folder, '--frames', frames, '--resume', output=file).wait() == 0
    said += (tmp_path / 'output').read_text()
    rows = rows_of(folder)
    assert rows[:len(committed_rows)] == committed_rows
    final = load_checkpoint(folder / 'checkpoint')
    assert final.info['frames'] == saved_frames(folder) == int(rows[-1]['frames']) >= frames
    assert int(rows[-2]['frames']) < frames
    assert not list(folder.glob('.*')), 'unfinished files of killed processes are left'
    if name == 'thesis':
        assert 'the replay memory is mapped' in said
        return
    # Without a replay memory the lives add up to one uninterrupted training, bit for bit.
    with (tmp_path / 'output').open('w') as file:
        assert start(name, tmp_path / 'whole', '--frames', frames, output=file).wait() == 0
    whole = load_checkpoint(tmp_path / 'whole' / 'checkpoint').network.state_dict()
    assert all(torch.equal(whole[key], part) for key, part in final.network.state_dict().items())
    assert untimed(rows) == untimed(rows_of(tmp_path / 'whole'))


def test_what_a_killed_process_had_begun_to_write_is_removed(tmp_path):
    (tmp_path / '.training_state.123.tmp').write_bytes(b'half')
    (tmp_path / '.checkpoint.123.tmp').mkdir()
    (tmp_path / '.checkpoint.123.tmp' / 'model.safetensors').write_bytes(b'half')
    (tmp_path / 'training_state').write_bytes(b'whole')
    remove_partial(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ['training_state']


def test_of_a_metrics_file_only_whole_rows_of_saved_frames_are_kept(tmp_path):
    path = tmp_path / 'metrics.csv'
    path.write_text('frames,fps\n10,1\n200,2\n3000,3\n')
    with Log(tmp_path, TrainConfig(), ('frames', 'fps'), 200):
        pass
    assert path.read_text() == 'frames,fps\n10,1\n200,2\n'
    path.write_text('frames,fps\n10,1\n20')  # that was to be 200,2
    with Log(tmp_path, TrainConfig(), ('frames', 'fps'), 200):
        pass
    assert path.read_text() == 'frames,fps\n10,1\n'


# The replay memory of a resumed training.


SMALL_THESIS = preset('thesis', frames=700, rollout_length=8, hidden=16, bf16=False,
                      replay_steps=320, replay_batch=2, replay_length=8)


def house_env():
    return NavigationEnv(EnvConfig(scenes=('house:3?rooms=1',), num_envs=4, size=36,
                                   max_decisions=40,
                                   privileged=('depth', 'goal_segmentation', 'segmentation')))


def interrupted(folder, config, updates=8):
    """A training that a signal ends after some updates."""
    rows = []

    def interrupt(row):
        rows.append(row)
        if len(rows) == updates:
            signal.raise_signal(signal.SIGTERM)
    train(house_env(), config, folder, info=FACTS, on_update=interrupt)
    assert len(rows) == updates


def test_with_a_mapped_replay_an_interrupted_training_ends_as_an_uninterrupted_one(
        tmp_path, capsys):
    interrupted(tmp_path / 'parts', SMALL_THESIS)
    parts = train(house_env(), SMALL_THESIS, tmp_path / 'parts', info=FACTS, resume=True)
    assert 'frames; the replay memory is mapped: 256 steps are there' in capsys.readouterr().out
    whole = train(house_env(), SMALL_THESIS, tmp_path / 'whole', info=FACTS)
    one, two = (load_checkpoint(folder).network.state_dict() for folder in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_lost_replay_is_refilled_and_it_is_said(tmp_path, capsys):
    interrupted(tmp_path, SMALL_THESIS)
    shutil.rmtree(tmp_path / 'replay')
    train(house_env(), SMALL_THESIS, tmp_path, info=FACTS, resume=True)
    assert 'the replay memory is refilled' in capsys.readouterr().out


# Full disks. A limit on the size of files fails a write as a full disk does, at a chosen byte.


@pytest.mark.parametrize('failing', ['training_state', 'metrics.csv'])
def test_a_file_that_cannot_be_written_ends_a_training_and_leaves_the_last_save(failing, tmp_path):
    saved = {}

    def limit(row):
        if row['frames'] > 300 and not saved:
            # The update before was saved: the next row or the next save is too much.
            saved.update(frames=saved_frames(tmp_path))
            size = {'training_state': 50_000,
                    'metrics.csv': (tmp_path / 'metrics.csv').stat().st_size + 10}[failing]
            _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # With minutes between the saves the row is what fails, else the save.
    config = QUICK if failing == 'training_state' else TrainConfig(
        **{**QUICK.__dict__, 'checkpoint_seconds': 60.0})
    try:
        with pytest.raises(UserError, match=f'{failing}.*free some space'):
            train(TwoBars(4), config, tmp_path, info=FACTS, on_update=limit)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert saved_frames(tmp_path) == saved['frames']
    assert load_checkpoint(tmp_path / 'checkpoint').info['frames'] == saved['frames']
    train(TwoBars(4), config, tmp_path, info=FACTS, resume=True)
    assert load_checkpoint(tmp_path / 'checkpoint').info['frames'] >= 800


def test_a_checkpoint_that_does_not_fit_leaves_the_one_before(tmp_path):
    config = NetworkConfig(actions=TwoBars.action_names, size=36, channels=(8, 8, 8),
                           features=24, hidden=16)
    save_checkpoint(tmp_path / 'model', Policy(config), FACTS)
    before = load_checkpoint(tmp_path / 'model').info
    with no_file_beyond(1000), pytest.raises(UserError, match='a checkpoint can be written'):
        save_checkpoint(tmp_path / 'model', Policy(config), {**FACTS, 'frames': 7})
    assert load_checkpoint(tmp_path / 'model').info == before
    assert [path.name for path in tmp_path.iterdir()] == ['model']


FULL_DISK = """
set -u
mount -t tmpfs -o size=4m tmpfs "$1/disk"
train() { "$2" -m vn_nav.cli train --out "$1/disk/run" --frames 1500 "${@:3}"; }
train "$@" > "$1/first" 2>&1 &
until [ "$(cat "$1/disk/run/metrics.csv" 2> /dev/null | wc -l)" -gt 5 ]; do sleep 0.02; done
dd if=/dev/zero of="$1/disk/filler" bs=4k 2> "$1/dd"
wait $!; echo $? > "$1/code"
cp -a "$1/disk/run" "$1/left"
rm "$1/disk/filler"
train "$@" --resume > "$1/second" 2>&1; echo $? >> "$1/code"
cp -a "$1/disk/run" "$1/finished"
"""


@pytest.mark.timeout(400)
def test_a_full_disk_ends_a_training_in_one_line_and_room_lets_it_finish(tmp_path):
    # With the first process of its own process namespace all others end.
    inside = own_mounts(tmp_path, '--pid', '--fork', '--kill-child')
    (tmp_path / 'disk').mkdir()
    subprocess.run([*inside, 'bash', '-c', FULL_DISK, 'bash', str(tmp_path), sys.executable,
                    '--preset', 'fast', *KILLED['fast'][0]], check=True, timeout=360)
    assert (tmp_path / 'code').read_text().split() == ['2', '0']
    assert 'No space left on device' in (tmp_path / 'dd').read_text()
    *_, line = (tmp_path / 'first').read_text().splitlines()
    assert line.startswith('vn_nav: ') and 'No space left' in line and 'free some space' in line
    assert 'Traceback' not in (tmp_path / 'first').read_text()
    left = saved_frames(tmp_path / 'left')
    assert load_checkpoint(tmp_path / 'left' / 'checkpoint').info['frames'] <= left
    assert f'resumed at {left:,} frames' in (tmp_path / 'second').read_text()
    finished = load_checkpoint(tmp_path / 'finished' / 'checkpoint')
    assert finished.info['frames'] == saved_frames(tmp_path / 'finished') >= 1500


# Losses that are not finite.


class Poisoned(TwoBars):
    """Gives a reward that is not a number, from some step on."""

    steps, poison = 0, 100

    def step(self, actions):
        observation, reward, *rest = super().step(actions)
        self.steps += 1
        if self.steps >= self.poison:
            reward = np.where(rest[2]['reset'], reward, math.nan)
        return observation, reward, *rest


def test_a_training_that_diverges_stops_and_leaves_the_batch_and_the_last_good_state(tmp_path):
    state = {}

    def remember(row):
        state['bytes'] = (tmp_path / 'training_state').read_bytes()  # of the update before
    with pytest.raises(UserError, match='finite.*value_loss nan.*failed_batch.pt'):
        train(Poisoned(4), QUICK, tmp_path, info=FACTS, on_update=remember)
    good = read_state(tmp_path / 'training_state')
    assert good['updates'] == 6  # of 16 steps; the seventh holds step 100
    kept = torch.load(tmp_path / 'failed_batch.pt', weights_only=True)
    assert kept['batch']['reward'].isnan().any() and math.isnan(kept['losses']['value'])
    assert kept['batch']['observation']['image'].dtype == torch.uint8
    assert kept['advantage'].shape == kept['target'].shape == kept['batch']['action'].shape
    assert all(torch.equal(good['network'][name], part) for name, part in kept['network'].items())
    assert (tmp_path / 'failed_batch.pt').stat().st_size < 2_000_000
    assert load_checkpoint(tmp_path / 'checkpoint').info['frames'] == good['frames']
    assert [path.name for path in tmp_path.glob('.*')] == []
    train(TwoBars(4), QUICK, tmp_path, info=FACTS, resume=True)
    assert saved_frames(tmp_path) >= 800


def test_of_a_replayed_loss_that_is_not_finite_what_was_drawn_is_kept(tmp_path):
    config = LearnerConfig(epochs=1, minibatches=1, value_replay=1.0, replay_batch=4,
                           replay_length=4)
    network = Policy(NetworkConfig(actions=TwoBars.action_names, size=36, channels=(8, 8, 8),
                                   features=24, hidden=16))
    memory = Replay(32, 6, 36, torch.from_numpy(TwoBars(6).goals), privileged=())
    learner = Learner(network, config, torch.Generator().manual_seed(0), replay=memory)
    learner.failed_batch = tmp_path / 'failed_batch.pt'
    learner.update(collected(network))
    memory.rings['reward'].fill_(math.nan)
    with pytest.raises(UserError, match='value_replay nan'):
        learner.update(collected(network, seed=1))
    kept = torch.load(tmp_path / 'failed_batch.pt', weights_only=True)
    assert list(kept['replayed']) == ['value_replay']
    assert kept['replayed']['value_replay']['reward'].isnan().any()
    assert not kept['batch']['reward'].isnan().any() and math.isfinite(kept['losses']['value'])


def test_a_full_disk_does_not_hide_a_loss_that_is_not_finite(tmp_path):
    network = Policy(NetworkConfig(actions=TwoBars.action_names, size=36, channels=(8, 8, 8),
                                   features=24, hidden=16))
    learner = Learner(network, LearnerConfig(), torch.Generator())
    learner.failed_batch = tmp_path / 'failed_batch.pt'
    rollout = collected(network)
    rollout.reward[:] = math.nan
    with no_file_beyond(1000), pytest.raises(UserError, match='finite.*could not be written'):
        learner.update(rollout)
    assert list(tmp_path.iterdir()) == []
