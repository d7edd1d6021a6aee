"""The state machine: arming, hold, stop, decisions, and who may move when."""

import numpy as np
import pytest

from vn_nav.policy.navigator import Limits, Navigator, State
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

DT = 0.05
ODOMETRY = np.zeros(3)


class Rig:
    """A navigator with a clock and a camera."""

    def __init__(self, **options):
        self.navigator = Navigator(RobotSpec().with_actions(DRIVE_ACTIONS), Limits(), **options)
        self.now = 100.0

    def frame(self):
        """One good frame now; the ticket of a decision if one is wanted."""
        assert self.navigator.admit(self.now, self.now)
        self.navigator.good_frame(self.now)
        return self.navigator.request(self.now, self.now)

    def step(self, odometry=ODOMETRY):
        self.now += DT
        return self.navigator.step(self.now, DT, odometry, self.now)

    def frame_later(self):
        """A period, then a frame."""
        self.step()
        return self.frame()

    def arm(self):
        """A goal, and a bit more than a second of frames."""
        self.navigator.new_goal()
        self.navigator.accept_goal(-np.inf)
        for _ in range(22):
            self.now += DT
            self.frame()
        assert self.navigator.enable(self.now)[0]

    def decide(self, action=0):
        """Frames until a decision is wanted; then make it."""
        for _ in range(60):
            self.step()
            ticket = self.frame()
            if ticket is not None:
                self.navigator.decided(ticket, action, self.now + 0.01)
                return
        raise AssertionError('no decision was ever wanted')


@pytest.fixture
def rig():
    return Rig()


def test_enabling_says_what_is_missing(rig):
    done, message = rig.navigator.enable(rig.now)
    assert not done and 'goal_image' in message and 'image_raw' in message
    rig.navigator.new_goal()
    rig.navigator.accept_goal(-np.inf)
    rig.frame()
    done, message = rig.navigator.enable(rig.now)
    assert not done and 'less than 1 s' in message
    assert not rig.navigator.enable(rig.now, ('an intruder',))[0]
    rig.arm()
    assert rig.navigator.state is State.RUNNING


def test_silent_until_enabled(rig):
    assert rig.step() is None
    rig.arm()
    assert np.array_equal(rig.step(), np.zeros(4))


def test_a_decision_moves_and_the_next_waits_for_rest(rig):
    rig.arm()
    rig.decide(action=0)
    first = rig.step()
    assert first[0] > 0 and (first[1:] == 0).all()
    assert rig.frame() is None  # in motion nobody decides
    pose = np.zeros(3)
    for _ in range(200):
        velocity = rig.step(pose)
        pose[0] += velocity[0] * DT
        rig.frame()
        if not velocity.any():
            break
    assert pose[0] == pytest.approx(0.5, abs=0.01)
    ended = rig.now
    while (ticket := rig.frame_later()) is None:
        assert rig.now < ended + 1
    assert ticket is not None and rig.now >= ended + rig.navigator.limits.settle_time


def test_a_base_that_rolls_on_is_not_at_rest(rig):
    """By odometry; and one whose odometry never rests is waited for no longer than 2 s."""
    rig.arm()
    for rolls in (0.8, 5.0):
        rig.decide(1)
        pose, ticket = np.zeros(3), None
        while rig.step(pose) is not None and rig.navigator.velocity.any():
            pose = pose - [0.05, 0.0, 0.0]
            rig.frame()
        ended = rig.now
        while ticket is None:
            if rig.now - ended < rolls:
                pose = pose - [0.01, 0.0, 0.0]
            rig.step(pose)
            ticket = rig.frame()
        assert rig.now - ended == pytest.approx(min(rolls, 2.0) + 0.1, abs=0.11)
        rig.navigator.decided(ticket, 1, rig.now + 0.01)
        while rig.step(pose) is not None and rig.navigator.velocity.any():
            pose = pose - [0.05, 0.0, 0.0]
            rig.frame()


