"""Hostile and broken bags end in one typed error, within limits of memory and time.

A child process with an address-space limit reads mutated bags: flipped bytes, cut and repeated
stretches, changed lengths, and chunks that were changed within and compressed anew with a fitting
checksum. Nothing but `BagError`, or a clean read, may come of it. VN_NAV_MUTATIONS=50000 is the
long form (`make soak`).
"""

import json
import os
import random
import resource
import struct
import subprocess
import sys
import time
import traceback
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, Schema
from paths import TESTS
from small_bags import START, STORE, STRING, chunk_record, drive, make, records, whole, write

from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.stream import Bag, BagError, messages

MUTATIONS = int(os.environ.get('VN_NAV_MUTATIONS', 1500))
MEMORY = 640 << 20  # bytes beyond what the process has when it begins
SECONDS = 5.0  # of CPU that a bag may take
CHUNK = 6
EXTREMES = (0, 1, 8, 0x7F, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**48, 2**63 - 1, 2**63, 2**64 - 1)


def bases(folder):
    """Sound bags of several layouts, a few kB each."""
    sent = drive(0.6, side=8)
    layouts = ({}, {'compression': 'lz4'}, {'compression': ''}, {'chunked': False},
               {'finish': False}, {'enable_data_crcs': True, 'enable_crcs': False})
    return [write(folder / f'base{k}.mcap', sent, chunk=1500, **options).read_bytes()
            for k, options in enumerate(layouts)]


