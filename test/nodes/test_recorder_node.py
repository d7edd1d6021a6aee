"""recorder_node as real processes: nothing is lost unsaid, whatever ends it leaves a bag."""

import itertools
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from ros_harness import child, wait_until
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float32, String

from vn_nav.bags.storage.output import CHUNK_BYTES
from vn_nav.bags.storage.reader import read_bag
from vn_nav.nodes.qos import qos

pytestmark = pytest.mark.ros
RECORDER = 'vn_nav.nodes.recorder_node'


@pytest.fixture
def talker():
    rclpy.init()
    try:
        node = rclpy.create_node('talker')
        yield node
        node.destroy_node()
    finally:
        rclpy.shutdown()


def pause():
    time.sleep(0.02)


def heard_by(publisher):
    """Wait for the recorder."""
    wait_until(publisher.get_subscription_count, pause)


def interrupt(process):
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0


def noise(size, seed):
    """A text that does not compress."""
    return np.random.default_rng(seed).integers(32, 127, size, np.uint8).tobytes().decode()


def of_others(folder):
    """The records of a bag, less what the recorder says of itself."""
    return [record for record in read_bag(folder) if record.topic != 'diagnostics']


def test_a_late_recorder_gets_the_history_and_drops_nothing(talker, tmp_path):
    publisher = talker.create_publisher(Float32, 'reward', qos('reward'))
    for number in range(500):  # before anybody listens
        publisher.publish(Float32(data=float(number)))
    with child(RECORDER, tmp_path / 'log', output=tmp_path / 'bag') as process:
        heard_by(publisher)
        for number in range(500, 1500):
            publisher.publish(Float32(data=float(number)))
            time.sleep(0.0005)
        time.sleep(1.0)
        interrupt(process)
    records = of_others(tmp_path / 'bag')
    assert [int(record.message.data) for record in records] == list(range(1500))
    stamps = [record.stamp for record in records]
    assert stamps == sorted(stamps)
    assert '/reward: 1500 received, 1500 written, 0 lost' in (tmp_path / 'log').read_text()


@pytest.mark.slow
def test_what_is_lost_is_counted(talker, tmp_path):
    """A recorder that stands still while more is published than anybody keeps for it."""
    publisher = talker.create_publisher(Odometry, 'odom', qos('odom'))
    with child(RECORDER, tmp_path / 'log', output=tmp_path / 'bag',
               topics=['odom']) as process:
        heard_by(publisher)
        time.sleep(0.5)  # the other side has met this one as well

        def publish(count):
            for _ in range(count):
                publisher.publish(Odometry())
                time.sleep(0.001)
        publish(50)
        time.sleep(1.0)
        process.send_signal(signal.SIGSTOP)
        publish(1500)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        publish(50)
        wait_until(lambda: 'lost in the last second' in (tmp_path / 'log').read_text(), pause)
        time.sleep(2.0)  # what waits in the reader when it ends is neither received nor lost
        interrupt(process)
    words, = re.findall(r'/odom: (\d+) received, (\d+) written, (\d+) lost',
                        (tmp_path / 'log').read_text())
    received, written, lost = map(int, words)
    assert received == written == sum(1 for _ in read_bag(tmp_path / 'bag'))
    assert received + lost == 1600 and lost > 500


