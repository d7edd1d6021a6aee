"""Bags to training batches: frames a second, compared with what others offer.

    python bench/bags.py --rounds 5

One drive of textured pictures, 640 x 480, with odometry, as a bag of each kind: raw, raw in zstd
chunks, JPEG and PNG. Each reader makes batches [32,3,84,84] uint8 out of it, every picture with
its pose: ours (`vn_nav.bags`, two decoding threads), `rosbags.AnyReader` and OpenCV, and
`mcap-ros2-support` and OpenCV, which decode and scale in plain loops as their documentation does.
The readers take turns; then ours again from the decoded cache. One JSON line a figure.

The peer needs `pip install -r bench/requirements.txt`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
from common import pin, report
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from vn_msgs_py.images import fill_compressed
from vn_msgs_py.motion import yaw_to_quaternion
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive import Report
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.drive_decoder import decoded, read_steps
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

SIZE, BATCH = 84, 32
KINDS = ('raw', 'zstd', 'jpeg', 'png')
STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


def pictures(count: int) -> list[np.ndarray]:
    """Views [480,640,3] that glide over a large texture with noise, as a camera's do."""
    rng = np.random.default_rng(0)
    coarse = cv2.resize(rng.integers(0, 256, (40, 60, 3), np.uint8), (1400, 900),
                        interpolation=cv2.INTER_CUBIC)
    scene = np.clip(coarse + rng.normal(0, 4, coarse.shape), 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(scene[k % 400:k % 400 + 480, 2 * k % 740:2 * k % 740 + 640])
            for k in range(count)]


