"""Labels, pairs and windows out of drives, against plain loops and against the simulator."""

import math

import numpy as np
import pytest
from round_room import ROBOT, drive_set, look

from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.bags.dataset import DriveSet
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.co_visibility import co_visible, lift
from vn_nav.errors import UserError
from vn_nav.learning.hindsight import (
    Drives,
    draw_windows,
    fill_windows,
    partners,
    rows_of,
    split,
)
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

STEPS = 100  # of a robot in a house


def some_drives(*, depth=True):
    """Two bags, one with and one without a motion that fits no action."""
    first, second = drive_set(5, depth=depth), drive_set(4, seed=1, depth=depth)
    second.action[3] = NO_ACTION
    return Drives([first, second], ROBOT)


def all_pairs(drives):
    """Rows and goals of all ordered pairs within episodes."""
    found = [(i, j) for first, stop in drives.episodes for i in range(first, stop)
             for j in range(first, stop) if i != j]
    return np.array(found).T


def angle(a, b):
    return abs(math.remainder(a - b, 2 * math.pi))


def test_labels_are_those_of_a_plain_loop():
    drives = some_drives()
    rows, goals = all_pairs(drives)
    assert len(rows) > 300
    labels = drives.label(rows, goals)
    for k, (i, j) in enumerate(zip(rows, goals, strict=True)):
        x, y, yaw = drives.pose[i]
        gx, gy, goal_yaw = drives.pose[j]
        metres = sum(math.dist(drives.pose[m][:2], drives.pose[m + 1][:2])
                     for m in range(min(i, j), max(i, j)))
        assert labels.distance[k] == pytest.approx(metres, abs=1e-5)
        there = complex(gx - x, gy - y) * complex(math.cos(yaw), -math.sin(yaw))
        assert np.allclose(labels.goal_pose[k], [there.real, there.imag, math.cos(goal_yaw - yaw),
                                                 math.sin(goal_yaw - yaw)], atol=1e-5)
        near = math.hypot(gx - x, gy - y) <= ARRIVAL_RADIUS
        assert labels.arrived[k] == (near and angle(yaw, goal_yaw) <= ARRIVAL_HEADING)
    assert 0.02 < labels.arrived.mean() < 0.5


def test_overlap_is_measured_where_there_is_depth_as_the_simulator_measures_it():
    drives = some_drives()
    rows, goals = all_pairs(drives)
    found = drives.co_visibility(rows, goals)
    exact = look(drives.pose)[1]
    errors = []
    for k in range(0, len(rows), 7):
        pair = [rows[k], goals[k]]
        cameras = np.array([[*drives.pose[m][:2], ROBOT.camera_height, drives.pose[m][2], 0.0]
                            for m in pair])
        fov = np.full(2, ROBOT.camera_fov)
        points = lift(exact[pair[1:]], cameras[1:], fov[1:])
        errors.append(found[k] - co_visible(points, exact[pair[:1]], cameras[:1], fov[:1])[0])
    # Stored depth has steps of 4 cm: a column of points may cross the edge of a picture.
    assert np.abs(errors).max() <= 0.13 and np.abs(errors).mean() < 0.01
    assert (found == 0).any() and (found > 0.5).any() and (found >= 0).all()


def test_one_bag_without_depth_does_not_spoil_that_of_the_other():
    mixed = Drives([drive_set(4), drive_set(4, depth=False)], ROBOT)
    rows, goals = all_pairs(mixed)
    here = rows < len(mixed.sets[0])
    found = mixed.co_visibility(rows, goals)
    own = Drives(mixed.sets[:1], ROBOT)
    assert np.array_equal(found[here], own.co_visibility(rows[here], goals[here]))
    assert np.array_equal(found[~here], mixed.co_visibility_by_odometry(rows[~here], goals[~here]))
    assert set(found[~here]) == {-1.0, 0.0, 1.0}


def house_drive(houses=(3, 4)):
    """Shortest-path drives through two houses, with depth."""
    env = NavigationEnv(EnvConfig(scenes=house_scenes(houses), num_envs=8, size=36,
                                  max_decisions=60,
                                  privileged=('depth', 'oracle_action')))
    seen, info = env.reset(seed=0)
    rows = []
    for _ in range(STEPS):
        before = (seen['image'].copy(), env.simulator.poses[:, :3].copy(), info['depth'].copy(),
                  info['oracle_action'].astype(np.int16))
        seen, _, _, _, info = env.step(before[-1].astype(np.int64))
        rows.append((*before, info['reset'].copy()))  # True: it showed how an episode ended
    image, pose, depth, action, last = (np.stack(part, 1).reshape(8 * STEPS, *part[0].shape[1:])
                                        for part in zip(*rows, strict=True))
    last[STEPS - 1::STEPS] = True
    return DriveSet(
        image=image, pose=pose, time=np.arange(len(image)) * 1.0,
        action=np.where(last, NO_ACTION, action).astype(np.int16),
        episode=np.cumsum(last) - last, goal=np.full(len(image), -1), goals=image[:0],
        depth=np.where(depth > 0, np.clip(depth * 25.5, 1, 255), 0).astype(np.uint8),
        labels=None, facts={})


def test_what_odometry_says_of_the_overlap_is_seldom_wrong_in_houses():
    drives = Drives([house_drive()], ROBOT)
    rows, goals = all_pairs(drives)
    said, true = drives.co_visibility_by_odometry(rows, goals), drives.co_visibility(rows, goals)
    ones, zeros = said == 1, said == 0
    assert ones.sum() > 1000 and zeros.sum() > 300
    assert (true[ones] >= 0.1).mean() > 0.97 and (true[zeros] < 0.1).mean() > 0.9
    # It says something of most pairs that overlap, but not of all.
    assert (said[true >= 0.1] == 1).mean() > 0.4 and (said == -1).mean() > 0.1


