"""`vn_nav bag doctor`: each fault is found, with its place and a remedy; sound bags have none."""

import dataclasses
import importlib.util
import json
import math
import re

import numpy as np
import pytest
from small_bags import (
    FIXTURE,
    IMAGE,
    INFO,
    ODOMETRY,
    START,
    STORE,
    STRING,
    TWIST,
    camera_info,
    drive,
    make,
    odometry,
    picture,
    records,
    serialised,
    twist,
    write,
)

from vn_nav import cli
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.doctor.checks import ERROR, WARNING, diagnose
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.roles import Topics, load_topics
from vn_nav.robot import RobotSpec

FAR = 60_000_000_000  # ns

# `bag export` wants it before it looks at the bag; only `make test-all` installs it.
LEROBOT = importlib.util.find_spec('av') is not None


def changed(messages, topic, change):
    """The messages with those of a topic changed; `change` returns None for one to leave out."""
    done = []
    for message in messages:
        new = change(*message) if message[0] == topic else message
        if new is not None:
            done.append(new)
    return done


def restamped(by, after=0.5):
    """A change of header stamps [ns], `after` s from the start on."""
    def change(topic, kind, time, message):
        if time >= START + after * 1e9:
            stamp = message.header.stamp
            total = stamp.sec * 10**9 + stamp.nanosec + by
            stamp.sec, stamp.nanosec = divmod(total, 10**9)
        return topic, kind, time, message
    return change


def unstamped(topic, kind, time, message):
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return topic, kind, time, message


def pixels_of(value):
    def change(topic, kind, time, message):
        if time >= START + 1e9:
            message = picture(time - 5_000_000, np.full((32, 32, 3), value, np.uint8))
        return topic, kind, time, message
    return change


def still(topic, kind, time, _):
    return topic, kind, time, odometry(time - 1_000_000, 0.0)


def longer(topic, kind, time, message):
    message.k[0] = 2 * message.width  # 28 deg
    return topic, kind, time, message


def slow(topic, kind, time, message):
    return (topic, kind, time, message) if (time - START) // 50_000_000 % 5 == 0 else None


def gone(*_):
    return None


def between(first, last):
    def change(topic, kind, time, message):
        inside = START + first * 1e9 <= time < START + last * 1e9
        return None if inside else (topic, kind, time, message)
    return change


def as_type(kind, message):
    return lambda topic, _, time, __: (topic, kind, time, message)


def later(topic, kind, time, message):
    return topic, kind, time + (FAR if time > START + 2e9 else 0), message


def earlier(topic, kind, time, message):
    return topic, kind, time - (FAR if time > START + 2e9 else 0), message


def repeated(topic, kind, time, message):
    return topic, kind, time, odometry(START + (time - START) // 200_000_000 * 200_000_000,
                                       (time - START) * 3e-10)


def raw(encoding, side=32):
    def change(topic, kind, time, message):
        if time > START + 1e9:
            message = picture(time, np.zeros((side, side, 3), np.uint8) + 90 + np.arange(
                side, dtype=np.uint8)[:, None], encoding)
        return topic, kind, time, message
    return change


CASES = {  # topic that is changed, how, and what is found: severity, topic, words, s
    'black': ('/image_raw', pixels_of(0), WARNING, '/image_raw', 'is black', 1.5),
    'one colour': ('/image_raw', pixels_of(130), WARNING, '/image_raw', 'one colour', 1.5),
    'frozen': ('/image_raw', pixels_of(130), ERROR, '/image_raw', 'stays the same', 1.5),
    'static': ('/odom', still, ERROR, '/odom', 'never moves, although', None),
    'not finite': ('/odom', as_type(ODOMETRY, odometry(START, math.nan)), ERROR, '/odom',
                   'finite', 0.0),
    'no camera': ('/image_raw', gone, ERROR, '', 'no camera picture', None),
    'no odometry': ('/odom', gone, WARNING, '', 'no odometry', None),
    'no camera_info': ('/camera_info', gone, WARNING, '', 'no camera calibration', None),
    'uncalibrated': ('/camera_info', as_type(INFO, camera_info(START, 0.0)), WARNING,
                     '/camera_info', 'focal length of 0', 0.006),
    'pause': ('/image_raw', between(1.0, 3.0), WARNING, '/image_raw', 'pauses for up to 2', 3.0),
    'slow odometry': ('/odom', slow, ERROR, '/odom', 'comes at 4.0 Hz: ', None),
    'stamps go back': ('/odom', restamped(-300_000_000), WARNING, '/odom', 'go back', 0.5),
    'stamps twice': ('/odom', repeated, WARNING, '/odom', 'same stamp', 0.05),
    'no stamps': ('/image_raw', unstamped, ERROR, '/image_raw', 'stamps of zero', None),
    'clock jumps': ('/odom', restamped(FAR), ERROR, '/odom', 'jumps by 60.0 s', 0.5),
    'clocks differ': ('/image_raw', restamped(-800_000_000, 0), ERROR, '/image_raw',
                      'earlier than /', None),
    'recorder set back': ('/odom', earlier, ERROR, '/odom', 'set back', None),
    'wrong type': ('/odom', as_type(STRING, make(STRING)), ERROR, '/odom',
                   'is std_msgs/msg/String, not nav_msgs', None),
    'unknown encoding': ('/image_raw', raw('magic8'), ERROR, '/image_raw', 'encoding', 1.1),
    'another size': ('/image_raw', raw('rgb8', 40), ERROR, '/image_raw', 'changes to rgb8 40',
                     1.1),
    'no message': ('/odom', as_type(ODOMETRY, b'\0\1\0\0' + bytes(9)), ERROR, '/odom', 'is none',
                   0.0),
}


