"""One bit of a bag without checksums is flipped: no message is invented, every loss is told.

Short in the suite; VN_NAV_FLIPS=20000 is the long form (`make soak`): every bit of every opcode,
and so many bits anywhere, of each layout.
"""

import collections
import os
import random
import struct

import pytest
from mcap.writer import IndexType
from small_bags import drive, write
from test_bag_recover import LAYOUTS

from vn_nav import cli
from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.storage.stream import Bag, BagError

FLIPS = int(os.environ.get('VN_NAV_FLIPS', 0))
SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, STATISTICS = 3, 4, 5, 6, 7, 11
MESSAGES = 45


def rows_of(path, **options):
    return [(m.topic, m.type, m.sequence, m.log_time, m.publish_time, m.data)
            for m in Bag(path, **options).messages()]


def places(data, start=8, end=None):
    """(place, opcode, bytes of the body) of the records of a sound file, chunks before theirs."""
    at, end = start, len(data) if end is None else end
    while at + 9 <= end:
        opcode, length = struct.unpack_from('<BQ', data, at)
        if at + 9 + length > end:
            return
        yield at, opcode, length
        if opcode == CHUNK and not any(data[at + 37:at + 41]):
            yield from places(data, at + 49, at + 9 + length)
        at += 9 + length


def bag(tmp_path, layout='chunks', **options):
    """A small bag in a layout: path, bytes, messages."""
    path = write(tmp_path / 'a.mcap', drive(1.0, side=8),
                 **{'chunk': 1024, **LAYOUTS[layout], **options})
    sound = rows_of(path, strict=False)
    assert len(sound) == MESSAGES
    return path, path.read_bytes(), sound


def recovered_of(tmp_path, data):
    """What `recover` says of a file with these bytes, and the messages that it saved."""
    path, out = tmp_path / 'b.mcap', tmp_path / 'out.mcap'
    path.write_bytes(data)
    recovered = recover(path, out)
    rows = rows_of(out)
    out.unlink()
    return recovered, rows


def flip(data, place, bit):
    changed = bytearray(data)
    changed[place] ^= 1 << bit
    return bytes(changed)


def place_of(data, kind, number=0, at=0):
    """The place of a byte of the body of a record of a kind."""
    return [place for place, opcode, _ in places(data) if opcode == kind][number] + 9 + at


@pytest.mark.slow
@pytest.mark.timeout(max(240, FLIPS))
@pytest.mark.parametrize('layout', LAYOUTS)
def test_a_record_is_what_its_fields_say(tmp_path, layout):
    """Whatever bit of whatever opcode is wrong: all messages are there, and no other."""
    _, data, sound = bag(tmp_path, layout)
    cases = [(at, bit) for at, *_ in places(data) for bit in range(8)]
    if not FLIPS:
        cases = random.Random(0).sample(cases, 80)
    for at, bit in cases:
        recovered, rows = recovered_of(tmp_path, flip(data, at, bit))
        assert rows == sound, (at, data[at], bit, recovered.lines())
        assert not recovered.missing and not recovered.surplus and not recovered.lost


def unknowable(data, place, layout):
    """What of a message may be another one where a byte changed, and nobody can know it."""
    at, opcode, _ = [row for row in places(data) if row[0] <= place < row[0] + 9 + row[2]][-1]
    inner = place - at - 9
    indexed = 'index' not in layout and 'no chunks' not in layout
    once = 'killed' in layout
    if inner < 0:
        return ''
    if opcode == MESSAGE and inner >= 2 and not (indexed and 6 <= inner < 14):
        return 'message'
    if opcode == MESSAGE and inner < 2 and not indexed:
        return 'channel'
    if opcode in (SCHEMA, CHANNEL):
        return 'declaration' if once else 'declared twice'
    return 'chunk' if opcode == CHUNK and layout.endswith(('zstd', 'lz4')) else ''


def judge(data, place, layout, sound, recovered, rows):
    """What is wrong with a recovery and its account; '' if nothing is."""
    what = unknowable(data, place, layout)
    if what in ('declaration', 'declared twice'):  # content, but for names and types
        if what == 'declared twice' and rows != sound and not recovered.lost:
            return 'a declaration that changed is not told'
        sound, rows = [row[2:] for row in sound], [row[2:] for row in rows]
    invented = (collections.Counter(rows) - collections.Counter(sound)).total()
    if invented > {'': 0, 'chunk': 20}.get(what, 1):
        return f'{invented} messages never were'
    short = len(sound) - len(rows)
    if short < 0:
        return f'{-short} messages too many'
    counted = what == 'channel' and recovered.missing is not None
    if (short or counted and invented) and not recovered.lost:
        return f'{short} messages are missing, and nothing is said'
    if recovered.missing not in (None, short) and what != 'channel':
        return f'{recovered.missing} messages are said to be missing, and {short} are'
    if 'lost messages: -' in ' '.join(recovered.lines()):
        return 'a negative number'
    return ''


