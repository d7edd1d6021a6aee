"""The replay memory and the pictures' targets: stored values tell their environment and row."""

import pytest
import torch
from replay_stream import (
    ENVS,
    GOAL_CLASSES,
    GOAL_TABLE,
    LENGTHS,
    SIZE,
    Stream,
    decode,
    draws,
    memory,
)

from vn_nav.errors import UserError
from vn_nav.learning.pixel_change import label_colours, label_target, pixel_change
from vn_nav.learning.replay import Replay
from vn_nav.learning.replay_rings import encode_depth
from vn_nav.learning.returns import n_step_returns


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
