"""A move without progress is not tried again from there, and turning has an end."""

import copy
import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.learning.learner import Learner, select
from vn_nav.learning.presets import preset
from vn_nav.learning.rollout import Collector
from vn_nav.policy.action_filter import BLOCKED_LOGITS as AGAIN
from vn_nav.policy.action_filter import FACING_LOGITS as BACK
from vn_nav.policy.action_filter import RESTLESS_RAD as RESTLESS
from vn_nav.policy.action_filter import SEEN_RAD as SEEN
from vn_nav.policy.action_filter import BlockedActionFilter, FilterCounts
from vn_nav.policy.batched import BatchedPolicy, choose, choose_filtered
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime

TURN = math.radians(30)
MOVES = ((0.5, 0, 0), (-0.2, 0, 0), (0, 0, TURN), (0, 0, -TURN))
ACTIONS = ('forward', 'backward', 'rotate_left', 'rotate_right')
FORWARD, BACKWARD, LEFT, RIGHT = range(4)
NO, YES = np.array([False]), np.array([True])


class Walker:
    """One robot whose pictures are random and the same in the same place; with noise."""

    def __init__(self, moves=MOVES, seed=0):
        self.random = np.random.default_rng(seed)
        self.filter = BlockedActionFilter(moves, 1)
        self.scene = self._draw()

    def _draw(self):
        coarse = self.random.integers(0, 256, (3, 8, 8))
        return coarse.repeat(8, axis=1).repeat(8, axis=2)

    def sees(self, last, starts=NO, new=True):
        if new:
            self.scene = self._draw()
        noisy = np.clip(self.scene + self.random.normal(0, 8, self.scene.shape), 0, 255)
        return self.filter.offsets(noisy.astype(np.uint8)[None], np.array([last]),
                                   starts)[0].tolist()


@pytest.fixture
def stuck():
    """Stands at a wall, and has tried to drive on."""
    walker = Walker()
    assert walker.sees(-1, YES) == [0, 0, 0, 0]
    assert walker.sees(FORWARD, new=False) == [-AGAIN, 0, 0, 0]
    return walker


def test_what_led_nowhere_is_not_done_again_nor_faced_again(stuck):
    assert stuck.sees(LEFT) == [0, 0, 0, -BACK]  # the way back to face the wall
    assert stuck.sees(FORWARD, new=False) == [-AGAIN, 0, 0, -BACK]  # a corner
    assert stuck.sees(LEFT) == [0, 0, 0, -BACK]
    assert stuck.sees(RIGHT) == [-AGAIN, 0, 0, -BACK]
    assert stuck.sees(BACKWARD, new=False) == [-AGAIN, -AGAIN, 0, -BACK]


def test_all_around_comes_back_to_the_wall(stuck):
    for _ in range(11):
        said = stuck.sees(LEFT)
    assert said[1:] == [0, -BACK, 0]
    assert stuck.sees(LEFT) == pytest.approx([-AGAIN + (2 * math.pi - SEEN) / RESTLESS, 0, 0, 0])


def test_who_turns_to_and_fro_drives_on_at_last():
    walker = Walker()
    walker.sees(-1, YES)
    said = [walker.sees((LEFT, RIGHT)[k % 2])[FORWARD] for k in range(12)]
    assert said == pytest.approx([max(k * TURN - SEEN, 0) / RESTLESS for k in range(1, 13)])
    assert said[6] == 0 < said[8] < said[-1]
    assert walker.sees(FORWARD) == [0, 0, 0, 0]


def test_who_has_moved_on_is_free(stuck):
    stuck.sees(LEFT)
    assert stuck.sees(FORWARD) == [0, 0, 0, 0]
    assert stuck.sees(RIGHT) == [0, 0, 0, 0]


@pytest.mark.parametrize('last, starts', [(-1, NO), (FORWARD, YES)], ids=['moved', 'begins'])
def test_who_was_moved_or_begins_knows_nothing(stuck, last, starts):
    assert stuck.sees(last, starts, new=False) == [0, 0, 0, 0]


def test_a_turn_that_shows_the_same_is_no_contact():
    walker = Walker()
    walker.sees(-1, YES)
    assert walker.sees(LEFT, new=False) == [0, 0, 0, 0]


def test_robots_have_memories_of_their_own():
    own = BlockedActionFilter(MOVES, 3)
    pictures = np.random.default_rng(0).integers(0, 256, (3, 3, 64, 64), np.uint8)
    pictures[:, :, :32] //= 4  # so that another picture differs, averaged, too
    own.offsets(pictures, np.array([-1, -1, -1]), np.ones(3, bool))
    pictures[1] = 255 - pictures[1]
    said = own.offsets(pictures, np.array([FORWARD, FORWARD, BACKWARD]), np.zeros(3, bool))
    assert said.tolist() == [[-AGAIN, 0, 0, 0], [0, 0, 0, 0], [0, -AGAIN, 0, 0]]