@pytest.mark.slow
def test_a_killed_recorder_loses_one_chunk_at_most(talker, tmp_path):
    """SIGKILL at three moments while 1 MB a second flows: 13 messages are a chunk."""
    publisher = talker.create_publisher(String, 'scene', QoSProfile(
        depth=100, durability=qos('scene').durability))
    size, number = 20_000, 0
    for trial in range(3):
        bag, log = tmp_path / f'bag{trial}', tmp_path / f'log{trial}'
        with child(RECORDER, log, output=bag, topics=['scene']) as process:
            file = bag / f'{bag.name}_0.mcap'
            # The one that was killed before is still on the graph, so the count of subscribers
            # says nothing: it hears when it has written.
            heard, end, sent = None, time.monotonic() + 30.0, []
            while time.monotonic() < end:
                if heard is None and file.exists() and file.stat().st_size > CHUNK_BYTES:
                    heard = time.monotonic()
                    end = heard + 1.0 + 0.37 * trial
                publisher.publish(String(data=f'{number:06}' + noise(size, number)))
                sent.append((time.monotonic(), number))
                number += 1
                time.sleep(0.02)
            killed = time.monotonic()
            process.kill()
            process.wait()
        assert heard is not None, log.read_text()
        got = []
        with open(file, 'rb') as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True).records:
                    if isinstance(record, Message):
                        got.append(int(record.data[8:14]))
            except McapError:
                pass
        assert got == list(range(got[0], got[-1] + 1)), 'without a gap'
        # What was on its way is not the recorder's to lose; half a second on a busy machine.
        due = [k for when, k in sent if when < killed - 0.5]
        assert due[-1] - got[-1] <= CHUNK_BYTES // size
        told = yaml.safe_load((bag / 'metadata.yaml').read_text())
        assert told['rosbag2_bagfile_information']['relative_file_paths'] == [file.name]


def test_a_disk_that_fails_ends_the_recording_and_not_the_node(talker, tmp_path):
    publisher = talker.create_publisher(String, 'scene', qos('scene'))
    states = []
    talker.create_subscription(DiagnosticArray, '/diagnostics',
                               lambda message: states.extend(message.status), qos('/diagnostics'))
    with child(RECORDER, tmp_path / 'log', output=tmp_path / 'bag') as process:
        heard_by(publisher)
        # It says that it records before it cannot any more.
        wait_until(lambda: states, lambda: rclpy.spin_once(talker, timeout_sec=0.1))
        # As on a full disk, a write fails; not at once, as the middleware has files of its own.
        _, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1_000_000, hard))
        count = 0

        def publish():
            nonlocal count
            publisher.publish(String(data=noise(50_000, count)))
            count += 1
            rclpy.spin_once(talker, timeout_sec=0.02)
        wait_until(lambda: sum(state.level != DiagnosticStatus.OK for state in states) >= 3,
                   publish)
        assert process.poll() is None
        interrupt(process)
    assert {state.name for state in states} == {'/recorder_node'}
    # 'recording', until the disk fails
    fine, failed = (list(group) for _, group in itertools.groupby(
        states, lambda state: state.level != DiagnosticStatus.OK))
    assert all(state.message == 'recording' for state in fine)
    assert all(state.level == DiagnosticStatus.ERROR and 'File too large' in state.message
               for state in failed)
    log = (tmp_path / 'log').read_text()
    assert log.count('recording stopped') == 1 and 'Traceback' not in log
    words, = re.findall(r'/scene: (\d+) received, (\d+) written, 0 lost', log)
    assert 8 < int(words[1]) < int(words[0])
    assert len(of_others(tmp_path / 'bag')) == int(words[1])


