"""What a policy is shown of a recorded drive, and when."""


import dataclasses

import numpy as np
import pytest
from shadow_drives import (
    FOREIGN,
    NAMES,
    ROBOT,
    SCAN,
    SPEED,
    STORE,
    scanned_drive,
    two_drives,
)
from small_bags import (
    FIXTURE,
    IMAGE,
    INFO,
    ODOMETRY,
    START,
    camera_info,
    drive,
    odometry,
    picture,
    write,
)

from vn_msgs_py.images import decode_rgb
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.roles import Topics, load_topics
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.bags.shadow.plan import make_plan, stamped
from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS


def test_a_decision_is_wanted_where_training_takes_a_picture(tmp_path):
    drives = load_drives(FIXTURE, Wanted(ROBOT), tmp_path)
    plan = make_plan(FIXTURE, ROBOT, Topics())
    names = [None if a == NO_ACTION else DRIVE_ACTIONS[a] for a in drives.action]
    assert [d.done for d in plan.decisions] == [None, *names[:-1]]
    assert [d.last for d in plan.decisions] == [False] * (len(names) - 1) + [True]
    assert np.array([d.pose for d in plan.decisions]) == pytest.approx(np.array(drives.pose))
    assert plan.goals.shown == 1 and plan.rate == 20.0 and plan.camera_info is not None
    events = [event for event in plan.events() if event is not None]
    shown = [event for event in events if event.decision is not None]
    assert [event.decision for event in shown] == plan.decisions
    # By the clock of the headers, which the simulator drives faster than the wall's.
    assert [event.stamp * 1e-9 for event in shown] == pytest.approx(list(drives.time), abs=1e-6)
    ticks = [event.stamp for event in events if not event.picture]
    assert len(ticks) > 50
    assert np.diff(ticks) == pytest.approx(50e6, abs=1e3)
    assert [event.log_time for event in events] == sorted(event.log_time for event in events)


def test_another_robot_with_compressed_pictures_and_no_goal(tmp_path):
    (tmp_path / 'topics.yaml').write_text(NAMES)
    plan = make_plan(FOREIGN, ROBOT, load_topics(tmp_path / 'topics.yaml'))
    assert plan.compressed and plan.goals.hindsight == 1 and plan.goals.shown == 0
    *_, last = [e for e in plan.events() if e is not None and e.decision is not None]
    message = STORE.deserialize_cdr(last.data, 'sensor_msgs/msg/CompressedImage')
    assert np.array_equal(plan.goals.picture(0).picture, decode_rgb(message))
    grey = np.full((8, 8, 3), 128, np.uint8)
    given = make_plan(FOREIGN, ROBOT, load_topics(tmp_path / 'topics.yaml'), grey)
    assert given.goals.picture(0) is grey and given.goals.hindsight == 0


def test_a_clock_that_goes_back_goes_on_for_the_node(tmp_path):
    plan = make_plan(write(tmp_path / 'bag.mcap', two_drives()), ROBOT, Topics())
    assert {d.episode for d in plan.decisions} == {0, 1}
    for picture_or_tick in (True, False):
        stamps = [e.stamp for e in plan.events() if e and e.picture == picture_or_tick]
        assert (np.diff(stamps) > 0).all() and len(stamps) > 50
        assert stamps[-1] - stamps[0] < 20e9


def test_unreadable_pictures_are_left_out_and_counted(tmp_path):
    messages = drive(4.0)
    broken = []
    for name, kind, log_time, message in messages:
        if kind == IMAGE and (log_time - START) // 10**8 in (17, 18, 19):
            message.encoding = 'no such'
        broken.append((name, kind, log_time, message))
    whole = make_plan(write(tmp_path / 'whole.mcap', drive(4.0)), ROBOT, Topics())
    plan = make_plan(write(tmp_path / 'bag.mcap', broken), ROBOT, Topics())
    shown = [e.decision for e in plan.events() if e and e.decision]
    for _ in range(2):  # each policy of a comparison reads the bag
        list(plan.events())
        assert plan.unreadable == 3
    wanted = [d.time for d in plan.decisions]
    left_out = set(wanted) - {d.time for d in shown}
    assert len(left_out) <= 1 and wanted == [d.time for d in whole.decisions]
    for before, after in zip(plan.decisions, plan.decisions[1:], strict=False):
        if before.time in left_out:  # what was done since the last one is unknown
            assert next(d for d in shown if d.time == after.time).done is None