def write(folder: Path, kind: str, shown: list[np.ndarray]) -> None:
    """A bag as `rosbags` writes it: 30 pictures and 60 poses a second."""
    stamp, header = TYPES['builtin_interfaces/msg/Time'], TYPES['std_msgs/msg/Header']
    image = 'sensor_msgs/msg/CompressedImage' if kind in ('jpeg', 'png') else (
        'sensor_msgs/msg/Image')
    bag = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if kind == 'zstd':
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        camera = bag.add_connection('/image_raw' + '/compressed' * (kind in ('jpeg', 'png')),
                                    image, typestore=STORE)
        odometry = bag.add_connection('/odom', 'nav_msgs/msg/Odometry', typestore=STORE)
        for k in range(2 * len(shown)):
            at = 10**9 + k * 10**9 // 60
            now = header(stamp(at // 10**9, at % 10**9), 'odom')
            bag.write(odometry, at, STORE.serialize_cdr(_odometry(now, 0.005 * k),
                                                        'nav_msgs/msg/Odometry'))
            if k % 2:
                continue
            picture = shown[k // 2]
            if kind in ('jpeg', 'png'):
                part = fill_compressed(SimpleNamespace(), picture, kind)
                message = TYPES[image](now, kind, np.frombuffer(part.data, np.uint8))
            else:
                message = TYPES[image](now, 480, 640, 'rgb8', 0, 1920, picture.reshape(-1))
            bag.write(camera, at, STORE.serialize_cdr(message, image))


def _odometry(header, x: float):
    vector, point = TYPES['geometry_msgs/msg/Vector3'], TYPES['geometry_msgs/msg/Point']
    pose = TYPES['geometry_msgs/msg/Pose'](
        point(x, 0.0, 0.0), TYPES['geometry_msgs/msg/Quaternion'](*yaw_to_quaternion(0.0)))
    zeros = np.zeros(36)
    twist = TYPES['geometry_msgs/msg/Twist'](vector(0.3, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    return TYPES['nav_msgs/msg/Odometry'](
        header, 'base_link', TYPES['geometry_msgs/msg/PoseWithCovariance'](pose, zeros),
        TYPES['geometry_msgs/msg/TwistWithCovariance'](twist, zeros))


def ours(bag: Path) -> int:
    """Frames of whole batches, by the project's reader."""
    wanted = Wanted(RobotSpec().with_actions(DRIVE_ACTIONS), size=SIZE, every=True, threads=2)
    steps, _, camera = read_steps(bag, wanted, Report())
    return _batches((step.frame.pose, shown['image'])
                    for step, shown in decoded(steps, wanted, camera))


def any_reader(bag: Path) -> int:
    """The same by `rosbags.AnyReader`."""
    def rows():
        pose = np.zeros(3)
        with AnyReader([bag], default_typestore=STORE) as reader:
            for connection, _, data in reader.messages():
                message = reader.deserialize(data, connection.msgtype)
                if connection.topic == '/odom':
                    pose = _pose(message)
                else:
                    yield pose, _scaled(message)
    return _batches(rows())


def mcap_ros2(bag: Path) -> int:
    """The same by `mcap-ros2-support`."""
    def rows():
        pose = np.zeros(3)
        with open(next(bag.glob('*.mcap')), 'rb') as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                if channel.topic == '/odom':
                    pose = _pose(message)
                else:
                    yield pose, _scaled(message)
    return _batches(rows())


def _pose(message) -> np.ndarray:
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return np.array([place.x, place.y, 2 * np.arctan2(turn.z, turn.w)])


def _scaled(message) -> np.ndarray:
    if hasattr(message, 'format'):
        picture = cv2.cvtColor(cv2.imdecode(np.frombuffer(message.data, np.uint8),
                                            cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    else:
        picture = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
    picture = cv2.resize(picture[:, 80:560], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return picture.transpose(2, 0, 1)


def _batches(rows) -> int:
    images, poses = np.empty((BATCH, 3, SIZE, SIZE), np.uint8), np.empty((BATCH, 3))
    count = 0
    for pose, image in rows:
        images[count % BATCH], poses[count % BATCH] = image, pose
        count += 1
    return count


def main():
    """Write the bags, read them in turns, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--pictures', type=int, default=600)
    parser.add_argument('--rounds', type=int, default=5)
    arguments = parser.parse_args()
    pin(2)
    shown = pictures(arguments.pictures)
    readers = {'ours': ours, 'rosbags.AnyReader + OpenCV': any_reader,
               'mcap-ros2-support + OpenCV': mcap_ros2}
    with tempfile.TemporaryDirectory() as scratch:
        for kind in KINDS:
            bag = Path(scratch) / kind
            write(bag, kind, shown)
            rates = {name: [] for name in readers}
            for turn in range(arguments.rounds + 1):  # the first warms caches up
                for name, read in readers.items():
                    begun = time.perf_counter()
                    count = read(bag)
                    if count != len(shown):
                        raise SystemExit(f'{name} read {count} of {len(shown)} pictures')
                    if turn:
                        rates[name].append(count / (time.perf_counter() - begun))
            for peer in list(readers)[1:]:
                report(f'bag to batches, {kind}', rates['ours'],
                       '640 x 480 to 84 x 84, two cores', peer=peer, peer_values=rates[peer])
        cached(Path(scratch), arguments.rounds)


def cached(scratch: Path, rounds: int) -> None:
    """Epochs after the first, shuffled batches out of the decoded cache."""
    wanted = Wanted(RobotSpec().with_actions(DRIVE_ACTIONS), size=SIZE, every=True)
    drives = load_drives(scratch / 'jpeg', wanted, scratch / 'cache')
    copy = np.array(drives.image)
    rates = {'cache': [], 'memory': []}
    for turn in range(rounds + 1):
        for name, images in (('cache', drives.image), ('memory', copy)):
            order = np.random.default_rng(turn).permutation(len(images))
            begun = time.perf_counter()
            for first in range(0, len(order), BATCH):
                np.ascontiguousarray(images[order[first:first + BATCH]])
            if turn:
                rates[name].append(len(order) / (time.perf_counter() - begun))
    report('epochs after the first, from the decoded cache', rates['cache'],
           'shuffled batches of 32, 84 x 84', peer='an array in memory',
           peer_values=rates['memory'])


if __name__ == '__main__':
    main()