def test_what_is_published_is_recorded_as_it_is_published(talker, tmp_path):
    """A TwistStamped command, a best-effort odometry, a foreign topic by name, and all others."""
    messages = {
        'cmd_vel': (TwistStamped, 10), 'odom': (Odometry, qos_profile_sensor_data),
        '/front/scan': (LaserScan, qos_profile_sensor_data), '/words': (String, 10)}
    publishers = {name: talker.create_publisher(kind, name, quality)
                  for name, (kind, quality) in messages.items()}
    nobodys = talker.create_publisher(String, '/_hidden', 10)
    with child(RECORDER, tmp_path / 'log1', output=tmp_path / 'all', all=True) as everything, \
            child(RECORDER, tmp_path / 'log2', output=tmp_path / 'named', max_bag_duration=1.0,
                  topics=['cmd_vel', '/front/scan:sensor_msgs/LaserScan']) as named:
        wanted = {'cmd_vel': 2, 'odom': 1, '/front/scan': 2, '/words': 1}

        def matched():
            return all(publishers[name].get_subscription_count() == count
                       for name, count in wanted.items())
        wait_until(matched, pause)
        for _ in range(20):
            for name, (kind, _) in messages.items():
                publishers[name].publish(kind())
            nobodys.publish(String())
            time.sleep(0.1)
        time.sleep(1.0)
        interrupt(everything)
        interrupt(named)

    def recorded(folder):
        told = yaml.safe_load((tmp_path / folder / 'metadata.yaml').read_text())[
            'rosbag2_bagfile_information']
        return told, {entry['topic_metadata']['name']: entry
                      for entry in told['topics_with_message_count']}
    _, topics = recorded('all')
    assert set(topics) >= {'/cmd_vel', '/odom', '/front/scan', '/words', '/rosout'}
    assert '/_hidden' not in topics
    for name, (_, quality) in messages.items():
        facts = topics[f'/{name.lstrip("/")}']
        assert facts['message_count'] == 20, name
        weak = quality != 10 and quality.reliability == ReliabilityPolicy.BEST_EFFORT
        assert facts['topic_metadata']['offered_qos_profiles'][0]['reliability'] == (
            'best_effort' if weak else 'reliable')
    assert topics['/cmd_vel']['topic_metadata']['type'] == 'geometry_msgs/msg/TwistStamped'
    told, topics = recorded('named')
    assert {name: entry['message_count'] for name, entry in topics.items()} == {
        '/cmd_vel': 20, '/front/scan': 20}
    assert len(told['files']) > 1
    assert sum(1 for _ in read_bag(tmp_path / 'named')) == 40


@pytest.mark.parametrize('number', [signal.SIGINT, *(
    pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGHUP, signal.SIGTERM))])
def test_every_recorder_ends_when_it_is_asked_to(tmp_path, number):
    """Whatever it was doing when the signal came: eight of them, signalled at eight moments."""
    with ExitStack() as stack:
        logs = [tmp_path / f'log{k}' for k in range(8)]
        processes = [stack.enter_context(child(RECORDER, log, output=tmp_path / f'bag{k}'))
                     for k, log in enumerate(logs)]
        wait_until(lambda: all('recording' in log.read_text() for log in logs),
                   lambda: time.sleep(0.1))
        for process in processes:
            process.send_signal(number)
            time.sleep(0.0013)
        assert [process.wait(20) for process in processes] == [0] * 8
    assert all((tmp_path / f'bag{k}' / 'metadata.yaml').is_file() for k in range(8))


@pytest.mark.slow
def test_a_signal_at_any_moment_is_not_a_deadlock(tmp_path):
    """Thousands of signals, from another process: one's own holds the interpreter's lock."""
    script = tmp_path / 'look.py'
    script.write_text("""
import time
from vn_nav.nodes.process import Ended
ended, until = Ended(), time.monotonic() + 6
print('ready', flush=True)
while time.monotonic() < until:
    ended.is_set()
print('ended' if ended.is_set() else 'never')
""")
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == 'ready\n'
        until = time.monotonic() + 4
        while time.monotonic() < until:
            process.send_signal(signal.SIGINT)
            time.sleep(0.0003)
        output, errors = process.communicate(timeout=100)
    finally:
        process.kill()
    assert (output, process.returncode) == ('ended\n', 0), errors[-500:]


@pytest.mark.parametrize('parameter', [
    'output:=.', "topics:=['nonsense']", "topics:=['/a:nobody_msgs/msg/Thing']",
    f'min_free_space:={1 << 50}'])
def test_bad_input_is_one_line_and_exit_code_2(parameter, tmp_path):
    words = [sys.executable, '-m', RECORDER, '--ros-args', '-p', 'output:=bag', '-p', parameter]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and 'received' in done.stderr
    assert not list(tmp_path.iterdir())
