"""Small recordings for tests, made message by message, and ways to damage them."""

import struct
import zlib
from io import BytesIO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer, Header
from mcap.writer import CompressionType, Writer
from paths import ROOT
from rosbags.typesys import Stores, get_typestore

FIXTURE = ROOT / 'bags' / 'house_drive'
STORE = get_typestore(Stores.ROS2_JAZZY)
MAGIC = b'\x89MCAP0\r\n'
START = 1_700_000_000_000_000_000  # ns
IMAGE, ODOMETRY, INFO, TWIST, STRING = (
    'sensor_msgs/msg/Image', 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/CameraInfo',
    'geometry_msgs/msg/Twist', 'std_msgs/msg/String')


def make(kind, **fields):
    """A message of a type; what is not given is zero or empty."""
    values = {}
    for name, (node, what) in STORE.fielddefs[kind][1]:
        if name in fields:
            values[name] = fields.pop(name)
        elif node == 1:
            values[name] = '' if what[0] == 'string' else 0
        elif node == 2:
            values[name] = make(what)
        elif node == 3:
            values[name] = np.zeros(what[1], what[0][1][0])
        else:
            values[name] = []
    assert not fields
    return STORE.types[kind](**values)


def header(time, frame='base_link'):
    stamp = make('builtin_interfaces/msg/Time', sec=time // 10**9, nanosec=time % 10**9)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id=frame)


def picture(time, pixels, encoding='rgb8'):
    return make(IMAGE, header=header(time), height=pixels.shape[0], width=pixels.shape[1],
                encoding=encoding, step=pixels.shape[1] * (pixels.size // pixels[..., 0].size
                                                           if pixels.ndim == 3 else 1),
                data=pixels.reshape(-1).view(np.uint8))


def odometry(time, x, yaw=0.0):
    message = make(ODOMETRY, header=header(time))
    message.pose.pose.position.x = float(x)
    message.pose.pose.orientation.z = float(np.sin(yaw / 2))
    message.pose.pose.orientation.w = float(np.cos(yaw / 2))
    return message


def camera_info(time, focal=16.0, side=32, width=None):
    width = width or side
    # Pixels have their centres at integers.
    k = np.array([focal, 0, (width - 1) / 2, 0, focal, (side - 1) / 2, 0, 0, 1.0])
    return make(INFO, header=header(time), height=side, width=width, k=k, d=np.zeros(0))


def twist(speed):
    message = make(TWIST)
    message.linear.x = speed
    return message


def drive(seconds=4.0, side=32, seed=0, speed=0.3):
    """A sound recording: camera at 10 Hz, odometry at 20 Hz, both stamped, and commands."""
    chance = np.random.default_rng(seed)
    messages = []
    for k in range(int(seconds * 20)):
        time = START + k * 50_000_000
        messages.append(('/odom', ODOMETRY, time + 1_000_000, odometry(time, speed * k * 0.05)))
        if k % 2 == 0:
            pixels = chance.integers(0, 256, (side, side, 3), np.uint8)
            messages += [('/image_raw', IMAGE, time + 5_000_000, picture(time, pixels)),
                         ('/camera_info', INFO, time + 6_000_000, camera_info(time, side / 2))]
        if k % 4 == 0:
            messages.append(('/cmd_vel', TWIST, time + 7_000_000, twist(speed)))
    return messages


def serialised(kind, message):
    return bytes(STORE.serialize_cdr(message, kind))


def write(path, messages, *, compression='zstd', chunk=4096, chunked=True, finish=True,
          definitions=None, schema='ros2msg', encoding='cdr', **options):
    """An MCAP file of (topic, type, log time, message or bytes); its path."""
    kinds = {'zstd': CompressionType.ZSTD, 'lz4': CompressionType.LZ4, '': CompressionType.NONE}
    stream = BytesIO()
    writer = Writer(stream, chunk_size=chunk, compression=kinds[compression],
                    use_chunking=chunked, **options)
    writer.start('ros2', 'test')
    channels = {}
    for topic, kind, time, message in messages:
        if topic not in channels:
            text = (definitions or {}).get(kind)
            if text is None:
                text = STORE.generate_msgdef(kind, ros_version=2)[0]
            number = writer.register_schema(kind, schema, text.encode())
            channels[topic] = writer.register_channel(
                topic, encoding, number, {'offered_qos_profiles': '[]'})
        data = message if isinstance(message, bytes) else serialised(kind, message)
        writer.add_message(channels[topic], time, data, time - 1000)
    if finish:
        writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def records(data):
    """(offset, opcode, length) of the records of a sound file."""
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', data, at)
        yield at, opcode, length
        at += 9 + length


def chunk_record(plain, *, size=None, crc=None, stored=None, compression='zstd', time=START):
    """A chunk; what it declares may be something else than what it holds."""
    builder = RecordBuilder()
    Chunk(compression=compression,
          data=zstandard.compress(plain) if stored is None else stored,
          message_start_time=time, message_end_time=time,
          uncompressed_crc=zlib.crc32(plain) if crc is None else crc,
          uncompressed_size=len(plain) if size is None else size).write(builder)
    return builder.end()


def whole(*parts):
    """A file of data records, with its two ends and without a summary."""
    builder = RecordBuilder()
    Header('ros2', 'test').write(builder)
    head = builder.end()
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    return MAGIC + head + b''.join(parts) + builder.end() + MAGIC
