"""A policy that searches may keep its map from goal to goal."""

import numpy as np
import pytest
from small_search import write_small_search

from vn_nav.policy.runtime import PolicyRuntime


def drive(runtime, pose, count=12, odometry=True):
    rng = np.random.default_rng(0)
    for picture in rng.integers(0, 255, (count, 3, 48, 48), np.uint8):
        action = runtime.act(picture, pose if odometry else None)
        dx, _, dyaw = runtime.moves[action]
        pose = pose + (dx * np.cos(pose[2]), dx * np.sin(pose[2]), dyaw)
    return pose


@pytest.fixture
def goals():
    return np.random.default_rng(1).integers(0, 255, (2, 3, 48, 48), np.uint8)


@pytest.mark.parametrize('keep', [True, False])
def test_another_goal_begins_with_the_map_of_the_one_before_or_without(tmp_path, goals, keep):
    runtime = PolicyRuntime(write_small_search(tmp_path / 'policy', stop_threshold=1.0),
                            keep_map=keep)
    searcher = runtime.search.searchers[0]
    runtime.set_goal(goals[0])
    pose = drive(runtime, np.array([3.0, 1.0, 0.5]))
    known, been = searcher.grid.log_odds.copy(), searcher.grid.been.sum()
    assert (known != 0).any() and been > 1
    runtime.set_goal(goals[1])
    # The robot was moved by a command that was cut off: odometry says so.
    moved = pose + (0.2, 0.1, 0.3)
    before = searcher.pose.copy()
    runtime.act(goals[0], moved)
    if keep:
        assert searcher.grid.been.sum() >= been
        assert np.hypot(*(searcher.pose[:2] - before[:2])) > 0.15
        assert not searcher.grid.contacts.any() or known.any()
    else:
        assert searcher.grid.been.sum() < been and np.array_equal(searcher.pose, np.zeros(3))
    # Where the robot is put elsewhere the map goes.
    runtime.reset()
    runtime.set_goal(goals[0])
    runtime.act(goals[1], moved)
    assert np.array_equal(searcher.pose, np.zeros(3))


def test_without_odometry_the_map_goes_with_the_goal(tmp_path, goals):
    runtime = PolicyRuntime(write_small_search(tmp_path / 'policy', stop_threshold=1.0),
                            keep_map=True)
    runtime.set_goal(goals[0])
    drive(runtime, np.zeros(3), odometry=False)
    runtime.set_goal(goals[1])
    runtime.act(goals[0], None)
    assert np.array_equal(runtime.search.searchers[0].pose, np.zeros(3))


def test_a_kept_map_is_searched_anew(tmp_path, goals):
    runtime = PolicyRuntime(write_small_search(tmp_path / 'policy', stop_threshold=1.0),
                            keep_map=True)
    runtime.set_goal(goals[0])
    pose = drive(runtime, np.zeros(3), 60)
    searcher = runtime.search.searchers[0]
    seen = searcher.grid.known_area()
    runtime.set_goal(goals[1])
    runtime.act(goals[0], pose)
    assert searcher.grid.known_area() < 0.7 * seen
    assert not searcher.grid.missed.max() > 2
