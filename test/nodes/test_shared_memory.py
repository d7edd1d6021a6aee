"""Shared memory that killed processes leave in /dev/shm."""

import signal
import subprocess
import sys

import pytest
from paths import ROOT

from vn_nav.nodes.shared_memory import FOLDER, remove_dead_segments

pytestmark = [pytest.mark.ros, pytest.mark.slow]
PARTICIPANT = """
import time, rclpy
rclpy.init()
node = rclpy.create_node('participant')
print('up', flush=True)
time.sleep(100)
"""
STARTS = """
import functools, sys
from vn_nav.nodes import process
process.remove_dead_segments = functools.partial(process.remove_dead_segments, min_age=0.0)
sys.exit(process.run_node('a_node', lambda ended: None, lambda node, ended: None, sys.argv[1:]))
"""


def start(*words):
    """The exit code of a node in a process of its own: its end ignores the process's signals."""
    return subprocess.run([sys.executable, '-c', STARTS, *words], cwd=ROOT).returncode


@pytest.fixture
def participant():
    """A ROS process, and the segments that came with it."""
    before = set(FOLDER.glob('fastrtps_*'))
    child = subprocess.Popen([sys.executable, '-c', PARTICIPANT], cwd=ROOT, text=True,
                             stdout=subprocess.PIPE)
    try:
        assert child.stdout.readline() == 'up\n'
        own = {path for path in set(FOLDER.glob('fastrtps_*')) - before
               if '_port' not in path.name}
        yield child, own
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
        remove_dead_segments(min_age=0.0)


def test_the_segment_of_a_killed_process_is_freed_and_that_of_a_live_one_stays(participant):
    child, own = participant
    assert any(path.stat().st_size > 2**25 for path in own), 'no segment as the profile has it'
    remove_dead_segments(min_age=0.0)
    assert all(path.exists() for path in own), 'in use'
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert all(path.exists() for path in own), 'Fast DDS cleans up by itself now: delete ours'
    assert remove_dead_segments() == 0 and all(path.exists() for path in own), 'too new'
    assert remove_dead_segments(min_age=0.0) > 0
    assert not any(path.exists() for path in own)


def test_a_node_frees_them_before_it_starts(participant):
    child, own = participant
    child.kill()
    child.wait()
    assert start('no argument') == 2
    assert any(path.exists() for path in own), 'refused arguments start nothing'
    assert start() == 0
    assert not any(path.exists() for path in own)


def test_where_there_is_no_shared_memory_nothing_happens(tmp_path):
    assert remove_dead_segments(tmp_path / 'none') == 0
