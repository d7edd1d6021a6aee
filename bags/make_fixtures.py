"""Makes the small bags of this folder. Run: python bags/make_fixtures.py [name...]

house_drive: one short journey (at most 10 decisions) of the shipped policy in house 7, recorded
by recorder_node from sim_bridge_node and policy_node in lock-step.

ros2_bag_record: an imitation of what `ros2 bag record` of Jazzy leaves, with messages of
house_drive.

foreign_robot: another robot's topics and types, written by `rosbags`, with what is seen in
house_drive.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import yaml
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from vn_msgs_py.images import decode_rgb
from vn_msgs_py.topics import BEST_EFFORT, LATCHED, topic
from vn_nav.nodes.processes import Processes
from vn_nav.resources import share_file

FOLDER = Path(__file__).resolve().parent
DRIVE = FOLDER / 'house_drive'
STORE = get_typestore(Stores.ROS2_JAZZY)
FOREVER = {'sec': 9223372036, 'nsec': 854775807}


def house_drive(bag):
    """The real nodes, for about half a minute."""
    base = str(share_file('config/robots/demo_base.yaml'))
    with tempfile.TemporaryDirectory() as logs:
        processes = Processes(Path(logs))
        try:
            processes.start('recorder', 'vn_nav.nodes.recorder_node', {'output': str(bag)})
            processes.start('policy', 'vn_nav.nodes.policy_node', {
                'checkpoint': str(share_file('models/house')), 'robot': base,
                'time': 'lock_step', 'auto_enable': True})
            processes.start('bridge', 'vn_sim_bridge.bridge_node', {
                'house': 7, 'robot': base, 'time': 'lock_step', 'episodes': 1,
                'max_decisions': 10, 'exit_when_done': True})
            processes.running['bridge'].wait(60)
        finally:
            processes.stop_all()


def ros2_bag_record(bag):
    """Written as rosbag2_storage_mcap does by default.

    Chunks of 786,432 bytes without compression, in the order of reception, which is not that of
    publishing; definitions as the .msg files have them, comments included; the metadata once more
    in the file. One picture in four, for the size.
    """
    names = {f'/{name}' for name in (
        'image_raw', 'camera_info', 'goal_image', 'cmd_vel', 'odom', 'action', 'action_names',
        'episode', 'episode_end', 'episode_result', 'scene')}
    rng = np.random.default_rng(0)
    received, pictures = [], 0
    with AnyReader([DRIVE], default_typestore=STORE) as reader:
        for connection, stamp, data in reader.messages(
                connections=[c for c in reader.connections if c.topic in names]):
            late = rng.uniform(5e6, 25e6) if 'image' in connection.topic else rng.uniform(2e5, 2e6)
            pictures += connection.topic == '/image_raw'
            if connection.topic != '/image_raw' or pictures % 4 == 1:
                received.append((stamp + int(late), stamp, connection.topic, connection.msgtype,
                                 bytes(data)))
    received.sort()
    bag.mkdir()
    path = bag / f'{bag.name}_0.mcap'
    counts: dict[tuple[str, str], int] = {}
    ids: dict[str, int] = {}
    with open(path, 'wb') as file:
        writer = Writer(file, chunk_size=786_432, compression=CompressionType.NONE)
        writer.start(profile='ros2', library='libmcap, imitated')
        for log_time, publish_time, name, kind, data in received:
            if name not in ids:
                schema = writer.register_schema(kind, 'ros2msg', msg_files(kind).encode())
                ids[name] = writer.register_channel(name, 'cdr', schema, {
                    'offered_qos_profiles': yaml.safe_dump([offered(name)], sort_keys=False),
                    'topic_type_hash': STORE.hash_rihs01(kind)})
            writer.add_message(ids[name], log_time, data, publish_time)
            counts[name, kind] = counts.get((name, kind), 0) + 1
        told = rosbag2_metadata(path.name, received, counts)
        writer.add_metadata('rosbag2', {'serialized_metadata': yaml.safe_dump(
            told['rosbag2_bagfile_information'], sort_keys=False)})
        writer.finish()
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(told, sort_keys=False))


def rosbag2_metadata(path, received, counts):
    """Contents of metadata.yaml, version 9."""
    times = {'duration': {'nanoseconds': received[-1][0] - received[0][0]},
             'starting_time': {'nanoseconds_since_epoch': received[0][0]}}
    return {'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', **times, 'message_count': len(received),
        'topics_with_message_count': [
            {'topic_metadata': {'name': name, 'type': kind, 'serialization_format': 'cdr',
                                'offered_qos_profiles': [offered(name)],
                                'type_description_hash': STORE.hash_rihs01(kind)},
             'message_count': count} for (name, kind), count in counts.items()],
        'compression_format': '', 'compression_mode': '', 'relative_file_paths': [path],
        'files': [{'path': path, **times, 'message_count': len(received)}],
        'custom_data': None, 'ros_distro': 'jazzy'}}


def offered(name):
    """As Fast DDS tells a recorder: it does not say history and depth."""
    entry = topic(name[1:])
    return {'history': 'unknown', 'depth': 0,
            'reliability': 'best_effort' if entry.reliability == BEST_EFFORT else 'reliable',
            'durability': 'transient_local' if entry.durability == LATCHED else 'volatile',
            'deadline': dict(FOREVER), 'lifespan': dict(FOREVER), 'liveliness': 'automatic',
            'liveliness_lease_duration': dict(FOREVER), 'avoid_ros_namespace_conventions': False}


def msg_files(kind):
    """The .msg files of a type and of what it is made of, as the installed packages have them."""
    words, *parts = STORE.generate_msgdef(kind, ros_version=2)[0].split('=' * 80 + '\nMSG: ')
    pieces = [msg_file(kind)]
    for part in parts:
        name = part.split('\n', 1)[0]
        pieces.append(f'MSG: {name}\n{msg_file(name.replace("/", "/msg/"))}')
    return ('=' * 80 + '\n').join(pieces)


def msg_file(kind):
    """One .msg file."""
    return Path(sys.prefix, 'share', f'{kind}.msg').read_text()


def foreign_robot(bag):
    """JPEGs, TwistStamped and other names; no goals, no ends of episodes."""
    types = STORE.types
    with RosbagsWriter(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        def connection(name, kind):
            return writer.add_connection(name, kind, typestore=STORE)
        camera = connection('/camera/color/image_raw/compressed',
                            'sensor_msgs/msg/CompressedImage')
        odometry = connection('/odometry/filtered', 'nav_msgs/msg/Odometry')
        command = connection('/base/cmd_vel', 'geometry_msgs/msg/TwistStamped')
        with AnyReader([DRIVE], default_typestore=STORE) as reader:
            for source, stamp, data in reader.messages():
                message = reader.deserialize(data, source.msgtype)
                if source.topic == '/image_raw':
                    _, jpeg = cv2.imencode('.jpg', decode_rgb(message)[..., ::-1])
                    out, to = types['sensor_msgs/msg/CompressedImage'](
                        message.header, 'rgb8; jpeg compressed bgr8', jpeg.ravel()), camera
                elif source.topic == '/odom':
                    out, to = message, odometry
                elif source.topic == '/cmd_vel':
                    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](
                        *divmod(stamp, 1_000_000_000)), 'base_link')
                    out, to = types['geometry_msgs/msg/TwistStamped'](header, message), command
                else:
                    continue
                writer.write(to, stamp, STORE.serialize_cdr(out, to.msgtype))


BAGS = {make.__name__: make for make in (house_drive, ros2_bag_record, foreign_robot)}


def main(names):
    """Replace the bags of these names, or all."""
    for name in names or BAGS:
        shutil.rmtree(FOLDER / name, ignore_errors=True)
        BAGS[name](FOLDER / name)


if __name__ == '__main__':
    main(sys.argv[1:])
