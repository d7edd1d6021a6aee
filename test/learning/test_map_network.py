"""`bench/map_network.py`: what the network is shown of the map, and that it learns."""

import importlib
import json
import math
import sys

import numpy as np
import pytest
import torch
from paths import ROOT
from small_env import make
from small_search import small_search, write_small_search

from vn_nav.evaluation.evaluator import PolicyActor, run_episodes
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.search.grid import CELL, OccupancyGrid
from vn_nav.policy.search.hypotheses import Hypotheses

PLACE = np.array([1.3, -0.7])
HEADINGS = [0.0, math.pi / 2, math.pi, -math.pi / 2, 0.6]


@pytest.fixture(scope='module')
def views():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / 'bench')
        yield importlib.import_module('map_views')


@pytest.fixture(scope='module')
def learning(views):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / 'bench')
        yield importlib.import_module('map_learning')


def pixel(views, ahead, left, scale):
    """Row and column of a place in the robot's frame [m]."""
    return tuple(round((views.PIXELS - 1) / 2 - along / views.SCALES[scale])
                 for along in (ahead, left))


def channel(views, name, scale):
    names = (*views.GRID_LAYERS, *views.GOAL_LAYERS)
    return scale * len(names) + names.index(name)


def walled(yaw, ahead, half):
    """A map with a wall across a robot's way, and its free floor behind it unseen."""
    grid = OccupancyGrid(0.18)
    c, s = math.cos(yaw), math.sin(yaw)
    for left in np.arange(-half, half, CELL / 2):
        x, y = PLACE + [c * ahead - s * left, s * ahead + c * left]
        for dx, dy in ((0, 0), (CELL, 0), (0, CELL), (-CELL, 0), (0, -CELL)):
            row, column = grid.cell(x + dx, y + dy)
            grid.log_odds[row, column], grid.seen[row, column] = 4.0, 2.0
    return grid


@pytest.mark.parametrize('yaw', HEADINGS)
@pytest.mark.parametrize('scale', [0, 1])
def test_a_wall_ahead_is_ahead_and_a_contact_to_the_left_is_left(views, yaw, scale):
    # Halfway between two pixels' centres a place would be in neither.
    ahead, side = 10.5 * views.SCALES[scale], 8.5 * views.SCALES[scale]
    half = 0.3 * ahead
    grid, pose = walled(yaw, ahead, half), np.array([*PLACE, yaw])
    grid.add_footprint(pose)
    left = pose[:2] + side * np.array([-math.sin(yaw), math.cos(yaw)])
    for dx in np.arange(-0.2, 0.25, 0.1):
        for dy in np.arange(-0.2, 0.25, 0.1):
            grid.contacts[grid.cell(left[0] + dx, left[1] + dy)] = True
    crops = views.map_crops(grid, Hypotheses(), pose)
    assert crops.shape == (views.CHANNELS, views.PIXELS, views.PIXELS)
    obstacle, contact, been = (crops[channel(views, name, scale)].astype(int)
                               for name in ('obstacle', 'contact', 'been'))
    row, column = pixel(views, ahead, 0.0, scale)
    assert obstacle[row, column] > 180, obstacle[row - 2:row + 3, column]
    for other in ((-ahead, 0.0), (0.0, ahead), (0.0, -ahead)):
        place = pixel(views, *other, scale)
        if other[1] <= 0:  # nothing is there
            assert abs(obstacle[place] - views.MIDDLE) <= 1, other
    where = np.argwhere(contact > 40).mean(0)
    assert np.abs(where - np.array(pixel(views, 0.0, side, scale))).max() < 1
    middle = (views.PIXELS - 1) / 2
    if scale == 0:
        assert np.abs(np.argwhere(been > 100) - middle).max() < 1.5
    looked = crops[channel(views, 'looked_at', scale)]
    assert looked[row, column] > 80 and looked[pixel(views, -ahead, 0.0, scale)] == 0


