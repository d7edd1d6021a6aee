"""The files of a replay memory: reopened, killed in between, full disks, what does not fit."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from paths import ROOT
from replay_stream import ENVS, GOAL_TABLE, LENGTHS, SIZE, Stream, decode, draws, memory

from vn_nav.errors import UserError
from vn_nav.learning.replay import Replay


def same_draws(a, b):
    one, other = a.windows(50, 6, draws()), b.windows(50, 6, draws())
    assert torch.equal(one.observation.image, other.observation.image)
    for name in ('reward', 'action', 'valid', 'terminated', 'truncated', 'starts'):
        assert torch.equal(getattr(one, name), getattr(other, name))
    for name, part in one.privileged.items():
        assert torch.equal(part, other.privileged[name])


@pytest.mark.parametrize('rows', [40, 130])
def test_a_mapped_memory_survives_a_reopen(tmp_path, rows):
    stream = Stream(LENGTHS, rows + 50)
    replay = stream.fill(memory(directory=tmp_path), rows)
    state = json.loads(json.dumps(replay.state_dict()))
    expected = stream.fill(memory(), rows)
    same_draws(replay, expected)
    replay.flush()
    del replay
    again = memory(directory=tmp_path)
    assert again.resumed is None and again.count == 0
    again.load_state_dict(state)
    assert again.resumed == 'mapped' and again.count == expected.count
    same_draws(again, expected)
    for part in (again, expected):
        stream.fill(part, 30, first=rows)
    same_draws(again, expected)


def test_rows_written_after_the_checkpoint_are_not_trusted(tmp_path):
    stream = Stream(((500,), (500,), (500,)), 260)
    replay = stream.fill(memory(directory=tmp_path), 130)
    state = replay.state_dict()
    stream.fill(replay, 12, first=130)  # in the place of rows 70 to 81
    again = memory(directory=tmp_path)
    again.load_state_dict(state)
    assert (again.total, again.count) == (130, 48)
    row, _ = decode(again.windows(300, 20, draws()).observation.image)
    assert int(row.min()) == 82 and int(row.max()) == 129
    assert torch.equal(row - row[0], torch.arange(21)[:, None].expand(21, 300))


KILLED = """
import os, signal, sys
sys.path[:0] = [sys.argv[2], sys.argv[2] + '/..']
from replay_stream import Stream, memory
replay = memory(directory=sys.argv[1])
stream = Stream(((500,), (500,), (500,)), 260)
stream.fill(replay, 80)
print(replay.state_dict()['identity'], flush=True)
write = replay._write
def die(name, rows):
    if name == 'reward':
        os.kill(os.getpid(), signal.SIGKILL)
    write(name, rows)
replay._write = die
replay.extend(stream.rollout(80, 7))
"""


def test_a_process_killed_while_it_writes_leaves_a_usable_memory(tmp_path):
    done = subprocess.run(
        [sys.executable, '-c', KILLED, str(tmp_path), str(Path(__file__).parent)],
        capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == -9, done.stderr
    replay = memory(directory=tmp_path)
    replay.load_state_dict({'total': 80, 'count': 60, 'identity': done.stdout.strip()})
    assert replay.resumed == 'mapped' and replay.count == 53  # 7 rows were being overwritten
    row, _ = decode(replay.windows(300, 20, draws()).observation.image)
    assert int(row.min()) == 27 and int(row.max()) == 79


def test_without_files_a_resumed_memory_is_refilled(tmp_path):
    stream = Stream(LENGTHS, 60)
    state = stream.fill(memory(directory=tmp_path / 'lost'), 30).state_dict()
    for replay in (memory(), memory(directory=tmp_path / 'new')):
        stream.fill(replay, 20)
        replay.load_state_dict(memory().state_dict())
        assert replay.resumed == 'refilled' and replay.count == replay.steps == 0
    replay = memory(directory=tmp_path / 'fresh')
    replay.load_state_dict(state)
    assert replay.resumed == 'refilled' and replay.count == 0
    same_draws(stream.fill(replay, 50, steps=50), stream.fill(memory(), 50, steps=50))


def test_files_of_another_memory_are_refused(tmp_path):
    stream = Stream(LENGTHS, 60)
    state = stream.fill(memory(directory=tmp_path), 30).state_dict()
    for other in ({'capacity': 50}, {'privileged': ('depth',)}, {'max_depth': 5.0}):
        with pytest.raises(UserError, match='remove that folder'):
            memory(directory=tmp_path, **other)
    with pytest.raises(UserError, match='goals differ'):
        Replay(60, ENVS, SIZE, GOAL_TABLE + 1, directory=tmp_path)
    # A new training in that folder: the checkpoint of the old one no longer fits.
    stream.fill(memory(directory=tmp_path), 10)
    with pytest.raises(UserError, match='its own replay files'):
        memory(directory=tmp_path).load_state_dict(state)
    with (tmp_path / 'image.ring').open('r+b') as file:
        file.truncate(100)
    with pytest.raises(UserError, match='image differ'):
        memory(directory=tmp_path)
    (tmp_path / 'replay.json').write_text('[]')
    with pytest.raises(UserError, match='remove that folder'):
        memory(directory=tmp_path)


def test_a_full_disk_is_one_clear_error(tmp_path):
    with pytest.raises(UserError, match='GB on the disk'):
        Replay(10**9, 16, 174, None, directory=tmp_path)