def test_partners_are_others_of_the_same_span_and_half_of_them_near():
    spans = [(2, 4), (10, 110), (200, 203)]
    rows = rows_of(spans)
    drawn = np.stack([partners(spans, np.random.default_rng(k)) for k in range(200)])
    assert (drawn != rows).all()
    for first, stop in spans:
        own = (rows >= first) & (rows < stop)
        assert ((drawn[:, own] >= first) & (drawn[:, own] < stop)).all()
    assert (drawn[:, rows == 2] == 3).all()
    middle = drawn[:, rows == 60].ravel()
    assert set(drawn[:, rows == 201].ravel()) == {200, 202}
    assert 0.45 < (np.abs(middle - 60) <= 8).mean() < 0.75 and np.ptp(middle) > 80


@pytest.mark.parametrize('length, farthest', [(1, 1), (5, 3), (8, 48), (100, 100)])
def test_windows_cover_every_action_once_and_are_those_of_a_plain_loop(length, farthest):
    drives = some_drives()
    drives.action[slice(*drives.episodes[2])] = NO_ACTION  # nothing to imitate there
    spans = [*drives.episodes[:3], *drives.episodes[4:]]
    windows = draw_windows(drives, spans, length, farthest, np.random.default_rng(0))
    filled = fill_windows(drives, windows, length)
    covered = []
    for w, (begin, stop, goal) in enumerate(windows):
        first, end = next(span for span in spans if span[0] <= begin < span[1])
        assert begin < goal < end and goal - begin <= farthest and stop - begin <= length
        assert stop <= goal + 1 and filled.goal[w] == goal
        for t in range(length):
            row = begin + t
            assert filled.valid[t, w] == (row < stop)
            if row >= stop:
                assert not filled.acts[t, w]
                continue
            action = drives.action[row]
            assert filled.rows[t, w] == row
            assert filled.acts[t, w] == (action != NO_ACTION and row < goal)
            if filled.acts[t, w]:
                covered.append(row)
                assert filled.action[t, w] == action
            fresh = t == 0 or drives.action[row - 1] == NO_ACTION
            assert filled.starts[t, w] == fresh
            assert filled.last_action[t, w] == (-1 if fresh else drives.action[row - 1])
    acting = [row for first, end in spans for row in range(first, end - 1)
              if drives.action[row] != NO_ACTION]
    assert sorted(covered) == acting
    again = draw_windows(drives, spans, length, farthest, np.random.default_rng(1))
    assert length == 1 or not np.array_equal(windows, again)


def test_windows_of_nothing_to_imitate_are_none():
    drives = some_drives()
    drives.action[:] = NO_ACTION
    windows = draw_windows(drives, drives.episodes, 8, 8, np.random.default_rng(0))
    assert windows.shape == (0, 3)


def test_a_split_sets_whole_episodes_aside():
    drives = Drives([drive_set(30)], ROBOT)
    parts = split(drives, 0.2, seed=0)
    assert sorted(parts.train + parts.validation) == drives.episodes
    assert 0.1 < len(rows_of(parts.validation)) / len(drives) < 0.3
    assert parts == split(drives, 0.2, seed=0) and parts != split(drives, 0.2, seed=1)
    assert 'of 30 episodes' in parts.summary


@pytest.mark.parametrize('lengths', [[60], [60, 3], [30, 30]])
def test_a_split_cuts_the_longest_episode_where_there_are_too_few(lengths):
    drives = Drives([drive_set(0, lengths=lengths)], ROBOT)
    parts = split(drives, 0.2, seed=0)
    (first, stop), *_ = parts.validation[-1:]
    assert any(span == (first - len(rows_of([span])), first) for span in parts.train)
    assert 'the last' in parts.summary and abs(stop - first - 0.2 * sum(lengths)) <= 3
    assert sorted(rows_of(parts.train + parts.validation)) == list(range(sum(lengths)))


def test_drives_with_and_without_actions_are_both_judged():
    still = drive_set(20, seed=3)
    still.action[:] = NO_ACTION
    drives = Drives([drive_set(2, lengths=[50, 50]), still], ROBOT)
    parts = split(drives, 0.2, seed=0)
    acting = [bool((drives.action[first:stop] >= 0).any()) for first, stop in parts.validation]
    assert set(acting) == {True, False}


def test_what_cannot_be_learned_from_is_refused():
    with pytest.raises(UserError, match='one bag at least'):
        Drives([], ROBOT)
    with pytest.raises(UserError, match='one size'):
        Drives([drive_set(2), drive_set(2, size=40)], ROBOT)
    alone = drive_set(3)
    alone.episode[:] = np.arange(len(alone))
    with pytest.raises(UserError, match='two steps'):
        Drives([alone], ROBOT)
    with pytest.raises(UserError, match='validation'):
        split(Drives([drive_set(0, lengths=[3])], ROBOT), 0.1, 0)


def test_pictures_come_from_the_bag_of_their_row():
    drives = some_drives()
    rows = np.random.default_rng(0).permutation(len(drives))[:40]
    for name in ('image', 'depth', 'labels'):
        whole = np.concatenate([getattr(part, name) for part in drives.sets])
        assert np.array_equal(drives.pictures(name, rows), whole[rows])
