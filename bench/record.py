"""Does recorder_node keep up? A second process publishes a VGA camera with depth at 30 Hz.

Camera (rgb8, with sensor noise), depth (32FC1) and odometry at 50 Hz go through Fast DDS with the
shipped profile to a recorder on the same two cores. The bag is read back and counted.

    python bench/record.py [--seconds 30] [--size 640 480] [--rate 30]

One JSON line a figure: the share of what was published that is in the bag, and CPU seconds a
second of recorder and publisher.
"""

import argparse
import collections
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import pin, report
from mcap.reader import make_reader

from vn_nav.nodes.isolation import profile_environment

RECORDER = 'vn_nav.nodes.recorder_node'
TOPICS = ('/image_raw', '/depth/image_raw', '/odom')
ODOMETRY = 50  # Hz


def publish(seconds: float, size: tuple[int, int], rate: float, recorder: int) -> None:
    """Publish on a grid of time once the recorder listens; print what, and who took what CPU."""
    import rclpy
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import Image

    from vn_msgs_py.images import fill_image
    from vn_nav.nodes.qos import qos
    rclpy.init()
    node = rclpy.create_node('bench_robot')
    kinds = dict(zip(TOPICS, (Image, Image, Odometry), strict=True))
    publishers = {name: node.create_publisher(kind, name, qos(name[1:]))
                  for name, kind in kinds.items()}
    rng = np.random.default_rng(0)
    width, height = size
    pictures = [rng.normal(128, 3, (height, width, 3)).astype(np.uint8) for _ in range(4)]
    depths = [rng.normal(3, 0.02, (height, width)).astype(np.float32) for _ in range(4)]
    until = time.monotonic() + 60
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        assert time.monotonic() < until, 'the recorder does not listen'
        time.sleep(0.05)
    time.sleep(1.0)
    due = sorted([(k / rate, name) for name in TOPICS[:2] for k in range(round(rate * seconds))]
                 + [(k / ODOMETRY, TOPICS[2]) for k in range(round(ODOMETRY * seconds))])
    before = [cpu_seconds(recorder), cpu_seconds(os.getpid())]
    begun = time.monotonic()
    for number, (when, name) in enumerate(due):
        time.sleep(max(0.0, begun + when - time.monotonic()))
        message = kinds[name]()
        message.header.stamp = node.get_clock().now().to_msg()
        if name == TOPICS[0]:
            fill_image(message, pictures[number % 4], 'rgb8')
        elif name == TOPICS[1]:
            fill_image(message, depths[number % 4], '32FC1')
        publishers[name].publish(message)
    taken = time.monotonic() - begun
    own = cpu_seconds(os.getpid()) - before[1]
    time.sleep(2.0)  # the recorder may be late, and the shared memory is the publisher's
    print(json.dumps({'published': {name: sum(n == name for _, n in due) for name in TOPICS},
                      'seconds': taken, 'publisher': own / taken,
                      'recorder': (cpu_seconds(recorder) - before[0]) / taken}), flush=True)
    rclpy.shutdown()


def cpu_seconds(process: int) -> float:
    """User and system time of a process."""
    fields = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def measure(seconds: float, size: tuple[int, int], rate: float) -> None:
    """Record what a publisher sends, count what is in the bag."""
    environment = os.environ | profile_environment() | {'OMP_NUM_THREADS': '1'}
    with tempfile.TemporaryDirectory(dir='.') as folder:
        bag, log = Path(folder, 'bag'), Path(folder, 'log')
        with open(log, 'w') as file:
            recorder = subprocess.Popen(
                [sys.executable, '-m', RECORDER, '--ros-args', '-p', f'output:={bag}'],
                stdout=file, stderr=subprocess.STDOUT, env=environment)
        try:
            while 'recording' not in log.read_text():
                assert recorder.poll() is None, log.read_text()
                time.sleep(0.05)
            done = subprocess.run(
                [sys.executable, __file__, '--publish', str(recorder.pid), '--seconds',
                 str(seconds), '--rate', str(rate), '--size', *map(str, size)],
                stdout=subprocess.PIPE, text=True, env=environment, check=True)
            recorder.send_signal(signal.SIGINT)
            assert recorder.wait(60) == 0, log.read_text()
        finally:
            if recorder.poll() is None:
                recorder.kill()
                recorder.wait()
        sent = json.loads(done.stdout)
        with open(bag / 'bag_0.mcap', 'rb') as file:
            recorded = collections.Counter(
                channel.topic for _, channel, _ in make_reader(
                    file, validate_crcs=True).iter_messages(log_time_order=False))
        lost = dict(re.findall(r'(/\S+): .* (\d+) lost', log.read_text()))
        stored = sum(path.stat().st_size for path in bag.glob('*.mcap'))
    conditions = (f'{size[0]} x {size[1]} rgb8 and 32FC1 at {rate:g} Hz, odometry at {ODOMETRY} '
                  f'Hz, {seconds:g} s ({sent["seconds"]:.1f} s taken), two processes on two '
                  f'cores, {stored / sent["seconds"] / 1e6:.0f} MB/s on disk')
    for name, count in sent['published'].items():
        kept = recorded[name]
        report(f'recorded of {name}', [kept / count], f'{count} published, {kept} in the bag, '
               f'{lost.get(name, "?")} lost by its own count; {conditions}', unit='share')
    report('CPU of recorder_node', [sent['recorder']], conditions, unit='cores')
    report('CPU of the publisher', [sent['publisher']], conditions, unit='cores')


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--seconds', type=float, default=30.0)
    parser.add_argument('--rate', type=float, default=30.0, help='of the pictures [Hz]')
    parser.add_argument('--size', type=int, nargs=2, default=(640, 480))
    parser.add_argument('--publish', type=int, metavar='RECORDER', help=argparse.SUPPRESS)
    options = parser.parse_args()
    pin(2)
    if options.publish:
        publish(options.seconds, options.size, options.rate, options.publish)
    else:
        measure(options.seconds, options.size, options.rate)


if __name__ == '__main__':
    main()
