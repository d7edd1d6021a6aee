"""A policy that searches where it was taught: localisation, the recalled map, goals, the file."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.errors import UserError
from vn_nav.learning.taught_keys import KEY_M, KEY_RAD, MOST_KEYS, choose_keys, recall_drive
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.costmap import Costmap
from vn_nav.policy.search.driver import SearchDriver
from vn_nav.policy.search.grid import CELL, OccupancyGrid, Prior
from vn_nav.policy.search.hypotheses import apart
from vn_nav.policy.search.key_pictures import KeyPictures, Mode, Votes, modes_of
from vn_nav.policy.search.look import RANGE_EDGES, column_bearings
from vn_nav.policy.search.recall import GOAL_WEIGHT, Localiser, Recall
from vn_nav.policy.search.searcher import Searcher
from vn_nav.policy.search.taught import TaughtPlace
from vn_nav.policy.search.torch_eyes import TorchEyes
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import RobotSpec

ROBOT = RobotSpec().with_actions(('forward', 'rotate_left', 'rotate_right'))
CONFIG = NetworkConfig(
    actions=ROBOT.action_names, moves=ROBOT.moves, size=48, architecture='search',
    channels=(8, 12, 8), features=24, blocks=1, view=ROBOT.camera_fov,
    footprint=ROBOT.footprint_radius)
INFO = {'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0, 'decoding': 'greedy'}


def pictures(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 3, 48, 48), dtype=np.uint8)


def network():
    torch.manual_seed(0)
    return build_policy(CONFIG).eval()


def place(count=5):
    """A map of 4 x 6 m with a wall at x = 3 m, all of it seen, driven through along y = 2 m."""
    log_odds = np.full((40, 60), -2.0, np.float32)
    log_odds[:, 30] = 3.0
    lane = np.zeros((40, 60), np.float32)
    lane[19:22, 5:26] = 1
    poses = np.column_stack([np.linspace(0.5, 2.5, count), np.full(count, 2.0), np.zeros(count)])
    return TaughtPlace(pictures(count), poses.astype(np.float32), log_odds,
                       np.full((40, 60), 2.0, np.float32), lane, np.zeros(2, np.float32),
                       np.ones(1, np.float32))


def taught(count=5):
    policy = network()
    with torch.no_grad():
        policy.recogniser.out.bias[4] = 3.0  # it recognises everything
    policy.taught = place(count)
    return policy


class Told:
    """Key pictures that say what a test says."""

    def __init__(self, *said):
        self.said = list(said)

    def recognise(self, image, about):
        return self.said.pop(0)


def mode(x, y, yaw, share=0.9):
    return Mode(np.array([x, y, yaw]), share, 20.0)


def searcher():
    return Searcher(CONFIG.moves, column_bearings(CONFIG.view), RANGE_EDGES, CONFIG.footprint)


def test_key_pictures_stand_for_all_others_and_show_something():
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(0, 1.5, (300, 2)), rng.uniform(-0.7, 0.7, 300)])
    shown = np.repeat(pictures(1), 300, axis=0)
    shown[::7] = 90  # a plain wall
    keys = choose_keys(shown, poses)
    assert 10 < len(keys) < 150 and not (keys % 7 == 0).any()
    own = poses[:, None] - poses[keys]
    off = np.hypot(np.hypot(own[..., 0], own[..., 1]) / KEY_M, own[..., 2] / KEY_RAD).min(axis=1)
    assert off[np.arange(300) % 7 > 0].max() <= 1
    far = np.column_stack([np.arange(600) * 0.5, np.zeros((600, 2))])
    assert MOST_KEYS / 2 < len(choose_keys(np.repeat(shown[1:2], 600, axis=0), far)) <= MOST_KEYS


def test_votes_that_agree_are_one_pose_and_doubt_remains():
    poses = np.array([[1, 1, 0.1], [1.2, 1, -0.1], [5, 5, 0], [9, 9, 0]], float)
    votes = Votes(poses, np.array([20, 20, 4, 1.0]), np.array([20, 20, 2, 1.0]), np.full(4, 4.0))
    first, second = modes_of(votes)  # the last one's odds are too low
    assert first.pose == pytest.approx([1.1, 1, 0], abs=1e-6) and second.pose[0] == 5
    assert first.share == pytest.approx(40 / 47) and second.share == pytest.approx(2 / 47)
    assert first.precision == 4  # votes of one picture err together
    assert modes_of(votes._replace(odds=np.ones(4))) == []


def test_headings_of_votes_are_averaged_across_the_half_turn():
    poses = np.array([[0, 0, 3.1], [0, 0, -3.1]], float)
    only, = modes_of(Votes(poses, np.full(2, 9.0), np.ones(2), np.ones(2)))
    assert abs(only.pose[2]) == pytest.approx(math.pi, abs=1e-6)


def test_two_looks_that_agree_say_where_the_robot_is_and_it_is_followed():
    own = Localiser()
    own.look([mode(1, 2, 0)], math.nan)
    assert not own.sure
    own.move(np.array([0.5, 0, math.pi / 2]))
    own.look([mode(1.6, 2, math.pi / 2)], 0.9)
    assert own.sure and own.poses[0].pose == pytest.approx([1.55, 2, math.pi / 2])
    for _ in range(20):  # it sees nothing that it knows, and believes its odometry
        own.move(np.array([0.1, 0, 0]))
        own.look([], math.nan)
    assert own.sure and own.poses[0].pose[:2] == pytest.approx([1.55, 4.0])


def test_two_places_that_look_alike_leave_it_unsure():
    own = Localiser()
    for _ in range(6):
        own.look([mode(1, 2, 0, 0.45), mode(8, 2, 0, 0.4)], 0.9)
    assert len(own.poses) == 2 and not own.sure


def test_a_robot_that_was_carried_away_finds_out():
    own = Localiser()
    for _ in range(8):
        own.look([mode(1, 2, 0)], 0.95)
    assert own.sure
    for _ in range(5):
        own.look([mode(7, 7, 1)], 0.02)
    assert own.sure and own.poses[0].pose[0] > 6
    for _ in range(8):  # and then to where nobody drove
        own.look([], 0.02)
    assert not own.sure


def recalled(frame):
    """A search in the taught place, whose frame lies so on the robot's map, after three looks."""
    search, shown = searcher(), place()
    here = compose(between(frame, np.zeros(3)), search.pose)  # in the frame of the drive
    recall = Recall(shown, Told(*[([mode(*here)], 0.9)] * 3, ([], 0.01)))
    recall.begin([mode(2, 3, 1, 0.8), mode(1, 1, 0, 0.1), mode(0.5, 0.5, 0, 0.05)])
    for _ in range(3):
        recall.look(search, None)
    return search, recall