@pytest.mark.slow
@pytest.mark.timeout(max(240, FLIPS))
@pytest.mark.parametrize('layout', LAYOUTS)
def test_no_bit_anywhere_invents_or_hides_a_message(tmp_path, layout):
    _, data, sound = bag(tmp_path, layout)
    chance, lost, nothing = random.Random(1), 0, 0
    # Half of the bits are where a record begins: its kind, length, number or channel.
    records = [at for at, *_ in places(data)]
    for trial in range(FLIPS or 150):
        place = (chance.choice(records) + chance.randrange(13) if trial % 2 else
                 chance.randrange(8, len(data)))
        bit = chance.randrange(8)
        try:
            recovered, rows = recovered_of(tmp_path, flip(data, place, bit))
        except BagError as error:  # nothing is whole
            nothing += 1
            assert 'no message' in str(error), (place, bit)
            continue
        fault = judge(data, min(place, len(data) - 9), layout, sound, recovered, rows)
        assert not fault, (place, bit, fault, recovered.lines())
        lost += len(sound) - len(rows)
    print(f'{layout}: {lost} messages of {FLIPS or 150} files lost, {nothing} files wholly')


# One fault each, with its right value.


NO_INDEX = {'index_types': IndexType.NONE}
OTHER_CHANNEL = 2  # of the messages of /odom, when a bit of their channel (1) is wrong


def test_an_index_or_a_channel_is_no_message(tmp_path):
    """An opcode of one bit more or less; both have a known channel, and a likely time."""
    for kind, number in ((MESSAGE_INDEX, 5), (CHANNEL, 0)):
        path, data, sound = bag(tmp_path)
        bad = bytearray(data)
        bad[place_of(data, kind, number, -9)] = MESSAGE
        recovered, rows = recovered_of(tmp_path, bad)
        assert rows == sound and recovered.missing == 0 and recovered.surplus == 0


@pytest.mark.parametrize('opcode', [0x16, 0x86, 7, 2])
def test_a_chunk_of_another_kind_is_that_chunk(tmp_path, opcode):
    _, data, sound = bag(tmp_path, 'killed')
    bad = bytearray(data)
    bad[place_of(data, CHUNK, 3, -9)] = opcode
    recovered, rows = recovered_of(tmp_path, bad)
    assert rows == sound and not recovered.lost
    assert f'has the kind {opcode}, and the fields of kind 6' in ' '.join(recovered.lines())


@pytest.mark.parametrize('layout', ['chunks', 'no index', 'killed', 'no chunks'])
def test_a_message_of_another_kind_is_that_message(tmp_path, layout):
    for opcode in (0x45, 0x85, 4, 7):
        _, data, sound = bag(tmp_path, layout)
        bad = bytearray(data)
        bad[place_of(data, MESSAGE, 20, -9)] = opcode
        recovered, rows = recovered_of(tmp_path, bad)
        assert rows == sound and not recovered.lost, opcode


def test_strict_reading_of_a_file_that_counts_nothing_sees_it_too(tmp_path):
    """No checksums and no statistics: a chunk or a message that is passed over would be silent."""
    path, data, sound = bag(tmp_path, use_statistics=False, **NO_INDEX)
    assert rows_of(path) == sound
    for kind, opcode in ((CHUNK, 0x16), (MESSAGE, 0x45), (CHANNEL, MESSAGE)):
        bad = bytearray(data)
        bad[place_of(data, kind, 3, -9)] = opcode
        path.write_bytes(bad)
        with pytest.raises(BagError, match=f'fields of kind {kind}'):
            rows_of(path)


@pytest.mark.parametrize('body', [
    bytes(range(40)),
    b'\4\0\0\0name\5\0\0\0value',  # as a metadata record has it
    b'\1\0\4\0\0\0name' + 2 * b'\5\0\0\0value'], ids=['bytes', 'a pair', 'a schema'])
