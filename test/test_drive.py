"""Synchronising messages and cutting drives into actions, on drives whose truth is known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from vn_msgs_py.motion import yaw_to_quaternion
from vn_nav.bags.drive import (
    MISFIT,
    Cutter,
    Heard,
    Report,
    integrate,
    synchronise,
)
from vn_nav.bags.roles import TYPES, Topics, load_topics
from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
ROLES = {'/image_raw': 'image', '/odom': 'odometry', '/cmd_vel': 'command',
         '/goal_image': 'goal', '/depth/image_raw': 'depth', '/episode_end': 'episode_end'}


def typed(**roles):
    """Topics by role, with a type that each may have."""
    return {name: TYPES[role][0] for role, name in roles.items()}


TOPICS = Topics().within({name: TYPES[role][0] for name, role in ROLES.items()})


def header(stamp):
    return SimpleNamespace(stamp=SimpleNamespace(
        sec=int(stamp), nanosec=round((stamp - int(stamp)) * 1e9)))


def picture(stamp):
    return SimpleNamespace(header=header(stamp))


def odometry(stamp, x, y, yaw):
    names = ('x', 'y', 'z', 'w')
    zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    return SimpleNamespace(header=header(stamp), pose=SimpleNamespace(pose=SimpleNamespace(
        position=SimpleNamespace(x=x, y=y, z=0.0),
        orientation=SimpleNamespace(**dict(zip(names, yaw_to_quaternion(yaw), strict=True))))),
        twist=SimpleNamespace(twist=SimpleNamespace(linear=zero, angular=zero)))


def twist(v, w):
    return SimpleNamespace(linear=SimpleNamespace(x=v, y=0.0, z=0.0),
                           angular=SimpleNamespace(x=0.0, y=0.0, z=w))


def drive(commands, *, rate=30.0, start=10.0, odometry_rate=50.0, offset=0.0):
    """Messages of a robot that obeys (v, w, seconds), and its pose at each time."""
    at, pose, path = start, np.zeros(3), [(start, np.zeros(3))]
    for v, w, seconds in commands:
        for _ in range(round(seconds * 1000)):
            pose = integrate(pose, np.array([v, 0.0, w]), 1e-3)
            at += 1e-3
            path.append((at, pose))
    times = np.array([t for t, _ in path])

    def where(t):
        return path[min(int(np.searchsorted(times, t)), len(path) - 1)][1]
    end = times[-1]
    messages = [Heard('/odom', odometry(t, *where(t)), t + offset)
                for t in np.arange(start - 0.1, end + 0.1, 1 / odometry_rate)]
    messages += [Heard('/image_raw', picture(t), t + offset + 0.02)
                 for t in np.arange(start, end, 1 / rate)]
    return sorted(messages, key=lambda heard: heard.time), where


def frames_of(messages, topics=TOPICS):
    report = Report()
    return list(synchronise(messages, topics, report)), report


def steps_of(messages, robot=ROBOT, topics=TOPICS):
    report = Report()
    return list(Cutter(robot, report).cut(synchronise(messages, topics, report))), report


def test_every_picture_gets_the_pose_of_its_own_stamp():
    # The clock of recording is years from that of the stamps, as with a simulator.
    messages, where = drive([(0.3, 0.5, 3.0)], offset=1e9)
    frames, report = frames_of(messages)
    assert len(frames) == report.pictures == 90 and report.without_pose == 0
    assert report.episodes == 1
    for frame in frames:
        assert np.allclose(frame.pose, where(frame.stamp), atol=2e-3)


def test_yaw_is_interpolated_the_short_way_round():
    messages = [Heard('/odom', odometry(1.0, 0, 0, math.pi - 0.02), 1.0),
                Heard('/image_raw', picture(1.02), 1.02),
                Heard('/odom', odometry(1.04, 0, 0, -math.pi + 0.02), 1.04)]
    (frame,), _ = frames_of(messages)
    assert abs(abs(frame.pose[2]) - math.pi) < 1e-6


def test_pictures_without_odometry_near_them_are_dropped_and_counted():
    messages, _ = drive([(0.3, 0.0, 4.0)])
    kept = [m for m in messages if m.topic != '/odom' or not 11.0 < m.message.header.stamp.sec
            + m.message.header.stamp.nanosec * 1e-9 < 13.0]
    frames, report = frames_of(kept)
    gone = [t for t in np.arange(10.0, 14.0, 1 / 30) if 11.05 <= t <= 12.95]
    assert abs(report.without_pose - len(gone)) <= 2
    assert report.episodes == 2  # nothing is known of what lies between
    assert len(frames) == report.pictures - report.without_pose


def test_late_and_repeated_pictures_are_left_out():
    messages, _ = drive([(0.3, 0.0, 1.0)])
    pictures = [m for m in messages if m.topic == '/image_raw']
    again = Heard('/image_raw', pictures[3].message, pictures[9].time)
    at = messages.index(pictures[9])
    frames, report = frames_of(messages[:at] + [again] + messages[at:])
    assert report.unordered == 1 and len(frames) == len(pictures)


def test_depth_belongs_to_the_picture_of_its_stamp():
    messages, _ = drive([(0.3, 0.0, 2.0)], rate=10.0)
    depths = [Heard('/depth/image_raw', picture(m.message.header.stamp.sec
                    + m.message.header.stamp.nanosec * 1e-9 + 0.004), m.time + 0.3)
              for m in messages if m.topic == '/image_raw'][:-1]
    frames, _ = frames_of(sorted(messages + depths, key=lambda heard: heard.time))
    for frame in frames[:-1]:
        stamp = frame.depth.header.stamp
        assert stamp.sec + stamp.nanosec * 1e-9 == pytest.approx(frame.stamp + 0.004)
    assert frames[-1].depth is None  # its own never came, and another's is not taken


def test_episodes_end_where_they_are_said_to_where_the_goal_changes_and_at_gaps_and_jumps():
    messages, _ = drive([(0.3, 0.0, 6.0)])
    end, goal = SimpleNamespace(data=1), 0.0
    events = [Heard('/goal_image', picture(5.0), 10.0), Heard('/episode_end', end, 11.0),
              Heard('/goal_image', picture(5.0), 12.0),  # the same goal again: nothing new
              Heard('/goal_image', picture(6.0), 13.0)]
    frames, report = frames_of(sorted(messages + events, key=lambda heard: heard.time))
    first = [next(f.time for f in frames if f.episode == k) for k in range(report.episodes)]
    assert report.episodes == 3 and report.jumps == 0
    assert all(abs(t - expected) < 0.05 for t, expected in zip(first, (10, 11, 13), strict=True))
    goal = [f.goal.header.stamp.sec for f in frames]
    assert goal[0] == 5 and goal[-1] == 6
    quiet = [m for m in messages if m.topic == '/odom' or not 12.0 < m.time < 13.5]
    assert frames_of(quiet)[1].episodes == 2
    moved = [m if m.time < 12.0 or m.topic != '/odom' else Heard(
        m.topic, odometry(m.message.header.stamp.sec + m.message.header.stamp.nanosec * 1e-9,
                          m.message.pose.pose.position.x + 3.0, 0.0, 0.0), m.time)
             for m in messages]
    assert frames_of(moved)[1].jumps == 1


def test_velocities_stand_in_for_odometry_and_are_not_believed_for_ever():
    topics = Topics().within(typed(image='/image_raw', command='/cmd_vel'))
    assert topics.odometry == ''
    messages = [Heard('/cmd_vel', twist(0.4, 0.0), t) for t in np.arange(1.0, 2.0, 0.1)]
    messages += [Heard('/cmd_vel', twist(math.nan, 0.0), 1.55)]
    messages += [Heard('/image_raw', picture(t), t) for t in np.arange(1.0, 4.0, 0.1)]
    frames, report = frames_of(sorted(messages, key=lambda heard: heard.time), topics)
    assert report.bad == 1
    # It drives for 0.9 s between commands, and half a second beyond the last.
    assert frames[-1].pose[0] == pytest.approx(0.4 * 1.4, abs=0.01)


def test_a_drive_in_clean_actions_is_cut_into_exactly_them():
    actions = [0, 2, 0, 0, 3, 3, 1, 0]
    commands = []
    for action in actions:
        v, w = {0: (0.25, 0.0), 1: (-0.2, 0.0), 2: (0.0, 0.5), 3: (0.0, -0.5)}[action]
        size = abs(ROBOT.actions[action].size)
        commands += [(v, w, size / (abs(v) + abs(w))), (0.0, 0.0, 0.3)]
    for rate in (30.0, 12.0):
        steps, report = steps_of(drive(commands, rate=rate)[0])
        assert [s.action for s in steps if not s.last] == actions
        assert report.misfits == 0 and report.misfit_share == 0 and steps[-1].last


def test_an_action_ends_at_the_picture_nearest_to_its_end():
    steps, _ = steps_of(drive([(0.3, 0.0, 6.0)], rate=8.0)[0])
    gaps = np.diff([step.frame.pose[0] for step in steps[:-1]])
    assert len(gaps) >= 2 and np.abs(gaps - 0.5).max() <= 0.3 / 8 / 2 + 1e-6


def test_curves_that_fit_no_action_are_counted_and_the_poses_go_on():
    gentle, report = steps_of(drive([(0.3, 0.1, 8.0)])[0])
    assert report.misfits == 0 and report.actions[0] >= 3
    tight, report = steps_of(drive([(0.3, 0.25, 8.0)])[0])
    assert report.misfits >= 3 and report.misfit_share > 0.5
    assert {step.action for step in tight} >= {MISFIT}
    for step, following in zip(tight, tight[1:], strict=False):
        assert np.hypot(*(following.frame.pose - step.frame.pose)[:2]) < 0.8


def test_a_robot_that_stands_still_gives_one_frame_an_episode():
    steps, report = steps_of(drive([(0.0, 0.0, 3.0)])[0])
    assert len(steps) == 1 and steps[0].last and not report.actions


def test_topics_are_found_by_role_and_renamed_by_a_file(tmp_path):
    names = typed(image='image_raw/compressed', odometry='odom')
    assert Topics().within(names).image == 'image_raw/compressed'
    path = tmp_path / 'topics.yaml'
    path.write_text('image: /camera/color/image_raw\nodometry: /base/odom\n')
    found = load_topics(path).within(typed(image='/camera/color/image_raw/compressed',
                                           odometry='/base/odom'))
    assert found.image == '/camera/color/image_raw/compressed' and found.odometry == '/base/odom'
    with pytest.raises(UserError, match='image_raw'):
        Topics().within(typed(odometry='/odom'))
    with pytest.raises(UserError, match='odometry or command'):
        Topics().within(typed(image='/image_raw'))
    for text in ('picture: /a', 'image: 3', '- a', ': :', 'image: "/"'):
        path.write_text(text)
        with pytest.raises(UserError, match='topics'):
            load_topics(path)


def test_what_is_held_is_bounded_when_odometry_ends():
    messages = [Heard('/odom', odometry(t, 0.0, 0.0, 0.0), t) for t in np.arange(0.9, 1.1, 0.02)]
    messages += [Heard('/image_raw', picture(t), t) for t in np.arange(1.0, 60.0, 0.1)]
    report, ahead = Report(), []

    def watched():
        for message in sorted(messages, key=lambda heard: heard.time):
            yield message
            ahead.append(report.pictures - report.without_pose)
    list(synchronise(watched(), TOPICS, report))
    assert max(ahead) <= 15 and report.without_pose > 500
