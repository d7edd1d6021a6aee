"""recorder_node as real processes: nothing is lost, and every SIGINT finishes the bag."""

import signal
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest
import rclpy
from ros_harness import child, wait_until
from std_msgs.msg import Float32

from vn_nav.bags.reader import read_bag
from vn_nav.nodes.qos import qos

pytestmark = pytest.mark.ros


def test_a_late_recorder_gets_the_history_and_drops_nothing(tmp_path):
    rclpy.init()
    try:
        node = rclpy.create_node('talker')
        publisher = node.create_publisher(Float32, 'reward', qos('reward'))
        for number in range(500):  # before anybody listens
            publisher.publish(Float32(data=float(number)))
        with child('vn_nav.nodes.recorder_node', tmp_path / 'log',
                   output=tmp_path / 'bag') as process:
            wait_until(publisher.get_subscription_count, lambda: time.sleep(0.02))
            for number in range(500, 1500):
                publisher.publish(Float32(data=float(number)))
                time.sleep(0.0005)
            time.sleep(1.0)
            process.send_signal(signal.SIGINT)
            assert process.wait(10) == 0
        node.destroy_node()
    finally:
        rclpy.shutdown()
    records = list(read_bag(tmp_path / 'bag'))
    assert [int(record.message.data) for record in records] == list(range(1500))
    stamps = [record.stamp for record in records]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_every_recorder_ends_when_it_is_asked_to(tmp_path, number):
    """Whatever it was doing when the signal came: eight of them, signalled at eight moments."""
    with ExitStack() as stack:
        logs = [tmp_path / f'log{k}' for k in range(8)]
        processes = [stack.enter_context(child('vn_nav.nodes.recorder_node', log,
                                               output=tmp_path / f'bag{k}'))
                     for k, log in enumerate(logs)]
        wait_until(lambda: all('recording' in log.read_text() for log in logs),
                   lambda: time.sleep(0.1))
        for process in processes:
            process.send_signal(number)
            time.sleep(0.0013)
        assert [process.wait(20) for process in processes] == [0] * 8
    assert all((tmp_path / f'bag{k}' / 'metadata.yaml').is_file() for k in range(8))


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
        output, errors = process.communicate(timeout=20)
    finally:
        process.kill()
    assert (output, process.returncode) == ('ended\n', 0), errors[-500:]


def test_an_existing_folder_is_one_line_and_exit_code_2(tmp_path):
    done = subprocess.run([sys.executable, '-m', 'vn_nav.nodes.recorder_node', '--ros-args', '-p',
                           f'output:={tmp_path}'], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and 'received' in done.stderr
