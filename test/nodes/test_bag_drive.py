"""`vn_nav bag drive`: the real policy node along a recorded drive, and how two of them differ."""

import dataclasses
import json
import math
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import rclpy
from foreign_readers import assert_every_reader_accepts
from geometry_msgs.msg import Twist
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from ros_harness import wait_until, write_checkpoint
from shadow_drives import (
    BASE,
    FOREIGN,
    NAMES,
    ROBOT,
    STORE,
    WALLS,
    scanned_drive,
    two_drives,
)
from small_bags import FIXTURE, ODOMETRY, START, drive, odometry, write
from small_search import write_small_search

from vn_msgs_py.images import decode_rgb
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.roles import Topics, load_topics
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.bags.shadow.compare import read_shadow
from vn_nav.bags.shadow.plan import make_plan
from vn_nav.bags.storage.reader import read_bag
from vn_nav.bags.storage.stream import messages
from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.nodes import shadow_domain
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.robot import DRIVE_ACTIONS, load_robot


def test_what_cannot_be_driven_is_one_line(tmp_path, capsys):
    checkpoint = str(write_checkpoint(tmp_path / 'policy', size=84))
    cut = tmp_path / 'cut'
    shutil.copytree(FIXTURE, cut)
    file, = cut.glob('*.mcap')
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    late = write(tmp_path / 'late.mcap', [
        (name, kind, time + (1 << 62), message) for name, kind, time, message in drive(2.0)])
    wrong = write(tmp_path / 'wrong.mcap', [
        ('/image_raw', ODOMETRY, START, odometry(START, 0.0)),
        ('/odom', ODOMETRY, START, odometry(START, 0.0))])
    blind = write(tmp_path / 'blind.mcap', [m for m in drive(2.0) if m[0] != '/image_raw'])
    narrow = tmp_path / 'narrow.mcap'
    messages = drive(2.0)
    for _, kind, _, message in messages:
        if kind.endswith('CameraInfo'):
            message.k[0] = 100.0
    write(narrow, messages)
    text = tmp_path / 'goal.png'
    text.write_text('no picture')
    for words, expected in (
            ([cut], 'recover'), ([tmp_path / 'nowhere'], 'nowhere'), ([late], '2038'),
            ([wrong], 'sensor_msgs/msg/Image'), ([blind], '--topics'), ([narrow], 'deg'),
            ([FIXTURE, '--goal', text], 'goal.png'), ([FIXTURE, '--robot', text], 'robot'),
            ([FIXTURE, '--compare', tmp_path], 'config.json'),
            ([FIXTURE, '--scan-topic', 'scan'], 'search with a map'),
            ([FIXTURE, '--out', tmp_path], 'folder of its own')):
        out = [] if '--out' in words else ['--out', tmp_path / 'out']
        code = main(['bag', 'drive', *map(str, [*words, *out]), '--checkpoint', checkpoint])
        error = capsys.readouterr().err
        assert code == 2 and error.count('\n') == 1, error
        assert expected in error
    assert not (tmp_path / 'out').exists()


def test_a_policy_with_a_map_takes_other_cameras_and_ranges_that_are_there(tmp_path, capsys):
    checkpoint = str(write_small_search(tmp_path / 'policy'))
    scanned = write(tmp_path / 'scanned.mcap', scanned_drive(40.0))
    for words, expected in (
            ([FIXTURE, '--scan-topic', 'front/scan'], 'front/scan'),
            ([FIXTURE, '--scan-topic', 'odom'], 'LaserScan'),
            ([scanned], '50 to 120 deg')):
        assert main(['bag', 'drive', *map(str, words), '--checkpoint', checkpoint, '--out',
                     str(tmp_path / 'out')]) == 2
        error = capsys.readouterr().err
        assert error.count('\n') == 1 and expected in error, error
    assert not (tmp_path / 'out').exists()


