"""Latency from a camera's picture to the command, over ROS, against a bare relay of rclpy.

    python bench/latency.py
    python bench/latency.py --checkpoint models/anywhere --seconds 20 --rounds 5

This process plays a camera: 640 x 480, rgb8, 30 Hz. Another one answers each picture: a relay, a
node that does nothing but publish a Twist with the picture's stamp; or policy_node, mode
`continuous`, by PyTorch and by ONNX Runtime, one thread. They take turns. What is measured is the
time from before a picture is published until the first command that its decision made is here. So
that this can be told, commands carry the stamp of the newest decision's picture; nothing else in
the node is changed. Prints one JSON line each: median over rounds of p50, p95 and p99 [ms].

`--fifo` gives all of them the kernel's real-time policy SCHED_FIFO (as `chrt -f 5`), which a
robot's control has where it matters: other processes do not come between. `--dashboard` measures
each policy once more while dashboard_node serves a browser that watches.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rclpy
from common import report
from geometry_msgs.msg import TwistStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image

from vn_msgs_py.images import fill_image
from vn_nav.nodes.isolation import profile_environment
from vn_nav.nodes.qos import qos
from vn_nav.resources import share_file

RATE_HZ, SHAPE = 30.0, (480, 640, 3)
WARM_S, PATIENCE_S = 3.0, 60.0
SEEN = ', dashboard'
RELAY = """
import rclpy
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Image
from vn_nav.nodes.qos import qos
rclpy.init()
node = rclpy.create_node('relay')
publisher = node.create_publisher(TwistStamped, 'cmd_vel', qos('cmd_vel'))
def answer(message):
    twist = TwistStamped()
    twist.header.stamp = message.header.stamp
    publisher.publish(twist)
node.create_subscription(Image, 'image_raw', answer, qos('image_raw'))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, RuntimeError):  # also in the middle of a message
    pass
"""
# policy_node, whose commands say which picture they follow from.
NODE = """
from vn_nav.nodes import command_output
from vn_nav.nodes.policy_node import main
from vn_nav.policy.navigator import Navigator
asked, newest = {}, [0.0]
request, decided = Navigator.request, Navigator.decided
def remember(self, stamp, now):
    ticket = request(self, stamp, now)
    if ticket is not None:
        asked.clear()
        asked[ticket] = stamp
    return ticket
def follow(self, ticket, action, now):
    done = decided(self, ticket, action, now)
    if done:
        newest[0] = asked[ticket]
    return done
Navigator.request, Navigator.decided = remember, follow
send = command_output.CommandOutput.send
def stamped(self, velocity):
    publish = self.publisher.publish
    class Stamped:
        def __getattr__(_, name):  # other threads ask it for its topic
            return getattr(own, name)
        def publish(_, message):
            seconds = int(newest[0])
            message.header.stamp.sec = seconds
            message.header.stamp.nanosec = round((newest[0] - seconds) * 1e9)
            publish(message)
    own = self.publisher
    self.publisher = Stamped()
    try:
        send(self, velocity)
    finally:
        self.publisher = own
command_output.CommandOutput.send = stamped
main()
"""


class Camera:
    """Publishes pictures, and takes the time until the commands that they cause."""

    def __init__(self):
        self.node = rclpy.create_node('camera')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._images = self.node.create_publisher(Image, 'image_raw', qos('image_raw'))
        self._goals = self.node.create_publisher(Image, 'goal_image', qos('goal_image'))
        self.node.create_subscription(TwistStamped, 'cmd_vel', self._take, qos('cmd_vel'))
        random = np.random.default_rng(0)
        self._pictures = [fill_image(Image(), random.integers(0, 256, SHAPE, np.uint8), 'rgb8')
                          for _ in range(8)]
        self._sent: dict[int, float] = {}  # when, by stamp [us]
        self.delays: list[float] = []  # s
        self._goals.publish(self._pictures[0])

    def _take(self, message: TwistStamped) -> None:
        # A node keeps stamps as seconds, in double precision: 0.2 us.
        key = message.header.stamp.sec * 10**6 + round(message.header.stamp.nanosec / 1000)
        if (sent := self._sent.pop(key, None)) is not None:
            self.delays.append(time.perf_counter() - sent)

    def show(self, seconds: float) -> int:
        """Publish pictures for some time; how many."""
        begun = time.perf_counter()
        count = 0
        while (due := begun + count / RATE_HZ) < begun + seconds:
            while (remaining := due - time.perf_counter()) > 0:
                self._executor.spin_once(timeout_sec=remaining)
            message = self._pictures[count % len(self._pictures)]
            microseconds = time.time_ns() // 1000
            message.header.stamp.sec = microseconds // 10**6
            message.header.stamp.nanosec = microseconds % 10**6 * 1000
            self._sent[microseconds] = time.perf_counter()
            self._images.publish(message)
            count += 1
        self._sent.clear()
        return count


WATCHER = """
import asyncio, sys, aiohttp
async def watch():
    async with aiohttp.ClientSession() as session:
        while True:
            try:
                async with session.ws_connect(sys.argv[1], max_msg_size=0) as socket:
                    async for _ in socket:
                        pass
            except aiohttp.ClientError:
                await asyncio.sleep(0.2)
