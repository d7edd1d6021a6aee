"""Place recognition: recorded pictures in other lights, where they were taken, and paths."""

import dataclasses
import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from corridor_drive import ROBOT, SIZE, corridor_graph
from torch.nn import functional as F

from vn_nav.arrival import wrap_angle
from vn_nav.learning.auxiliary import imitation_loss
from vn_nav.learning.places import fit_paths, fit_places, recognise, spread_spots
from vn_nav.learning.teach_network import widened
from vn_nav.observation import Observation
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.places import HEADINGS, MultiViewAveraging
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.datasets.recorded_views import GraphViews
from vn_sim_bridge.recorded.lattice_motion import MOST_REGRET
from vn_sim_bridge.recorded.relight import draw_light, relight
from vn_sim_bridge.simulators.recorded import RecordedSimulator
from vn_sim_bridge.teach_place import make_views, regrets

SIDE = 36
CONFIG = NetworkConfig(actions=ROBOT.action_names, size=SIDE, channels=(8, 8, 8), features=16,
                       hidden=16, heads=('goal_pose',), pose_to_memory=True, places=6)


@pytest.fixture(scope='module')
def corridor():
    return corridor_graph()


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


class Stripes:
    """Pictures of a world in which colours say where one is, and a bright column says the yaw."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def draw(self, count):
        poses = np.column_stack([self.rng.uniform(0, 4, (count, 2)),
                                 self.rng.uniform(-np.pi, np.pi, count)])
        return self.show(poses), poses

    @staticmethod
    def show(poses):
        pictures = np.zeros((len(poses), 3, SIDE, SIDE), np.uint8)
        pictures[:, 0] = (50 * poses[:, 0])[:, None, None]
        pictures[:, 1] = (50 * poses[:, 1])[:, None, None]
        column = ((poses[:, 2] + np.pi) / (2 * np.pi) * SIDE).astype(int) % SIDE
        pictures[np.arange(len(poses)), 2, :, column] = 255
        return pictures


@pytest.fixture(scope='module')
def fitted():
    """A network that knows the striped world, and what was said of it."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network, lines = Policy(dataclasses.replace(CONFIG, places=24)), []
    grid = np.random.default_rng(0).uniform(0, 4, (500, 2))
    facts = fit_places(network, Stripes(0), Stripes(1), grid, minutes=0.001, least=30_000,
                       say=lines.append)
    return network, facts, lines


def test_the_recogniser_learns_where_pictures_were_taken(fitted):
    network, facts, lines = fitted
    assert facts['metres'] < 0.8 and facts['degrees'] < 20  # chance: 1.5 m, 90 deg
    assert len(lines) >= 3 and f'{facts["metres"]:.2f} m' in lines[-1]
    code = recognise(network, Stripes(2).draw(50)[0])
    assert code.shape == (50, 24 + HEADINGS)
    assert torch.allclose(code.sum(1), torch.full((50,), 2.0), atol=1e-3)
    assert not any(part.requires_grad for part in network.places.parameters())


def test_routes_learn_the_first_actions_of_ways(fitted):
    """Here: forward where the goal has the greater x, else backward."""
    network, _, _ = fitted
    pictures, poses = Stripes(3).draw(256)
    goals, ends = Stripes(4).draw(16)
    behind = (ends[:, None, 0] < poses[None, :, 0])[..., None]
    regrets = np.where(behind == np.arange(4), 0, 2).astype(np.float16)
    regrets[..., 2:] = 5
    lines = []
    facts = fit_paths(network, pictures, goals, regrets, until=time.monotonic(),
                      say=lines.append, least=200_000)
    assert facts['regret'] < 0.3 and facts['ways'] >= 200_000 and len(lines) == 1
    new, ends = Stripes(5).draw(16)
    here, there = recognise(network, pictures), recognise(network, new)
    advised = network.routes(here.repeat(16, 1), there.repeat_interleave(256, 0))[1].argmax(1)
    truth = (ends[:, None, 0] < poses[None, :, 0]).ravel()
    assert float((advised.numpy() == truth).mean()) > 0.8


def test_spots_are_spread_over_all_positions():
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), -1).reshape(-1, 2)
    spots = spread_spots(grid, 16)
    assert np.array_equal(spots, spread_spots(grid, 16))
    assert np.hypot(*(grid[:, None] - spots).transpose(2, 0, 1)).min(axis=1).max() < 2.5


