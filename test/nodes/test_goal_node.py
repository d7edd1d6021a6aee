"""goal_node shows a picture from a file to whoever listens, now or later."""

import math
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import rclpy
from picture_bytes import encoded, photo, with_exif
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, child, wait_until
from sensor_msgs.msg import CameraInfo, Image

from vn_msgs_py.images import decode_rgb
from vn_nav.calibration import read_calibration
from vn_nav.nodes.qos import qos
from vn_nav.rectification import Camera

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


def test_a_phones_picture_comes_with_its_lens(tmp_path):
    (tmp_path / 'goal.jpg').write_bytes(
        with_exif(encoded(photo(480, 640), '.jpg'), 6, focal_35mm=26))
    rclpy.init()
    try:
        with child('vn_nav.nodes.goal_node', tmp_path / 'log', picture=tmp_path / 'goal.jpg'):
            node = rclpy.create_node('listener')
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            images, lenses = [], []
            node.create_subscription(Image, 'goal_image', images.append, qos('goal_image'))
            node.create_subscription(CameraInfo, 'goal_camera_info', lenses.append,
                                     qos('goal_camera_info'))
            wait_until(lambda: images and lenses, lambda: executor.spin_once(timeout_sec=0.1))
            assert lenses[0].header.stamp == images[0].header.stamp
            assert (lenses[0].width, lenses[0].height) == (480, 640)
            camera = Camera(read_calibration(lenses[0]))
            assert camera.is_pinhole and math.degrees(camera.fov) == pytest.approx(53.06, abs=0.01)
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