def test_a_sound_recording_has_no_findings(tmp_path):
    found = diagnose(write(tmp_path / 'a.mcap', drive()), fov=math.radians(90))
    assert found.findings == [] and found.usable and found.seconds == pytest.approx(3.95, 0.01)
    odom, image = (next(t for t in found.topics if t.topic == name)
                   for name in ('/odom', '/image_raw'))
    assert (odom.count, odom.rate, odom.worst_gap) == (80, pytest.approx(20), pytest.approx(0.05))
    assert image.pictures == ['rgb8 32 x 32'] and image.lag == pytest.approx(0.005)
    assert image.unordered == 0 and image.repeated == 0 and image.bytes > 40 * 32 * 32 * 3
    assert diagnose(FIXTURE).findings == []


@pytest.mark.parametrize('case', CASES)
def test_each_fault_is_found_where_it_is(tmp_path, case):
    topic, change, severity, place, words, when = CASES[case]
    sent = changed(drive(), topic, change)
    found = diagnose(write(tmp_path / 'a.mcap', sent))
    hits = [f for f in found.findings
            if f.severity == severity and f.topic == place and re.search(words, f.what)]
    assert hits, found.findings
    assert all(f.remedy for f in found.findings)
    assert found.usable == all(f.severity != ERROR for f in found.findings)
    if when is not None:
        assert hits[0].when == pytest.approx(when, abs=0.52)


def test_a_camera_too_narrow_for_the_policy_is_an_error(tmp_path):
    path = write(tmp_path / 'a.mcap', drive())
    found = diagnose(path, fov=math.radians(120))
    assert [(f.topic, f.severity) for f in found.findings] == [('/camera_info', ERROR)]
    assert '90 deg' in found.findings[0].what and '120' in found.findings[0].what
    assert diagnose(path, fov=math.radians(120), any_lens=True).findings == []
    narrow = write(tmp_path / 'b.mcap', changed(drive(), '/camera_info', longer))
    found = diagnose(narrow, fov=math.radians(90), any_lens=True)
    assert [(f.topic, f.severity) for f in found.findings] == [('/camera_info', ERROR)]
    assert 'horizontally' in found.findings[0].what


def test_a_standing_robot_may_show_the_same_picture(tmp_path):
    sent = changed(changed(drive(), '/odom', still), '/image_raw', pixels_of(90))
    assert not any('stays the same' in f.what
                   for f in diagnose(write(tmp_path / 'a.mcap', sent)).findings)


@pytest.mark.parametrize('clock', ['rosgraph_msgs/msg/Clock', None])
def test_simulated_time_is_not_compared_with_the_recorders(tmp_path, clock):
    sent = drive()
    if clock:
        sent.append(('/clock', clock, START + 5 * 10**9, make(clock)))
    for topic in ('/odom', '/image_raw', '/camera_info'):
        sent = changed(sent, topic, restamped(-START + 10**9, 0))
    assert diagnose(write(tmp_path / 'a.mcap', sent)).findings == []


def test_topics_of_other_names_are_proposed_and_taken(tmp_path):
    names = {'/image_raw': '/cam/image', '/odom': '/base/odom', '/camera_info': '/cam/info',
             '/cmd_vel': '/nav/cmd_vel'}
    sent = [(names[topic], *rest) for topic, *rest in drive()]
    path = write(tmp_path / 'a.mcap', sent)
    first = diagnose(path).findings
    assert any('image: /cam/image' in f.remedy for f in first)
    assert any('odometry: /base/odom' in f.remedy for f in first)
    topics = dataclasses.replace(Topics(), image='/cam/image', odometry='base/odom',
                                 camera_info='/cam/info', command='/nav/cmd_vel')
    assert diagnose(path, topics=topics).findings == []