def observe(network, seed=0, steps=3, envs=2):
    generator = torch.Generator().manual_seed(seed)

    def pictures(*shape):
        return torch.randint(0, 256, (*shape, 3, SIDE, SIDE), generator=generator,
                             dtype=torch.uint8)
    return Observation(pictures(steps, envs), pictures(4),
                       torch.randint(0, 4, (steps, envs), generator=generator),
                       torch.zeros(steps, envs, dtype=torch.int64), torch.zeros(steps, envs))


def test_a_policy_that_is_told_of_a_place_begins_as_it_was():
    before = Policy(dataclasses.replace(CONFIG, places=0))
    after = Policy(CONFIG)
    after.load_state_dict(widened(before.state_dict(), after))
    starts = torch.zeros(3, 2, dtype=torch.bool)
    seen = observe(before)
    for one, other in zip(before(seen, starts)[0][:2], after(seen, starts)[0][:2], strict=True):
        assert torch.allclose(one, other, atol=1e-5)
    # And again, of another place: what it knew of the first one is no use.
    again = Policy(dataclasses.replace(CONFIG, places=9))
    again.load_state_dict(widened(after.state_dict(), again))


def test_no_gradient_changes_where_places_are():
    network = Policy(CONFIG)
    output, _ = network(observe(network), torch.zeros(3, 2, dtype=torch.bool))
    output.logits.square().sum().backward()
    assert all(part.grad is None for part in network.places.parameters())
    assert network.routes.advise.weight.grad.abs().sum() > 0


def test_imitation_reaches_what_is_acted_upon():
    """The cross-entropy is that of the actor and the advice together, not of the actor alone."""
    network = Policy(CONFIG)
    for part in network.parameters():
        part.data.normal_(0, 0.3)
    seen, starts = observe(network), torch.zeros(3, 2, dtype=torch.bool)
    latents, _ = network.latents(seen, starts)
    action = torch.randint(0, 4, (2, 2))
    batch = SimpleNamespace(valid=torch.ones(2, 2, dtype=torch.bool),
                            privileged={'oracle_action': action})
    loss = imitation_loss(network, latents, batch, 'oracle_action')
    logits = network(seen, starts)[0].logits[:2]
    assert loss.item() == pytest.approx(
        F.cross_entropy(logits.flatten(0, 1), action.flatten()).item(), abs=1e-5)


def test_who_turns_on_the_spot_knows_it_by_all_its_pictures():
    around = MultiViewAveraging(((0.5, 0, 0), (-0.2, 0, 0), (0, 0, 0.5), (0, 0, -0.5)), 3)
    here = torch.rand(7, 1, 3 + HEADINGS)
    actions = torch.tensor([-1, 2, 3, 0, 2, 2, 3])[:, None]
    starts = torch.tensor([True, False, False, False, False, True, False])[:, None]
    said, remembered = around(here, actions, starts, torch.full((1, 4), 9.0))
    spots = here[..., :3]
    expected = [spots[0], spots[:2].mean(0), spots[:3].mean(0),  # turns
                spots[3], spots[3:5].mean(0),  # has driven on
                spots[5], spots[5:].mean(0)]  # another episode
    assert torch.allclose(said[..., :3], torch.stack(expected), atol=1e-6)
    assert torch.equal(said[..., 3:], here[..., 3:])
    assert remembered[0, 3] == 2
    stepwise, state = [], torch.zeros(1, 4)
    for t in range(7):
        row, state = around(here[t:t + 1], actions[t:t + 1], starts[t:t + 1], state)
        stepwise.append(row)
    assert torch.equal(torch.cat(stepwise), said) and torch.equal(state, remembered)


def test_advice_of_a_goal_reaches_its_own_robot():
    """Goals by index, and goals in the order of the robots, say the same."""
    network = Policy(CONFIG)
    for part in network.parameters():
        part.data.normal_(0, 0.2)
    seen, starts = observe(network, steps=1), torch.zeros(1, 2, dtype=torch.bool)
    whole, _ = network(seen, starts)
    own = seen.goals[seen.goal_index[0]]
    alone, _ = network(seen._replace(goals=None, goal_index=None), starts,
                       goal_maps=network.encode_goals(own))
    assert torch.allclose(whole.logits, alone.logits, atol=1e-5)


