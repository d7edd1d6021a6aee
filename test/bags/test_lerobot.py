"""`vn_nav bag export --lerobot`: what a reader of LeRobot's format 3.0 finds, by other means."""

import json
import sys

import numpy as np
import pytest
from small_bags import FIXTURE, IMAGE, START, TWIST, odometry, picture, twist, write

from vn_msgs_py.images import decode_rgb
from vn_nav.bags.export.lerobot import export
from vn_nav.bags.export.lerobot_layout import ACTION, CAMERA, FIRST, STATE
from vn_nav.bags.export.lerobot_stats import Colours, describe, merge
from vn_nav.bags.roles import Topics
from vn_nav.bags.storage.reader import read_bag
from vn_nav.cli import main
from vn_nav.errors import UserError


def grey(time, level, height=48, width=64):
    return picture(time, np.full((height, width, 3), level, np.uint8))


def two_episodes(goals=True):
    """Two drives of 2 s at 0.4 m/s, the second turning; each picture brighter than the last."""
    messages = []
    for part, turn in enumerate((0.0, 0.5)):
        begin, speed = START + part * 4 * 10**9, 0.4
        if goals:
            messages.append(('/goal_image', IMAGE, begin, grey(begin, 200 + part)))
        for k in range(41):
            time = begin + k * 50_000_000
            message = odometry(time, speed * k * 0.05, turn * k * 0.05)
            message.twist.twist.linear.x, message.twist.twist.angular.z = speed, turn
            messages.append(('/odom', message.__msgtype__, time + 10**6, message))
            command = twist(speed)
            command.angular.z = turn
            messages.append(('/cmd_vel', TWIST, time + 2 * 10**6, command))
            if k % 2 == 0:
                messages.append(('/image_raw', IMAGE, time + 3 * 10**6, grey(
                    time, 20 + 4 * (k // 2) + 100 * part)))
    return messages


def read(folder):
    """Everything of a dataset: info, rows, episodes, tasks, stats, frames of the video."""
    import av
    import pyarrow.parquet as parquet
    info = json.loads((folder / 'meta/info.json').read_text())
    rows = parquet.read_table(folder / 'data' / f'{FIRST}.parquet').to_pydict()
    episodes = parquet.read_table(folder / 'meta/episodes' / f'{FIRST}.parquet').to_pylist()
    tasks = parquet.read_table(folder / 'meta/tasks.parquet')
    path = folder / info['video_path'].format(video_key=CAMERA, chunk_index=0, file_index=0)
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        assert stream.average_rate == info['fps'] and stream.pix_fmt == 'yuv420p'
        frames = [(float(f.time), f.to_ndarray(format='rgb24')) for f in video.decode(stream)]
    stats = json.loads((folder / 'meta/stats.json').read_text())
    return info, {k: np.array(v) for k, v in rows.items()}, episodes, tasks, stats, frames


@pytest.fixture(scope='module')
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp('export')
    bag = write(folder / 'two.mcap', two_episodes())
    export(bag, folder / 'out', topics=Topics(), robot='standard', fps=10)
    return read(folder / 'out')


@pytest.mark.slow
def test_rows_are_a_constant_grid_and_episodes_follow_one_another(dataset):
    info, rows, episodes, tasks, _, frames = dataset
    assert info['codebase_version'] == 'v3.0' and info['fps'] == 10
    assert info['total_episodes'] == len(episodes) == 2
    assert info['total_frames'] == len(rows['index']) == len(frames) == 42
    assert info['splits'] == {'train': '0:2'} and info['total_tasks'] == tasks.num_rows == 1
    assert np.array_equal(rows['index'], np.arange(42))
    edge = 0
    for number, episode in enumerate(episodes):
        own = rows['episode_index'] == number
        assert own.sum() == episode['length'] == 21
        assert episode['dataset_from_index'] == edge
        edge = episode['dataset_to_index']
        assert np.allclose(rows['timestamp'][own], np.arange(21) / 10, atol=1e-6)
        assert np.array_equal(rows['frame_index'][own], np.arange(21))
        assert episode[f'videos/{CAMERA}/from_timestamp'] == pytest.approx(2.1 * number)
        assert episode[f'videos/{CAMERA}/to_timestamp'] == pytest.approx(2.1 * (number + 1))
    assert edge == 42


@pytest.mark.slow
def test_each_row_has_its_picture_pose_and_command(dataset):
    _, rows, _, _, _, frames = dataset
    for k, (time, frame) in enumerate(frames):
        assert time == pytest.approx(k / 10, abs=1e-3)  # what a reader seeks by
        assert frame.shape == (48, 64, 3)
        expected = 20 + 4 * (k % 21) + 100 * (k // 21)
        assert np.abs(frame.astype(int) - expected).max() <= 3
    t = rows['frame_index'] / 10
    assert np.allclose(rows[STATE][:, 0], 0.4 * t, atol=1e-3)
    turning = np.where(rows['episode_index'] == 1, 0.5, 0.0)
    assert np.allclose(rows[STATE][:, 2], turning * t, atol=1e-3)
    assert np.allclose(rows[STATE][:, 3:], np.stack([0.4 + 0 * t, 0 * t, turning], 1), atol=1e-5)
    # The first picture of a drive comes after its first command.
    assert np.allclose(rows[ACTION], rows[STATE][:, 3:], atol=1e-5)


@pytest.mark.slow
def test_statistics_are_those_of_the_rows(dataset):
    _, rows, episodes, _, stats, frames = dataset
    for name in (STATE, ACTION, 'timestamp', 'index'):
        values = rows[name].reshape(42, -1)
        assert np.allclose(stats[name]['mean'], values.mean(0), atol=1e-5)
        assert np.allclose(stats[name]['std'], values.std(0), atol=1e-5)
        assert np.allclose(stats[name]['max'], values.max(0)) and stats[name]['count'] == [42]
        assert np.allclose(episodes[1][f'stats/{name}/min'], values[21:].min(0))
    seen = np.mean([frame for _, frame in frames]) / 255
    assert np.shape(stats[CAMERA]['mean']) == (3, 1, 1) and stats[CAMERA]['count'] == [42]
    assert np.allclose(stats[CAMERA]['mean'], seen, atol=0.01)


@pytest.mark.slow
def test_the_tasks_are_the_index_that_pandas_finds(dataset):
    _, _, episodes, tasks, _, _ = dataset
    told = json.loads(tasks.schema.metadata[b'pandas'])
    assert told['index_columns'] == ['task']
    assert tasks.to_pylist() == [{'task_index': 0, 'task': episodes[0]['tasks'][0]}]
    assert 'goal picture' in episodes[0]['tasks'][0]


@pytest.mark.slow
def test_an_action_is_what_was_commanded_from_the_picture_on(tmp_path):
    messages = []
    for k in range(61):
        time = START + k * 50_000_000
        messages += [('/odom', (m := odometry(time, 0.0)).__msgtype__, time, m),
                     ('/image_raw', IMAGE, time, grey(time, 100))]
    # One command just after 1.00 s, none after it: a base stops half a second later.
    at = START + 1_010_000_000
    messages.append(('/cmd_vel', TWIST, at, twist(0.2)))
    bag = write(tmp_path / 'a.mcap', sorted(messages, key=lambda m: m[2]))
    export(bag, tmp_path / 'out', topics=Topics(), robot='standard', fps=10)
    speed = read(tmp_path / 'out')[1][ACTION][:, 0]
    expected = np.zeros(31)
    expected[10:16] = [0.18, 0.2, 0.2, 0.2, 0.2, 0.02]
    assert np.allclose(speed, expected, atol=1e-4)


@pytest.mark.slow
def test_pictures_are_repeated_or_left_out_to_keep_the_rate(tmp_path):
    bag = write(tmp_path / 'two.mcap', two_episodes(goals=False))
    for fps, count in ((25, 51), (4, 9)):
        export(bag, tmp_path / f'out{fps}', topics=Topics(), robot='standard', fps=fps)
        info, rows, episodes, _, _, frames = read(tmp_path / f'out{fps}')
        assert len(frames) == len(rows['index']) == 2 * count and len(episodes) == 2
        assert np.allclose(rows[STATE][:count, 0], 0.4 * np.arange(count) / fps, atol=1e-3)
        for k, (_, frame) in enumerate(frames[:count]):
            assert abs(frame.mean() - (20 + 40 * k / fps)) <= 2 + 1.5  # the nearest; coding
        assert episodes[0]['tasks'] == ['drive']


@pytest.mark.slow
def test_a_recorded_journey_comes_back_picture_by_picture(tmp_path):
    assert main(['bag', 'export', str(FIXTURE), '--lerobot', str(tmp_path / 'out')]) == 0
    info, rows, _, _, _, frames = read(tmp_path / 'out')
    shown = [decode_rgb(r.message) for r in read_bag(FIXTURE, ('image_raw',))]
    assert info['features'][CAMERA]['shape'] == list(shown[0].shape)
    for _, frame in frames:  # some picture of the bag, but for the coding
        assert min(np.abs(frame.astype(int) - own).mean() for own in shown) < 8
    assert len(frames) == len(rows['index'])
    assert np.isfinite(rows[STATE]).all() and np.ptp(rows[STATE][:, 0]) > 0.1


@pytest.mark.slow
def test_without_commands_actions_are_measured_and_odd_sides_lose_a_pixel(tmp_path):
    messages = [m for m in two_episodes() if m[0] not in ('/cmd_vel', '/image_raw')]
    messages += [('/image_raw', IMAGE, START + k * 10**8, grey(START + k * 10**8, 9, 33, 35))
                 for k in range(20)]
    bag = write(tmp_path / 'a.mcap', sorted(messages, key=lambda m: m[2]))
    said = export(bag, tmp_path / 'out', topics=Topics(), robot='standard', fps=10)
    info, rows, *_ = read(tmp_path / 'out')
    assert 'measured' in said and info['features'][CAMERA]['shape'] == [32, 34, 3]
    assert np.allclose(rows[ACTION][:, 0], 0.4, atol=1e-5)


@pytest.mark.slow
def test_a_damaged_picture_is_the_one_before_but_not_of_another_place(tmp_path):
    seen, messages = 0, []
    for topic, kind, time, message in two_episodes():
        seen += topic == '/image_raw'
        if topic == '/image_raw' and seen in (5, 22):  # within the first drive; the second begins
            message.step = 1
        messages.append((topic, kind, time, message))
    said = export(write(tmp_path / 'a.mcap', messages), tmp_path / 'out', topics=Topics(),
                  robot='standard', fps=10)
    _, rows, episodes, _, _, frames = read(tmp_path / 'out')
    assert '2 pictures could not be decoded' in said
    assert [e['length'] for e in episodes] == [21, 20] and len(frames) == 41
    assert frames[4][1].mean() == pytest.approx(frames[3][1].mean(), abs=1)
    assert frames[21][1].mean() == pytest.approx(124, abs=2)
    assert rows['timestamp'][21] == 0 and rows[STATE][21, 0] == pytest.approx(0.04, abs=1e-3)


@pytest.mark.slow
def test_what_cannot_be_exported_leaves_nothing_behind(tmp_path):
    def refused(bag, match, fps=10, out='out', topics=None):
        with pytest.raises(UserError, match=match):
            export(bag, tmp_path / out, topics=topics or Topics(), robot='standard', fps=fps)
        left = {path.name for path in tmp_path.iterdir()}
        assert left == {path.name for path in bags + [tmp_path / 'there']}

    messages = two_episodes()
    bags = [write(tmp_path / 'good.mcap', messages)]
    changed = [m if m[0] != '/image_raw' or m[2] < START + 10**9
               else (*m[:3], grey(m[2], 9, 24, 32)) for m in messages]
    bags.append(write(tmp_path / 'changed.mcap', changed))
    bags.append(write(tmp_path / 'blind.mcap', [
        (*m[:3], picture(m[2], np.zeros((4, 4), np.uint8), '16UC1'))
        if m[0] == '/image_raw' else m for m in messages]))
    (tmp_path / 'there').mkdir()
    refused(bags[0], 'new folder', out='there')
    refused(bags[0], 'frames a second', fps=0)
    refused(bags[0], '--topics', topics=Topics(image='camera'))
    refused(bags[1], 'one size')
    refused(bags[2], 'cannot be decoded')
    refused(tmp_path / 'nowhere', 'bag')


@pytest.mark.parametrize('package', ['av', 'pyarrow'])
def test_a_missing_extra_is_named(tmp_path, monkeypatch, capsys, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, 'av' if package == 'pyarrow' else 'pyarrow', sys)
    assert main(['bag', 'export', str(FIXTURE), '--lerobot', str(tmp_path / 'out')]) == 2
    said = capsys.readouterr().err
    assert 'vn_nav[lerobot]' in said and len(said.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_statistics_of_parts_add_up():
    chance = np.random.default_rng(0)
    values = chance.normal(3, 2, (300, 2))
    whole, parts = describe(values), merge([describe(values[:100]), describe(values[100:])])
    for name in ('min', 'max', 'mean', 'std', 'count'):
        assert np.allclose(whole[name], parts[name]), name
    assert np.allclose(whole['q50'], parts['q50'], atol=0.3)
    colours = Colours()
    pictures = chance.integers(10, 200, (5, 32, 32, 3), np.uint8)
    for one in pictures:
        colours.add(one)
    figures, few = colours.describe(), pictures[:, ::4, ::4].reshape(-1, 3) / 255
    assert np.allclose(np.ravel(figures['mean']), few.mean(0))
    assert np.allclose(np.ravel(figures['std']), few.std(0))
    assert np.allclose(np.ravel(figures['q90']), np.quantile(few, 0.9, axis=0), atol=0.02)
    assert np.allclose(np.ravel(figures['min']), few.min(0)) and figures['count'] == [5]
