"""Synchronising messages and cutting drives into actions, on drives whose truth is known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from vn_msgs_py.motion import yaw_to_quaternion
from vn_nav.bags.drive import Report, synchronise
from vn_nav.bags.drive import TimestampedMessage as Message
from vn_nav.bags.poses import integrate
from vn_nav.bags.roles import TYPES, Topics, full_name, load_topics
from vn_nav.bags.segmenter import NO_ACTION, ActionSegmenter
from vn_nav.bags.stamped import Stamped
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
    messages = [Message('/odom', odometry(t, *where(t)), t + offset)
                for t in np.arange(start - 0.1, end + 0.1, 1 / odometry_rate)]
    messages += [Message('/image_raw', picture(t), t + offset + 0.02)
                 for t in np.arange(start, end, 1 / rate)]
    return sorted(messages, key=lambda heard: heard.time), where


def frames_of(messages, topics=TOPICS):
    report = Report()
    return list(synchronise(messages, topics, report)), report


def steps_of(messages, robot=ROBOT, topics=TOPICS):
    report = Report()
    return list(ActionSegmenter(robot, report).cut(synchronise(messages, topics, report))), report


def test_every_picture_gets_the_pose_of_its_own_stamp():
    # The clock of recording is years from that of the stamps, as with a simulator.
    messages, where = drive([(0.3, 0.5, 3.0)], offset=1e9)
    frames, report = frames_of(messages)
    assert len(frames) == report.pictures == 90 and report.without_pose == 0
    assert report.episodes == 1
    for frame in frames:
        assert np.allclose(frame.pose, where(frame.stamp), atol=2e-3)


def test_yaw_is_interpolated_the_short_way_round():
    messages = [Message('/odom', odometry(1.0, 0, 0, math.pi - 0.02), 1.0),
                Message('/image_raw', picture(1.02), 1.02),
                Message('/odom', odometry(1.04, 0, 0, -math.pi + 0.02), 1.04)]
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
    again = Message('/image_raw', pictures[3].message, pictures[9].time)
    at = messages.index(pictures[9])
    frames, report = frames_of(messages[:at] + [again] + messages[at:])
    assert report.unordered == 1 and len(frames) == len(pictures)


def test_depth_belongs_to_the_picture_of_its_stamp():
    messages, _ = drive([(0.3, 0.0, 2.0)], rate=10.0)
    taken = [(m.message.header.stamp.sec + m.message.header.stamp.nanosec * 1e-9, m.time)
             for m in messages if m.topic == '/image_raw']
    depths = [Message('/depth/image_raw', picture(stamp + 0.004), time + 0.3)
              for stamp, time in taken[:-1]]
    frames, _ = frames_of(sorted(messages + depths, key=lambda heard: heard.time))
    for frame in frames[:-1]:
        stamp = frame.depth.header.stamp
        assert stamp.sec + stamp.nanosec * 1e-9 == pytest.approx(frame.stamp + 0.004)
    assert frames[-1].depth is None  # its own never came, and another's is not taken


def test_episodes_end_where_they_are_said_to_where_the_goal_changes_and_at_gaps_and_jumps():
    messages, _ = drive([(0.3, 0.0, 6.0)])
    end, goal = SimpleNamespace(data=1), 0.0
    events = [Message('/goal_image', picture(5.0), 10.0), Message('/episode_end', end, 11.0),
              Message('/goal_image', picture(5.0), 12.0),  # the same goal again: nothing new
              Message('/goal_image', picture(6.0), 13.0)]
    frames, report = frames_of(sorted(messages + events, key=lambda heard: heard.time))
    first = [next(f.time for f in frames if f.episode == k) for k in range(report.episodes)]
    assert report.episodes == 3 and report.jumps == 0
    assert all(abs(t - expected) < 0.05 for t, expected in zip(first, (10, 11, 13), strict=True))
    goal = [f.goal.header.stamp.sec for f in frames]
    assert goal[0] == 5 and goal[-1] == 6
    quiet = [m for m in messages if m.topic == '/odom' or not 12.0 < m.time < 13.5]
    assert frames_of(quiet)[1].episodes == 2
    moved = [m if m.time < 12.0 or m.topic != '/odom' else Message(
        m.topic, odometry(m.message.header.stamp.sec + m.message.header.stamp.nanosec * 1e-9,
                          m.message.pose.pose.position.x + 3.0, 0.0, 0.0), m.time)
             for m in messages]
    assert frames_of(moved)[1].jumps == 1


def test_velocities_stand_in_for_odometry_and_are_not_believed_for_ever():
    topics = Topics().within(typed(image='/image_raw', command='/cmd_vel'))
    assert topics.odometry == ''
    messages = [Message('/cmd_vel', twist(0.4, 0.0), t) for t in np.arange(1.0, 2.0, 0.1)]
    messages += [Message('/cmd_vel', twist(math.nan, 0.0), 1.55)]
    messages += [Message('/image_raw', picture(t), t) for t in np.arange(1.0, 4.0, 0.1)]
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
    assert {step.action for step in tight} >= {NO_ACTION}
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
    messages = [Message('/odom', odometry(t, 0.0, 0.0, 0.0), t) for t in np.arange(0.9, 1.1, 0.02)]
    messages += [Message('/image_raw', picture(t), t) for t in np.arange(1.0, 60.0, 0.1)]
    report, ahead = Report(), []

    def watched():
        for message in sorted(messages, key=lambda heard: heard.time):
            yield message
            ahead.append(report.pictures - report.without_pose)
    list(synchronise(watched(), TOPICS, report))
    assert max(ahead) <= 15 and report.without_pose > 500


def reset(first, second, *, odometry_rate=50.0, offset=100.0):
    """A drive, and behind it another whose stamps begin anew: a simulator that was reset."""
    one, _ = drive(first, start=10.0, odometry_rate=odometry_rate)
    other, _ = drive(second, start=10.0, odometry_rate=odometry_rate, offset=offset)
    return one, other


def test_a_clock_that_was_set_back_begins_an_episode_and_no_picture_is_lost():
    one, other = reset([(0.3, 0.0, 4.0)], [(0.3, 0.5, 2.0)], offset=4.3)
    count = sum(m.topic == '/image_raw' for m in one + other)
    frames, report = frames_of(one + other)
    assert len(frames) == report.pictures == count == 180
    assert report.set_back == 1 and report.unordered == report.without_pose == report.jumps == 0
    assert [f.episode for f in frames] == [0] * 120 + [1] * 60
    # The poses are those of each take, to the last picture before and the first one behind.
    assert frames[119].pose[0] == pytest.approx(0.3 * (119 / 30), abs=0.01)
    assert abs(frames[120].pose[0]) < 0.01 and frames[179].pose[2] == pytest.approx(0.98, abs=0.03)


@pytest.mark.parametrize('later', ['/odom', '/image_raw'])
def test_a_topic_may_come_late_to_the_new_clock(later):
    """Around a reset the one topic is already of the new clock, the other still of the old."""
    one, other = reset([(0.3, 0.0, 4.0)], [(0.3, 0.0, 4.0)], offset=4.3)
    moved = sorted((m._replace(time=m.time + 0.35) if m.topic == later else m
                    for m in one + other), key=lambda heard: heard.time)
    frames, report = frames_of(moved)
    assert len(frames) == 240 and report.set_back == 1 and report.episodes == 2


@pytest.mark.parametrize('back', [1.5, 3.0])
def test_takes_whose_stamps_overlap_keep_their_own_poses(back):
    """A reset by little: two poses with the same stamps are remembered at once."""
    one, _ = drive([(0.3, 0.0, 4.0)], start=10.0)
    other, _ = drive([(0.0, 0.0, 4.0)], start=14.0 - back, offset=back + 0.3)
    frames, report = frames_of(one + other)
    assert len(frames) == 240 and report.set_back == 1
    assert max(abs(f.pose[0]) for f in frames if f.episode == 1) < 1e-6
    assert min(f.pose[0] - 0.3 * (f.stamp - 10.0) for f in frames if f.episode == 0) > -0.01


def test_depth_obeys_the_same_clock():
    one, other = reset([(0.3, 0.0, 3.0)], [(0.3, 0.0, 3.0)], offset=3.3)
    depths = [Message('/depth/image_raw', m.message, m.time + 0.02)
              for m in one + other if m.topic == '/image_raw']
    frames, _ = frames_of(sorted(one + other + depths, key=lambda heard: heard.time))
    assert len(frames) == 180 and all(f.depth is f.image for f in frames)


def test_one_stray_stamp_costs_no_more_than_itself():
    for topic in ('/odom', '/image_raw'):
        for by in (-5.0, 5.0):
            messages, _ = drive([(0.3, 0.0, 4.0)])
            at = next(k for k, m in enumerate(messages) if m.topic == topic and m.time > 12.0)
            stamp = messages[at].message.header.stamp
            stamp.sec += int(by)
            frames, report = frames_of(messages)
            assert len(frames) >= 119 and report.episodes == 1, (topic, by)


def test_the_clock_of_the_recorder_may_be_set_back_too():
    """Recorded on simulated time; with odometry, and with commands in its place."""
    one, other = reset([(0.3, 0.0, 4.0)], [(0.3, 0.0, 3.0)], offset=0.0)
    frames, report = frames_of(one + other)
    assert len(frames) == 210 and report.set_back == 1 and report.episodes == 2
    topics = Topics().within(typed(image='/image_raw', command='/cmd_vel'))
    takes = [Message(topic, message, t) for start, stop in ((1.0, 4.0), (1.0, 3.0))
             for t in np.arange(start, stop, 0.1)
             for topic, message in (('/cmd_vel', twist(0.4, 0.0)), ('/image_raw', picture(t)))]
    frames, report = frames_of(takes, topics)
    assert len(frames) == 50 and report.set_back == 1
    assert frames[-1].pose[0] == pytest.approx(0.4 * (2.9 + 1.9), abs=0.01)


def test_what_is_held_of_depth_is_bounded():
    rows = Stamped()
    for take in range(5):
        for t in np.arange(0.0, 20.0, 0.05):
            rows.add(t, 30.0 * take + t, None)
            assert sum(len(run.stamps) for run in rows._runs) <= 3 * 41


def test_a_repeated_picture_is_left_out_in_later_episodes_too():
    messages, _ = drive([(0.3, 0.0, 6.0)])
    quiet = [m for m in messages if m.topic == '/odom' or not 11.0 < m.time < 12.5]
    last = [m for m in quiet if m.topic == '/image_raw'][-1]
    frames, report = frames_of([*quiet, last._replace(time=last.time + 0.01)])
    assert report.episodes == 2 and report.unordered == 1


@pytest.mark.parametrize('role, kind', [
    ('image', 'sensor_msgs/msg/PointCloud2'), ('odometry', 'geometry_msgs/msg/PoseStamped'),
    ('command', 'sensor_msgs/msg/Joy'), ('goal', 'geometry_msgs/msg/PoseStamped'),
    ('depth', 'sensor_msgs/msg/CompressedImage'), ('labels', 'std_msgs/msg/String'),
    ('episode_end', 'std_msgs/msg/Bool'), ('camera_info', 'std_msgs/msg/String'),
    ('odometry', ''), ('odometry', 'nav_msgs/msg/Odometry and std_msgs/msg/String')])
def test_a_role_whose_topic_has_another_type_is_refused_with_one_that_has_it(role, kind):
    names = {known: f'/{known}' for known in TYPES}
    held = typed(**names) | {f'/{role}': kind}
    with pytest.raises(UserError, match=f'the {role} of a bag is') as error:
        Topics(**names).within(held)
    assert f"'/{role}: {kind or 'no type'}'" in str(error.value)
    if role not in ('image', 'odometry', 'command', 'goal'):
        assert f'{role}: null' in error.value.remedy
    with pytest.raises(UserError) as error:
        Topics(**names).within(held | {'/other': TYPES[role][0]})
    assert '/other' in error.value.remedy and '--topics' in error.value.remedy


@pytest.mark.parametrize('role, other', [('odometry', 'command'), ('command', 'odometry')])
def test_odometry_and_commands_stand_in_for_each_other(tmp_path, role, other):
    wrong = {f'/{role}': 'geometry_msgs/msg/PoseStamped'}
    names = {'image': '/image', 'odometry': '/odometry', 'command': '/command'}
    with pytest.raises(UserError, match=f'the {role} of a bag is') as error:
        Topics(**names).within(typed(image='/image', **{other: f'/{other}'}) | wrong)
    assert f'`{role}: null`' in error.value.remedy and '--topics' in error.value.remedy
    (tmp_path / 'topics.yaml').write_text(''.join(
        f'{known}: {name}\n' for known, name in names.items() if known != role)
        + f'{role}: null\n')  # as it says
    left = load_topics(tmp_path / 'topics.yaml').within(
        typed(image='/image', **{other: f'/{other}'}) | wrong)
    assert getattr(left, role) == '' and getattr(left, other) == f'/{other}'
    with pytest.raises(UserError, match=f'the {role} of a bag is') as error:  # nothing stands in
        Topics(**names).within(typed(image='/image') | wrong)
    assert 'null' not in error.value.remedy
    with pytest.raises(UserError) as error:
        Topics(**names).within(typed(image='/image') | wrong | {
            f'/{other}': 'geometry_msgs/msg/PoseStamped'})
    assert 'null' not in error.value.remedy


def test_types_without_msg_are_the_same_types_and_a_role_can_be_left_out(tmp_path):
    assert full_name('nav_msgs/Odometry') == full_name('nav_msgs/msg/Odometry')
    assert Topics().within({'/image_raw': 'sensor_msgs/Image',
                            '/odom': 'nav_msgs/Odometry'}).odometry == '/odom'
    path = tmp_path / 'topics.yaml'
    path.write_text('depth: null\n')
    held = typed(image='/image_raw', odometry='/odom') | {'/depth/image_raw': 'std_msgs/msg/Int8'}
    assert load_topics(path).within(held).depth == ''
