"""Bridge and policy over another middleware: the nodes name none."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from ros_harness import PATIENT, child, write_checkpoint

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
PATIENCE = 150  # s
LISTEN = """
import os, sys, time
import rclpy
from geometry_msgs.msg import Twist

rclpy.init()
node, moved = rclpy.create_node('listener'), []
node.create_subscription(Twist, 'cmd_vel', lambda m: moved.append(m.linear.x or m.angular.z), 10)
end = time.monotonic() + {patience}
while not any(moved) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(rclpy.get_rmw_implementation_identifier(), any(moved), flush=True)
os._exit(0)
"""


def python(code):
    return subprocess.run([sys.executable, '-c', code], env=os.environ, capture_output=True,
                          text=True, timeout=PATIENCE + 60)


@contextlib.contextmanager
def router(middleware):
    """What nodes of Zenoh find each other by."""
    if middleware != 'rmw_zenoh_cpp':
        yield
        return
    process = subprocess.Popen(
        [Path(get_package_prefix(middleware), 'lib', middleware, 'rmw_zenohd')])
    try:
        yield
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize('middleware', ['rmw_fastrtps_cpp', 'rmw_zenoh_cpp', 'rmw_cyclonedds_cpp'])
def test_a_picture_becomes_a_command(middleware, tmp_path, monkeypatch):
    monkeypatch.setenv('RMW_IMPLEMENTATION', middleware)
    if middleware != 'rmw_fastrtps_cpp':  # which is there
        try:
            get_package_prefix(middleware)
        except (PackageNotFoundError, OSError):  # OSError: no ROS is sourced
            pytest.skip(f'expected: {middleware} is not installed')
    checkpoint = write_checkpoint(tmp_path / 'checkpoint')
    with router(middleware), \
            child('vn_sim_bridge.bridge_node', tmp_path / 'bridge', house=7), \
            child('vn_nav.nodes.policy_node', tmp_path / 'policy', auto_enable=True,
                  checkpoint=checkpoint, **PATIENT):
        heard = python(LISTEN.format(patience=PATIENCE))
    assert heard.stdout.split() == [middleware, 'True'], heard.stdout + heard.stderr + (
        tmp_path / 'policy').read_text()