def test_camera_silence_holds_then_latches(rig):
    rig.arm()
    rig.decide()
    assert rig.step().any()
    start, held, stopped = rig.now, None, None
    while rig.now < start + 3:
        velocity = rig.step()
        if rig.navigator.state is State.HOLD and held is None:
            held = rig.now - start
        if rig.navigator.state is State.STOPPED and stopped is None:
            stopped = rig.now - start
        if held is not None and velocity is not None:
            assert not velocity.any()
    assert held <= 0.30 and 0.9 <= stopped <= 1.1
    assert velocity is None  # a second of zeros, then silence
    rig.frame()
    assert rig.navigator.state is State.STOPPED  # latched
    assert not rig.navigator.enable(rig.now)[0]
    rig.navigator.reset()
    assert rig.navigator.state is State.IDLE  # reset never enables
    rig.arm()


def test_a_camera_that_sends_what_is_no_use_is_not_called_silent(rig):
    rig.arm()
    for _ in range(30):
        rig.step()
        assert not rig.navigator.admit(rig.now - 0.4, rig.now)
        if rig.navigator.state is State.HOLD:
            assert 'no usable camera frame: stamps lie 0.40 s behind' in rig.navigator.reason
    assert rig.navigator.state is State.STOPPED
    assert rig.navigator.reason.startswith('no usable camera frame for 1.0 s: stamps lie 0.40 s')
    assert 'max_frame_age' in rig.navigator.reason


def test_a_short_silence_heals_by_itself(rig):
    rig.arm()
    for _ in range(8):
        rig.step()
    assert rig.navigator.state is State.HOLD
    rig.frame()
    rig.step()
    assert rig.navigator.state is State.RUNNING


def test_a_new_goal_holds_and_begins_a_new_episode(rig):
    rig.arm()
    rig.decide()
    assert rig.step().any()
    rig.navigator.new_goal()
    rig.frame()
    assert not rig.step().any() and rig.navigator.state is State.HOLD
    rig.navigator.accept_goal(-np.inf)
    rig.frame()
    rig.step()
    assert rig.navigator.state is State.RUNNING and rig.navigator.decisions == 0


def test_a_decision_for_the_old_goal_is_discarded(rig):
    rig.arm()
    rig.step()
    ticket = rig.frame()
    rig.navigator.new_goal()
    rig.navigator.accept_goal(-np.inf)
    rig.navigator.decided(ticket, 0, rig.now)
    assert not rig.step().any()
    assert not rig.navigator.ready_to_move


@pytest.mark.parametrize('stamp, reason', [
    (99.0, 'old'), (100.2, 'ahead'), (99.94, None)])
def test_stamps_are_judged(rig, stamp, reason):
    assert rig.navigator.admit(stamp, rig.now) == (reason is None)
    if reason:
        assert any(reason in key for key in rig.navigator.dropped)


def test_duplicate_and_reordered_frames_are_dropped(rig):
    assert rig.navigator.admit(100.0, 100.0)
    assert not rig.navigator.admit(100.0, 100.0)
    assert not rig.navigator.admit(99.99, 100.0)
    assert rig.navigator.dropped == {'reordered stamp': 2}


def test_three_bad_frames_in_a_row_stop(rig):
    rig.arm()
    for _ in range(2):
        rig.navigator.bad_frame('unknown encoding', rig.now)
    rig.frame_later()
    for _ in range(2):
        rig.navigator.bad_frame('unknown encoding', rig.now)
    assert rig.navigator.state is State.RUNNING
    rig.navigator.bad_frame('unknown encoding', rig.now)
    assert rig.navigator.state is State.STOPPED and 'bad frames' in rig.navigator.reason


def test_late_inference_is_discarded_and_the_third_latches(rig):
    rig.arm()
    for miss in range(3):
        rig.step()
        ticket = None
        while ticket is None:
            ticket = rig.frame_later()
        for _ in range(3):  # 150 ms without an answer
            velocity = rig.step()
        assert not velocity.any()
        rig.navigator.decided(ticket, 0, rig.now)
        assert not rig.step().any(), 'a late decision must not move the robot'
        assert (rig.navigator.state is State.STOPPED) == (miss == 2)


