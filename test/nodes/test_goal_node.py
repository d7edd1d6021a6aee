"""goal_node shows a picture from a file to whoever listens, now or later."""

import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, child, wait_until
from sensor_msgs.msg import Image

from vn_msgs_py.images import decode_rgb
from vn_nav.nodes.qos import qos

pytestmark = pytest.mark.ros


def test_a_late_listener_gets_the_picture(tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    cv2.imwrite(str(tmp_path / 'goal.png'), picture)
    rclpy.init()
    try:
        with child('vn_nav.nodes.goal_node', tmp_path / 'log',
                   picture=tmp_path / 'goal.png') as process:
            node = rclpy.create_node('late')
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            wait_until(lambda: 'showing' in (tmp_path / 'log').read_text(),
                       lambda: executor.spin_once(timeout_sec=0.1))
            heard = []
            node.create_subscription(Image, 'goal_image', heard.append, qos('goal_image'))
            wait_until(lambda: heard, lambda: executor.spin_once(timeout_sec=0.1))
            assert np.array_equal(decode_rgb(heard[0]), picture[:, :, ::-1])
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE) == 0
            node.destroy_node()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize('name', ['missing.png', 'broken.jpg'])
def test_a_bad_picture_is_one_line(tmp_path, name):
    (tmp_path / 'broken.jpg').write_bytes(b'no picture')
    done = subprocess.run([sys.executable, '-m', 'vn_nav.nodes.goal_node', '--ros-args', '-p',
                           f'picture:={tmp_path / name}'], capture_output=True, text=True,
                          timeout=60)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and 'received' in done.stderr