@pytest.mark.parametrize('yaw', HEADINGS)
def test_a_hypothesis_is_a_blob_with_its_heading(views, yaw):
    pose = np.array([*PLACE, yaw])
    c, s = math.cos(yaw), math.sin(yaw)
    ahead, left, turn = 1.2, -0.9, 2.0
    hypotheses = Hypotheses()
    own = hypotheses.suggest(
        [pose[0] + c * ahead - s * left, pose[1] + s * ahead + c * left, yaw + turn], 6.0, 25.0)
    crops = views.map_crops(OccupancyGrid(0.18), hypotheses, pose)
    for scale, metres in enumerate(views.SCALES):
        goal, cosine, sine = (crops[channel(views, name, scale)].astype(float)
                              for name in views.GOAL_LAYERS)
        row, column = np.unravel_index(goal.argmax(), goal.shape)
        middle = (views.PIXELS - 1) / 2
        assert abs((middle - row) * metres - ahead) < 0.51 * metres
        assert abs((middle - column) * metres - left) < 0.51 * metres
        size = goal[row, column] / 255
        assert 0.5 * views.strength(own) < size <= views.strength(own) == 0.75
        assert (cosine[row, column] - 128) / 127 == pytest.approx(size * math.cos(turn), abs=0.02)
        assert (sine[row, column] - 128) / 127 == pytest.approx(size * math.sin(turn), abs=0.02)
    own.pose[:2] = pose[:2] + 50 * np.array([c, s])  # beyond the crop: at its edge, ahead
    goal = views.map_crops(OccupancyGrid(0.18), hypotheses, pose)[channel(views, 'goal', 1)]
    assert np.unravel_index(goal.argmax(), goal.shape)[0] == 0


@pytest.fixture(scope='module')
def drive(views):
    """What a planner and a driver with and without plans saw on one drive."""
    network = small_search()
    env = make(size=48, odometry='drift', stop='declared', privileged=('explorer_action',))
    planner = BatchedPolicy(network, env.num_envs, decoding='greedy')
    drivers = [views.MapDriver(network, env.num_envs, plans) for plans in (True, False)]
    observation, info = env.reset(seed=2)
    rows = []
    for _ in range(25):
        action = planner.act(observation, env.goals, info['reset'])
        rows.append((action, *(own.look(observation, env.goals, info['reset'])
                               for own in drivers), info['explorer_action']))
        observation, _, _, _, info = env.step(action)
    yield rows, planner, drivers
    env.close()


def test_the_planner_behind_the_views_is_the_planner_and_the_map_the_same(views, drive):
    rows, planner, (advised, alone) = drive
    for action, told, silent, _ in rows:
        assert np.array_equal(told.advice, action)
        assert (silent.advice == -1).all()
        assert np.array_equal(told.arrival, silent.arrival)
        assert silent.numbers.shape == (len(action), views.NUMBERS)
        assert np.isfinite(silent.numbers).all()
    for one, other, third in zip(planner.search.searchers, advised.searchers, alone.searchers,
                                 strict=True):
        assert np.array_equal(one.grid.log_odds, other.grid.log_odds)
        # Given up floor is the planner's alone; what was seen and felt is everybody's.
        for name in ('log_odds', 'seen', 'stood', 'contacts'):
            assert np.array_equal(getattr(one.grid, name), getattr(third.grid, name)), name


@pytest.mark.parametrize('advised', [False, True])
def test_a_step_of_imitation_lowers_the_loss(learning, drive, advised):
    examples = learning.Examples(64)
    for _, told, _, teacher in drive[0]:
        examples.add(told, teacher, np.arange(len(teacher)))
    assert examples.count == 100
    torch.manual_seed(0)
    network = learning.MapNetwork(advised)
    batch = examples.draw(64, np.random.default_rng(0))
    logits, value = network(*batch[:3])
    assert logits.shape == (64, 4) and value.shape == (64,)
    if advised:
        assert torch.equal(logits.argmax(1), batch[2])  # it begins as the planner
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    losses = [learning.imitate(network, optimiser, *batch)[0] for _ in range(30)]
    assert losses[1] < losses[0] and losses[-1] < 0.8 * losses[0]