def test_a_stamp_is_replaced_in_place():
    message = STORE.serialize_cdr(odometry(START, 1.5), ODOMETRY)
    back = STORE.deserialize_cdr(stamped(bytes(message), 7_000_000_008), ODOMETRY)
    assert (back.header.stamp.sec, back.header.stamp.nanosec) == (7, 8)
    assert back.pose.pose.position.x == 1.5 and back.header.frame_id == 'base_link'


SCANS = dataclasses.replace(Topics(), scan='scan')


def decided(plan):
    return [event for event in plan.events() if event and event.decision]


def test_the_nearest_scan_belongs_to_a_picture_also_when_it_was_recorded_later(tmp_path):
    messages = scanned_drive()
    bag = write(tmp_path / 'bag.mcap', messages)
    plan = make_plan(bag, ROBOT, SCANS, ranges='scan')
    events = decided(plan)
    assert plan.ranges == '/scan' and len(events) >= 3
    for event in events:  # 30 ms later, and not the one 70 ms before
        assert event.ranges.stamp - event.stamp == 30_000_000
        where = SPEED * (event.ranges.stamp - START) * 1e-9
        assert event.ranges.pose == pytest.approx((where, 0.0, 0.0), abs=1e-6)
        message = STORE.deserialize_cdr(event.ranges.data, SCAN)
        assert message.header.stamp.nanosec == event.ranges.stamp % 10**9
    assert all(event.ranges is None for event in decided(make_plan(bag, ROBOT, SCANS)))
    # Where the nearest is too far off in time there is none.
    late = [m for m in messages if m[0] != '/scan' or m[2] > START + 2 * 10**9]
    held = [event.ranges is not None for event in decided(make_plan(
        write(tmp_path / 'late.mcap', late), ROBOT, SCANS, ranges='scan'))]
    assert not held[0] and held[-1]


def test_scans_of_a_clock_that_was_set_back_are_stamped_as_the_pictures_are(tmp_path):
    one = scanned_drive()
    two = []
    for name, kind, log_time, message in scanned_drive():
        if hasattr(message, 'header'):
            message.header.stamp.sec -= 1000
        two.append((name, kind, log_time + 10 * 10**9, message))
    events = decided(make_plan(write(tmp_path / 'bag.mcap', one + two), ROBOT, SCANS,
                               ranges='scan'))
    assert {event.decision.episode for event in events} == {0, 1}
    assert [event.ranges.stamp - event.stamp for event in events] == [30_000_000] * len(events)


def test_depth_pictures_come_with_their_camera_info(tmp_path):
    messages = [m for m in scanned_drive() if m[0] != '/scan']
    depth = [('/depth/image_raw', IMAGE, time, picture(
        time - 5_000_000, np.full((8, 8), 2.0, np.float32), '32FC1'))
        for name, _, time, _ in messages if name == '/image_raw']
    info = [('/depth/camera_info', INFO, time, message)
            for name, _, time, message in messages if name == '/camera_info']
    plan = make_plan(write(tmp_path / 'bag.mcap', messages + depth + info), ROBOT, Topics(),
                     ranges='depth')
    assert plan.ranges == '/depth/image_raw' and plan.depth_info is not None
    assert all(event.ranges.stamp == event.stamp for event in decided(plan))
    with pytest.raises(UserError, match='camera_info'):
        make_plan(write(tmp_path / 'none.mcap', messages + depth), ROBOT, Topics(),
                  ranges='depth')


def test_a_goal_of_another_camera_says_what_it_shows(tmp_path):
    goal = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    lens = camera_info(START, focal=20 / np.tan(np.radians(35)), side=40, width=60)
    sent = [('/goal_camera_info', INFO, START, lens),
            ('/goal_image', IMAGE, START + 1, picture(START, goal)), *drive(2.0)]
    plan = make_plan(write(tmp_path / 'bag.mcap', sent), ROBOT, Topics())
    shown = plan.goals.picture(0)
    assert plan.goals.shown == 1 and shown.fov == pytest.approx(np.radians(70), abs=1e-3)
    assert np.array_equal(shown.picture, goal)
