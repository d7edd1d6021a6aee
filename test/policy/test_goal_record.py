"""How a goal ends: arrived, given up for each reason, taken back; nothing moves then."""

import numpy as np
import pytest
from test_navigator import DT, Rig

from vn_nav.policy.goal_record import Code, GoalLimits, GoalRecord, ProgressWatch, Status
from vn_nav.policy.navigator import State
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

FORWARD, LEFT = DRIVE_ACTIONS.index('forward'), DRIVE_ACTIONS.index('rotate_left')


def armed(**limits):
    rig = Rig(goal_limits=GoalLimits(**limits))
    rig.arm()
    return rig


def see(rig):
    """A good frame, of which no decision is made."""
    assert rig.navigator.admit(rig.now, rig.now)
    rig.navigator.good_frame(rig.now)


def finish_action(rig):
    """Drive the action under way to its end, by time."""
    for _ in range(200):
        velocity = rig.step(None)
        see(rig)
        if not velocity.any() and rig.navigator.phase.value == 'look':
            return
    raise AssertionError('the action did not end')


def test_a_goal_waits_for_enable_and_then_is_under_way():
    rig = Rig()
    assert rig.navigator.goal.status is Status.NONE
    rig.navigator.new_goal()
    rig.navigator.accept_goal(-np.inf)
    assert (rig.navigator.goal.number, rig.navigator.goal.status) == (1, Status.WAITING)
    assert rig.navigator.goal.seconds(rig.now) == 0.0
    rig = armed()
    assert rig.navigator.goal.status is Status.ACTIVE


@pytest.mark.parametrize('take_back', ['disable', 'reset'])
def test_a_goal_that_a_person_takes_back_waits_no_more(take_back):
    """Whoever enables what waits (an action, auto_enable) leaves it alone."""
    rig = Rig()
    rig.navigator.new_goal()
    rig.navigator.accept_goal(-np.inf)
    getattr(rig.navigator, take_back)()
    assert rig.navigator.goal.status is Status.CANCELLED
    for _ in range(22):
        see(rig)
        rig.step()
    assert rig.navigator.enable(rig.now)[0]
    assert (rig.navigator.goal.number, rig.navigator.goal.status) == (1, Status.ACTIVE)


def test_a_goal_that_is_cut_anew_is_the_same_goal():
    rig = armed()
    rig.navigator.accept_goal(-np.inf, again=True)
    assert (rig.navigator.goal.number, rig.navigator.goal.status) == (1, Status.ACTIVE)


def test_no_time_is_negative():
    """Somebody else may have read the clock before the goal began; no Duration holds that."""
    record = GoalRecord()
    record.accept()
    record.activate(10.0)
    assert record.seconds(9.999) == 0.0


def test_arriving_is_success_and_its_time_stands_still():
    rig = armed()
    ticket = rig.frame_later()
    rig.navigator.declared(ticket, 0.9, rig.now)
    goal = rig.navigator.goal
    assert (goal.status, goal.code, rig.navigator.state) == (
        Status.SUCCEEDED, Code.NONE, State.ARRIVED)
    took = goal.seconds(rig.now)
    for _ in range(5):
        rig.step()
    assert goal.seconds(rig.now) == took


def test_used_up_decisions_end_it_and_enable_begins_it_again():
    rig = armed(max_decisions=2)
    for _ in range(2):
        rig.decide(FORWARD)
        finish_action(rig)
    for _ in range(10):
        rig.step()
        assert rig.frame() is None
    goal = rig.navigator.goal
    assert (goal.status, goal.code) == (Status.FAILED, Code.BUDGET) and '2 dec' in goal.message
    assert rig.navigator.state is State.FAILED and not rig.step().any()
    assert rig.navigator.enable(rig.now)[0] and rig.navigator.state is State.RUNNING
    assert (goal.status, rig.navigator.decisions) == (Status.ACTIVE, 0)
    rig.decide(FORWARD)
    assert rig.step().any()


def test_a_budget_is_renewed_also_where_motion_was_disabled_in_between():
    rig = armed(max_decisions=1)
    rig.decide(FORWARD)
    finish_action(rig)
    while rig.navigator.goal.status is Status.ACTIVE:
        rig.frame_later()
    rig.navigator.disable()
    assert rig.navigator.enable(rig.now)[0]
    rig.decide(FORWARD)
    assert rig.step().any()


def test_time_that_is_over_ends_it_in_motion():
    rig = armed(time_allowance=1.0)
    rig.decide(FORWARD)
    moved = False
    while rig.navigator.goal.status is Status.ACTIVE:
        moved |= bool(rig.step().any())
        see(rig)
    assert moved and rig.navigator.goal.code is Code.BUDGET
    assert rig.navigator.goal.seconds(rig.now) == pytest.approx(1.0, abs=2 * DT)
    assert not rig.step().any() and rig.navigator.state is State.FAILED