@pytest.mark.parametrize('frame', [(0, 0, 0), (2.5, -1.2, 2.0), (-4.0, 0.33, -0.7)])
def test_the_recalled_map_lies_where_the_robot_is(frame):
    frame = np.array(frame)
    search, _ = recalled(frame)
    lane, wall, floor = search.grid.heard_of()
    assert not search.grid.obstacles().any() and lane.sum() > 50 and floor.sum() > 2000
    walls = np.argwhere(wall)
    assert len(walls) > 35
    at = np.column_stack([search.grid.origin + CELL * (walls[:, ::-1] + 0.5),
                          np.zeros(len(walls))])
    on_drive = np.array([between(frame, pose) for pose in at])
    assert on_drive[:, 0] == pytest.approx(3.05, abs=0.11)
    assert on_drive[:, 1].min() < 0.2 and on_drive[:, 1].max() > 3.8
    for x, y, known in ((1.0, 3.5, True), (5.5, 0.5, True), (7.0, 2.0, False)):
        row, column = search.grid.cell(*compose(frame, np.array([x, y, 0.0]))[:2])
        assert search.grid.unknown()[row, column] != known


def test_what_is_seen_outweighs_what_is_recalled_and_a_lost_robot_believes_its_eyes_alone():
    search, _ = recalled(np.array([-1.0, -2.0, 0.0]))  # the robot stands at (1, 2)
    grid = search.grid
    row, column = grid.cell(2.05, 0.5)  # the wall
    assert grid.heard_of()[1][row, column]
    ahead = np.zeros((32, 24))
    ahead[:, -1] = 1.0  # free as far as one sees: the wall was taken away
    grid.add_ranges(search.pose, column_bearings(CONFIG.view), ahead, RANGE_EDGES)
    assert not np.any([part[row, column] for part in (*grid.heard_of(), grid.unknown())])
    back = grid.cell(-0.5, -1.5)  # behind it: known from the drive alone
    assert not grid.unknown()[back]
    grid.forget_looks()
    assert grid.unknown()[back] and grid.heard_of() is None


