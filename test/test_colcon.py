"""`colcon build` lays the nodes out for `ros2 run`, and they start from there."""

import os
import signal
import subprocess
import sys
import time

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(420)]

NODES = ('policy_node', 'sim_bridge_node')


@pytest.fixture
def workspace(source_copy):
    """The source tree, built with colcon; sourcing its set-up gives the environment."""
    result = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', 'log', 'build'],
        cwd=source_copy, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return source_copy


def environment_of(workspace):
    """The environment after `source install/setup.bash`."""
    result = subprocess.run(
        ['bash', '-c', 'source install/local_setup.bash && env -0'],
        cwd=workspace, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0 and not result.stderr, result.stderr
    return dict(entry.split('=', 1) for entry in result.stdout.split('\0') if entry)


def wait_for_node(name, process, log, seconds=90):
    """Wait until the ROS graph shows a node; fail when its process ends or the time is over."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        watcher = rclpy.create_node('watcher', context=context)
        deadline = time.monotonic() + seconds
        while name not in watcher.get_node_names():
            assert process.poll() is None, f'{name} ended: {log.read_text()}'
            assert time.monotonic() < deadline, f'no node {name}: {log.read_text()}'
            time.sleep(0.1)
        watcher.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def test_nodes_start_from_the_installation(workspace, tmp_path):
    environment = environment_of(workspace)
    install = workspace / 'install' / 'vn_nav'
    assert str(install) in environment['AMENT_PREFIX_PATH'].split(os.pathsep)
    where = subprocess.run(
        [sys.executable, '-c', 'import vn_nav; print(vn_nav.__file__)'], cwd=tmp_path,
        env=environment, capture_output=True, text=True, timeout=60)
    assert where.stdout.startswith(str(install)), where.stdout + where.stderr

    for name in NODES:
        log = tmp_path / f'{name}.log'
        with log.open('w') as output:
            process = subprocess.Popen(
                [str(install / 'lib' / 'vn_nav' / name)], cwd=tmp_path, env=environment,
                stdout=output, stderr=subprocess.STDOUT)
            try:
                wait_for_node(name, process, log)
                time.sleep(1.0)
                assert process.poll() is None, f'{name} ended: {log.read_text()}'
                process.send_signal(signal.SIGINT)
                assert process.wait(timeout=100) == 0, log.read_text()
            finally:
                process.kill()
                process.wait()
        assert 'Traceback' not in log.read_text(), log.read_text()