def test_damage_is_found_beside_what_is_still_there(tmp_path):
    path = write(tmp_path / 'a.mcap', drive())
    data = bytearray(path.read_bytes())
    at, length = [(at, length) for at, op, length in records(data) if op == 6][3]
    data[at + 9 + length // 2] ^= 0xFF
    path.write_bytes(data[:-100])
    found = diagnose(path)
    assert sum('recover' in f.remedy for f in found.findings) >= 2 and not found.usable
    assert any(f'byte {at}' in f.what for f in found.findings)
    assert sum(t.count for t in found.topics) > 140


def test_the_command_prints_a_table_and_writes_json(tmp_path, capsys):
    path = write(tmp_path / 'a.mcap', changed(drive(), '/odom', still))
    figures = tmp_path / 'figures.json'
    assert cli.main(['bag', 'doctor', str(path), '--json', str(figures)]) == 1
    told = capsys.readouterr().out
    assert '/image_raw' in told and 'error: /odom never moves' in told
    written = json.loads(figures.read_text())
    assert written['usable'] is False and written['findings'][0]['topic'] == '/odom'
    sound = write(tmp_path / 'b.mcap', drive())
    assert cli.main(['bag', 'doctor', str(sound)]) == 0
    assert 'nothing is wrong' in capsys.readouterr().out
    assert cli.main(['bag', 'doctor', str(tmp_path / 'nothing')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_the_doctor_of_graphs_looks_at_bags_too(tmp_path, capsys):
    path = write(tmp_path / 'a.mcap', changed(drive(), '/odom', still))
    page, figures = tmp_path / 'page.html', tmp_path / 'figures.json'
    words = ['--html', str(page), '--json', str(figures)]
    assert cli.main(['doctor', '--bag', str(path), *words]) == 1
    assert 'error: /odom never moves' in capsys.readouterr().out
    assert '/odom never moves' in page.read_text()
    assert json.loads(figures.read_text())['usable'] is False
    sound = write(tmp_path / 'b.mcap', drive())
    assert cli.main(['doctor', '--bag', str(sound), '--strict', *words]) == 0
    assert 'Nothing is wrong' in page.read_text()
    # No camera_info: a warning.
    bare = write(tmp_path / 'c.mcap', changed(drive(), '/camera_info', gone))
    assert cli.main(['doctor', '--bag', str(bare)]) == 0
    assert cli.main(['doctor', '--bag', str(bare), '--strict']) == 1


def test_commands_alone_serve_and_a_robot_that_is_never_told_to_move_is_found(tmp_path):
    sent = changed(changed(drive(), '/odom', gone), '/cmd_vel', as_type(TWIST, twist(0.0)))
    found = diagnose(write(tmp_path / 'a.mcap', sent))
    assert any(f.topic == '/cmd_vel' and 'never moves' in f.what for f in found.findings)
    assert IMAGE in {t.type for t in found.topics}


def set_back(messages, topics, recorder=False):
    """The messages and, behind them, others with the same stamps: a simulator that was reset."""
    again = [(topic, kind, time if recorder else time + FAR, message)
             for topic, kind, time, message in drive(seed=1) if topic in topics]
    late = [] if recorder else [
        (topic, kind, time + FAR, restamped(FAR, 0)(topic, kind, time, message)[3])
        for topic, kind, time, message in drive(seed=2) if topic not in topics
        and topic != '/cmd_vel']
    return messages + sorted(again + late, key=lambda m: m[2])


@pytest.mark.parametrize('recorder', [False, True])
def test_a_clock_that_was_set_back_everywhere_ends_an_episode_and_is_no_error(tmp_path, recorder):
    every = ('/image_raw', '/odom', '/camera_info', '/cmd_vel')
    found = diagnose(write(tmp_path / 'a.mcap', set_back(drive(), every, recorder)))
    hits = [f for f in found.findings if 'set back by' in f.what]
    assert {f.topic for f in hits} >= {'/image_raw', '/odom'} and found.usable, found.findings
    assert all('episode ends there' in f.remedy and f.severity == WARNING for f in hits)


def test_a_clock_that_was_set_back_on_one_topic_alone_is_an_error(tmp_path):
    found = diagnose(write(tmp_path / 'a.mcap', set_back(drive(), ('/odom',))))
    assert any(f.severity == ERROR and f.topic == '/odom' and 'set back' in f.what
               and 'chrony' in f.remedy for f in found.findings), found.findings


@pytest.mark.parametrize('clock', ['rosgraph_msgs/msg/Clock', 'rosgraph_msgs/Clock', None])
def test_a_pause_in_simulated_time_is_not_blamed_on_the_disk(tmp_path, clock):
    sent = changed(drive(), '/image_raw', between(1.0, 3.0))
    assert 'disk' in diagnose(write(tmp_path / 'a.mcap', sent)).findings[0].remedy
    if clock:
        sent.append(('/clock', clock, START + 5 * 10**9, make('rosgraph_msgs/msg/Clock')))
        definition = {clock: STORE.generate_msgdef('rosgraph_msgs/msg/Clock', ros_version=2)[0]}
        sent[-1] = (*sent[-1][:3], serialised('rosgraph_msgs/msg/Clock', sent[-1][3]))
    else:
        definition = None
        for topic in ('/odom', '/image_raw', '/camera_info'):
            sent = changed(sent, topic, restamped(-START + 10**9, 0))
    (finding,) = diagnose(write(tmp_path / 'b.mcap', sent, definitions=definition)).findings
    assert 'pauses' in finding.what and 'disk' not in finding.remedy


def test_types_without_msg_are_the_same_types(tmp_path):
    short = [(topic, kind.replace('/msg/', '/'), time, serialised(kind, message))
             for topic, kind, time, message in drive()]
    definitions = {kind.replace('/msg/', '/'): STORE.generate_msgdef(kind, ros_version=2)[0]
                   for kind in (IMAGE, ODOMETRY, INFO, TWIST)}
    path = write(tmp_path / 'a.mcap', short, definitions=definitions)
    assert diagnose(path).findings == []
    assert len(load_drives(path, Wanted(RobotSpec()), tmp_path / 'cache')) > 1


def test_a_ros_1_mcap_is_named_as_such_by_every_command(tmp_path, capsys):
    sent = [(topic, kind.replace('/msg/', '/'), time, b'') for topic, kind, time, _ in drive(1.0)]
    path = write(tmp_path / 'a.mcap', sent, schema='ros1msg', encoding='ros1',
                 definitions={kind: '' for _, kind, _, _ in sent})
    (finding,) = diagnose(path).findings
    assert finding.severity == ERROR and 'recording of ROS 1' in finding.what
    assert 'rosbags-convert --src FILE.bag' in finding.remedy
    export = [['export', '--lerobot', str(tmp_path / 'out')]] if LEROBOT else []
    for command in (['show'], *export):
        assert cli.main(['bag', command[0], str(path), *command[1:]]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert 'recording of ROS 1' in line and 'rosbags-convert' in line


@pytest.mark.parametrize('role, topic, kind', [
    ('odometry', '/amcl_pose', 'geometry_msgs/msg/PoseWithCovarianceStamped'),
    ('command', '/joy', 'sensor_msgs/msg/Joy'),
    ('depth', '/depth/compressedDepth', 'sensor_msgs/msg/CompressedImage')])
def test_a_topic_of_another_type_is_one_error_in_every_command(
        tmp_path, capsys, role, topic, kind):
    sent = drive(1.0) + [(topic, kind, START + k * 10**8, bytes(64)) for k in range(5)]
    bag, names = write(tmp_path / 'a.mcap', sent), tmp_path / 'topics.yaml'
    names.write_text(f'{role}: {topic}\n')
    commands = [['teach', str(bag), '--out', str(tmp_path / 'o')],
                ['pretrain', str(bag), '--out', str(tmp_path / 'o')]]
    if role != 'depth':  # which these do not use
        commands += [['bag', 'show', str(bag), '--out', str(tmp_path / 'x.html')],
                     *([['bag', 'export', str(bag), '--lerobot', str(tmp_path / 'l')]]
                       if LEROBOT else [])]
    for command in commands:
        assert cli.main([*command, '--topics', str(names)]) == 2, command
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert f'the {role} of a bag is' in line and f'{topic}: {kind}' in line
    found = diagnose(bag, topics=load_topics(names))
    (finding,) = (f for f in found.findings if f.topic == topic and f'is {kind}, not' in f.what)
    assert f'{role}: null' in finding.remedy  # the other of odometry and commands is there


def test_what_the_reader_went_on_with_is_noted(tmp_path, capsys):
    path, figures = tmp_path / 'a.mcap', tmp_path / 'figures.json'
    write(path, drive(), enable_crcs=False)
    assert cli.main(['bag', 'doctor', str(path), '--json', str(figures)]) == 0
    told = ' '.join(capsys.readouterr().out.split())
    (note,) = diagnose(path).notes
    assert 'no checksums' in note and f'note: {note}' in told and 'ok: nothing' in told
    assert json.loads(figures.read_text())['notes'] == [note]
    write(path, drive(1.0), finish=False)
    data = path.read_bytes()
    at = 17 + int.from_bytes(data[9:17], 'little')  # behind the header
    path.write_bytes(data[:at] + b'\x99' + (5).to_bytes(8, 'little') + b'mine!' + data[at:])
    assert cli.main(['bag', 'doctor', str(path)]) == 1
    told = ' '.join(capsys.readouterr().out.split())
    assert any('0x99 (14 bytes)' in note and note in told for note in diagnose(path).notes)
    assert diagnose(write(tmp_path / 'b.mcap', drive(1.0))).notes == []
