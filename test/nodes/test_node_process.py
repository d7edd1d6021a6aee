"""Processes of the nodes: arguments, --help, signals at every time of their lives, exit codes."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time

import pytest
import rclpy
from rcl_interfaces.srv import DescribeParameters
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, ask, child, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.slow]

NODES = {'goal_node': 'vn_nav.nodes.goal_node', 'policy_node': 'vn_nav.nodes.policy_node',
         'recorder_node': 'vn_nav.nodes.recorder_node', 'route_node': 'vn_nav.nodes.route_node',
         'sim_bridge_node': 'vn_sim_bridge.bridge_node',
         'teleop_node': 'vn_nav.nodes.teleop_node'}
ENDING = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT]
EXECUTABLE = 'import sys; sys.argv[0] = "node"; from vn_nav.cli import nodes; ' \
    'sys.exit(nodes.{}())'


def run(name, *words, **options):
    return subprocess.run([sys.executable, '-m', NODES[name], *words], capture_output=True,
                          text=True, timeout=100, **options)


def assert_one_line(done, word):
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and word in lines[0] and 'received' in lines[0], done.stderr


@pytest.mark.parametrize('name', NODES)
def test_help_is_printed_and_nothing_starts(name, tmp_path):
    done = run(name, '--help', cwd=tmp_path)
    assert done.returncode == 0 and not done.stderr
    assert done.stdout.startswith(f'usage: ros2 run vn_nav {name}')
    assert 'parameters' in done.stdout and not list(tmp_path.iterdir())


@pytest.mark.parametrize(('name', 'words', 'says'), [
    ('policy_node', ['-p', 'control_rate:=20'], 'a number with a point'),
    ('policy_node', ['-p', 'control_rate:=.nan'], 'control_rate'),
    ('policy_node', ['-p', 'control_rate:=500.0'], 'between 5.0 and 100.0'),
    ('policy_node', ['-p', 'autostart:=5'], 'true or false'),
    ('policy_node', ['-p', 'seed:=1.5'], 'whole number'),
    ('policy_node', ['-p', 'robot:=5'], 'text'),
    ('policy_node', ['-p', 'chekpoint:=x'], 'did you mean checkpoint?'),
    ('policy_node', ['-p', 'mode:=sideways'], 'stop_and_go, continuous, shadow'),
    ('sim_bridge_node', ['-p', 'camera_rate:=10'], 'a number with a point'),
    ('sim_bridge_node', ['-p', 'camera_rate:=.inf'], 'camera_rate'),
    ('sim_bridge_node', ['-p', 'mode:=shadow'], 'stop_and_go, continuous'),
    ('sim_bridge_node', ['-p', 'hous:=7'], 'did you mean house?'),
    ('recorder_node', ['-p', 'max_bag_size:=20.0'], 'whole number'),
    ('recorder_node', ['-p', 'topics:=odom'], 'list'),
    ('teleop_node', ['-p', 'speed:=2.0'], 'between 0.05 and 1.0'),
    ('teleop_node', ['-p', 'source:=mouse'], 'auto, keyboard, joy'),
    ('route_node', ['-p', 'place:=5'], 'in quotes'),
    ('recorder_node', ['-p', 'outptu:=x'], 'did you mean output?'),
    ('goal_node', ['-p', 'picture:=5'], 'text'),
    ('goal_node', ['-p', 'use_sim_time:=5'], 'use_sim_time'),
    ('goal_node', ['-p', 'picture'], 'name:=value'),
    ('goal_node', ['-p'], '-p'),
    ('goal_node', ['--params-file', '/nowhere.yaml'], '/nowhere.yaml'),
    ('goal_node', ['--log-level', 'loud'], 'debug, info, warn, error and fatal'),
    ('goal_node', ['--nonsense'], '--nonsense'),
    ('goal_node', ['-r', '__ns:=9bad'], '__ns'),
])
def test_bad_arguments_are_one_line_and_exit_code_2(name, words, says, tmp_path):
    assert_one_line(run(name, '--ros-args', *words, cwd=tmp_path), says)
    assert not list(tmp_path.iterdir())


def test_what_stands_before_ros_args_is_not_ignored():
    assert_one_line(run('goal_node', 'kitchen.jpg'), 'after --ros-args')


def test_bad_params_files_are_one_line(tmp_path):
    file = tmp_path / 'params.yaml'
    for content in (b'a: [1,\n', b'/**:\n  picture: x\n', b'\xe9: \xff\n',
                    b'/**:\n  ros__parameters:\n    picture: [1, a]\n'):
        file.write_bytes(content)
        assert_one_line(run('goal_node', '--ros-args', '--params-file', str(file)), str(file))


def test_a_shared_file_is_no_error_and_its_unknown_names_are_said(tmp_path):
    file = tmp_path / 'params.yaml'
    # control_rate is policy_node's; pictur is nobody's.
    file.write_text('/**:\n  ros__parameters:\n    control_rate: 20.0\n    pictur: kitchen.jpg\n')
    done = run('goal_node', '--ros-args', '--params-file', str(file))
    *warnings, error = done.stderr.strip().splitlines()
    assert done.returncode == 2 and 'the goal is a picture file' in error
    assert len(warnings) == 1 and 'no parameter pictur:' in warnings[0], done.stderr


def test_allowed_words_and_limits_stand_in_descriptors(tmp_path):
    rclpy.init()
    node = rclpy.create_node('asks')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        with child(NODES['policy_node'], tmp_path / 'log', autostart=False):
            client = node.create_client(DescribeParameters, '/policy_node/describe_parameters')
            answer, _ = ask(client, DescribeParameters.Request(
                names=['mode', 'control_rate', 'decoding']),
                lambda: executor.spin_once(timeout_sec=0.1))
            mode, rate, decoding = answer.descriptors
            assert mode.additional_constraints == 'one of stop_and_go, continuous, shadow'
            assert decoding.additional_constraints == 'one of (empty), sample, greedy'
            assert rate.floating_point_range[0].to_value == 100.0
            assert 'lifecycle set /policy_node configure' in (tmp_path / 'log').read_text()
    finally:
        node.destroy_node()
        rclpy.shutdown()


@pytest.mark.parametrize('number', ENDING)
@pytest.mark.parametrize('name', ['policy_node', 'recorder_node'])
def test_many_signals_end_a_node_with_exit_code_0(name, number, tmp_path):
    """Also those that meet the interpreter's own shutdown, which once killed it."""
    log = tmp_path / 'log'
    parameters = {'output': tmp_path / 'bag'} if name == 'recorder_node' else {}
    with child(NODES[name], log, **parameters) as process:
        wait_until(lambda: 'waits for' in log.read_text() or 'recording' in log.read_text(),
                   lambda: time.sleep(0.05))
        time.sleep(0.3)
        until = time.monotonic() + 30
        while process.poll() is None and time.monotonic() < until:
            process.send_signal(number)
            time.sleep(0.002)
        assert process.wait(PATIENCE) == 0, log.read_text()
    assert 'Traceback' not in log.read_text()