def test_a_failed_goal_stays_failed_through_a_moment_without_camera():
    rig = armed()
    rig.navigator.give_up(Code.BLOCKED, 'a wall')
    for _ in range(8):  # 0.4 s without pictures
        rig.step()
    assert rig.navigator.state is State.HOLD
    see(rig)
    rig.step()
    assert (rig.navigator.state, rig.navigator.reason) == (State.FAILED, 'a wall')


def test_another_goal_after_a_failed_one_is_driven_to_with_the_usual_limits():
    rig = armed(max_decisions=5)
    rig.navigator.new_goal(GoalLimits(max_decisions=1))
    assert rig.navigator.goal.status is Status.CANCELLED
    rig.navigator.accept_goal(-np.inf)
    assert rig.navigator.goal.status is Status.ACTIVE  # motion is still enabled
    assert rig.navigator.goal_limits.max_decisions == 1
    rig.navigator.give_up(Code.NO_PROGRESS, 'nowhere')
    rig.navigator.new_goal()
    rig.navigator.accept_goal(-np.inf)
    assert rig.navigator.goal_limits.max_decisions == 5
    rig.decide(FORWARD)
    assert rig.step().any()


@pytest.mark.parametrize('end, status, code', [
    (lambda rig: rig.navigator.disable(), Status.CANCELLED, Code.NONE),
    (lambda rig: rig.navigator.reset(), Status.CANCELLED, Code.NONE),
    (lambda rig: rig.navigator.new_goal(), Status.CANCELLED, Code.NONE),
    (lambda rig: rig.navigator.stop('somebody', rig.now), Status.FAILED, Code.STOPPED),
    (lambda rig: rig.navigator.time_jumped('clock'), Status.FAILED, Code.STOPPED),
    (lambda rig: rig.navigator.refuse_goal('torn'), Status.FAILED, Code.GOAL_REFUSED),
    (lambda rig: [rig.step() for _ in range(30)], Status.FAILED, Code.CAMERA_LOST),
    (lambda rig: [rig.navigator.bad_frame('torn', rig.now) for _ in range(3)], Status.FAILED,
     Code.CAMERA_LOST),
    (lambda rig: (rig.decide(FORWARD), rig.step(), rig.step(), rig.navigator.step(
        rig.now, DT, np.zeros(3), rig.now, odometry_lost=True)),
     Status.FAILED, Code.ODOMETRY_LOST),
])
def test_whatever_ends_a_goal_is_told(end, status, code):
    rig = armed()
    end(rig)
    assert (rig.navigator.goal.status, rig.navigator.goal.code) == (status, code)
    assert rig.navigator.goal.message
    silent = rig.step()
    assert silent is None or not silent.any()


def test_a_robot_that_circles_about_one_place_makes_no_progress():
    watch = ProgressWatch(GoalLimits(progress_decisions=10, progress_radius=0.5),
                          RobotSpec().with_actions(DRIVE_ACTIONS))
    away = [watch.decided(FORWARD, np.array([0.3 * k, 0.0, 0.0])) for k in range(40)]
    assert not any(away)
    found = [watch.decided(LEFT, np.array([11.7, 0.3 * (k % 2), 0.5 * k])) for k in range(12)]
    # The circle may have begun up to two decisions before the last metre was driven.
    assert [bool(one) for one in found].index(True) in (8, 9, 10)
    assert found[-1][0] is Code.NO_PROGRESS
    watch.reset()
    assert watch.decided(LEFT, np.array([11.7, 0.0, 0.0])) is None


def test_moves_that_are_cut_off_in_a_row_are_blocked():
    watch = ProgressWatch(GoalLimits(blocked_moves=3), RobotSpec().with_actions(DRIVE_ACTIONS))
    here = np.zeros(3)
    assert [watch.decided(action, here) for action in (FORWARD, LEFT, FORWARD)] == [None] * 3
    assert watch.decided(LEFT, here) is None  # turns between do not count
    assert watch.decided(FORWARD, np.array([0.4, 0.0, 0.0])) is None
    assert watch.decided(FORWARD, np.array([0.9, 0.0, 0.0])) is None  # free again
    for _ in range(2):
        assert watch.decided(FORWARD, np.array([0.95, 0.0, 0.0])) is None
    assert watch.decided(FORWARD, np.array([0.95, 0.0, 0.0]))[0] is Code.BLOCKED


def test_without_odometry_nothing_is_said_of_progress():
    watch = ProgressWatch(GoalLimits(progress_decisions=1, blocked_moves=1),
                          RobotSpec().with_actions(DRIVE_ACTIONS))
    assert not any(watch.decided(FORWARD, None) for _ in range(20))


def test_no_limits_no_end():
    watch = ProgressWatch(GoalLimits(), RobotSpec().with_actions(DRIVE_ACTIONS))
    assert not any(watch.decided(FORWARD, np.zeros(3)) for _ in range(500))
    record = GoalRecord()
    record.end(Status.FAILED, 1.0, Code.BUDGET, 'of nothing')
    assert record.status is Status.NONE
