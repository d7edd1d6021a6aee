"""The replay memory and the pictures' targets: stored values tell their environment and row."""

import colorsys
import hashlib
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from paths import ROOT

from vn_nav.errors import UserError
from vn_nav.learning.pixel_change import (
    average_pool_target,
    label_colours,
    label_target,
    pixel_change,
)
from vn_nav.learning.replay import Replay, encode_depth
from vn_nav.learning.returns import n_step_returns
from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation

SIZE, ENVS, GOALS = 6, 3, 5
GOAL_TABLE = torch.arange(GOALS, dtype=torch.uint8)[:, None, None, None].expand(
    GOALS, 3, SIZE, SIZE).contiguous()
GOAL_CLASSES = (100 + torch.arange(GOALS, dtype=torch.uint8))[:, None, None].expand(
    GOALS, SIZE, SIZE).contiguous()


def draws(seed=0):
    return torch.Generator().manual_seed(seed)


class Stream:
    """Rows of environments whose episodes have given lengths, one after the other.

    Row t of environment e shows a picture with the bytes of t and e; an episode of n decisions
    takes n + 1 rows, the last of them no frame. Every third episode is cut off; the others earn
    1 or -1 at their end.
    """

    def __init__(self, lengths, rows):
        envs = len(lengths)
        t = torch.arange(rows)[:, None].expand(rows, envs)
        env = torch.arange(envs).expand(rows, envs)
        self.starts, self.valid, self.terminated, self.truncated = (
            torch.zeros(4, rows, envs, dtype=torch.bool))
        self.begin, self.end = torch.zeros(2, rows, envs, dtype=torch.int64)
        self.last_reward = torch.zeros(rows, envs)
        self.goal_index, self.last_action = torch.zeros(2, rows, envs, dtype=torch.int64)
        self.valid |= True
        for e, cycle in enumerate(lengths):
            row = number = 0
            while row < rows:
                n = cycle[number % len(cycle)]
                last = row + n
                episode = slice(row, last + 1)
                self.starts[row, e] = True
                self.begin[episode, e], self.end[episode, e] = row, last
                self.goal_index[episode, e] = (number + e) % GOALS
                self.last_action[episode, e] = (t[episode, e] - 1) % 4
                self.last_action[row, e] = -1
                if last < rows:
                    self.valid[last, e] = False
                if last - 1 < rows:
                    ends = self.truncated if number % 3 == 2 else self.terminated
                    ends[last - 1, e] = True
                if last < rows and number % 3 != 2:
                    self.last_reward[last, e] = 1.0 if number % 2 == 0 else -1.0
                row, number = last + 1, number + 1
        self.action = t % 4
        self.reward = t + 1000.0 * env + 0.5  # shaped: tells nothing of the task's reward
        code = torch.stack([t % 256, t // 256, env], dim=-1).to(torch.uint8)
        self.image = code[:, :, None, None].expand(rows, envs, SIZE, SIZE, 3).permute(
            0, 1, 4, 2, 3)
        self.segmentation = ((7 * t + env) % 256).to(torch.uint8)[..., None, None].expand(
            rows, envs, SIZE, SIZE)
        self.depth = ((t % 50) / 5.0 + env / 10)[..., None, None].expand(rows, envs, SIZE, SIZE)

    def rollout(self, first, steps):
        now, seen = slice(first, first + steps), slice(first, first + steps + 1)
        return Rollout(
            Observation(self.image[seen], GOAL_TABLE, self.goal_index[seen],
                        self.last_action[seen], self.last_reward[seen]),
            self.starts[seen], self.action[now], self.reward[now], self.terminated[now],
            self.truncated[now], self.valid[now], None,
            {'depth': self.depth[seen], 'segmentation': self.segmentation[seen]})

    def fill(self, replay, rows, steps=7, first=0):
        """Extend a memory by rows first..first+rows-1; the remainder is a shorter rollout."""
        for begin in range(first, first + rows, steps):
            replay.extend(self.rollout(begin, min(steps, first + rows - begin)))
        return replay


def memory(capacity=60, **options):
    return Replay(capacity, ENVS, SIZE, GOAL_TABLE, goal_segmentation=GOAL_CLASSES, **options)


LENGTHS = ((13, 1, 4), (2, 30, 9), (45, 3))


def decode(image):
    """Row and environment [...] that a picture [...,3,S,S] tells."""
    code = image[..., 0, 0].long()
    return code[..., 0] + 256 * code[..., 1], code[..., 2]


def test_ids_above_255_come_back_as_they_went_in(tmp_path):
    stream = Stream(LENGTHS, 60)
    stream.segmentation = (stream.segmentation.int() + 40_000).to(torch.uint16)
    for folder in (None, tmp_path / 'replay'):
        replay = stream.fill(memory(label_type=torch.uint16, directory=folder), 40)
        window = replay.windows(200, 8, draws())
        assert window.privileged['segmentation'].dtype == torch.uint16
        assert torch.equal(window.privileged['segmentation'],
                           stream.segmentation[decode(window.observation.image)])
        assert replay.nbytes == Replay.bytes_needed(60, ENVS, SIZE, label_type=torch.uint16)
    assert memory().nbytes < replay.nbytes  # one byte a pixel where it is enough
    with pytest.raises(UserError, match=r'segmentations of this memory are torch\.uint8'):
        stream.fill(memory(), 40)
    with pytest.raises(UserError, match='replay files fit the memory'):
        memory(directory=tmp_path / 'replay')


@pytest.mark.parametrize('rows', [25, 60, 61, 217, 300])
def test_windows_are_exact(rows):
    stream = Stream(LENGTHS, rows + 10)
    replay = stream.fill(memory(), rows)
    oldest, newest, length = max(0, rows - 60), rows - 1, 8
    window = replay.windows(400, length, draws())
    row, env = decode(window.observation.image)
    assert bool((env == env[0]).all()) and set(env[0].tolist()) == {0, 1, 2}
    assert int(row.min()) >= oldest and int(row.max()) <= newest
    here = (row, env)
    for name in ('goal_index', 'last_action', 'last_reward'):
        assert torch.equal(getattr(window.observation, name), getattr(stream, name)[here])
    assert torch.equal(window.observation.image, stream.image[here])
    assert torch.equal(window.starts, stream.starts[here])
    assert torch.equal(window.privileged['segmentation'], stream.segmentation[here])
    depth = window.privileged['depth']
    assert depth.dtype == torch.uint8
    assert float((depth.float() * 10 / 255 - stream.depth[here]).abs().max()) < 0.02
    goal = stream.goal_index[here]
    assert torch.equal(window.privileged['goal_segmentation'], GOAL_CLASSES[goal])
    assert torch.equal(window.observation.goals[window.observation.goal_index],
                       GOAL_TABLE[goal])
    for column in range(400):
        first, e = int(row[0, column]), int(env[0, column])
        end = min(int(stream.end[first, e]), newest)
        n = min(length, end - first)
        assert n >= 1
        assert row[:, column].tolist() == [min(first + k, first + n) for k in range(length + 1)]
        assert window.valid[:, column].tolist() == [k < n for k in range(length)]
        if n < length:  # nothing more of this episode is stored
            assert first == max(int(stream.begin[first, e]), oldest)
        past = slice(first, first + n)
        for name in ('action', 'reward', 'terminated', 'truncated'):
            got = getattr(window, name)[:, column]
            assert torch.equal(got[:n], getattr(stream, name)[past, e])
            if name != 'action':
                assert not got[n:].any()
    assert window.state is None and window.value is None and window.log_probability is None


def test_rollouts_chain_without_storing_an_observation_twice():
    stream = Stream(((200,),), 101)
    replay = Replay(100, 1, SIZE, GOAL_TABLE)
    stream.fill(replay, 100, steps=10)
    assert replay.count == 100 and replay.steps == 99  # the newest waits for what follows it
    row, _ = decode(replay.windows(200, 25, draws()).observation.image)
    assert torch.equal(row - row[0], torch.arange(26)[:, None].expand(26, 200))


def test_an_environment_begun_anew_is_not_chained_to_what_was_before():
    stream = Stream(((50,), (50,), (50,)), 60)
    replay = stream.fill(memory(), 20)
    stream.fill(replay, 20)  # reset in the middle of an episode: row 0 again, `starts`
    window = replay.windows(300, 10, draws())
    row, _ = decode(window.observation.image)
    step = row[1:] - row[:-1]
    assert torch.equal(step == 1, window.valid) and bool(((step == 0) | window.valid).all())
    assert bool(window.valid.all())  # both stretches are long enough


def test_trap_3_short_episodes_still_fill_the_windows():
    """Episodes of 13 steps against windows of 20: the published code drew nothing."""
    stream = Stream(((13,), (13,), (5,)), 62)
    replay = stream.fill(memory(), 60, steps=20)
    window = replay.windows(300, 20, draws())
    row, env = decode(window.observation.image)
    frames = window.valid.sum(0)
    assert not window.valid.all(0).any() and int(frames.min()) >= 1
    whole = (row[0] == stream.begin[row[0], env[0]]) & (stream.end[row[0], env[0]] < 60)
    assert torch.equal(frames[whole], torch.tensor([13, 13, 5])[env[0][whole]])
    # Padding does not reach the returns: they bootstrap from the true last observation.
    value = row.float()
    returns = n_step_returns(torch.zeros_like(window.reward), value, window.terminated,
                             window.truncated, window.valid, gamma=1.0)
    last = row[-1].expand_as(returns).float()
    ended = window.terminated.any(0).expand_as(returns)
    expected = torch.where(ended, 0.0, last)
    assert torch.equal(returns[window.valid], expected[window.valid])


def test_trap_4_the_last_pixel_change_is_against_the_true_last_frame():
    """The step that ends an episode changes the picture by 1; the next episode by far more."""
    stream = Stream(((6,), (6,), (6,)), 120)
    episode = torch.arange(120) // 7
    within = torch.arange(120) % 7
    code = (30 * (episode % 5) + within).to(torch.uint8)
    stream.image = code[:, None, None, None, None].expand(120, ENVS, 3, SIZE, SIZE)
    replay = stream.fill(memory(), 60)
    window = replay.windows(200, 9, draws())
    change = pixel_change(window.observation.image, cell=2, cells=2)
    ends = window.terminated | window.truncated
    assert int(ends.sum()) > 100
    assert torch.allclose(change[ends], torch.tensor(1 / 255), atol=1e-6)
    assert torch.allclose(change[window.valid], torch.tensor(1 / 255), atol=1e-6)
    assert not change[~window.valid].any()


def test_trap_6_memory_stays_small():
    for size, limit in ((84, 2e9), (174, 6e9)):
        assert Replay.bytes_needed(2000, 16, size) < limit
    replay = memory()
    assert replay.nbytes == Replay.bytes_needed(60, ENVS, SIZE)
    pictures = {name: ring for name, ring in replay.rings.items()
                if ring.nbytes >= 60 * ENVS * SIZE * SIZE}
    assert set(pictures) == {'image', 'depth', 'segmentation'}  # no goals for each step
    assert all(ring.dtype == torch.uint8 for ring in pictures.values())
    Stream(LENGTHS, 30).fill(replay, 20)
    assert replay.goals.data_ptr() == GOAL_TABLE.data_ptr()
    window = replay.windows(4, 5, draws())
    assert window.observation.goals.data_ptr() == GOAL_TABLE.data_ptr()
    assert window.privileged['depth'].dtype == torch.uint8


def test_trap_11_class_colours_are_averaged_and_never_classes():
    generator = draws(2)
    labels = torch.randint(0, 2, (2, 14, 14), generator=generator, dtype=torch.uint8) * 4
    colours = label_colours(5)
    target = label_target(labels, colours, cells=3, cell=4)
    assert target.shape == (2, 3, 3, 3)
    for n in range(2):
        for y in range(3):
            for x in range(3):
                cell = labels[n, 1 + 4 * y:5 + 4 * y, 1 + 4 * x:5 + 4 * x]
                total = sum(colours[int(label)] for label in cell.flatten())
                assert torch.allclose(target[n, :, y, x], total / 16, atol=1e-6)
    # Only classes 0 (black) and 4 occur: no cell points into the direction of another colour.
    share = target.amax(1, keepdim=True) / colours[4].max()
    assert torch.allclose(target, share * colours[4][:, None, None], atol=1e-6)


def test_every_stored_step_is_drawn_equally_often():
    stream = Stream(((9,), (19,), (4,)), 61)
    replay = stream.fill(memory(), 60)
    window = replay.windows(30_000, 30, draws())  # longer than any episode: one window for each
    row, env = decode(window.observation.image)
    begin, counted = torch.unique(torch.stack([env[0], row[0]]), dim=1, return_counts=True)
    length = torch.minimum(stream.end[begin[1], begin[0]], torch.tensor(59)) - begin[1]
    assert int(length.sum()) == replay.steps
    expected = 30_000 * length / replay.steps
    deviation = ((counted - expected) ** 2 / expected).sum() / (len(length) - 1)
    assert 0.3 < float(deviation) < 2.0  # chi-squared over its degrees of freedom


@pytest.mark.parametrize('rows', [40, 213])
def test_reward_frames_are_exact(rows):
    stream = Stream(LENGTHS, rows + 10)
    replay = stream.fill(memory(), rows)
    seen, label = replay.reward_frames(300, draws())
    row, env = decode(seen.image)
    assert row.shape == (3, 300) and bool((env == env[0]).all())
    assert int(row.min()) >= max(0, rows - 60) and int(row.max()) < rows - 1
    for name in ('goal_index', 'last_action', 'last_reward'):
        assert torch.equal(getattr(seen, name), getattr(stream, name)[row, env])
    last, column = row[-1], env[-1]
    begin = stream.begin[last, column]
    for back in (1, 2):
        assert torch.equal(row[2 - back], torch.maximum(last - back, begin))
    assert bool(stream.valid[last, column].all())
    sign = stream.last_reward[last + 1, column]
    assert torch.equal(label, torch.tensor([2, 0, 1])[sign.long() + 1])
    assert int((label == 0).sum()) == 100
    assert {1, 2} <= set(label.tolist())


@pytest.mark.parametrize(('batch', 'unrewarded', 'without'), [
    (16, 1 / 3, 5), (9, 1 / 3, 3), (16, 0.5, 8), (4, 0.0, 0), (4, 1.0, 4)])
def test_the_ratio_of_rewards_is_fixed(batch, unrewarded, without):
    replay = Stream(LENGTHS, 70).fill(memory(), 60)
    for seed in range(5):
        _, label = replay.reward_frames(batch, draws(seed), unrewarded=unrewarded)
        assert int((label == 0).sum()) == without and len(label) == batch


def test_without_rewards_all_samples_are_unrewarded_and_the_other_way_round():
    replay = Stream(((80,), (80,), (80,)), 70).fill(memory(), 60)
    _, label = replay.reward_frames(12, draws())
    assert label.tolist() == [0] * 12
    always = Stream(((1,), (1,), (1,)), 12)
    always.last_reward[1::2] = 1.0
    _, label = always.fill(memory(), 9).reward_frames(12, draws())
    assert label.tolist() == [1] * 12


def test_equal_generators_draw_equal_batches():
    replay = Stream(LENGTHS, 130).fill(memory(), 120)
    one, other = draws(7), draws(7)
    for _ in range(3):
        a, b = replay.windows(16, 20, one), replay.windows(16, 20, other)
        assert torch.equal(a.observation.image, b.observation.image)
        assert torch.equal(a.reward, b.reward) and torch.equal(a.valid, b.valid)
        (a, label), (b, same) = replay.reward_frames(16, one), replay.reward_frames(16, other)
        assert torch.equal(a.image, b.image) and torch.equal(label, same)
    assert not torch.equal(replay.windows(16, 20, draws(7)).reward,
                           replay.windows(16, 20, draws(8)).reward)


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
from test_replay import Stream, memory
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


def test_rollouts_that_do_not_fit_are_refused():
    stream = Stream(LENGTHS, 90)
    with pytest.raises(UserError, match='extend it first'):
        memory().windows(4, 5, draws())
    with pytest.raises(UserError, match='extend it first'):
        memory().reward_frames(4, draws())
    with pytest.raises(UserError, match='at most 60 steps'):
        memory().extend(stream.rollout(0, 61))
    with pytest.raises(UserError, match='table'):
        Replay(60, ENVS, SIZE, GOAL_TABLE + 1).extend(stream.rollout(0, 5))
    rollout = stream.rollout(0, 5)
    del rollout.privileged['depth']
    with pytest.raises(UserError, match='bring depth'):
        memory().extend(rollout)
    with pytest.raises(UserError, match='oracle_action'):
        memory(privileged=('oracle_action',))


def test_a_memory_keeps_what_it_is_asked_to():
    stream = Stream(LENGTHS, 60)
    replay = stream.fill(Replay(60, ENVS, SIZE, GOAL_TABLE, privileged=()), 40)
    assert replay.windows(4, 5, draws()).privileged == {}


def test_depth_is_stored_in_steps_of_a_255th():
    depth = torch.tensor([0.0, 10.0, 5.0, 30.0, float('inf'), float('nan')])
    assert encode_depth(depth).tolist() == [0, 255, 128, 255, 255, 255]
    assert encode_depth(torch.tensor([7], dtype=torch.uint8)).tolist() == [7]


@pytest.mark.parametrize('grey', [True, False])
def test_pixel_change_equals_a_naive_loop(grey):
    images = torch.randint(0, 256, (3, 2, 3, 11, 11), generator=draws(), dtype=torch.uint8)
    change = pixel_change(images, cell=2, cells=4, grey=grey)  # a crop of 8: rows 1 to 8
    assert change.shape == (2, 2, 4, 4) and change.dtype == torch.float32
    for t in range(2):
        for b in range(2):
            for y in range(4):
                for x in range(4):
                    total = 0.0
                    for i in range(1 + 2 * y, 3 + 2 * y):
                        for j in range(1 + 2 * x, 3 + 2 * x):
                            now, then = (images[t + k, b, :, i, j].tolist() for k in (1, 0))
                            difference = [p - q for p, q in zip(now, then, strict=True)]
                            if grey:
                                luma = (0.299, 0.587, 0.114)
                                total += abs(sum(w * d for w, d in
                                                 zip(luma, difference, strict=True)))
                            else:
                                total += sum(map(abs, difference)) / 3
                    assert float(change[t, b, y, x]) == pytest.approx(total / 4 / 255, abs=1e-6)


@pytest.mark.parametrize(('size', 'cells'), [(84, 20), (172, 42), (174, 42)])
def test_targets_have_the_sizes_of_the_thesis(size, cells):
    images = torch.zeros(2, 1, 3, size, size, dtype=torch.uint8)
    images[1] = 255
    change = pixel_change(images)
    assert change.shape == (1, 1, cells, cells) and bool((change > 0.999).all())
    depth = torch.arange(size, dtype=torch.float32).expand(1, 1, size, size)
    target = average_pool_target(depth, cells)
    margin = (size - 4 * cells) // 2
    assert target.shape == (1, 1, cells, cells)
    assert target[0, 0, 0].tolist() == [margin + 4 * k + 1.5 for k in range(cells)]
    with pytest.raises(UserError, match='fit into the picture'):
        average_pool_target(depth, cells + 2)


@pytest.mark.parametrize('count', [1, 2, 5, 12, 57])
def test_colours_lie_farther_apart_than_by_chance_or_on_a_wheel_of_hues(count):
    def gap(rgb):
        """Least distance in the HSB cone, from RGB by another road than the code's."""
        points = []
        for colour in rgb.tolist():
            hue, saturation, brightness = colorsys.rgb_to_hsv(*colour)
            angle = torch.tensor(hue * 2 * torch.pi)
            points.append([float(angle.cos()) * saturation * brightness,
                           float(angle.sin()) * saturation * brightness, brightness])
        return float(torch.pdist(torch.tensor(points)).min())
    colours = label_colours(count)
    assert colours.shape == (count, 3) and colours.dtype == torch.float32
    assert 0 <= float(colours.min()) and float(colours.max()) <= 1
    assert not colours[0].any() and torch.equal(colours, label_colours(count))
    if count > 1:
        black = torch.zeros(1, 3)
        hues = [colorsys.hsv_to_rgb(k / (count - 1), 1.0, 1.0) for k in range(count - 1)]
        others = [torch.rand(count - 1, 3, generator=draws(seed)) for seed in range(50)]
        for other in (torch.tensor(hues), *others):
            assert gap(colours) > gap(torch.cat([black, other])) - 1e-6
    with pytest.raises(UserError, match='1 to 65536 classes'):
        label_colours(65_537)


def test_the_colours_of_published_weights_are_as_they_were():
    """Of up to 64 classes, whatever more classes take."""
    digests = {5: 'c3dca6a10fc89f47', 57: 'adf4c80da5958f0c', 64: 'f528bdb54742cb04'}
    assert {count: hashlib.sha256(label_colours(count).numpy().tobytes()).hexdigest()[:16]
            for count in digests} == digests


@pytest.mark.parametrize('count', [65, 100, 190, 256, 257, 700, 1500])
def test_many_colours_are_as_far_apart_as_balls_can_be_packed(count):
    """The volume of the cone over their number says how far apart they can be inside it."""
    colours = label_colours(count)
    points = []
    for colour in colours.tolist():
        hue, saturation, brightness = colorsys.rgb_to_hsv(*colour)
        turn, chroma = 2 * math.pi * hue, saturation * brightness
        points.append([chroma * math.cos(turn), chroma * math.sin(turn), brightness])
    gap = float(torch.pdist(torch.tensor(points, dtype=torch.float64)).min())
    densest = (math.sqrt(2) * (math.pi / 3) / count) ** (1 / 3)
    assert gap > 0.95 * densest and not colours[0].any()
    assert 0 <= float(colours.min()) and float(colours.max()) <= 1
    assert torch.equal(colours, label_colours(count))
    # They are 8-bit pictures of this many colours, too.
    assert len({tuple(row) for row in (colours * 255).round().int().tolist()}) == count
