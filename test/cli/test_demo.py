"""The demo for real, small: every figure of result.json is counted again from its bag."""

import json
import math
import os
import re

import numpy as np
import pytest
from paths import ROOT
from ros_harness import write_checkpoint
from rosbags.highlevel import AnyReader

from vn_nav.cli import main
from vn_nav.cli.demo import ANY_HOUSE, ONE_HOUSE, SEED, control_env
from vn_nav.cli.world import make_env
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.report.trial_page import SHOWN
from vn_nav.resources import share_file

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(240)]  # drives over ROS


@pytest.fixture(scope='module')
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp('demo') / 'out'
    assert main(['demo', '--out', str(folder), '--episodes', '4', '--unseen-episodes', '2']) == 0
    return folder


def counted(folder):
    """Episodes by stamps alone, without the code that made result.json."""
    begins, ends, rewards, touches, poses = [], [], [], [], []
    with AnyReader([folder]) as reader:
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            match connection.topic:
                case '/episode':
                    begins.append((stamp, json.loads(message.data)))
                case '/episode_end':
                    ends.append((stamp, message.data))
                case '/reward':
                    rewards.append((stamp, message.data))
                case '/collision':
                    touches.append((stamp, message.data))
                case '/ground_truth/odom':
                    time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
                    position = message.pose.pose.position
                    poses.append((time, position.x, position.y))
    poses = np.array(poses)
    for k, (stamp, facts) in enumerate(begins):
        until = begins[k + 1][0] if k + 1 < len(begins) else math.inf
        end = begins[k + 1][1]['stamp'] if k + 1 < len(begins) else math.inf
        own = poses[(poses[:, 0] >= facts['stamp'] - 1e-6) & (poses[:, 0] < end - 1e-6)]
        path = np.hypot(*np.diff(own[:, 1:], axis=0).T).sum()
        decisions = sum(stamp < s < until + 3e6 for s, _ in rewards) - sum(
            stamp < s < stamp + 3e6 for s, _ in rewards)
        collisions = sum(v for s, v in touches if stamp + 3e6 < s < until + 3e6)
        # A stop elsewhere terminates an episode as well, without a reward.
        gained = sum(v for s, v in rewards if stamp + 3e6 < s < until + 3e6)
        success = [v for s, v in ends if stamp + 3e6 < s < until + 3e6] == [1] and gained > 0
        shortest = max(facts['start_distance'] - 0.6, 0)
        yield facts['max_decisions'], success, decisions, collisions, (
            success * shortest / max(path, shortest, 1e-9))


def test_every_figure_is_in_the_bag(demo):
    result = json.loads((demo / 'result.json').read_text())
    assert set(result) >= {'trained', 'unseen', 'seconds', 'bag', 'html'}
    episodes = list(counted(demo / result['bag']))
    for place, own, count in (('trained', episodes[:4], 4), ('unseen', episodes[4:], 2)):
        figures = result[place]
        assert {e[0] for e in own} == {figures['max_decisions']} == {300}
        assert len(own) == figures['episodes'] == count
        assert figures['success'] == pytest.approx(np.mean([e[1] for e in own]))
        assert figures['spl'] == pytest.approx(np.mean([e[4] for e in own]), abs=1e-6)
        assert figures['collisions'] == pytest.approx(
            sum(e[3] for e in own) / sum(e[2] for e in own))
        assert figures['random']['episodes'] == count


def test_declared_stops_are_counted_from_the_bag(tmp_path):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    assert main(['demo', '--out', str(tmp_path / 'out'), '--checkpoint', str(sure),
                 '--episodes', '2', '--unseen-episodes', '1']) == 0
    result = json.loads((tmp_path / 'out' / 'result.json').read_text())
    for place in ('trained', 'unseen'):
        for figures in (result[place], result[place]['without_ros']):
            assert (figures['success'], figures['declared'], figures['false_stops'],
                    figures['reached'], figures['decisions']) == (0, 1, 1, 0, 1)
        assert result[place]['stop'] == 'declared' and 'declared' in result[place]['random']
    with AnyReader([tmp_path / 'out' / 'bag']) as reader:
        said = [reader.deserialize(data, connection.msgtype).data
                for connection, _, data in reader.messages(
                    [c for c in reader.connections if c.topic == '/arrived'])]
    assert sum(said) == 3  # and False again at each goal, and where a node ends