def test_a_private_record_stays_one(tmp_path, body):
    """It is passed over, and nothing is lost."""
    private = struct.pack('<BQ', 0x90, len(body)) + body
    path, data, sound = bag(tmp_path, 'killed')
    at = place_of(data, CHUNK, 3, -9)
    recovered, rows = recovered_of(tmp_path, data[:at] + private + data[at:])
    assert rows == sound and not recovered.lost
    assert f'0x90 ({len(private)} bytes)' in ' '.join(recovered.lines())
    assert 'fields of kind' not in ' '.join(recovered.lines())
    path, data, sound = bag(tmp_path, use_statistics=False, use_summary_offsets=False,
                            repeat_channels=False, repeat_schemas=False, **NO_INDEX)
    at = place_of(data, CHUNK, 3, -9)
    bad = bytearray(data[:at] + private + data[at:])
    path.write_bytes(bad)
    assert rows_of(path) == sound  # strictly, and nothing vouches for it


@pytest.mark.parametrize('layout', ['no index', 'no chunks'])
def test_messages_are_counted_by_channel(tmp_path, layout, capsys):
    """One is of another channel: the total is right, and two counts are not."""
    path, data, sound = bag(tmp_path, layout)
    number = [row[0] for row in sound].index('/odom', 5)
    bad = bytearray(data)
    place = place_of(data, MESSAGE, number)
    assert bad[place] == 1
    bad[place] = OTHER_CHANNEL
    path.write_bytes(bad)
    with pytest.raises(BagError, match='counts 20 messages of channel 1 .*19 were read'):
        rows_of(path)
    assert cli.main(['bag', 'recover', str(path), str(tmp_path / 'out'), '--strict']) == 2
    told = capsys.readouterr().out
    assert 'counts 20 messages of channel 1 (/odom), and 19 were read' in told
    assert 'lost messages: 1; 1 more than the file counts' in told


def test_a_surplus_is_not_a_negative_loss(tmp_path):
    """A copy of a message that no count has: nothing is missing, and one is too many."""
    path, data, _ = bag(tmp_path, 'no chunks', **{'repeat_channels': True})
    at, _, length = [row for row in places(data) if row[1] == MESSAGE][10]
    copy = data[at:at + 9 + length]
    footer = len(data) - 37
    start, = struct.unpack_from('<Q', data, footer + 9)
    bad = bytearray(data[:at] + copy + data[at:])
    struct.pack_into('<QQ', bad, footer + len(copy) + 9, start + len(copy), 0)
    recovered, rows = recovered_of(tmp_path, bad)
    assert len(rows) == MESSAGES + 1
    assert (recovered.missing, recovered.surplus, recovered.lost) == (0, 1, True)
    assert 'lost messages: 0; 1 more than the file counts' in recovered.lines()[-1]


def test_of_two_copies_the_sound_one_is_taken(tmp_path):
    """A bit of a copy is wrong: no message is lost."""
    _, data, sound = bag(tmp_path)
    first = [row for row in places(data) if row[1] == CHANNEL]
    again = first[len(first) // 2][0] + 9  # in the summary
    wrong = {
        "a channel's schema in the summary": (again + 2, 6),
        "a channel's schema in the data": (first[0][0] + 9 + 2, 6),
        "the index's channel": (place_of(data, MESSAGE_INDEX, 4), 6),
        "the index's channel, another one": (place_of(data, MESSAGE_INDEX, 4), 1),
        'a length in a schema': (place_of(data, SCHEMA, 0, 2), 3),
        "a channel's length": (first[1][0] + 1, 4),
        'a place in the index of chunks': (place_of(data, 8, 4, 16), 6),
        'a count': (place_of(data, STATISTICS, 0, 0), 3),
        "a chunk's checksum, which there is none of": (place_of(data, CHUNK, 2, 24), 5)}
    for name, (place, bit) in wrong.items():
        recovered, rows = recovered_of(tmp_path, flip(data, place, bit))
        assert rows == sound and recovered.missing == 0, (name, recovered.lines())
        assert not recovered.lost, (name, recovered.lines())


@pytest.mark.parametrize('layout', ['killed', 'no chunks, killed'])
def test_a_length_in_a_declaration_without_another_copy(tmp_path, layout):
    _, data, sound = bag(tmp_path, layout)
    for kind, at in ((SCHEMA, 2), (CHANNEL, 4)):
        for place in (place_of(data, kind, 1, at), place_of(data, kind, 1, -8)):
            recovered, rows = recovered_of(tmp_path, flip(data, place, 6))
            assert rows == sound and not recovered.lost, (kind, recovered.lines())
