"""policy_node under faults: a real process, real topics, a robot that misbehaves.

What must hold is the fault table of docs/safety.md.
"""

import re
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from fake_robot import BEST_EFFORT, RELIABLE, robot_and_node
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from ros_harness import wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import SetBool, Trigger

pytestmark = [pytest.mark.ros, pytest.mark.slow]
WARN, ERROR = DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint')


# What the node receives.

def test_best_effort_odometry_is_heard_and_its_silence_stops(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': BEST_EFFORT}) as (robot, _):
        robot.drive()
        robot.sends.discard('odom')
        silent = time.monotonic()
        assert robot.wait_for_zero() - silent < 0.8
        robot.says('odometry fell silent', 'odometry silent')


@pytest.mark.parametrize('profile', [BEST_EFFORT, RELIABLE], ids=['best effort', 'volatile'])
def test_a_goal_of_any_publisher_is_heard(checkpoint, tmp_path, profile):
    with robot_and_node(checkpoint, tmp_path, robot={'goal': profile}) as (robot, _):
        wait_until(lambda: robot.goal.get_subscription_count() >= 1, robot.spin)
        robot.spin_for(1.0)  # the other side has met this one as well
        robot.drive()


def test_odometry_of_another_type_or_without_a_word_refuses_to_enable(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        other = robot.node.create_publisher(PoseStamped, 'odom', RELIABLE)
        robot.show_goal()
        robot.says('geometry_msgs/msg/PoseStamped')
        assert 'geometry_msgs/msg/PoseStamped' in robot.refusal()
        robot.node.destroy_publisher(other)
        silent = robot.node.create_publisher(Odometry, 'odom', RELIABLE)
        robot.refuses('nothing of it has come')
        robot.node.destroy_publisher(silent)
        robot.enable()
        robot.says('actions run on time alone')


def test_required_odometry_is_waited_for(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'require_odometry': True},
                        robot={'odometry': RELIABLE}) as (robot, _):
        robot.sends.discard('odom')
        robot.show_goal()
        robot.refuses('odometry')
        robot.sends.add('odom')
        robot.enable()


def test_a_simulator_that_is_reset_is_driven_again(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'use_sim_time': True},
                        robot={'odometry': RELIABLE, 'sim_time': True}) as (robot, _):
        robot.begun -= 1000.0
        robot.drive()
        robot.begun = time.monotonic() - 1.0  # /clock and all stamps: from 1,000 s to 1 s
        assert robot.wait_for_zero() - time.monotonic() < 0.5
        robot.says('went back')
        robot.enable()
        wait_until(robot.moving, robot.spin)


def test_a_camera_whose_stamps_go_back_is_used_again(checkpoint, tmp_path):
    """Two takes of a bag, a driver restarted: in lock-step no clock says so but the stamps."""
    with robot_and_node(checkpoint, tmp_path, node={'max_frame_age': 5.0},
                        robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        robot.offset = -4.9  # still within the age that is allowed: the order alone tells
        robot.spin_for(0.3)
        robot.offset = 0.0
        robot.spin_for(0.3)
        robot.enable()
        wait_until(robot.moving, robot.spin)


def test_a_clock_that_jumps_ahead_stands_still(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'use_sim_time': True},
                        robot={'odometry': RELIABLE, 'sim_time': True}) as (robot, _):
        robot.drive()
        robot.begun -= 100.0
        robot.wait_for_zero()
        robot.says('jumped ahead')


def test_without_a_clock_it_does_not_become_active(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'use_sim_time': True},
                        robot={'odometry': RELIABLE, 'sim_time': True}) as (robot, _):
        robot.sends.discard('clock')
        robot.show_goal()
        robot.refuses('not active', '/clock')
        robot.sends.add('clock')
        robot.enable()