def test_where_a_robot_has_driven_is_the_cheapest_way_until_something_stands_there():
    search, _ = recalled(np.array([-1.0, -2.0, 0.0]))
    grid, wall = search.grid, search.grid.cell(2.05, 0.0)
    lane, beside, past = grid.cell(1.05, 0.05), grid.cell(1.05, 1.05), grid.cell(3.5, 0.0)
    costs = Costmap(grid).cost
    assert costs[lane] == 1 and costs[beside] == costs[past] == 3.5  # floor that was only seen
    assert costs[wall] == 31.5
    grid.add_contact(np.array([0.85, 0.0, 0.0]), 0.0)
    assert not Costmap(grid).passable[lane]
    grid.forget_looks()
    assert Costmap(grid).cost[wall] == 3  # it is unknown floor


def test_goals_of_the_drive_are_hypotheses_until_looks_know_better():
    frame = np.array([1.0, 0.5, 0.5])
    search, recall = recalled(frame)
    best, other = search.hypotheses.all
    assert best.weight == pytest.approx(0.8 * GOAL_WEIGHT) and other.weight < best.weight
    assert apart(best.pose, compose(frame, np.array([2.0, 3.0, 1.0]))) == pytest.approx(
        (0, 0), abs=1e-5)
    assert search.hypotheses.worth_trying(search.rules.follow_from) == [best, other]
    best.pose[0] += 0.4  # looks on the way are less exact than two pictures of the drive
    recall.keys.said = [([mode(*between(frame, np.zeros(3)))], 0.9)]
    recall.look(search, None)
    assert apart(best.pose, compose(frame, np.array([2.0, 3.0, 1.0])))[0] < 1e-5
    # It found no way there, and tries again.
    search.hypotheses.refute(best)
    recall.keys.said = [([mode(*between(frame, np.zeros(3)))], 0.9)]
    recall.look(search, None)
    assert best.refuted == 0 and best.weight == pytest.approx(0.8 * GOAL_WEIGHT)
    # It was there in vain, and is lost: that remains, the other one goes.
    search.pose = best.pose.copy()
    recall.keys.said = [([mode(2, 3, 1)], 0.9)]
    recall.look(search, None)
    search.hypotheses.refute(best)
    for _ in range(12):
        recall.keys.said = [([], 0.01)]
        recall.look(search, None)
    assert not recall.localiser.sure and search.grid.prior is None
    assert search.hypotheses.all == [best]
    # It turns out to be elsewhere: then it was not there.
    for _ in range(3):
        recall.keys.said = [([mode(9.0, 9.0, 0.0)], 0.9)]
        recall.look(search, None)
    assert recall.localiser.sure and all(
        own is not best for own in search.hypotheses.all)


def test_the_map_of_a_drive_has_its_floor_in_it():
    policy, poses = network(), np.column_stack([np.linspace(0, 4, 30), np.zeros((30, 2))])
    shown = pictures(30)
    found = recall_drive(policy, shown, poses, np.array([0, 20]))
    assert (found.pictures == shown[[0, 20]]).all() and found.poses[1, 0] == pytest.approx(
        poses[20, 0])
    cells = np.floor((poses[:, :2] - found.origin) / CELL).astype(int)
    assert (found.log_odds[cells[:, 1], cells[:, 0]] < 0).all()
    assert (found.seen[cells[:, 1], cells[:, 0]] >= 1).all()
    with pytest.raises(UserError, match='show something'):
        recall_drive(policy, shown, poses, np.zeros(0, np.int64))


def test_a_taught_checkpoint_comes_back(tmp_path):
    policy = taught()
    save_checkpoint(tmp_path / 'model', policy, INFO)
    loaded = load_checkpoint(tmp_path / 'model')
    assert 'place_sha256' not in loaded.info
    for field in dataclasses.fields(TaughtPlace):
        assert np.array_equal(getattr(loaded.network.taught, field.name),
                              getattr(policy.taught, field.name))
    assert 'map of that drive' in (tmp_path / 'model' / 'README.md').read_text()
    save_checkpoint(tmp_path / 'model', network(), INFO)  # replaced by one that was taught nothing
    assert load_checkpoint(tmp_path / 'model').network.taught is None
    assert sorted(path.name for path in (tmp_path / 'model').iterdir()) == [
        'README.md', 'config.json', 'model.safetensors']


def other_file(folder):
    save_checkpoint(folder.parent / 'other', taught(3), INFO)
    (folder / 'place.safetensors').write_bytes(
        (folder.parent / 'other' / 'place.safetensors').read_bytes())


def other_size(folder):
    policy = network()
    policy.taught = dataclasses.replace(place(), pictures=np.zeros((5, 3, 40, 40), np.uint8))
    save_checkpoint(folder, policy, INFO)


def no_string(folder):
    config = json.loads((folder / 'config.json').read_text())
    del config['config_sha256']
    (folder / 'config.json').write_text(json.dumps({**config, 'place_sha256': [1]}))


