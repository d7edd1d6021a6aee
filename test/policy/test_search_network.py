"""The networks of `search`: shapes, distributions, checkpoint, and what they refuse."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.measured_ranges import laser_scan
from vn_nav.observation import Observation
from vn_nav.policy.action_filter import BLOCKED_ACTIONS, NONE
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import _check_stop_threshold
from vn_nav.policy.search import approach, costmap, grid, lookahead, measured
from vn_nav.policy.search.driver import SearchDriver
from vn_nav.policy.search.look import (
    BINS,
    COLUMNS,
    LOG_CONCENTRATIONS,
    RANGE_CENTRES,
    RANGE_EDGES,
    Recognition,
    arrival_by_pose,
    column_bearings,
    heading_deviation,
    median_ranges,
    range_classes,
)
from vn_nav.policy.search.network import SearchPolicy, agreed
from vn_nav.policy.search.torch_eyes import TorchEyes
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import RobotSpec

ROBOT = RobotSpec().with_actions(('forward', 'rotate_left', 'rotate_right'))
CONFIG = NetworkConfig(
    actions=ROBOT.action_names, moves=ROBOT.moves, size=48, architecture='search',
    channels=(8, 12, 8), features=24, blocks=1, view=ROBOT.camera_fov,
    footprint=ROBOT.footprint_radius)


def network(config=CONFIG):
    torch.manual_seed(0)
    return build_policy(config)


def pictures(count, size=48, seed=0):
    return torch.from_numpy(
        np.random.default_rng(seed).integers(0, 256, (count, 3, size, size), dtype=np.uint8))


@pytest.mark.parametrize('size', [40, 48, 64, 84])
def test_a_look_has_its_shapes_whatever_the_pictures_side(size):
    policy = network(dataclasses.replace(CONFIG, size=size))
    assert isinstance(policy, SearchPolicy)
    with torch.inference_mode():
        goals = policy.encode_goals(pictures(2, size, 1))
        look = policy.look(pictures(5, size), goals, torch.tensor([0, 1, 1, 0, 0]))
    assert [tuple(part.shape) for part in look] == [
        (5, COLUMNS, BINS), (5, 2), (5,), (5, 2), (5,), (5,), (5,)]
    assert all(part.dtype == torch.float32 and torch.isfinite(part).all() for part in look)
    assert torch.allclose(look.ranges.exp().sum(2), torch.ones(5, COLUMNS), atol=1e-5)
    assert torch.allclose(look.heading.norm(dim=1), torch.ones(5), atol=1e-5)
    assert (look.position_sigma > 0).all() and (look.heading_sigma > 0).all()


def test_a_goal_belongs_to_its_picture_and_ranges_to_no_goal():
    policy = network()
    image, goals = pictures(3), policy.encode_goals(pictures(2, seed=1))
    with torch.inference_mode():
        look = policy.look(image, goals, torch.tensor([1, 0, 1]))
        same = policy.look(image, goals[[1, 0, 1]])
        other = policy.look(image, goals[[0, 1, 0]])
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(look, same, strict=True))
    assert torch.equal(look.ranges, other.ranges)
    assert not torch.allclose(look.position, other.position, atol=1e-4)


def test_a_mirrored_look_is_the_look_mirrored():
    policy = network()
    image, goals = pictures(3), pictures(3, seed=1)
    with torch.inference_mode():
        look = policy.look(image, policy.encode_goals(goals))
        other = policy.look(image.flip(-1), policy.encode_goals(goals.flip(-1)))
    sides = torch.tensor([1.0, -1.0])
    back = other._replace(ranges=other.ranges.flip(1), position=sides * other.position,
                          heading=sides * other.heading)
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(look, back, strict=True))


def test_of_two_opinions_the_surer_one_counts_more():
    sure, unsure = (Recognition(
        torch.tensor([[x, 0.0]]), torch.tensor([scale]), torch.tensor([heading]),
        torch.tensor([kappa]), torch.tensor([logit]), torch.tensor([logit]))
        for x, scale, heading, kappa, logit in (
            (1.0, math.log(0.1), [1.0, 0.0], math.log(9.0), 2.0),
            (2.0, math.log(0.3), [0.0, 1.0], 0.0, 4.0)))
    both = agreed(sure, unsure)
    assert torch.allclose(both.position, torch.tensor([[1.1, 0.0]]))  # 9 : 1
    assert torch.allclose(both.heading[:, 1] / both.heading[:, 0], torch.tensor([1 / 9]))
    assert both.co_visible.item() == both.arrived.item() == 3.0
    assert all(torch.allclose(a, b) for a, b in zip(both, agreed(unsure, sure), strict=True))


def test_columns_stay_apart():
    """What is far to the left says nothing of the range to the right."""
    policy = network(dataclasses.replace(CONFIG, size=64))
    image = pictures(1, 64)
    changed = image.clone()
    changed[..., :16] = 255 - changed[..., :16]
    with torch.inference_mode():
        before, after = (policy.ranges(part, torch.float32)[0] for part in (image, changed))
    assert torch.allclose(before[20:], after[20:], atol=1e-5)
    assert not torch.allclose(before[:4], after[:4], atol=1e-3)


def test_bearings_and_bins():
    bearings = column_bearings(math.radians(90))
    assert len(bearings) == COLUMNS and bearings[0] > bearings[-1] == -bearings[0]
    assert np.allclose(np.diff(np.tan(bearings)), -2 / COLUMNS)
    assert len(RANGE_EDGES) == BINS - 1 and np.isclose(RANGE_EDGES[[0, -1]], (0.15, 8)).all()
    assert (range_classes(RANGE_CENTRES) == np.arange(BINS)).all()
    assert range_classes(np.array([0.01, 90.0, np.inf, np.nan])).tolist() == [
        0, BINS - 1, BINS - 1, -1]
    sure = torch.log_softmax(50 * torch.eye(BINS), dim=1).numpy()
    assert np.allclose(median_ranges(sure), RANGE_CENTRES, rtol=1e-3)
    two = np.full(BINS, -50.0)
    two[8], two[9] = math.log(0.5), math.log(0.5)  # the median is the edge between the two
    assert np.isclose(median_ranges(two), RANGE_EDGES[8], rtol=1e-3)


def test_the_deviation_of_a_heading_is_that_of_its_distribution():
    kappa = torch.tensor([0.5, 4.0, 100.0])
    drawn = torch.distributions.VonMises(torch.zeros(3), kappa).sample((40_000,))
    length = torch.hypot(drawn.cos().mean(0), drawn.sin().mean(0))
    found = heading_deviation(kappa.log().numpy())
    assert np.allclose(found, torch.sqrt(-2 * length.log()), rtol=0.03)
    wide = torch.linspace(*LOG_CONCENTRATIONS, 5003).exp().double()
    exact = torch.sqrt(-2 * torch.log(torch.special.i1e(wide) / torch.special.i0e(wide)))
    assert np.allclose(heading_deviation(wide.log().numpy()), exact, rtol=2e-5)


def test_arrival_follows_from_the_pose():
    random = np.random.default_rng(0)
    cases = np.array([[0.1, 0.0, 0.1, 5, 5], [0.5, 0.2, 0.4, 25, 20], [0.0, 0.9, 0.3, 0, 10],
                      [0.3, -0.3, 1.0, -20, 15], [3.0, 0.0, 0.5, 0, 5]])
    x, y, sigma, turn, spread = cases.T
    turn, spread = np.radians(turn), np.radians(spread)
    found = arrival_by_pose(np.stack([x, y], 1), sigma,
                            np.stack([np.cos(turn), np.sin(turn)], 1), spread)
    for k in range(len(cases)):
        radius = random.gamma(2.0, sigma[k] / math.sqrt(3), 100_000)  # of exp(-r) in the plane
        angle = random.uniform(0, 2 * math.pi, 100_000)
        near = np.hypot(x[k] + radius * np.cos(angle), y[k] + radius * np.sin(angle)) <= 0.6
        ahead = np.abs(random.normal(turn[k], spread[k], 100_000)) <= math.radians(30)
        assert abs(found[k] - (near & ahead).mean()) < 0.02


def test_a_checkpoint_comes_back_and_says_what_it_is(tmp_path):
    policy = network()
    save_checkpoint(tmp_path / 'model', policy, {
        'world_version': '1', 'camera_fov_deg': 90.0, 'camera_height': 1.0,
        'stop_threshold': 0.7, 'data': '10 picture pairs'})
    loaded = load_checkpoint(tmp_path / 'model')
    assert loaded.config == CONFIG and isinstance(loaded.network, SearchPolicy)
    state = loaded.network.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in policy.state_dict().items())
    assert not any(part in name for name in state for part in ('actor', 'critic', 'memory'))
    card = (tmp_path / 'model' / 'README.md').read_text()
    assert 'planner' in card and 'LSTM' not in card and 'sampled' not in card
    _check_stop_threshold(0.7, loaded.config)


def test_it_declares_and_chooses_no_action():
    assert CONFIG.declares and CONFIG.filter_name == NONE
    fused = dataclasses.replace(CONFIG, architecture='fused', moves=(), view=0, footprint=0)
    assert not fused.declares
    with pytest.raises(UserError, match='declares its stop'):
        _check_stop_threshold(0.5, fused)
    seen = Observation(pictures(1)[None], pictures(1), None, torch.tensor([[-1]]),
                       torch.zeros(1, 1))
    with pytest.raises(UserError, match='map and planner'):
        network()(seen, torch.tensor([[True]]))
    with pytest.raises(UserError, match='build_policy'):
        Policy(CONFIG)


@pytest.mark.parametrize(('changes', 'rule'), [
    ({'moves': ()}, 'moves of its actions'),
    ({'view': 0.0}, 'field of view'), ({'view': 4.0}, 'field of view'),
    ({'view': math.nan}, 'field of view'),
    ({'footprint': 0.0}, 'radius'), ({'footprint': -1.0}, 'radius'),
    ({'heads': ('arrival',)}, 'heads of its own'),
    ({'frames': 2}, 'one picture at a time'), ({'places': 16}, 'place cells'),
    ({'action_filter': BLOCKED_ACTIONS}, 'no action filter'),
    ({'size': 36}, 'at least 40 pixels'),
    ({'architecture': 'matching', 'moves': ()}, 'left out for others'),
    ({'architecture': 'matching', 'moves': (), 'view': 0.0}, 'left out for others'),
])
def test_what_a_configuration_must_not_say(changes, rule):
    with pytest.raises(UserError, match=rule):
        dataclasses.replace(CONFIG, **changes)


def test_a_budget_is_counted_from_the_beginning_of_each_episode():
    eyes = TorchEyes(network())
    goals = eyes.encode_goals(pictures(2, seed=1).numpy())
    known, unknown = SearchDriver(eyes, 2, max_decisions=300), SearchDriver(eyes, 2)
    last = np.full(2, -1)
    left = []
    for k in range(4):
        starts = np.array([k == 0, k in (0, 2)])
        last = known.act(pictures(2, seed=k).numpy(), goals, last, starts, None)
        left.append([searcher.remaining for searcher in known.searchers])
    assert left == [[300, 300], [299, 299], [298, 300], [297, 299]]
    unknown.act(pictures(2).numpy(), goals, np.full(2, -1), np.ones(2, bool), None)
    assert unknown.searchers[0].remaining is None


def test_nothing_is_compiled_while_a_robot_drives():
    """Decisions have 0.1 s: whoever makes the driver waits for the compiler, once."""
    kernels = (grid._integrate, grid._disc, grid._expect, costmap._dijkstra, costmap.free_length,
               lookahead.best_turns, approach.best_move, measured.enter_scan, measured.look_over,
               measured.free_of_points)
    driver = SearchDriver(TorchEyes(build_policy(CONFIG)), 2)
    before = [set(kernel.signatures) for kernel in kernels]
    assert all(before)
    rng = np.random.default_rng(0)
    last, starts = np.full(2, -1), np.ones(2, bool)
    goals = driver.eyes.encode_goals(np.zeros((2, 3, 48, 48), np.uint8))
    for k in range(30):
        image = rng.integers(0, 256, (2, 3, 48, 48), dtype=np.uint8)
        scans = None if k % 2 else [laser_scan(rng.uniform(0.5, 6, 360), -math.pi,
                                               math.radians(1), 0.1, 12.0), None]
        last = driver.act(image, goals, last, starts, rng.normal(0, 1, (2, 3)), scans)
        starts = np.zeros(2, bool)
        assert ((last >= 0) & (last < len(CONFIG.actions))).all()
    assert [set(kernel.signatures) for kernel in kernels] == before
