"""The shipped Fast DDS profiles carry pictures whole, between two processes."""

import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree

import pytest
from paths import ROOT

PROFILES = ('fastdds_localhost', 'fastdds_multihost')
RATE, FRAMES = 30.0, 180
SPACE = '{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}'

PUBLISH = """
import array, sys, time
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

rclpy.init()
node = rclpy.create_node('camera')
publisher = node.create_publisher(Image, 'image_raw', qos_profile_sensor_data)
picture = Image(height=480, width=640, encoding='rgb8', step=1920,
                data=array.array('B', bytes(480 * 1920)))
while publisher.get_subscription_count() == 0:
    time.sleep(0.05)
time.sleep(0.5)
start = time.monotonic()
for frame in range({frames}):
    time.sleep(max(0.0, start + frame / {rate} - time.monotonic()))
    picture.header.frame_id = str(frame)
    publisher.publish(picture)
time.sleep(0.5)
rclpy.shutdown()
"""
RECEIVE = """
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

rclpy.init()
node = rclpy.create_node('viewer')
received = []
node.create_subscription(
    Image, 'image_raw', lambda picture: received.append(int(picture.header.frame_id)),
    qos_profile_sensor_data)
print('ready', flush=True)
quiet = 0
while quiet < 20 and (not received or received[-1] < {frames} - 1):
    before = len(received)
    rclpy.spin_once(node, timeout_sec=0.1)
    quiet = quiet + 1 if received and len(received) == before else 0
print(len(set(received)))
rclpy.shutdown()
"""


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize('profile', PROFILES)
def test_vga_pictures_arrive(profile):
    environment = {**os.environ,
                   'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / f'config/{profile}.xml')}
    start = time.monotonic()
    processes = []
    try:
        for source in (RECEIVE, PUBLISH):
            processes.append(subprocess.Popen(
                [sys.executable, '-c', source.format(frames=FRAMES, rate=RATE)],
                env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        output, errors = processes[0].communicate(timeout=60)
        _, publisher_errors = processes[1].communicate(timeout=60)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert processes[0].returncode == 0 and processes[1].returncode == 0, errors + publisher_errors
    assert 'XML' not in errors, errors  # Fast DDS goes on with its defaults after a parse error
    received = int(output.split()[-1])
    assert time.monotonic() - start >= FRAMES / RATE, 'the pictures came faster than a camera'
    assert received >= 0.98 * FRAMES, f'{received} of {FRAMES} pictures arrived'


@pytest.mark.parametrize('profile', PROFILES)
def test_profile_says_what_it_promises(profile):
    root = ElementTree.parse(ROOT / f'config/{profile}.xml').getroot()
    transports = {element.find(f'{SPACE}type').text: element
                  for element in root.iter(f'{SPACE}transport_descriptor')}
    assert set(transports) == {'SHM', 'UDPv4'}
    assert int(transports['SHM'].find(f'{SPACE}segment_size').text) == 32 * 1024 * 1024
    addresses = [element.text for element in transports['UDPv4'].iter(f'{SPACE}address')]
    assert addresses == (['127.0.0.1'] if profile == 'fastdds_localhost' else [])
    participant = root.find(f'.//{SPACE}participant')
    assert participant.get('is_default_profile') == 'true'
    assert participant.find(f'.//{SPACE}useBuiltinTransports').text == 'false'
    used = {element.text for element in participant.iter(f'{SPACE}transport_id')}
    assert used == {element.find(f'{SPACE}transport_id').text for element in transports.values()}