def test_a_slow_policy_does_not_take_its_own_thinking_for_a_silent_camera():
    """While it thinks no picture is decoded; those that are admitted say that the camera lives."""
    rig = Rig()
    rig.navigator.limits = Limits(inference_timeout=1.0)
    rig.arm()

    def think(sees):
        ticket = None
        while ticket is None:
            ticket = rig.frame_later()
        for _ in range(8):  # 0.4 s, and the camera is silent after 0.25
            rig.step()
            if sees:
                assert rig.navigator.admit(rig.now, rig.now, rig.now)
        return rig.navigator.decided(ticket, 0, rig.now)
    for _ in range(3):
        assert think(True) and rig.step().any() and rig.navigator.state is State.RUNNING
        rig.frame()
        while rig.step().any():
            rig.frame()
    assert not think(False) and rig.navigator.reason == 'camera silent'
    # What came and cannot be decoded is as good as nothing.
    rig.frame_later()
    rig.step()
    rig.navigator.admit(rig.now, rig.now, rig.now)
    rig.navigator.bad_frame('torn', rig.now)
    for _ in range(6):
        rig.step()
    assert rig.navigator.state is State.HOLD


def test_stop_is_immediate_even_in_motion(rig):
    rig.arm()
    rig.decide()
    assert rig.step().any()
    rig.navigator.stop('~/stop was called', rig.now)
    assert np.array_equal(rig.step(), np.zeros(4))


def test_nobody_drives_blind_when_odometry_falls_silent(rig):
    rig.arm()
    rig.now += DT
    assert not rig.navigator.step(rig.now, DT, ODOMETRY, rig.now, odometry_lost=True).any()
    assert rig.navigator.state is State.HOLD and 'odometry' in rig.navigator.reason
    rig.frame()
    rig.decide()  # odometry is back
    assert rig.step().any()
    rig.now += DT
    assert not rig.navigator.step(rig.now, DT, ODOMETRY, rig.now, odometry_lost=True).any()
    assert rig.navigator.state is State.STOPPED and 'odometry' in rig.navigator.reason


def test_a_clock_that_goes_back_disarms(rig):
    rig.arm()
    rig.navigator.time_jumped('the clock went back by 5 s')
    assert not rig.step().any() and rig.navigator.state is State.IDLE


def test_disabling_in_motion_sends_zeros_before_the_silence(rig):
    assert rig.step() is None  # never enabled: nothing to take back
    rig.arm()
    while not rig.step().any():
        rig.decide()
    rig.navigator.disable()
    sent = [rig.step() for _ in range(int(1.5 / DT))]
    zeros = [velocity for velocity in sent if velocity is not None]
    assert len(zeros) >= 0.9 / DT and not np.any(zeros)
    assert sent[0] is not None and sent[-1] is None


def declare(rig, probability=0.93):
    """Frames until a decision is wanted; then the policy says that it has arrived."""
    while (ticket := rig.frame_later()) is None:
        pass
    rig.navigator.declared(ticket, probability, rig.now + 0.01)


@pytest.mark.parametrize('continuous', [False, True])
def test_a_declared_arrival_stands_until_there_is_another_goal(continuous):
    rig = Rig(continuous=continuous)
    rig.arm()
    if continuous:
        rig.decide()
        assert rig.step().any()
    declare(rig)
    assert rig.navigator.state is State.ARRIVED and rig.navigator.reason == 'p = 0.93'
    assert rig.navigator.decisions == 1 + continuous  # standing still is a decision
    for _ in range(60):
        assert rig.frame_later() is None  # nothing is decided
        assert np.array_equal(rig.step(), np.zeros(4))
    rig.navigator.new_goal()
    assert rig.navigator.state is State.HOLD and rig.navigator.arrival is None
    rig.navigator.accept_goal(-np.inf)
    rig.decide()
    assert rig.step().any() and rig.navigator.decisions == 1


