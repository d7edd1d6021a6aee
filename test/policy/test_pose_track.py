"""Which pose of odometry belongs to a picture, and poses in a frame of the episode."""

import math

import numpy as np
import pytest

from vn_nav.policy.pose_track import EpisodePose, PoseTrack


def test_a_picture_has_the_pose_of_its_stamp():
    track = PoseTrack()
    assert track.at(1.0, 10.0) is None
    track.add(1.0, (0.0, 1.0, math.pi - 0.1))
    track.add(1.1, (0.2, 1.0, 0.1 - math.pi))
    assert track.at(0.99, 10.0) is None
    assert track.at(1.0, 0.2) == pytest.approx([0.0, 1.0, math.pi - 0.1])
    x, y, yaw = track.at(1.05, 0.2)  # the shorter way round
    assert (x, y) == pytest.approx((0.1, 1.0)) and math.cos(yaw) == pytest.approx(-1.0)
    assert track.at(1.25, 0.2) == pytest.approx([0.2, 1.0, 0.1 - math.pi])
    assert track.at(1.35, 0.2) is None


def test_what_was_before_a_break_is_forgotten_and_counted():
    track = PoseTrack()
    track.add(5.0, np.zeros(3))
    track.cut()
    assert track.breaks == 1 and track.at(5.0, 10.0) is None
    track.add(1.0, np.ones(3))  # its clock may have been set back
    assert np.array_equal(track.at(1.0, 10.0), np.ones(3))


def test_an_episode_has_a_frame_of_its_own():
    place = EpisodePose()
    place.begin()
    assert np.array_equal(place.follow(np.array([3.0, 2.0, math.pi / 2]), 0), np.zeros(3))
    seen = place.follow(np.array([3.0, 2.5, math.pi]), 0)
    assert seen == pytest.approx([0.5, 0.0, math.pi / 2])
    assert np.array_equal(place.follow(None, 0), seen)
    # Odometry set anew while the robot stands: it has not moved.
    assert np.array_equal(place.follow(np.array([9.0, 9.0, 0.0]), 1), seen)
    assert place.follow(np.array([10.0, 9.0, 0.0]), 1) == pytest.approx([0.5, 1.0, math.pi / 2])
    place.begin()
    assert np.array_equal(place.follow(np.array([10.0, 9.0, 0.0]), 1), np.zeros(3))
