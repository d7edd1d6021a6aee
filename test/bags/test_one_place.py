"""Of a bag what is surely one place: breaks of odometry, stretches, what never looks alike."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from small_bags import ODOMETRY, START, odometry, write

from vn_nav.bags.continuity import ODOMETRY_GAP_S, Break, divide, find_breaks
from vn_nav.bags.mapping.loop_closure import OptimisedOdometry
from vn_nav.bags.mapping.one_place import Part, check_frame, check_place, choose, parse_pictures
from vn_nav.bags.mapping.same_place import MIN_UNMATCHED_PAIRS, together, unnoticed
from vn_nav.errors import UserError

TICK = 50_000_000  # ns


def breaks(tmp_path, *rows):
    """Of odometry at (seconds, x, yaw, frame); times of recording go on."""
    messages = []
    for k, (seconds, x, yaw, frame) in enumerate(rows):
        message = odometry(START + round(seconds * 1e9), x, yaw)
        message.header.frame_id = frame
        messages.append(('/odom', ODOMETRY, START + k * TICK, message))
    return find_breaks(write(tmp_path / 'bag.mcap', messages), '/odom')


@pytest.mark.parametrize(('then', 'reason'), [
    ((1.05, 0.65, 0.0, 'odom'), None),  # 1 m/s, and a correction of 0.3 m
    ((1.05, 5.0, 0.0, 'odom'), 'jumps by 4.7 m in 0.05 s'),
    ((1.05, 0.3, math.pi, 'odom'), 'turns by 180 deg in 0.05 s'),
    ((1.05, 0.3, 0.0, 'map'), "changes from 'odom' to 'map'"),
    ((0.0, 0.0, 0.0, 'odom'), 'goes back by 1.0 s'),
    ((1.0, 0.3, 0.0, 'odom'), None),  # twice the same
    ((1.5 + ODOMETRY_GAP_S, 0.3, 0.0, 'odom'), None),  # it stood there
    ((1.5 + ODOMETRY_GAP_S, 1.3, 0.0, 'odom'), 'silent for 10 s and then 1.0 m away'),
    ((0.9 + ODOMETRY_GAP_S, 1.3, 0.0, 'odom'), None)])
def test_what_no_robot_drives_is_a_break(then, reason, tmp_path):
    found = breaks(tmp_path, (0.95, 0.28, 0.0, 'odom'), (1.0, 0.3, 0.0, 'odom'), then,
                   (then[0] + 0.05, then[1], then[2], then[3]))
    if reason is None:
        assert not found
    else:
        assert len(found) == 1 and reason in found[0].reason
        assert math.isclose(found[0].before, START / 1e9 + 1.0, abs_tol=1e-6)


def test_pictures_fall_into_stretches_and_those_within_a_break_into_none():
    stamps = np.arange(0.0, 2.0, 0.1)
    found = divide(stamps, [Break(0.45, 0.55, 'a jump'), Break(1.21, 1.29, 'another frame')])
    assert found.number.tolist() == [0] * 6 + [1] * 7 + [2] * 7
    assert found.reasons == ['', 'a jump', 'another frame']
    assert np.flatnonzero(~found.sound).tolist() == [5]
    # A clock that is set back: the same stamps once more are other pictures.
    again = np.concatenate([stamps, stamps])
    found = divide(again, [Break(1.9, 0.0, 'the clock', back=True), Break(0.45, 0.55, 'a jump')])
    assert found.number.tolist() == [0] * 20 + [1] * 6 + [2] * 14
    assert found.reasons == ['', 'the clock', 'a jump']
    # Without odometry a silence, and pictures alone whose clock goes back.
    gap = np.concatenate([stamps, stamps + 60, stamps])
    found = divide(gap, [], odometry=False)
    assert found.number.tolist() == [0] * 20 + [1] * 20 + [2] * 20
    assert found.reasons == ['', 'silent for 58 s', 'the stamps of pictures go back']


def test_stretches_are_one_place_where_enough_closures_lead_across():
    pairs = [(0, 2)] * 5 + [(1, 2)] * 4 + [(3, 1)] * 2 + [(1, 3)] * 3
    assert together(5, pairs, 5).tolist() == [0, 1, 0, 1, 2]
    assert together(3, [], 5).tolist() == [0, 1, 2]
    assert together(1, [], 5).tolist() == [0]


def test_a_place_that_never_looks_as_it_did_is_another_one():
    rng = np.random.default_rng(0)
    first = rng.integers(0, 90, 400)
    second = np.minimum(first + rng.integers(5, 60, 400), 99)
    alike = rng.random(400) < 0.85
    assert unnoticed(first, second, alike) is None
    across = (first < 47) & (second >= 47)
    assert across.sum() > 2 * MIN_UNMATCHED_PAIRS
    assert unnoticed(first, second, alike & ~across) == 47
    few = np.flatnonzero(across)[MIN_UNMATCHED_PAIRS - 1:]  # too few to tell
    kept = np.setdiff1d(np.arange(400), few)
    assert unnoticed(first[kept], second[kept], (alike & ~across)[kept]) is None
    assert unnoticed(first[:0], second[:0], alike[:0]) is None


@pytest.mark.parametrize('text', ['', '5', '3-2', '0-4', '1-5,4-9', '1-5;7-9', 'a-b'])
def test_ranges_that_are_none_are_refused(text):
    with pytest.raises(UserError, match='ranges in their order'):
        parse_pictures(text)


def part(*lengths, vouched=False):
    """Stretches of a drive of one picture a second."""
    stretch = np.repeat(np.arange(len(lengths)), lengths)
    return Part(SimpleNamespace(time=np.arange(float(len(stretch)))), np.arange(len(stretch)),
                stretch, ['', *['odometry jumps'] * (len(lengths) - 1)], vouched)


def optimised(own, place, **facts):
    return OptimisedOdometry(np.zeros((len(own), 3)), None, np.array(own), np.array(place),
                             {'strain': 0.0, 'moved': 10.0, 'strained': 99} | facts)


def test_several_places_are_refused_with_the_stretches_and_how_to_take_one():
    asked = part(100, 200, 30)
    own = asked.stretch
    with pytest.raises(UserError) as error:
        check_place(asked, optimised(own, [0, 1, 0]))
    assert '2 that have nothing in common' in error.value.received
    assert '1-100 (0:00 to 1:39); 101-300 (1:40 to 4:59, because odometry jumps); 301-330' in (
        error.value.received)
    assert '--pictures 101-300, or' in error.value.remedy
    assert error.value.remedy.endswith('name them all: --pictures 1-100,101-300,301-330')
    check_place(asked, optimised(own, [0, 0, 0]))  # pictures connect them
    check_place(part(100, 200, vouched=True), optimised(own[:300], [0, 1]))
    with pytest.raises(UserError, match='--no-straighten'):
        check_frame(asked)
    check_frame(part(100))
    # What odometry does not say.
    hidden = np.repeat([0, 1], [60, 40])
    with pytest.raises(UserError, match=r'61-100 \(1:00 to 1:39, because from here on no picture'):
        check_place(part(100), optimised(hidden, [0, 1]))
    # Closures that bend odometry further than any drive does.
    with pytest.raises(UserError, match=r'after picture 100 \(1:39\).*up to 10.0 m'):
        check_place(part(200), optimised(own[:200] * 0, [0], strain=50.0))


def test_a_part_of_a_drive_is_chosen_by_the_numbers_of_its_pictures(tmp_path):
    class Set(SimpleNamespace):
        def __len__(self):
            return len(self.time)
    stamps = np.concatenate([np.arange(0.0, 10.0), np.arange(100.0, 110.0)])
    whole = Set(time=stamps, facts={'topics': {'odometry': ''}})
    chosen = choose(tmp_path, whole, None)
    assert chosen.stretch.tolist() == [0] * 10 + [1] * 10 and not chosen.vouched
    with pytest.raises(UserError, match='the drive has 20 pictures'):
        choose(tmp_path, whole, '5-21')