@pytest.mark.parametrize('number', ENDING)
def test_a_signal_while_a_node_imports_ends_it_with_exit_code_0(number):
    words = [sys.executable, '-c',
             'import os, signal, threading, time\n'
             'from vn_nav.nodes import signals\n'
             'def shoot():\n'
             '    while signal.getsignal(signal.SIGINT) is signal.default_int_handler:\n'
             '        time.sleep(0.001)\n'
             f'    time.sleep(0.05); os.kill(os.getpid(), {int(number)})\n'
             'threading.Thread(target=shoot, daemon=True).start()\n'
             + EXECUTABLE.format('policy_node')]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0 and not done.stderr, done.stderr


def test_nohup_still_means_that_a_closed_session_does_not_end_it(tmp_path):
    log = tmp_path / 'log'
    with log.open('w') as file:
        process = subprocess.Popen(
            ['nohup', sys.executable, '-m', NODES['policy_node']], stdin=subprocess.DEVNULL,
            stdout=file, stderr=subprocess.STDOUT)
    try:
        wait_until(lambda: 'waits for' in log.read_text(), lambda: time.sleep(0.05))
        process.send_signal(signal.SIGHUP)
        time.sleep(1.5)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.wait()


def test_a_terminal_that_is_gone_ends_a_node_cleanly():
    """An ssh session that breaks: SIGHUP, and nowhere to write to."""
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, '-m', NODES['policy_node']])
    said = b''
    until = time.monotonic() + 60
    while b'waits for' not in said and time.monotonic() < until:
        with contextlib.suppress(OSError):
            said += os.read(terminal, 4096)
    os.close(terminal)
    try:
        while (ended := os.waitpid(process, os.WNOHANG)) == (0, 0):
            assert time.monotonic() < until + 30
            time.sleep(0.05)
    except BaseException:
        os.kill(process, signal.SIGKILL)
        raise
    assert os.waitstatus_to_exitcode(ended[1]) == 0


@pytest.mark.timeout(300)
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_first_compilation_shows_progress_and_can_be_ended(number, tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'cache'))
    log = tmp_path / 'log'
    with child(NODES['sim_bridge_node'], log, house=7) as process:
        wait_until(lambda: 's so far' in log.read_text(), lambda: time.sleep(0.05), 120)
        process.send_signal(number)
        assert process.wait(PATIENCE) == 0, log.read_text()
    assert 'Traceback' not in log.read_text() and 'ready' not in log.read_text()