def test_the_recorder_has_each_house_from_its_first_picture(demo):
    """The policy drives only when the recorder hears everything: a decision needs a picture."""
    pictures, decisions, begins = [], [], []
    with AnyReader([demo / 'bag']) as reader:
        for connection, stamp, _ in reader.messages():
            kept = {'/image_raw': pictures, '/action': decisions, '/episode': begins}
            kept.get(connection.topic, []).append(stamp)
    for first in (begins[0], begins[4]):
        seen = next(stamp for stamp in pictures if stamp > first)
        assert seen < next(stamp for stamp in decisions if stamp > first)


def test_the_page_is_whole_and_needs_nothing_else(demo):
    page = (demo / 'report.html').read_text()
    assert page.count('<svg') == 2 + SHOWN, 'a map of each house, and ways of the trial'
    assert 'On a base that is late and slips' in page and page.count('data:image/png') > 10
    assert '<script' not in page and 'src="http' not in page and '<link' not in page
    assert 'nan' not in re.sub(r'data:[^"]*', '', page)


def test_the_bridges_own_account_agrees(demo):
    """Cross-check: what the simulator says of each episode, against what the bag shows."""
    own = []
    with AnyReader([demo / 'bag']) as reader:
        wanted = [c for c in reader.connections if c.topic == '/episode_result']
        for connection, _, data in reader.messages(connections=wanted):
            own.append(json.loads(reader.deserialize(data, connection.msgtype).data))
    for said, seen in zip(own, counted(demo / 'bag'), strict=True):
        assert (said['success'], said['decisions'], said['collisions']) == seen[1:4]


def test_the_control_without_ros_is_shown_the_goal_pictures_of_the_bag(demo):
    for place, (drive, scene, model) in zip(
            ('trained', 'unseen'), zip(drives_from_bag(demo / 'bag', pictures=True),
                                       ('house:7', 'house:11000'), (ONE_HOUSE, ANY_HOUSE),
                                       strict=True), strict=True):
        checkpoint, limit = load_checkpoint(share_file(model)), 300
        env = control_env(make_env, checkpoint, scene, len(drive.episodes), limit)
        seen, info = env.reset(seed=SEED)
        for k, recorded in enumerate(drive.episodes):
            np.testing.assert_array_equal(recorded.goal_picture.transpose(2, 0, 1),
                                          env.goals[seen['goal_index'][k]], err_msg=place)
            assert recorded.facts['start'] == info['pose'][k].tolist()
            # The recorder may meet the camera (best effort) only after the first pictures: on a
            # loaded machine discovery takes as long as some dozen decisions in lock-step.
            numbers = list(range(1, recorded.episode.decisions + 1))
            assert list(recorded.pictures) == numbers[-len(recorded.pictures):]
            assert len(recorded.pictures) > 0
            assert k == 0 or len(recorded.pictures) == len(numbers)


@pytest.mark.parametrize('simulator', ['examples.corridor', 'gltf'])
def test_it_drives_in_a_scene_of_another_simulator(tmp_path, monkeypatch, simulator):
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    scene = f'{simulator}:5'
    if simulator == 'gltf':
        file = tmp_path / 'my flat.glb'
        assert main(['house', 'export', '--seed', '5', '--rooms', '2', '--out', str(file)]) == 0
        scene = f'gltf:{file}'
    assert main(['demo', '--out', str(tmp_path), '--scene', scene, '--episodes', '1']) == 0
    result = json.loads((tmp_path / 'result.json').read_text())
    assert 'trained' not in result and result['unseen']['scene'] == scene
    assert result['unseen']['episodes'] == 1 and 0 < result['unseen']['decisions'] <= 300
    (drive,) = drives_from_bag(tmp_path / 'bag')
    assert drive.scene['simulator'] == simulator and len(drive.episodes) == 1
    page = (tmp_path / 'report.html').read_text()
    assert 'A scene it has never seen' in page and scene in page and 'house it' not in page