def test_a_goal_published_at_a_rate_is_one_goal_and_is_named(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.show_goal()
        robot.enable()
        end, due, drove = time.monotonic() + 5.0, 0.0, False
        while time.monotonic() < end:
            if time.monotonic() > due:
                due = time.monotonic() + 0.1
                robot.show_goal()  # the same picture, a new stamp
            robot.spin()
            drove |= robot.moving()
        assert drove
        robot.says('publish it once')
        assert int(robot.statuses[-1][3]['decisions']) > 0


def test_goals_that_change_all_the_time_are_named(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        heard, due = len(robot.commands), 0.0
        end = time.monotonic() + 5.0
        while time.monotonic() < end:
            if time.monotonic() > due:
                due = time.monotonic() + 0.1
                robot.show_goal(robot.images)  # another picture each time
            robot.spin()
        _, level, message, _ = robot.says('each picture is a new goal')
        assert level == WARN and re.search(r'changes [0-9.]+ times a second', message)
        # A glance may end in a decision before the next goal takes it back: no more than a twitch.
        sent = np.array([velocity for _, velocity in robot.commands[heard + 10:]])
        assert np.abs(sent[:, 0]).max() <= 0.1, sent
        robot.says('running')  # and drives again when it ends
        wait_until(robot.moving, robot.spin)


def test_an_unusable_goal_is_refused_with_the_reason(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        message = robot.picture(0)
        message.encoding = 'nonsense'
        robot.goal.publish(message)
        robot.refuses('nonsense')
        assert 'goal_image' in robot.refusal()
        robot.drive()
        heard = len(robot.arrived)
        message.header.stamp = robot.stamp()
        robot.goal.publish(message)
        robot.says('goal refused')
        robot.wait_for_zero()
        assert not any(robot.arrived[heard:])


def test_another_goal_with_the_old_stamp_is_another_goal(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        stamp = robot.stamp()
        robot.show_goal(0, stamp)
        robot.enable()
        wait_until(lambda: robot.arrived, robot.spin)
        robot.spin_for(0.5)
        answers = len(robot.arrived)
        robot.show_goal(0, stamp)
        robot.spin_for(0.5)
        assert len(robot.arrived) == answers, 'the same picture and stamp are the same goal'
        robot.show_goal(1, stamp)
        wait_until(lambda: len(robot.arrived) > answers, robot.spin)


def test_a_camera_on_another_clock_is_named_with_the_cure(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        robot.offset = -37.0
        robot.show_goal()
        robot.refuses('37.0', 'use_sim_time', 'NTP', 'max_frame_age')
        robot.offset = 12.0
        robot.refuses('max_frame_ahead')


def test_messages_that_no_camera_sends_end_no_thread(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        for focal in (1e-300, 1e300, float('nan'), -1.0):
            info = CameraInfo(width=84, height=84)
            info.k[0] = focal
            robot.info.publish(info)
        robot.spin_for(0.5)
        wait_until(robot.moving, robot.spin)
        robot.pose[:2] = 1e308
        robot.publish_odometry()
        robot.pose[:2] = 0.0
        robot.wait_for_zero()
        robot.says('bad odometry')
        assert robot.call(Trigger, 'reset').success
        robot.enable()
        wait_until(robot.moving, robot.spin)


def test_odometry_that_is_set_anew_ends_the_action(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        for change in ((20.0, 0.0, 0.0), (-0.45, 0.0, 0.0), (0.0, 0.0, -1.0)):
            wait_until(lambda: not robot.moving(), robot.spin)
            wait_until(robot.moving, robot.spin)
            robot.pose += change
            set_at = time.monotonic()
            assert robot.wait_for_zero() - set_at < 0.4, 'an action takes more than a second'


def test_three_unusable_pictures_in_a_row_stop(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        robot.sends.discard('image')
        for _ in range(3):
            message = robot.picture()
            message.encoding = 'nonsense'
            robot.image.publish(message)
            robot.spin_for(0.03)
        robot.sends.add('image')
        robot.wait_for_zero()
        _, level, *_ = robot.says('stopped: three bad frames in a row')
        assert level == ERROR and '~/reset' in robot.refusal()


def test_frames_with_a_stamp_that_is_not_later_are_dropped(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        for _ in range(20):
            robot.image.publish(robot.picture(stamp=robot.stamp(-0.1)))
            robot.spin_for(0.05)
        status = robot.says('not later')
        assert int(status[3]['dropped: reordered stamp']) >= 5
        wait_until(robot.moving, robot.spin)


def test_odometry_that_falls_silent_at_rest_is_waited_for(tmp_path):
    there = write_checkpoint(tmp_path / 'there', arrival=0.93, stop_threshold=0.5)
    with robot_and_node(there, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.show_goal()
        robot.enable()
        robot.says('arrived')
        robot.sends.discard('odom')
        _, level, *_ = robot.says('hold: odometry silent')
        assert level == WARN
        silent = len(robot.statuses)
        robot.sends.add('odom')
        wait_until(lambda: any(status[2].startswith('arrived') for status in
                               robot.statuses[silent:]), robot.spin)


def test_dropped_frames_are_counted_by_kind(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path) as (robot, _):
        wait_until(lambda: robot.statuses, robot.spin)
        robot.sends.discard('image')
        for number in range(300):
            message = robot.picture()
            message.encoding = f'nonsense{number}' * 500
            robot.image.publish(message)
            robot.spin_for(0.01)
        status = robot.says('nonsense')
        assert sum(len(key) + len(value) for key, value in status[3].items()) < 2000
        assert sum(key.startswith('dropped') for key in status[3]) <= 4


# Time.

def test_silence_is_noticed_at_its_deadline(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path,
                        robot={'size': (640, 480), 'odometry': RELIABLE}) as (robot, _):
        robot.show_goal()
        robot.enable()
        late = []
        for _ in range(5):
            wait_until(robot.moving, robot.spin)
            robot.sends.discard('image')
            silent = time.monotonic()
            late.append(robot.wait_for_zero() - silent)
            robot.sends.add('image')
        assert np.median(late) < 0.30, late


def test_continuous_decides_at_nearly_every_frame(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'mode': 'continuous'},
                        robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        robot.spin_for(1.5)
        status, frames = robot.statuses[-1], robot.images
        robot.spin_for(4.0)
        decided = int(robot.statuses[-1][3]['decisions']) - int(status[3]['decisions'])
        frames = (robot.statuses[-1][0] - status[0]) * 30
        assert decided > 0.85 * frames, (decided, frames)


def test_continuous_stops_when_odometry_falls_silent_in_motion(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, node={'mode': 'continuous'},
                        robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()
        robot.sends.discard('odom')
        robot.wait_for_zero()
        robot.says('odometry fell silent', 'odometry silent')
        assert not robot.call(SetBool, 'enable', data=True).success


def test_the_diagnostics_name_rates_and_latency(checkpoint, tmp_path):
    with robot_and_node(checkpoint, tmp_path, robot={'odometry': RELIABLE}) as (robot, _):
        robot.drive()

        def sound():
            values = robot.statuses[-1][3]
            if 'unknown' in values.values():
                return False
            return (20 < float(values['frame_rate_hz']) < 40
                    and 30 < float(values['odometry_rate_hz']) < 60
                    and 0 < float(values['inference_ms']) < 100
                    and float(values['frame_age_ms']) < 250)
        wait_until(sound, robot.spin)  # rates are of the last seconds