@pytest.mark.parametrize(('damage', 'says'), [
    (lambda folder: (folder / 'place.safetensors').unlink(), 'can be read'),
    (lambda folder: (folder / 'place.safetensors').write_bytes(b'none'), 'SHA-256'),
    (other_file, 'SHA-256'), (other_size, 'size of the policy'), (no_string, 'SHA-256'),
])
def test_a_damaged_place_is_refused(damage, says, tmp_path):
    save_checkpoint(tmp_path / 'model', taught(), INFO)
    damage(tmp_path / 'model')
    with pytest.raises(UserError, match=says):
        load_checkpoint(tmp_path / 'model')


@pytest.mark.parametrize('change', [
    {'poses': np.zeros((4, 3), np.float32)}, {'poses': np.full((5, 3), np.nan, np.float32)},
    {'seen': np.zeros((3, 3), np.float32)}, {'origin': np.zeros(2)},
    {'pictures': np.zeros((5, 3, 48, 48), np.float32)}, {'zoom': np.zeros(1, np.float32)},
])
def test_parts_that_do_not_fit_are_no_place(change):
    with pytest.raises(UserError, match='taught place'):
        dataclasses.replace(place(), **change)


def test_a_runtime_recalls_and_prepares_its_goal(tmp_path):
    save_checkpoint(tmp_path / 'model', taught(), INFO)
    policy = PolicyRuntime(tmp_path / 'model')
    (goal, other), image = pictures(2, 12), pictures(1, 6)[0]
    policy.set_goal(goal)
    assert policy.search is not None and policy.search.recalls is not None
    first = [policy.act(image, np.zeros(3)) for _ in range(3)]
    recall, = policy.search.recalls
    prepared = [own.pose for own in recall.goals]
    eyes = policy.search.eyes
    alone = KeyPictures(eyes, eyes.taught).poses_of_goal(eyes.encode_goals(goal[None]))
    assert [list(pose) for pose in prepared] == [list(own.pose) for own in alone[:3]]
    policy.set_goal(other)
    policy.set_goal(goal)
    assert [policy.act(image, np.zeros(3)) for _ in range(3)] == first


def test_robots_in_one_place_do_not_disturb_each_other():
    policy = TorchEyes(taught())
    maps = policy.encode_goals(pictures(3, 9))

    def drive(rows):
        driver = SearchDriver(policy, len(rows))
        for k in range(4):
            driver.act(pictures(3, 20 + k)[rows], maps[rows], np.full(len(rows), -1 if k == 0
                       else 0), np.full(len(rows), k == 0), np.zeros((len(rows), 3)))
        return [np.array([[*own.pose, own.share] for own in recall.localiser.poses])
                for recall in driver.recalls]
    together, alone = drive([0, 1, 2]), [drive([k])[0] for k in range(3)]
    assert all(len(own) for own in together) and not np.array_equal(together[0], together[1])
    for one, other in zip(together, alone, strict=True):
        assert one == pytest.approx(other, abs=1e-3)


def test_through_another_lens_it_searches_as_if_it_had_been_taught_nothing():
    policy = TorchEyes(taught())
    maps = policy.encode_goals(pictures(1, 9))
    for zoom, told in ((1.0, True), (1.7, False)):
        driver = SearchDriver(policy, 1)
        driver.act(pictures(1, 20), maps, np.array([-1]), np.array([True]), np.zeros((1, 3)),
                   zoom=zoom)
        assert bool(driver.recalls[0].localiser.poses) == told


def test_votes_through_a_narrow_lens_are_in_metres():
    policy = TorchEyes(taught())
    goal = policy.encode_goals(pictures(1, 9))
    look = policy.look(place(1).pictures, goal)
    one = KeyPictures(policy, place(1)).poses_of_goal(goal)[0].pose
    narrow = dataclasses.replace(place(1), zoom=np.full(1, 2, np.float32))
    other = KeyPictures(policy, narrow).poses_of_goal(goal)[0].pose
    at = place(1).poses[0]
    ahead, left = (float(part) for part in look.position[0])
    assert one[:2] - at[:2] == pytest.approx([ahead, left], abs=1e-4)
    assert other[:2] - at[:2] == pytest.approx([2 * ahead, left], abs=1e-4)


def test_a_prior_is_dropped_when_the_map_moves():
    grid = OccupancyGrid(0.18)
    grid.prior = Prior(*np.ones((3, 320, 320), np.float32))
    grid.add_footprint(np.array([0.0, 0.0, 0.0]))
    assert grid.prior is not None
    grid.add_footprint(np.array([13.0, 0.0, 0.0]))
    assert grid.prior is None