@pytest.fixture
def stranger():
    """Makes a node on a ROS domain."""
    made = []

    def make(domain, *, listens_to=None):
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        node = rclpy.create_node('stranger', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        made.append((context, node, executor))
        if listens_to:
            node.create_subscription(Twist, listens_to, lambda _: None, 10)
        return node
    yield make
    for context, node, executor in made:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.ros
def test_a_domain_where_somebody_is_is_not_taken(stranger, monkeypatch):
    monkeypatch.setattr(shadow_domain, 'DISCOVERY_S', 60.0)  # ends with the first one found
    stranger(231)
    with pytest.raises(UserError, match='231: .*stranger'):
        shadow_domain.Domain([231])
    monkeypatch.setattr(shadow_domain, 'DISCOVERY_S', 0.1)
    with (shadow_domain.Domain(range(225, 230)) as one,
          shadow_domain.Domain(range(225, 231)) as other):
        assert one.number != other.number and one.namespace != other.namespace
        with pytest.raises(UserError, match='another shadow'):
            shadow_domain.Domain([one.number])


def alone(runtime, drives, robot):
    """What a policy says of a drive's steps, asked without ROS."""
    goal = drives.goals[drives.goal[-1]]
    runtime.set_goal(np.array(goal))
    choices, before = [], NO_ACTION
    for image, action in zip(drives.image, drives.action, strict=True):
        runtime.correct(before)
        choice = runtime.act(np.array(image))
        choices.append('arrived' if runtime.arrived else robot.action_names[choice])
        before = int(action)
    return choices


def said_in(folder):
    """All that does not come by the wall clock, topic by topic."""
    records = sorted(read_bag(folder), key=lambda record: record.topic)
    return [(r.topic, r.stamp, STORE.serialize_cdr(r.message, r.message.__msgtype__).tobytes())
            for r in records if not r.topic.endswith('diagnostics')]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_node_says_along_a_bag_what_the_policy_says_without_ros(tmp_path, capfd):
    first = write_checkpoint(tmp_path / 'first')
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    arguments = ['bag', 'drive', str(FIXTURE), '--robot', str(BASE), '--checkpoint', str(first)]
    assert main([*arguments, '--compare', str(sure), '--out', str(tmp_path / 'both')]) == 0
    said = capfd.readouterr().out
    assert 'shadow' in said and 'first against sure' in said
    drives = load_drives(FIXTURE, Wanted(ROBOT), tmp_path / 'cache')
    a, b = (read_shadow(tmp_path / 'both' / name) for name in 'ab')
    expected = alone(PolicyRuntime(first), drives, ROBOT)
    assert [answer.choice for answer in a.answers] == expected and len(set(expected)) > 1
    assert [answer.choice for answer in b.answers] == ['arrived'] * len(expected)
    assert [answer.done for answer in a.answers[:-1]] == [
        DRIVE_ACTIONS[action] for action in drives.action[:-1]]
    found = json.loads((tmp_path / 'both' / 'comparison.json').read_text())
    assert found['decisions'] == len(expected) and found['agree'] == 0.0
    assert len(found['arrived']['b']) == len(expected) and not found['arrived']['a']
    assert found['mean_dv'] + found['mean_dw'] > 0.1 and found['latency']['b']['median'] > 0
    assert 'first against sure' in (tmp_path / 'both' / 'comparison.md').read_text()
    # Within the base's limits, and where the policy stands by its own word it stands.
    base = load_robot(BASE)
    sent = np.array(list(a.commands.values()))
    assert len(sent) > 80 and sent.any()
    assert np.abs(sent[:, 0]).max() <= base.max_linear + 1e-9
    rise = np.abs(np.diff(sent, axis=0))
    assert rise[:, 0].max() <= base.linear_acceleration / 20 + 1e-6
    assert rise[:, 2].max() <= base.angular_acceleration / 20 + 1e-6
    assert not np.array(list(b.commands.values())).any()
    # The stamps are the bag's, nothing in it can reach a base, and everybody can read it.
    pictures = {r.stamp for r in read_bag(FIXTURE, ('image_raw',))}
    assert {answer.time for answer in a.answers} <= pictures
    where = [json.loads(r.message.data)['odometry'] for r in read_bag(
        tmp_path / 'both' / 'a', ('shadow/executed_action',))]
    assert np.array(where) == pytest.approx(np.array(drives.pose), abs=1e-6)
    odometries = {r.stamp for r in read_bag(FIXTURE, ('odom',))}
    assert a.commands.keys() <= pictures | odometries
    assert {r.topic.split('/')[0] for r in read_bag(tmp_path / 'both' / 'a')} == {'shadow'}
    assert_every_reader_accepts(tmp_path / 'both' / 'a')
    # Again, and the same.
    assert main([*arguments, '--out', str(tmp_path / 'again')]) == 0
    assert said_in(tmp_path / 'again') == said_in(tmp_path / 'both' / 'a')


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_node_acts_behind_the_filter_and_says_how_often(tmp_path, capfd):
    """In its diagnostics, and in the report: what `PolicyRuntime` counts on the same drive."""
    checkpoint = write_checkpoint(tmp_path / 'policy', heads=('goal_pose',), pose_to_memory=True,
                                  moves=ROBOT.moves)
    assert main(['bag', 'drive', str(FIXTURE), '--robot', str(BASE), '--checkpoint',
                 str(checkpoint), '--out', str(tmp_path / 'out')]) == 0
    said, shadow = capfd.readouterr().out, read_shadow(tmp_path / 'out')
    runtime = PolicyRuntime(checkpoint)
    expected = alone(runtime, load_drives(FIXTURE, Wanted(ROBOT), tmp_path / 'cache'), ROBOT)
    assert [answer.choice for answer in shadow.answers] == expected
    assert shadow.filtered == dataclasses.asdict(runtime.filter_counts)
    assert shadow.filtered['decisions'] == len(expected)
    assert f'acted at {shadow.filtered["acted"]} of {len(expected)} decisions' in said


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_foreign_drive_towards_a_picture(tmp_path, capfd):
    """JPEG pictures, no camera_info, a goal from a file."""
    (tmp_path / 'topics.yaml').write_text(NAMES)
    goal = np.random.default_rng(0).integers(0, 255, (84, 84, 3), np.uint8)
    cv2.imwrite(str(tmp_path / 'goal.png'), goal[:, :, ::-1])
    checkpoint = write_checkpoint(tmp_path / 'policy')
    assert main(['bag', 'drive', str(FOREIGN), '--checkpoint', str(checkpoint), '--topics',
                 str(tmp_path / 'topics.yaml'), '--goal', str(tmp_path / 'goal.png'), '--decoding',
                 'greedy', '--out', str(tmp_path / 'out')]) == 0
    assert '1 by --goal' in capfd.readouterr().out
    shown, = read_bag(tmp_path / 'out', ('shadow/goal_image',))
    assert np.array_equal(decode_rgb(shown.message), goal)
    robot = dataclasses.replace(ROBOT, camera_fov=math.radians(90))
    drives = load_drives(FOREIGN, Wanted(robot, topics=load_topics(tmp_path / 'topics.yaml')),
                         tmp_path / 'cache')
    drives.goals, drives.goal[:] = goal.transpose(2, 0, 1)[None], 0
    assert [answer.choice for answer in read_shadow(tmp_path / 'out').answers] == alone(
        PolicyRuntime(checkpoint, decoding='greedy'), drives, ROBOT)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_two_episodes_by_commands_alone(tmp_path, capfd):
    """No odometry, a clock that goes back in between, and a policy that always has arrived."""
    bag = write(tmp_path / 'bag.mcap', [m for m in two_drives() if m[0] != '/odom'])
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    assert main(['bag', 'drive', str(bag), '--checkpoint', str(sure), '--out',
                 str(tmp_path / 'out')]) == 0
    assert '2 last pictures of episodes' in capfd.readouterr().out
    plan = make_plan(bag, ROBOT, Topics())
    answers = read_shadow(tmp_path / 'out').answers
    assert [(a.episode, a.choice) for a in answers] == [
        (d.episode, 'arrived') for d in plan.decisions] and len(answers) > 4
    shown = list(read_bag(tmp_path / 'out', ('shadow/goal_image',)))
    assert len(shown) == 2
    for episode, record in enumerate(shown):
        assert np.array_equal(decode_rgb(record.message), plan.goals.picture(episode).picture)
    said = [r.message.data for r in read_bag(tmp_path / 'out', ('shadow/arrived',))]
    assert sum(said) == len(answers) and said[-1]


def last_map(folder):
    """Percent of an obstacle at places on the map after the last decision, -1: unknown."""
    message = list(read_bag(folder, ('shadow/policy_node/map',)))[-1].message
    cells = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    origin = message.info.origin
    yaw = 2 * math.atan2(origin.orientation.z, origin.orientation.w)
    c, s = math.cos(yaw), math.sin(yaw)

    def at(x, y):
        x, y = x - origin.position.x, y - origin.position.y
        return cells[int((c * y - s * x) / message.info.resolution),
                     int((c * x + s * y) / message.info.resolution)]
    return at


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_map_takes_the_scans_of_the_bag(tmp_path, capfd):
    """Of a narrow camera whose pictures show nothing: the wall ahead is in the scans alone."""
    bag = write(tmp_path / 'bag.mcap', scanned_drive())
    checkpoint = write_small_search(tmp_path / 'policy')
    arguments = ['bag', 'drive', str(bag), '--checkpoint', str(checkpoint)]
    with_scans = ['--scan-topic', 'scan', '--scan-x', '0.1', '--scan-yaw', str(math.pi)]
    assert main([*arguments, '--out', str(tmp_path / 'seen')]) == 0
    assert 'measured' not in capfd.readouterr().out
    for name in ('measured', 'again'):
        assert main([*arguments, *with_scans, '--out', str(tmp_path / name)]) == 0
    decisions = len(read_shadow(tmp_path / 'measured').answers)
    assert decisions >= 3 and f'measured ranges at {decisions} of' in capfd.readouterr().out
    # By odometry, whose frame begins where the robot did.
    seen, measured = (last_map(tmp_path / name) for name in ('seen', 'measured'))
    wall = [(WALLS[0], y) for y in np.arange(-1.2, 1.21, 0.1)]
    known = [[max(at(x + off, y) for off in (-0.1, 0.0, 0.1)) > 80 for x, y in wall]
             for at in (seen, measured)]
    assert np.mean(known[0]) < 0.2 and np.mean(known[1]) > 0.9
    inside = [measured(x, y) for x in np.arange(0.5, 2.6, 0.3) for y in np.arange(-1.2, 1.3, 0.3)]
    assert all(0 <= cell < 40 for cell in inside)
    assert said_in(tmp_path / 'again') == said_in(tmp_path / 'measured')
    assert_every_reader_accepts(tmp_path / 'measured')


@pytest.fixture
def long_drive(tmp_path):
    """A drive of five minutes, under way: the process, its output, and the second bag."""
    bag = write(tmp_path / 'bag.mcap', drive(300.0), chunk=1 << 20)
    checkpoint = write_checkpoint(tmp_path / 'policy')
    out, log = tmp_path / 'out', tmp_path / 'log'
    with open(log, 'w') as file:
        process = subprocess.Popen(
            [sys.executable, '-m', 'vn_nav.cli', 'bag', 'drive', str(bag), '--checkpoint',
             str(checkpoint), '--out', str(out)], stdout=file, stderr=subprocess.STDOUT)

    def decided():
        return (out / 'metadata.yaml').exists() and sum(
            1 for _ in messages(out, ['shadow/action'], strict=False)) > 2
    try:
        wait_until(lambda: process.poll() is not None or decided(), lambda: time.sleep(0.2), 200)
        assert process.poll() is None, log.read_text()
        yield process, log, out
    finally:
        process.kill()
        process.wait()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_a_whole_bag(long_drive, number):
    process, log, out = long_drive
    process.send_signal(number)
    assert process.wait(30) == 130, log.read_text()
    assert 'whole' in log.read_text() and 'Traceback' not in log.read_text()
    assert_every_reader_accepts(out)
    assert 0 < len(read_shadow(out).answers) < 180


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize('listens', [False, True])
def test_somebody_who_comes_ends_it(long_drive, stranger, listens):
    process, log, out = long_drive
    words = log.read_text().split()
    domain = int(words[words.index('domain') + 1].rstrip(','))
    namespace = words[words.index('namespace') + 1].rstrip(':')
    stranger(domain, listens_to=f'{namespace}/shadow/cmd_vel' if listens else None)
    assert process.wait(30) == 2, log.read_text()
    said = log.read_text()
    # Who listens is known at times before its node's name is.
    assert 'stranger' in said or listens and 'which listens to' in said
    assert 'Traceback' not in said
    assert_every_reader_accepts(out)
