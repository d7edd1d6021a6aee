"""Velocities and odometry, and what must not move a robot."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from paths import ROOT

from vn_msgs_py import motion, topics
from vn_msgs_py.motion import MotionError
from vn_nav.bags.storage.definitions import definition

pytestmark = pytest.mark.ros


@pytest.mark.parametrize('kind', [Twist, TwistStamped])
def test_twist_round_trip(kind):
    velocity = np.array([0.3, -0.1, 0.7, -0.2])
    assert np.array_equal(motion.twist_to_array(motion.fill_twist(kind(), velocity)), velocity)


def test_not_finite_is_refused_both_ways():
    message = Twist()
    message.linear.z = math.nan
    with pytest.raises(MotionError, match='finite'):
        motion.twist_to_array(message)
    with pytest.raises(MotionError, match='finite'):
        motion.fill_twist(Twist(), np.array([math.inf, 0, 0, 0]))


def test_odometry_round_trip():
    message = motion.fill_odometry(Odometry(), 1.5, -2.0, 3.0, np.array([0.2, 0, -0.4, 0]))
    message.header.stamp.sec, message.header.stamp.nanosec = 7, 250_000_000
    assert np.allclose(motion.odometry_to_array(message), [1.5, -2.0, 3.0, 0.2, 0, -0.4, 7.25])


def test_a_quaternion_of_zeros_is_no_heading():
    message = Odometry()
    message.pose.pose.orientation.w = 0.0
    with pytest.raises(MotionError, match='quaternion'):
        motion.odometry_to_array(message)


def test_every_topic_type_exists_and_the_readme_has_the_table():
    import importlib
    for entry in topics.TOPICS:
        package, _, kind = entry.type.split('/')
        assert definition(entry.type)  # a bag can hold it
        if package == 'tf2_msgs':  # in no wheel
            continue
        assert hasattr(importlib.import_module(f'{package}.msg'), kind)
    readme = (ROOT / 'README.md').read_text()
    assert topics.markdown_table() in readme, 'paste vn_msgs_py.topics.markdown_table() there'
    with pytest.raises(KeyError, match='contract'):
        topics.topic('nothing')