def test_enabling_again_goes_on_from_where_it_arrived(rig):
    rig.arm()
    declare(rig)
    assert rig.navigator.enable(rig.now)[0]
    assert rig.navigator.state is State.RUNNING and rig.navigator.arrival is None
    rig.decide()
    assert rig.step().any()


def test_camera_and_odometry_are_watched_where_it_arrived(rig):
    rig.arm()
    declare(rig)
    rig.now += DT
    assert not rig.navigator.step(rig.now, DT, ODOMETRY, rig.now, odometry_lost=True).any()
    assert rig.navigator.state is State.HOLD and 'odometry' in rig.navigator.reason
    rig.step()
    assert rig.navigator.state is State.ARRIVED, 'a healed fault is no reason to drive on'
    for _ in range(8):
        rig.step()
    assert rig.navigator.state is State.HOLD and 'camera' in rig.navigator.reason
    rig.frame()
    rig.step()
    assert rig.navigator.state is State.ARRIVED and rig.navigator.reason == 'p = 0.93'
    for _ in range(25):
        rig.step()
    assert rig.navigator.state is State.STOPPED


@pytest.mark.parametrize('order, state', [
    (lambda navigator, now: navigator.stop('~/stop was called', now), State.STOPPED),
    (lambda navigator, now: navigator.disable(), State.IDLE),
    (lambda navigator, now: navigator.reset(), State.IDLE),
    (lambda navigator, now: navigator.time_jumped('the clock went back'), State.IDLE)])
def test_orders_of_people_come_before_arrival(rig, order, state):
    rig.arm()
    ticket = None
    while ticket is None:
        ticket = rig.frame_later()
    order(rig.navigator, rig.now)
    rig.navigator.declared(ticket, 0.93, rig.now)  # too late to say so
    assert rig.navigator.state is state and rig.navigator.arrival is None
    rig.navigator.reset()
    rig.arm()
    declare(rig)
    order(rig.navigator, rig.now)
    assert rig.navigator.state is state and rig.navigator.arrival is None


def test_a_late_declaration_is_discarded(rig):
    rig.arm()
    while (ticket := rig.frame_later()) is None:
        pass
    rig.navigator.declared(ticket, 0.93, rig.now + 0.2)
    assert rig.navigator.state is State.RUNNING and rig.navigator.decisions == 0


def test_continuous_mode_decides_in_motion():
    rig = Rig(continuous=True)
    rig.arm()
    rig.decide(action=0)
    for _ in range(5):
        velocity = rig.step()
        ticket = rig.frame()
        assert ticket is not None
        rig.navigator.decided(ticket, 0, rig.now)
    assert velocity[0] > 0.05


@pytest.mark.parametrize('heard', [0, 1, 5])
def test_a_stop_that_is_cleared_at_once_still_sends_its_zeros(rig, heard):
    """Whether or not the output thread was asked between the two."""
    rig.arm()
    while not rig.step().any():
        rig.decide()
    rig.navigator.stop('~/stop was called', rig.now)
    sent = [rig.step() for _ in range(heard)]
    rig.navigator.reset()
    sent += [rig.step() for _ in range(int(1.5 / DT))]
    zeros = [velocity for velocity in sent if velocity is not None]
    assert len(zeros) >= 0.9 / DT and not np.any(zeros)
    rig.navigator.stop('again', rig.now)
    while rig.step() is not None:
        pass
    rig.navigator.reset()
    assert rig.step() is None, 'what was said is not said again'


def test_a_picture_taken_in_motion_is_no_picture_at_rest(rig):
    rig.arm()
    while not rig.step().any():
        rig.decide()
    rig.navigator.odometry_jumped('odometry jumped by 2 m')
    assert not rig.step().any()
    stopped = rig.now
    while rig.frame_later() is None:
        assert rig.now < stopped + 1
    assert rig.now > stopped + rig.navigator.limits.settle_time


def test_a_goal_that_is_refused_in_motion_stands_still(rig):
    rig.arm()
    while not rig.step().any():
        rig.decide()
    rig.navigator.refuse_goal('the camera is too narrow')
    assert not rig.step().any() and rig.navigator.state is State.HOLD
