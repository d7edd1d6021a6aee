"""`vn_nav bag show`: its page, its bounds, and what it says that a policy would have done."""

import json
import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from ros_harness import write_checkpoint
from small_bags import FIXTURE, IMAGE, START, drive, odometry, picture, write

from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive import Frame
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.report.agreement import END, OTHER, STOP, judge
from vn_nav.bags.report.figures import (
    MAX_BINS,
    MAX_PATH_POINTS,
    MAX_STRIP_PICTURES,
    Film,
    Odometer,
    Timeline,
    Ways,
)
from vn_nav.bags.report.page import show_page
from vn_nav.bags.report.page_charts import _series
from vn_nav.bags.report.show import show
from vn_nav.bags.roles import Topics
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.bags.storage.reader import read_bag
from vn_nav.cli import main
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
SECOND = 10**9  # ns


class Page(HTMLParser):
    """Addresses, words and the table cells of a page."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.words, self.open = [], [], []
        self.feed(text)
        assert not self.open, f'elements without an end: {self.open}'

    def handle_starttag(self, tag, attributes):
        self.addresses += [value for name, value in attributes if name in ('src', 'href')]
        if tag not in ('img', 'meta', 'br', '!doctype'):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def turning_drive(goals=(), curve=()):
    """A drive of 12 s: 30 degrees to the left, half a metre, and so on; in a `curve` both."""
    chance, messages, x, y, yaw = np.random.default_rng(0), [], 0.0, 0.0, 0.0
    for k in range(240):
        time = START + k * SECOND // 20
        curved = k // 20 in curve
        if k % 40 < 20 or curved:
            yaw += math.radians(30) / 20
        if k % 40 >= 20 or curved:
            x, y = x + 0.025 * math.cos(yaw), y + 0.025 * math.sin(yaw)
        pose = odometry(time, x, yaw)
        pose.pose.pose.position.y = y
        messages.append(('/odom', pose.__msgtype__, time, pose))
        if k % 2 == 0:
            pixels = chance.integers(0, 256, (40, 40, 3), np.uint8)
            messages.append(('/image_raw', IMAGE, time, picture(time, pixels)))
    for at in goals:
        time = START + round(at * SECOND)
        pixels = chance.integers(0, 256, (40, 40, 3), np.uint8)
        messages.append(('/goal_image', IMAGE, time, picture(time, pixels)))
    return sorted(messages, key=lambda m: m[2])


def test_the_page_is_one_file_and_tells_what_the_bag_holds(tmp_path, capsys):
    out = tmp_path / 'page.html'
    assert main(['bag', 'show', str(FIXTURE), '--out', str(out)]) == 0
    assert str(out) in capsys.readouterr().out and [p.name for p in tmp_path.iterdir()] == [
        'page.html']
    text = out.read_text()
    page, words = Page(text), ' '.join(Page(text).words)
    assert page.addresses and all(a.startswith('data:image/png;base64,') for a in page.addresses)
    assert 'http' not in text and '<script' not in text and 'nan' not in text
    names = json.loads(next(iter(read_bag(FIXTURE, ('action_names',)))).message.data)
    recorded = [names[r.message.data] for r in read_bag(FIXTURE, ('action',))]
    for name in set(recorded):
        said = int(re.search(rf'{name.replace("_", " ")} (\d+) \(', words).group(1))
        assert recorded.count(name) - 1 <= said <= recorded.count(name)
    for topic in ('/image_raw', '/odom', '/cmd_vel', '/scene'):
        assert topic in words
    assert 'goal of episode 1' in words and 'finds nothing wrong' in words
    assert 'What the policy would have done' not in words


def test_words_of_a_bag_are_not_html(tmp_path):
    messages = turning_drive()
    bag = write(tmp_path / '<b>&x.mcap', [*messages, ('/<i>a&b', *messages[0][1:])])
    text = show_page(str(bag), show(bag, topics=Topics(), robot=ROBOT))
    assert '<i>a' not in text and '<b>&x' not in text and '/&lt;i&gt;a&amp;b' in text
    Page(text)


def test_the_film_and_the_path_are_where_the_robot_was(tmp_path):
    bag = write(tmp_path / 'a.mcap', turning_drive(goals=(0.0, 6.0)))
    shown = show(bag, topics=Topics(), robot=ROBOT)
    assert sorted(shown.ways) == [0, 1] and shown.goals.count == len(shown.goals.shown) == 2
    assert shown.odometer.metres == pytest.approx(3.0, abs=0.1)
    assert shown.odometer.turned == pytest.approx(math.pi, abs=0.1)
    assert len(shown.film) == MAX_STRIP_PICTURES
    poses = {round(m[2] * 1e-9, 3): m[3].pose.pose.position for m in turning_drive()
             if m[0] == '/odom'}
    for shot in shown.film:
        there = poses[round(shot.time, 3)]
        assert shot.pose[:2] == pytest.approx([there.x, there.y], abs=1e-6)
    gaps = np.diff([shot.progress for shot in shown.film])
    assert gaps.max() < 2 * gaps.min()
    assert shown.report.actions[DRIVE_ACTIONS.index('forward')] == 6
    assert shown.report.actions[DRIVE_ACTIONS.index('rotate_left')] == 6
    times, rate = shown.rates.rate('/odom')
    assert rate == pytest.approx(20, abs=2.1) and times[-1] > 11


def test_velocities_are_those_of_commands_and_odometry(tmp_path):
    messages = drive(seconds=6, speed=0.3)
    for topic, _, time, message in messages:
        if topic == '/odom' and time > START + 3 * SECOND:
            message.twist.twist.linear.x = 0.2
    shown = show(write(tmp_path / 'a.mcap', messages), topics=Topics(), robot=ROBOT)
    times, values = shown.velocities.values('measured vx')
    known = np.isfinite(values[:, 0])
    assert np.allclose(values[known & (times < 2.9), 0], 0)
    assert np.allclose(values[known & (times > 3.2), 0], 0.2)
    assert np.nanmax(np.abs(shown.velocities.values('commanded vx')[1] - 0.3)) < 1e-9
    curve = _series('commanded', *shown.velocities.values('commanded vx'),
                    shown.velocities.width)
    assert np.allclose(curve.mean, 0.3)  # a command every 0.2 s holds until the next


def test_a_command_that_nobody_repeats_ends():
    line = Timeline(0.05)
    line.add('commanded vx', 0, 0.4)
    line.add('commanded vx', 3 * SECOND, 0.4)
    curve = _series('commanded', *line.values('commanded vx'), line.width)
    assert np.allclose(curve.mean[curve.x < 0.5], 0.4)
    assert np.allclose(curve.mean[(curve.x > 0.7) & (curve.x < 2.9)], 0)


def test_a_timeline_keeps_its_sums_when_it_runs_out_of_room():
    chance, line = np.random.default_rng(0), Timeline(0.5)
    times = np.sort(chance.integers(0, 4000 * SECOND, 3000))
    numbers = chance.normal(size=3000)
    for at, number in zip(times, numbers, strict=True):
        line.add('a', int(at), float(number))
    centres, values = line.values('a')
    assert len(centres) <= MAX_BINS and line.width == 32
    own = ((times - times[0]) * 1e-9 / line.width).astype(int)
    for k in np.unique(own):
        here = numbers[own == k]
        assert values[k] == pytest.approx([here.mean(), here.min(), here.max()])
    _, rate = line.rate('a')
    assert rate[:-1].mean() == pytest.approx(3000 / 4000, rel=0.02)


def frame(k, pose, episode=0):
    message = picture(START + k, np.full((4, 4, 3), k % 256, np.uint8))
    return Frame(message, k * 0.1, k * 0.1, np.array(pose, float), episode, episode)


def test_what_is_kept_of_a_long_drive_is_bounded():
    film, ways, odometer = Film(), Ways(), Odometer()
    for k in range(20_000):
        angle = k * 0.002
        one = frame(k, (3 * math.cos(angle), 3 * math.sin(angle), 0.0), k // 5000)
        odometer.go(one)
        film.add(one, odometer.progress)
        ways.add(one)
        assert len(film._shots) < 4 * MAX_STRIP_PICTURES and ways._points <= 2.5 * MAX_PATH_POINTS
    shots = film.shots()
    assert len(shots) == MAX_STRIP_PICTURES and shots[0].time == 0
    assert shots[-1].time == pytest.approx(1999.9)
    gaps = np.diff([shot.progress for shot in shots])
    assert gaps.max() < 2 * gaps.min()
    way = ways.ways()
    assert sorted(way) == [0, 1, 2, 3] and sum(map(len, way.values())) <= MAX_PATH_POINTS + 4
    assert all(np.allclose(np.hypot(*w[:, :2].T), 3) for w in way.values())
    assert odometer.metres == pytest.approx(20_000 * 0.006, rel=0.01)


def test_episodes_without_end_are_bounded_and_a_standing_robot_shows_one_picture():
    film, ways, odometer = Film(), Ways(), Odometer()
    for k in range(3 * MAX_PATH_POINTS):
        one = frame(k, (k % 7, 0, 0), k)
        odometer.go(one)
        film.add(one, odometer.progress)
        ways.add(one)
    assert sum(map(len, ways.ways().values())) <= MAX_PATH_POINTS and odometer.metres == 0
    assert len(film.shots()) == MAX_STRIP_PICTURES
    film = Film()
    for k in range(100):
        film.add(frame(k, (0, 0, 0)), 0.0)
    assert len(film.shots()) == 1


def test_a_policy_is_told_what_was_done_and_judged_as_in_training(tmp_path):
    bag = write(tmp_path / 'a.mcap', turning_drive(goals=(0.0, 6.0), curve=(2, 3)))
    checkpoint = load_checkpoint(write_checkpoint(tmp_path / 'model', size=36))
    found = judge(bag, checkpoint, ROBOT, Topics())
    drives = load_drives(bag, Wanted(ROBOT, 36), tmp_path / 'cache')
    assert found.hindsight == 0 and found.table.sum() == len(drives) == len(found.steps)
    at = 0
    for steps in drives.episodes():
        # The same in one go, as the learner does it.
        done = drives.action[steps].astype(np.int64)
        before = np.concatenate([[NO_ACTION], done[:-1]])
        goals = torch.from_numpy(np.array(drives.goals[drives.goal[steps][-1:]]))
        network = checkpoint.network
        with torch.inference_mode():
            output, _ = network(
                Observation(torch.from_numpy(np.array(drives.image[steps]))[:, None], None, None,
                            torch.from_numpy(before)[:, None], torch.zeros(len(done), 1)),
                torch.from_numpy(before == NO_ACTION)[:, None], network.initial_state(1),
                network.encode_goals(goals))
        sure = torch.softmax(output.logits[:, 0], -1).numpy()
        for k, judged in enumerate(found.steps[at:at + len(done)]):
            assert judged.sure == pytest.approx(sure[k].max(), abs=1e-5)
            assert judged.would == DRIVE_ACTIONS[sure[k].argmax()]
            if done[k] != NO_ACTION:
                assert judged.done == DRIVE_ACTIONS[done[k]]
                assert judged.done_sure == pytest.approx(sure[k][done[k]], abs=1e-5)
            else:
                assert judged.done in (OTHER, END)
        at += len(done)
    assert sum(j.done == OTHER for j in found.steps) >= 1
    same = sum(j.done == j.would for j in found.steps)
    assert found.share == pytest.approx(same / found.counted)
    gaps = [d.judged.sure - d.judged.done_sure for d in found.worst]
    assert gaps == sorted(gaps, reverse=True) and len(gaps) == min(8, found.counted - same)


def test_a_bag_without_goals_is_judged_towards_its_last_picture(tmp_path):
    bag = write(tmp_path / 'a.mcap', turning_drive())
    checkpoint = load_checkpoint(write_checkpoint(tmp_path / 'model', size=36, arrival=0.9,
                                                  stop_threshold=0.5))
    found = judge(bag, checkpoint, ROBOT, Topics())
    assert found.hindsight == 1 and found.columns[-1] == STOP
    assert found.table[:, -1].sum() == found.table.sum() and found.share == 0  # always arrived
    assert all(d.hindsight for d in found.worst)
    last = load_drives(bag, Wanted(ROBOT, 36), tmp_path / 'cache').image[-1].transpose(1, 2, 0)
    assert all(np.array_equal(d.goal, last) for d in found.worst)
    assert found.steps[0].sure == pytest.approx(0.9, abs=1e-3)


def test_the_page_of_a_policy(tmp_path):
    folder, out = write_checkpoint(tmp_path / 'model', size=36), tmp_path / 'page.html'
    assert main(['bag', 'show', str(FIXTURE), '--out', str(out), '--checkpoint',
                 str(folder)]) == 0
    page = Page(out.read_text())
    words = ' '.join(page.words)
    assert 'What the policy would have done' in words and 'the policy agrees' in words
    assert 'Where it disagrees most' in words and re.search(r'All \d+ steps', words)


@pytest.mark.parametrize('words, expected', [
    (['/nowhere'], 'bag'),
    ([str(FIXTURE), '--out', 'TMP/no/page.html'], 'folder'),
    ([str(FIXTURE), '--checkpoint', '/nowhere'], 'checkpoint'),
    ([str(FIXTURE), '--robot', '/nowhere'], 'robot'),
    ([str(FIXTURE), '--topics', 'TMP/topics.yaml'], '--topics'),
    (['TMP/cut.mcap'], 'recover'),
])
def test_bad_input_is_one_line_and_leaves_no_page(tmp_path, capsys, words, expected):
    (tmp_path / 'topics.yaml').write_text('image: /camera\n')
    whole = write(tmp_path / 'cut.mcap', drive()).read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[:len(whole) // 2])
    words = [word.replace('TMP', str(tmp_path)) for word in words]
    if '--out' not in words:
        words += ['--out', str(tmp_path / 'page.html')]
    assert main(['bag', 'show', *words]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and expected in said, said
    assert not list(tmp_path.rglob('*.html'))