def test_light_is_a_function_of_the_counter_and_changes_every_pixel_alike():
    tables = draw_light(3, Stream.VIEW_APPEARANCE, np.arange(40), np.zeros(40, int))
    assert np.array_equal(tables[7:9], draw_light(3, Stream.VIEW_APPEARANCE, np.array([7, 8]),
                                                  np.zeros(2, int)))
    assert (np.diff(tables.astype(int), axis=2) >= 0).all()  # brighter stays brighter
    middle = tables[:, 1, 128].astype(float)
    assert middle.min() < 110 and middle.max() > 146
    pictures = np.random.default_rng(0).integers(0, 256, (2, 3, 8, 8), np.uint8)
    changed = pictures.copy()
    relight(changed, tables[:2])
    for n in range(2):
        for c in range(3):
            assert np.array_equal(changed[n, c], tables[n, c][pictures[n, c]])


def test_every_episode_in_a_graph_has_a_light_and_goals_have_none(corridor):
    robots = np.arange(2)
    lit = RecordedSimulator(corridor, 2, robot=ROBOT, light=True, draw=False)
    plain = RecordedSimulator(corridor, 2, robot=ROBOT, draw=False)
    poses = np.array([[*corridor.poses[k], 0.0] for k in (5, 9)])
    for simulator in (lit, plain):
        simulator.place(robots, poses)
    assert np.array_equal(lit.observe().rgb, plain.observe().rgb)  # nothing drawn yet
    lit.apply_appearance(robots, 0, Stream.APPEARANCE, robots, np.array([4, 4]))
    first, true = lit.observe().rgb, plain.observe().rgb
    assert not np.array_equal(first, true)
    assert np.array_equal(first[1], lit.observe(np.array([1])).rgb[0])
    lit.apply_appearance(np.array([1]), 0, Stream.APPEARANCE, np.array([1]), np.array([5]))
    second = lit.observe().rgb
    assert np.array_equal(first[0], second[0]) and not np.array_equal(first[1], second[1])
    goals = np.array([[*corridor.goals[0].pose]])
    assert np.array_equal(lit.view(np.array([0]), goals).rgb, plain.view(np.array([0]), goals).rgb)


def test_views_are_a_function_of_seed_and_number_with_their_true_poses(corridor):
    nodes = [3, 4, 50]
    pictures, poses = GraphViews(corridor, ROBOT, nodes, 1).draw(30)
    other = GraphViews(corridor, ROBOT, nodes, 1)
    for part in (10, 20):
        one = other.draw(part)
    assert np.array_equal(one[0], pictures[10:]) and np.array_equal(one[1], poses[10:])
    assert pictures.shape == (30, 3, SIZE, SIZE)
    gap = np.abs(poses[:, None, :2] - corridor.poses[nodes][None, :, :2]).sum(axis=2)
    turned = np.abs(wrap_angle(poses[:, None, 2] - corridor.poses[nodes][None, :, 2]))
    assert (turned[gap == 0].reshape(-1)).min() <= np.radians(10) and (gap.min(axis=1) == 0).all()
    fit, judge = make_views(corridor, ROBOT, 0)
    drawn = {tuple(pose[:2]) for pose in fit.draw(400)[1]}
    assert len(drawn) > 20 and judge.draw(5)[0].shape[0] == 5


def test_regrets_are_what_actions_lose_on_the_shortest_ways(corridor):
    own = corridor.with_goals([0, 3])
    poses = corridor.poses[::7]
    found = regrets(own, poses)
    assert found.shape == (2, len(poses), 4) and found.min() == 0 and found.max() <= MOST_REGRET
    for goal, row in zip(own.goals, found, strict=True):
        ends = np.tile(np.array(goal.pose), (len(poses), 1))
        best = corridor.map.actions(poses, ends)
        assert (row[np.arange(len(poses)), best] == 0).all()
        assert np.allclose(row, corridor.map.regrets(poses, ends), atol=0.01)
    # At the end of the corridor, facing its middle: the goal lies ahead, and nothing behind.
    goal = corridor.with_goals([0]).goals[0].pose
    x = 4.0 if goal[0] < 2 else 0.0
    yaw = math.pi if x else 0.0
    forward, backward, *_ = corridor.map.regrets_to(np.array([[x, 0.0, yaw]]), goal)[0]
    assert forward == 0 and backward > 0.5