def walk(steps, robots=4, size=64, seed=0):
    """Pictures, last actions and starts of robots that often touch something."""
    random = np.random.default_rng(seed)

    def draw():
        blocks = random.integers(0, 256, (robots, 3, 8, 8)).repeat(size // 8 + 1, 2)
        return blocks.repeat(size // 8 + 1, 3)[:, :, :size, :size]

    scene = draw()
    for t in range(steps):
        moved = random.random(robots) < 0.3
        scene[moved] = draw()[moved]
        pictures = np.clip(scene + random.normal(0, 8, scene.shape), 0, 255).astype(np.uint8)
        yield pictures, random.integers(-1, 4, robots), (random.random(robots) < 0.02) | (t == 0)


@pytest.mark.parametrize('size', [64, 84])
def test_numpy_and_torch_say_the_same(size):
    arrays, tensors = BlockedActionFilter(MOVES, 4), BlockedActionFilter(MOVES, 4, 'cpu')
    acted = 0
    for rows in walk(60, size=size):
        said = arrays.offsets(*rows)
        other = tensors.offsets(*map(torch.from_numpy, rows))
        assert said.dtype == np.float32 and np.array_equal(said, other.numpy())
        acted += np.count_nonzero(said)
    assert acted > 20


def test_it_goes_on_where_its_state_was_taken():
    one, other = BlockedActionFilter(MOVES, 4), BlockedActionFilter(MOVES, 4)
    rows = list(walk(40))
    for row in rows[:20]:
        one.offsets(*row)
    other.load_state_dict({name: part.copy() for name, part in one.state_dict().items()})
    assert [one.offsets(*row).tolist() for row in rows[20:]] == [
        other.offsets(*row).tolist() for row in rows[20:]]


def test_numpy_alone_is_enough():
    code = ('import sys, numpy as np; sys.modules["torch"] = None\n'
            'from vn_nav.policy.action_filter import BlockedActionFilter as Filter\n'
            f'own = Filter({MOVES}, 1)\n'
            'picture = np.zeros((1, 3, 64, 64), np.uint8)\n'
            'own.offsets(picture, np.array([-1]), np.array([True]))\n'
            'print(own.offsets(picture, np.array([0]), np.array([False]))[0, 0])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=False)
    assert done.stdout == f'{-AGAIN}\n', done.stderr


# The filter in use: a policy, its rollouts, its checkpoint.


def network_of(**changes):
    """A policy that knows its moves and clearly wants to drive forward, but at times turns."""
    torch.manual_seed(0)
    network = Policy(NetworkConfig(**{
        'actions': ACTIONS, 'moves': MOVES, 'size': 64, 'hidden': 16, 'heads': ('goal_pose',),
        'pose_to_memory': True, **changes})).eval()
    network.actor.bias.data = torch.tensor([2.0, -1.0, 1.0, 0.0])
    return network


class Wall:
    """A vector environment in which no move leads anywhere; episodes of ten decisions."""

    num_envs, action_names, house_index = 3, ACTIONS, np.zeros(3, int)
    goals = np.zeros((1, 3, 64, 64), np.uint8)

    def __init__(self):
        self.count = 0

    def _see(self, last, reset):
        picture = np.full((3, 3, 64, 64), 90, np.uint8)
        return ({'image': picture, 'goal_index': np.zeros(3, int), 'last_action': last,
                 'last_reward': np.zeros(3, np.float32)},
                {'reset': reset, 'success': np.zeros(3, bool), 'collided': np.zeros(3, bool)})

    def reset(self, *, seed):
        return self._see(np.full(3, -1), np.ones(3, bool))

    def step(self, actions):
        self.count += 1
        over, reset = np.full(3, self.count % 11 == 10), np.full(3, self.count % 11 == 0)
        seen, info = self._see(np.where(reset, -1, actions), reset)
        return seen, np.zeros(3, np.float32), np.zeros(3, bool), over, info


def collector_of(network, env):
    collector = Collector(env, network, torch.Generator().manual_seed(0))
    collector.begin(0)
    return collector


def test_rollouts_are_driven_behind_the_filter_and_learned_from_so():
    network = network_of()
    rollout, _ = collector_of(network, Wall()).collect(30)
    own = BlockedActionFilter(MOVES, 3, 'cpu')
    seen = rollout.observation
    expected = torch.stack([own.offsets(seen.image[t], seen.last_action[t], rollout.starts[t])
                            for t in range(30)])
    assert torch.equal(rollout.filter_offsets, expected) and (expected == -AGAIN).sum() > 10
    # At the first step the ratio of new to old probabilities is 1, as it must be.
    losses = Learner(network, preset('anywhere', imitation=0.0, teacher_share=0.0, goal_pose=0.5,
                                     arrival=0.0, distance=0.0, pair_minutes=0.0),
                     torch.Generator())
    losses._weights = {'goal_pose': 0.0}
    batch = dataclasses.replace(rollout, privileged={
        'goal_pose': torch.zeros(31, 3, 4), 'overlap': torch.zeros(31, 3)})
    zeros = torch.zeros(30, 3)
    _, figures = losses._loss(batch, zeros, zeros, 0.0)
    assert figures['kl'] == pytest.approx(0.0, abs=1e-6) and figures['clipped'] == 0
    blind = dataclasses.replace(batch, filter_offsets=None)
    assert losses._loss(blind, zeros, zeros, 0.0)[1]['kl'] > 0.1
    assert torch.equal(select(batch, torch.tensor([2, 0])).filter_offsets,
                       rollout.filter_offsets[:, [2, 0]])


def test_a_collector_goes_on_with_what_was_blocked():
    network, env = network_of(), Wall()
    collector = collector_of(network, env)
    collector.collect(5)
    again = Collector(copy.deepcopy(env), network, torch.Generator())
    again.generator.set_state(collector.generator.get_state())
    again.load_state_dict(collector.state_dict())
    one, other = (own.collect(12)[0] for own in (collector, again))
    assert torch.equal(one.action, other.action)
    assert torch.equal(one.filter_offsets, other.filter_offsets) and one.filter_offsets[0].any()


@pytest.mark.parametrize('name', ['none', 'blocked_actions'])
def test_the_checkpoint_says_whether_it_is_on(name, tmp_path):
    save_checkpoint(tmp_path / 'model', network_of(action_filter=name), {
        'world_version': '2', 'camera_fov_deg': 90.0, 'camera_height': 1.0, 'decoding': 'greedy'})
    config = json.loads((tmp_path / 'model' / 'config.json').read_text())
    assert config['network']['action_filter'] == name
    card = (tmp_path / 'model' / 'README.md').read_text()
    assert ('| Action filter | ' in card) == (name != 'none')
    network = load_checkpoint(tmp_path / 'model').network
    env, policy = Wall(), BatchedPolicy(network, 3, 'greedy')
    runtime = PolicyRuntime(tmp_path / 'model')
    runtime.set_goal(env.goals[0])
    (seen, info), rows, alone = env.reset(seed=0), [], []
    for _ in range(6):
        rows.append(policy.act(seen, env.goals, info['reset']))
        alone.append(runtime.act(seen['image'][0]))
        seen, _, _, _, info = env.step(rows[-1])
    assert [row[0] for row in rows] == alone and runtime.action_filter == name
    if name == 'none':
        assert set(alone) == {FORWARD} and policy.filtered is None
        assert runtime.filter_counts == FilterCounts()
    else:
        assert alone[:3] == [FORWARD, LEFT, FORWARD] and alone[3] != FORWARD
        assert [part.tolist() for part in policy.filtered] == [[True] * 3] * 2
        assert runtime.filter_counts.decisions == 6
        assert 0 < runtime.filter_counts.changed <= runtime.filter_counts.acted < 6


def test_changed_means_by_the_same_random_numbers():
    """With and without an offset the same draw: it changes nothing where it need not."""
    torch.manual_seed(0)
    logits, offsets = torch.randn(500, 4), np.zeros((500, 4), np.float32)
    offsets[::2, 1] = -AGAIN
    one, other = (torch.Generator().manual_seed(5) for _ in range(2))
    actions, filtered, acted, changed = choose_filtered(logits, offsets, 'sample', one)
    plain = choose(logits, 'sample', other)
    assert torch.equal(filtered, logits + torch.from_numpy(offsets))
    assert acted.tolist() == [True, False] * 250
    assert changed.tolist() == (actions != plain).tolist()
    assert changed.tolist() == [k % 2 == 0 and plain[k] == 1 for k in range(500)]
    assert torch.equal(one.get_state(), other.get_state())  # it draws none of its own


def test_a_filter_needs_moves_and_a_known_name():
    assert network_of(moves=()).config.filter_name == 'none'
    for wrong, rule in (({'moves': (), 'action_filter': 'blocked_actions'}, 'needs the moves'),
                        ({'action_filter': 'all'}, 'one of none, blocked_actions')):
        with pytest.raises(UserError, match=rule):
            network_of(**wrong)


def test_a_training_may_leave_it_out():
    for on, name in ((True, 'blocked_actions'), (False, 'none')):
        config = preset('anywhere', action_filter=on)
        assert config.network(ACTIONS, 64, MOVES).filter_name == name
    assert preset('fast').network(ACTIONS, 64).filter_name == 'none'
