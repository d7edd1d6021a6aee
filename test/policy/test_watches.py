"""Stamps, clocks and goals: what is new, what is late, what belongs to another time."""

import math

import pytest

from vn_nav.policy.clock_watch import ClockWatch
from vn_nav.policy.frame_gate import FrameGate, shorten
from vn_nav.policy.goal_watch import GoalWatch


def test_the_cure_stands_beside_the_offset():
    gate = FrameGate(0.25, 0.05)
    assert not gate.admit(100.0, 137.5) and '37.50 s behind' in gate.last
    assert all(word in gate.last for word in ('use_sim_time', 'NTP', 'max_frame_age'))
    assert not gate.admit(137.6, 137.5) and 'ahead' in gate.last and 'max_frame_ahead' in gate.last
    assert gate.dropped == {'old stamp': 1, 'stamp ahead': 1}
    assert '1 for old stamp' in gate.summary()


def test_hostile_texts_stay_short_and_kinds_few():
    gate = FrameGate(0.25, 0.05)
    for number in range(1000):
        gate.unusable(f'{number}\n' * 100_000)
    assert gate.dropped == {'unusable picture': 1000} and len(gate.last) <= 200
    assert shorten('a\n b') == 'a b' and len(shorten('x' * 10**7)) == 200


@pytest.mark.parametrize('stamp, clock, back', [
    (99.9, 100.0, 0.0),  # reordered: both agree with one clock
    (99.0, 99.1, 1.0),  # the clock was set back by more than both may differ
    (99.0, 100.0, 0.0),  # merely old
    (1.0, None, 99.0),  # lock-step: the order alone tells
    (99.9, None, 0.0)])
def test_when_a_frame_shows_that_time_was_set_back(stamp, clock, back):
    gate = FrameGate(0.25, 0.05)
    assert gate.admit(100.0, 100.0)
    assert gate.went_back(stamp, clock) == pytest.approx(back)
    if back:
        gate.forget()
        assert gate.admit(stamp, clock) and not gate.admit(stamp, clock)


def test_frames_that_are_not_later_are_dropped():
    gate = FrameGate(0.25, 0.05)
    assert gate.admit(100.0, 100.0) and not gate.admit(100.0, 100.0)
    assert not gate.admit(99.9, 100.0) and not gate.admit(math.nan, 100.0)
    assert gate.dropped == {'reordered stamp': 3}


def looks(*pairs, simulated=True):
    watch = ClockWatch(simulated=simulated)
    return [watch.look(clock, steady) for clock, steady in pairs]


def test_a_clock_that_was_set():
    assert looks((100.0, 5.0), (100.05, 5.05), (160.0, 5.1), (160.05, 5.15), (1.0, 5.2)) == [
        '', '', 'the clock jumped ahead by 59.95 s', '', 'the clock went back by 159.1 s']


def test_a_clock_that_goes_its_way():
    assert not any(looks((0.0, 1.0), (0.0, 2.0), (50.0, 3.0), (50.05, 3.05)))  # it begins
    assert not any(looks((10.0, 1.0), (20.0, 11.0)))  # the process was suspended
    assert not any(looks((10.0, 1.0), (14.0, 1.5)))  # a simulator eight times as fast
    assert not any(looks((10.0, 1.0), (9.95, 1.05)))  # NTP
    assert any(looks((10.0, 1.0), (11.1, 1.05), simulated=False)), 'no clock of this world'


def test_a_goal_is_a_stamp_and_a_picture():
    watch = GoalWatch()
    assert watch.is_new(1, 'kitchen', 0.0)
    assert not watch.is_new(1, 'kitchen', 0.1)  # latched, heard again
    assert watch.is_new(1, 'bath', 0.2)  # a simulator that was started again
    assert watch.is_new(2, 'bath', 60.0)  # a new episode towards the same place


def test_a_goal_at_a_rate_is_one_goal():
    watch = GoalWatch()
    new = [watch.is_new(stamp, 'kitchen', stamp / 10) for stamp in range(50)]
    assert new == [True, True] + [False] * 48
    assert '10.0 times a second' in watch.warning(4.9) and 'once' in watch.warning(4.9)
    assert not watch.warning(12.0)
    assert watch.is_new(100, 'kitchen', 20.0), 'after a pause it is meant anew'
    watch = GoalWatch(trust_stamps=True)
    assert all(watch.is_new(stamp, 'kitchen', stamp / 10) for stamp in range(50))
    assert not watch.warning(4.9)


def test_goals_that_change_all_the_time_are_named():
    watch = GoalWatch()
    assert all(watch.is_new(stamp, stamp, stamp / 10) for stamp in range(50))
    assert 'each picture is a new goal' in watch.warning(4.9)
    assert not watch.warning(12.0)


@pytest.mark.parametrize('period', [0.1, 1.0, 2.5, 4.0])
def test_any_rate_is_noticed(period):
    watch = GoalWatch()
    new = [watch.is_new(stamp, 'kitchen', stamp * period) for stamp in range(20)]
    assert sum(new) == 2 and 'publish it once' in watch.warning(19 * period)