def test_reinforcement_prefers_what_was_paid(learning, drive):
    """Rows alike but for the action; one action is paid. A declared stop teaches no move."""
    _, told, _, _ = drive[0][-1]
    torch.manual_seed(0)
    network = learning.MapNetwork(False)
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    steps, robots, generator = 16, len(told.advice), torch.Generator().manual_seed(0)
    inputs = [part.expand(steps, *part.shape) for part in learning.tensors(told)]
    action = torch.randint(4, (steps, robots), generator=generator)
    own = torch.ones(steps, robots, dtype=torch.bool)
    own[::4] = False

    def chance(which):
        with torch.no_grad():
            return network(*learning.tensors(told))[0].softmax(1)[:, which].mean().item()
    before, ends = chance(2), torch.ones(steps, robots, dtype=torch.bool)
    reward = torch.where(own, (action == 2).float(), (action == 1).float())
    rollout = learning.Rollout(
        *inputs, action, torch.full(action.shape, math.log(0.25)), torch.zeros(steps + 1, robots),
        reward, ends, ~ends, ends, own)
    frozen = network.actor.weight.clone()
    learning.reinforce(network, optimiser, rollout, learning.Ppo(), True, generator)
    assert torch.equal(network.actor.weight, frozen) and chance(2) == before
    other = chance(1)
    figures = learning.reinforce(network, optimiser, rollout, learning.Ppo(), False, generator)
    assert chance(2) > before + 0.01 and chance(1) < other
    assert all(math.isfinite(value) for value in figures.values())


@pytest.mark.slow
def test_what_rests_does_not_change_what_the_others_do(learning, drive):
    """Episodes as `PolicyActor` drives them; an environment with enough of them is left alone."""
    threshold = float(np.quantile([told.arrival for _, told, _, _ in drive[0]], 0.8))
    network = small_search()
    env = make(size=48, odometry='drift', stop='declared', max_decisions=8)
    before = run_episodes(env, PolicyActor(env, network, 'greedy', 0, threshold), 8, seed=3,
                          robot=env.robot)
    actor = learning.MapActor(env, network, None, 'greedy', 0, threshold, 2)
    assert run_episodes(env, actor, 8, seed=3, robot=env.robot) == before
    assert len({episode.decisions for episode in before}) > 1  # some wait for others
    env.close()


@pytest.mark.slow
def test_one_command_trains_measures_and_goes_on_where_it_was(learning, monkeypatch, capsys,
                                                              tmp_path):
    monkeypatch.syspath_prepend(ROOT / 'bench')
    command = importlib.import_module('map_network')
    folder, out = write_small_search(tmp_path / 'model'), tmp_path / 'out'
    words = ('map_network.py', folder, '--minutes', 0.005, '--reinforce-minutes', 0.01,
             '--robots', 2, '--train-houses', 1, '--houses', 1, '--episodes', 1,
             '--max-decisions', 3, '--out', out)

    def call(*more):
        monkeypatch.setattr(sys, 'argv', [*map(str, words), *more])
        code = command.main()
        return code, capsys.readouterr().out
    code, first = call()
    rows = [line for line in first.splitlines() if line.startswith('|')]
    assert code == 0 and len(rows) == 2 + 5
    both = json.loads((out / 'both_reinforced.sample.json').read_text())
    assert both['frames'] > 0 and both['figures']['episodes'] == 1
    curves = (out / 'curves.csv').read_text().splitlines()
    assert {line.split(',')[0] for line in curves[1:]} == {
        'network_imitated', 'network_reinforced', 'both_imitated', 'both_reinforced'}
    kept = {path.name: path.read_bytes() for path in out.iterdir()}
    monkeypatch.setattr(command, 'make_env', lambda *_, **__: pytest.fail('trained again'))
    monkeypatch.setattr(command, 'run_episodes', lambda *_, **__: pytest.fail('measured again'))
    code, again = call()
    assert code == 0 and [line for line in again.splitlines() if line.startswith('|')] == rows
    assert kept == {path.name: path.read_bytes() for path in out.iterdir()}