asyncio.run(watch())
"""
PORT = 8093


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """Somebody looks at the dashboard."""
    children = [subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL,
                                 stderr=subprocess.DEVNULL) for words in (
        ['-m', 'vn_nav.nodes.dashboard_node', '--ros-args', '-p', f'port:={PORT}'],
        ['-c', WATCHER, f'http://127.0.0.1:{PORT}/live'])]
    try:
        yield
    finally:
        for child in reversed(children):
            child.send_signal(signal.SIGINT)
            child.wait(PATIENCE_S)


def measure(camera: Camera, words: list[str], seconds: float) -> tuple[np.ndarray, float]:
    """p50, p95 and p99 [ms] of a process, and the share of pictures that it answered."""
    process = subprocess.Popen([sys.executable, *words], env=os.environ | {'OMP_NUM_THREADS': '1'},
                               stdout=subprocess.DEVNULL)
    try:
        camera.delays.clear()
        until = time.monotonic() + PATIENCE_S
        while len(camera.delays) < 10:
            if time.monotonic() > until or process.poll() is not None:
                raise SystemExit(f'expected: commands within {PATIENCE_S:g} s; received: none')
            camera.show(0.5)
        camera.show(WARM_S)
        camera.delays.clear()
        count = camera.show(seconds)
        return (1e3 * np.percentile(camera.delays, [50, 95, 99]), len(camera.delays) / count)
    finally:
        # Politely: what a killed process leaves behind would disturb the next one.
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--checkpoint', type=Path, nargs='+', default=[
        share_file(f'models/{name}') for name in ('house', 'anywhere', 'search')])
    parser.add_argument('--seconds', type=float, default=10.0, help='of a round')
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--fifo', action='store_true', help='SCHED_FIFO; needs the right to it')
    parser.add_argument('--dashboard', action='store_true', help='each policy also while somebody '
                        'looks at the dashboard')
    options = parser.parse_args()
    if options.fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(5))  # children inherit it
    # Fast DDS's usual shared memory is smaller than a picture: many would be lost.
    os.environ.update(profile_environment())
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.policy.export import export_onnx
    with tempfile.TemporaryDirectory() as folder:
        runs = {'bare relay': ['-c', RELAY]}
        for path in options.checkpoint:
            export_onnx(load_checkpoint(path), Path(folder) / path.name)
            for backend, where in (('PyTorch', path), ('ONNX Runtime', Path(folder) / path.name)):
                parameters = {'checkpoint': where, 'mode': 'continuous', 'stop_threshold': 1.0,
                              'enable_stamped_cmd_vel': 'true', 'auto_enable': 'true'}
                runs[f'{path.name}, {backend}'] = ['-c', NODE, '--ros-args', *(
                    word for name, value in parameters.items() for word in (
                        '-p', f'{name}:={value}'))]
        rclpy.init()
        camera = Camera()
        if options.dashboard:
            runs |= {f'{name}{SEEN}': words for name, words in list(runs.items())
                     if name != 'bare relay'}
        found: dict[str, list[np.ndarray]] = {name: [] for name in runs}
        answered: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(options.rounds):
            for name, words in runs.items():
                with watched() if name.endswith(SEEN) else contextlib.nullcontext():
                    figures, share = measure(camera, words, options.seconds)
                found[name].append(figures)
                answered[name].append(share)
        rclpy.shutdown()
    relay = np.array(found['bare relay'])
    how = (f'640 x 480, 30 Hz, {"SCHED_FIFO, " * options.fifo}{options.rounds} rounds of '
           f'{options.seconds:g} s')
    for name, rows in found.items():
        for k, percentile in enumerate(('p50', 'p95', 'p99')):
            report(f'{name}: {percentile}', np.array(rows)[:, k],
                   f'{how}, {np.median(answered[name]):.1%} of pictures answered',
                   unit='ms', peer='bare relay', peer_values=relay[:, k])
    return 0


if __name__ == '__main__':
    sys.exit(main())