def mutated(base, chance):
    """A bag with one or a few things wrong."""
    data = bytearray(base)
    kind = chance.choice(('flip', 'cut', 'extreme', 'remove', 'repeat', 'within', 'within'))
    if kind == 'within':
        return mutated_within(base, chance)
    at = chance.randrange(len(data))
    if kind == 'flip':
        for _ in range(chance.randint(1, 8)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == 'cut':
        del data[at:]
    elif kind == 'extreme':
        places = [place for place, _, _ in records(base)] if chance.random() < 0.5 else []
        at = chance.choice(places) + chance.choice((1, 9, 25, 33)) if places else at
        width = chance.choice((2, 4, 8))
        value = chance.choice((*EXTREMES, len(data), len(data) - at)) % (1 << 8 * width)
        data[at:at + width] = value.to_bytes(width, 'little')
    else:
        end = min(at + chance.randint(1, 2000), len(data))
        data[at:end] = b'' if kind == 'remove' else data[at:end] * 2
    return bytes(data)


def mutated_within(base, chance):
    """Change what is in a chunk, and compress it anew so that its checksum is right."""
    chunks = []
    try:
        chunks = [(at, length) for at, opcode, length in records(base) if opcode == CHUNK]
    except struct.error:  # a base without its end
        pass
    if not chunks:
        return base[:-1]
    at, length = chance.choice(chunks)
    body = base[at + 9:at + 9 + length]
    compression = body[32:32 + body[28]].decode()
    if compression == 'lz4':
        return base[:at] + base[at + 9:]
    stored = body[40 + len(compression):]
    plain = bytearray(zstandard.decompress(stored) if compression else stored)
    for _ in range(chance.randint(1, 4)):
        place = chance.randrange(len(plain))
        if chance.random() < 0.5:
            plain[place] ^= 1 << chance.randrange(8)
        else:
            width = chance.choice((2, 4, 8))
            plain[place:place + width] = (chance.choice(EXTREMES) % (1 << 8 * width)).to_bytes(
                width, 'little')
    builder = RecordBuilder()
    Chunk(compression=compression, data=zstandard.compress(plain) if compression else bytes(plain),
          message_start_time=START, message_end_time=START, uncompressed_crc=zlib.crc32(plain),
          uncompressed_size=len(plain)).write(builder)
    return base[:at] + builder.end() + base[at + 9 + length:]


def declarations(builder):
    Schema(id=1, name=STRING, encoding='ros2msg',
           data=STORE.generate_msgdef(STRING, ros_version=2)[0].encode()).write(builder)
    Channel(id=1, schema_id=1, topic='/t', message_encoding='cdr', metadata={}).write(builder)


def crafted():
    """Files that ask for more than they should get, by name."""
    builder = RecordBuilder()
    declarations(builder)
    declared = builder.end()
    endless = zstandard.ZstdCompressor(level=19).compress(bytes(2 << 30 >> 3))
    stream = zstandard.ZstdCompressor().compressobj()  # no size in its frame
    unsized = b''.join([stream.compress(bytes(64 << 20)) for _ in range(4)] + [stream.flush()])
    huge = bytearray(zstandard.compress(b'x' * 1000))
    huge[5:7] = b'\xff\xff'

    def raw(opcode, length, body):
        return struct.pack('<BQ', opcode, length) + body

    chunk = struct.Struct('<QQQII')
    return {
        'endless zstd that declares 1,000 bytes': whole(declared, chunk_record(
            b'', stored=endless, size=1000)),
        'endless zstd without a size': whole(declared, chunk_record(
            b'', stored=unsized, size=1000)),
        'endless zstd that declares all': whole(declared, chunk_record(
            b'', stored=endless, size=1 << 40)),
        'a frame that lies': whole(declared, chunk_record(b'x' * 1000, stored=bytes(huge))),
        'a bad checksum': whole(declared, chunk_record(b'x' * 1000, crc=1)),
        'lz4 that is none': whole(declared, chunk_record(
            b'x', stored=b'\x04"M\x18' + bytes(40), size=1 << 13, compression='lz4')),
        'lz4 that declares too much': whole(declared, chunk_record(
            b'x', stored=lz4.frame.compress(b'x'), size=1 << 27, compression='lz4')),
        'an unknown compression': whole(declared, chunk_record(b'', compression='gzip', size=1)),
        'a record beyond the file': whole(declared, raw(5, 2**63, bytes(40))),
        'a chunk beyond the file': whole(declared, raw(6, 1 << 40, bytes(100))),
        'a chunk within itself': whole(declared, chunk_record(chunk_record(b''))),
        'a text beyond its record': whole(raw(3, 10, b'\1\0' + b'\xff' * 8)),
        'many fake chunks': whole(declared, b''.join(
            b'\x06' + struct.pack('<Q', 60_000) + chunk.pack(0, 0, 1 << 28, 0, 0)
            + struct.pack('<Q', 60_000 - 40) for _ in range(20_000)), bytes(1 << 20)),
        'a topic that is not for terminals': whole(raw(4, 22, struct.pack(
            '<HHI', 1, 0, 5) + b'\x1b[2Jx' + struct.pack('<I', 0) + bytes(5))),
    }


def try_all(path, folder, thorough):
    """Read a bag in every way; what came of it, 'clean' or 'error'."""
    outcome = 'clean'
    for read in (lambda: [m.message for m in messages(path)],
                 lambda: list(Bag(path, strict=False).messages()),
                 lambda: list(Bag(path).messages(['odom'])),
                 lambda: list(messages(path, strict=False)),
                 *((lambda: diagnose(path), lambda: recover(path, folder / 'out.mcap'))
                   if thorough else ())):
        try:
            read()
        except BagError as error:
            assert str(path) in str(error) or str(folder) in str(error), error
            outcome = 'error'
    (folder / 'out.mcap').unlink(missing_ok=True)
    return outcome


def run(folder, first, count):
    """The child: prints what came of its bags."""
    base_bags, found = bases(folder), {'clean': 0, 'error': 0, 'other': [], 'slowest': 0.0}
    path = folder / 'bag.mcap'
    path.write_bytes(base_bags[0])
    try_all(path, folder, True)  # what is loaded once
    special = crafted() if first == 0 else {}
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for number in range(first, first + count):
        chance = random.Random(number)
        path.write_bytes(mutated(chance.choice(base_bags), chance))
        attempt(str(number), path, folder, number % 5 == 0, found)
    for name, data in special.items():
        path.write_bytes(data)
        before = found['error']
        attempt(name, path, folder, True, found)
        if found['error'] == before:
            found['other'].append(f'{name}: no error')
    print(json.dumps(found))


def attempt(name, path, folder, thorough, found):
    begin = time.process_time()
    try:
        found[try_all(path, folder, thorough)] += 1
    except BaseException:  # the very thing that must not happen
        found['other'].append(f'{name}: {traceback.format_exc()[-1500:]}')
    seconds = time.process_time() - begin
    found['slowest'] = max(found['slowest'], seconds)
    if seconds > SECONDS:
        found['other'].append(f'{name}: {seconds:.1f} s')


@pytest.mark.slow
@pytest.mark.timeout(max(240, MUTATIONS // 10))
def test_no_mutated_bag_escapes_the_one_error(tmp_path):
    environment = {**os.environ, 'PYTHONPATH': str(TESTS),
                   'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'}
    done = subprocess.run([sys.executable, __file__, str(tmp_path), '0', str(MUTATIONS)],
                          env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert not found['other'], f'{len(found["other"])}: ' + '\n'.join(found['other'][:3])
    assert found['error'] > MUTATIONS / 2 and found['clean'] > 0
    print(found)


def test_what_is_only_declared_takes_no_memory(tmp_path):
    path = tmp_path / 'bag.mcap'
    next(messages(write(path, drive(0.2))))  # what is loaded once
    tracemalloc.start()
    try:
        for name, data in crafted().items():
            path.write_bytes(data)
            size = len(data)
            del data
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            with pytest.raises(BagError):
                list(messages(path))
            list(Bag(path, strict=False).messages())
            taken = tracemalloc.get_traced_memory()[1] - before
            assert taken < 3_000_000 + 4 * size, f'{name}: {taken} bytes'
    finally:
        tracemalloc.stop()


def test_a_message_that_would_become_millions_of_objects_is_refused(tmp_path):
    kind = 'diagnostic_msgs/msg/KeyValue'
    many = 'a/msg/Many'
    text = f'{kind}[] values\n{"=" * 80}\nMSG: {kind}\nstring key\nstring value\n'
    count = 2_100_000
    data = b'\0\1\0\0' + count.to_bytes(4, 'little') + np.zeros(count * 10, np.uint8).tobytes()
    path = write(tmp_path / 'a.mcap', [('/many', many, START, data)], definitions={many: text})
    with pytest.raises(BagError, match='objects'):
        list(messages(path))
    few = STORE.types['diagnostic_msgs/msg/DiagnosticArray'](
        make('std_msgs/msg/Header'), [make('diagnostic_msgs/msg/DiagnosticStatus')] * 10)
    path = write(tmp_path / 'b.mcap', [('/d', 'diagnostic_msgs/msg/DiagnosticArray', START, few)])
    assert len(next(messages(path)).message.status) == 10


if __name__ == '__main__':
    run(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
