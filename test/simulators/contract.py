"""What every simulator keeps, whatever it can do; `conformance.py` has what only some can.

A test asks `Capabilities` alone: what a simulator says it cannot do is refused, or is zeros.
"""

import abc
import dataclasses
import gc

import numpy as np
import pytest

from vn_nav.co_visibility import co_visible, lift
from vn_nav.errors import UserError
from vn_nav.labels import label_dtype
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig, check_simulator
from vn_sim_bridge.simulator import Capabilities, Simulator

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
SIZE = 24
GROWTH_MB = 24  # of 8,000 steps; one leaked picture a step would be 55


def resident_mb():
    with open('/proc/self/status') as status:
        line = next(line for line in status if line.startswith('VmRSS'))
    return int(line.split()[1]) / 1024


class Contract(abc.ABC):
    """The contract of `vn_sim_bridge.simulator.Simulator`, as tests."""

    robot = ROBOT
    depth_slack = 0.9  # share of a picture's points that the same pose sees again

    growth_robots = 4  # that drive 10,000 steps
    state_slack = 0.0  # of figures, where an engine has its own numbers for a pose

    @abc.abstractmethod
    def make(self, num_envs, size=SIZE):
        """A new simulator of `num_envs` robots with pictures of `size` pixels."""

    def config(self, num_envs, **options):
        """Of an environment about it."""
        return EnvConfig(num_envs=num_envs, size=SIZE, actions=self.actions, **options)

    @property
    def actions(self):
        """Names of the robot's."""
        return self.robot.action_names

    def env(self, num_envs=3, **options):
        return NavigationEnv(self.config(num_envs, **options), self.robot,
                             simulator=self.make(num_envs))

    @pytest.fixture
    def shared(self):
        """A simulator with its robots at starts, for tests that look alone or put them back."""
        simulator = self.make(4)
        yield simulator
        simulator.close()

    def put(self, simulator, turned=0.0):
        """Put every robot at a start of its place, or where the simulator does; poses [N,4]."""
        everyone = np.arange(simulator.num_envs)
        if not simulator.capabilities.teleport:
            simulator.spawn(everyone, key(7, Stream.START_CELL, everyone, 0))
            return simulator.poses.copy()
        poses = np.zeros((simulator.num_envs, 4))
        for n in range(simulator.num_envs):
            cells, headings = simulator.places[simulator.place_index[n]].starts()
            k = (n * 7919 + 13) % len(cells)
            poses[n, :2] = cells[k]
            poses[n, 2] = 0.4 * n if headings is None else headings[k]
        poses[:, 2] += turned
        simulator.place(everyone, poses)
        return simulator.poses.copy()

    def step(self, simulator, kind):
        """Do the actions [N] of all robots."""
        if simulator.capabilities.own_actions:
            return simulator.act(kind, np.arange(simulator.num_envs))
        actions = [self.robot.actions[k] for k in kind]
        return simulator.move(np.array([[a.dx, a.dy, a.dyaw, a.dpitch] for a in actions]))

    def drive(self, simulator, seed=0, steps=12):
        """Random actions; all that came of them. Episodes that end begin again."""
        rng, found = np.random.default_rng(seed), []
        self.put(simulator)
        for step in range(steps):
            motion = self.step(simulator, rng.integers(0, len(self.actions), simulator.num_envs))
            frames = simulator.observe(keys=key(seed, Stream.SENSOR, np.arange(
                simulator.num_envs), 0, step))
            found += [*(part.copy() for part in motion if part is not None),
                      simulator.poses.copy(), *(part.copy() for part in frames)]
            over = simulator.broken_off()
            over = np.nonzero(over if motion.ended is None else over | motion.ended)[0]
            if len(over) and simulator.capabilities.rewards:
                simulator.spawn(over, key(seed, Stream.START_CELL, over, 0, step))
        return found

    def test_it_has_all_of_the_protocol(self, shared):
        assert isinstance(shared, Simulator)
        assert isinstance(shared.version, str) and shared.version
        # A checkpoint is judged by the class before a simulator is opened.
        assert shared.version == type(shared).version
        assert isinstance(shared.capabilities, Capabilities)
        assert all(type(value) is bool for value in dataclasses.astuple(shared.capabilities))
        assert not (shared.capabilities.labels and len(shared.label_names) == 0)
        for split, scenes in getattr(shared, 'splits', {}).items():
            assert split and len(scenes) and str(parse_scene(scenes[0])) == scenes[0]

    def test_spaces(self, shared):
        n = shared.num_envs
        poses = self.put(shared)
        assert poses.shape == (n, 4) and poses.dtype == np.float64
        assert shared.place_index.shape == shared.seen_from.shape[:1] == (n,)
        assert shared.objects.scene.shape == shared.object_models().shape
        labels = label_dtype(len(shared.label_names))
        frames = shared.observe()
        for part, shape, dtype in zip(frames, ((n, 3, SIZE, SIZE), *[(n, SIZE, SIZE)] * 3),
                                      (np.uint8, np.float32, labels, np.uint16), strict=True):
            assert part.shape == shape and part.dtype == dtype
        some = shared.observe(np.array([2, 0]))
        assert some.rgb.shape == (2, 3, SIZE, SIZE)
        cameras, fov = shared.cameras()
        assert cameras.shape == (n, 5) and np.shape(fov) == (n,) and np.isfinite(cameras).all()
        env = self.env(2)
        observation, info = env.reset(seed=1)
        assert env.observation_space.contains(observation)
        assert np.isfinite(info['distance']).all()
        env.close()

    def test_places_have_goals_and_starts(self, shared):
        for place in shared.places:
            assert str(parse_scene(place.name)) == place.name
            cells, headings = place.starts()
            assert cells.ndim == 2 and cells.shape[1] == 2 and np.isfinite(cells).all()
            assert headings is None or headings.shape == (len(cells),)
            assert len(place.goals) >= 1
            goal = place.goals[0]
            distance = place.distance_to(goal)
            assert (distance is not None) == shared.capabilities.geodesic
            if distance is not None:
                far = distance.at(cells)
                straight = np.hypot(*(cells - goal.pose[:2]).T)
                there = np.isfinite(far)
                assert there.any() and distance.at(np.array([goal.pose]))[0] <= 0.15
                assert (far[there] >= straight[there] - 0.15).all()
                assert far[there].max() <= distance.maximum + 0.15
            plan = place.plan()
            assert plan is None or {'bounds', 'goals', 'walls', 'outside', 'obstacles',
                                    'rooms_list', 'area'} <= plan.keys()

    def test_the_same_is_the_same_again(self):
        one, two = self.make(3), self.make(3)
        first, second = self.drive(one), self.drive(two)
        assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
        assert all(np.array_equal(a, b)
                   for a, b in zip(self.drive(one), first, strict=True))  # and from the start
        one.close()
        two.close()

    def test_a_view_moves_nobody(self, shared):
        poses = self.put(shared)
        seen = shared.view(shared.place_index, poses)
        assert seen.rgb.shape == (4, 3, SIZE, SIZE)
        assert np.array_equal(shared.poses, poses)
        assert np.array_equal(seen.rgb, shared.view(shared.place_index, poses).rgb)

    def test_appearance_is_a_function_of_the_counter(self, shared):
        self.put(shared)
        everyone = np.arange(4)
        shared.apply_appearance(everyone, 5, Stream.APPEARANCE, everyone, 3)
        first = shared.observe().rgb.copy()
        shared.apply_appearance(everyone, 6, Stream.APPEARANCE, everyone, 4)
        shared.apply_appearance(everyone, 5, Stream.APPEARANCE, everyone, 3)
        assert np.array_equal(shared.observe().rgb, first)

    def test_depth_is_of_the_geometry(self, shared):
        poses = self.put(shared)
        depth = shared.observe().depth.copy()
        if not shared.capabilities.depth:
            assert not depth.any()
            return
        assert (depth >= 0).all() and (depth > 0).mean() > 0.5
        points = lift(depth, *shared.cameras())
        again = co_visible(points, shared.observe().depth, *shared.cameras())
        assert (again >= self.depth_slack).all()
        # A little ahead the same points are nearer, where the map says they are.
        shared.move(np.array([[0.2, 0.0, 0.0, 0.0]] * 4))
        ahead = shared.observe().depth
        moved = np.hypot(*(shared.poses[:, :2] - poses[:, :2]).T) > 0.15
        share = co_visible(points, ahead, *shared.cameras())
        assert not moved.any() or np.median(share[moved]) > 0.4

    def test_labels_have_names(self, shared):
        self.put(shared)
        labels = shared.observe().labels
        if shared.capabilities.labels:
            assert labels.max() < len(shared.label_names) and len(np.unique(labels)) > 1
        else:
            assert not labels.any()

    def test_what_it_cannot_do_is_refused(self):
        told = {'depth': ('depth',), 'labels': ('segmentation',), 'walls': ('explorer_action',)}
        simulator = self.make(2)
        for name, privileged in told.items():
            if not getattr(simulator.capabilities, name):
                with pytest.raises(UserError):
                    NavigationEnv(self.config(2, privileged=privileged), self.robot,
                                  simulator=simulator)
        if not simulator.capabilities.tilt:
            with pytest.raises(UserError, match='camera|actions of its own'):
                NavigationEnv(dataclasses.replace(self.config(2), actions=(
                    'forward', 'rotate_left', 'look_up')), simulator=simulator)
        for name, task in (('rooms', 'room'), ('placeable_objects', 'object')):
            if not getattr(simulator.capabilities, name):
                with pytest.raises(UserError, match=task):
                    NavigationEnv(self.config(2, task=task), self.robot, simulator=simulator)
        if simulator.capabilities.rewards:  # it ends its episodes itself
            with pytest.raises(UserError, match='ends its episodes'):
                NavigationEnv(self.config(2, stop='declared'), self.robot, simulator=simulator)
        if not simulator.capabilities.geodesic:
            with pytest.raises(UserError, match='ways'):
                NavigationEnv(self.config(2, progress_reward=1.0), self.robot,
                              simulator=simulator)
        if not simulator.capabilities.other_goals:
            for config in (self.config(2, goal_seed=1), self.config(2, goals_per_room=2)):
                with pytest.raises(UserError, match='makes goals'):
                    check_simulator(simulator, config, self.robot)
        simulator.close()

    def test_episodes_end_and_begin(self):
        env = self.env(3, max_decisions=4)
        env.reset(seed=2)
        ended = np.zeros(3, bool)
        for step in range(12):
            action = (step % 2 + 2) % len(self.actions)
            _, _, terminated, truncated, info = env.step(np.full(3, action))
            assert not (terminated & truncated).any()
            assert (info['decisions'][truncated] == 4).all()
            assert info['reset'][ended].all() and not info['reset'][~ended].any()
            ended = terminated | truncated
        env.close()

    def test_a_state_goes_on_as_before(self):
        one, two = self.env(3, max_decisions=9), self.env(3, max_decisions=9)
        assert one.restorable == one.simulator.capabilities.teleport
        if not one.restorable:  # then a training begins new episodes
            with pytest.raises(UserError, match='put anywhere'):
                one.get_state()
            one.close()
            two.close()
            return
        rng = np.random.default_rng(4)
        one.reset(seed=3)
        for _ in range(5):
            one.step(rng.integers(0, len(self.actions), 3))
        two.reset(seed=8)
        two.set_state(one.get_state())
        for _ in range(14):
            actions = rng.integers(0, len(self.actions), 3)
            (a, reward, *ends, told), (b, other, *also, too) = one.step(actions), two.step(actions)
            assert all(np.array_equal(a[name], b[name]) for name in a)
            assert np.array_equal(reward, other) and np.array_equal(ends, also)
            assert all(np.allclose(told[name], too[name], rtol=0, atol=self.state_slack)
                       for name in told)
        one.close()
        two.close()

    def test_it_closes_once_and_for_all(self):
        simulator, calls = self.make(2), []
        close = simulator.close
        simulator.close = lambda: (calls.append(1), close())
        env = NavigationEnv(self.config(2), self.robot, simulator=simulator)
        env.close()
        env.close()
        assert calls == [1]
        close()  # a second time it does nothing

    @pytest.mark.slow
    @pytest.mark.timeout(600)
    def test_ten_thousand_steps_do_not_grow(self):
        robots = self.growth_robots
        env = self.env(robots, max_decisions=50)
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        held = []
        for step in range(1, 10_001):
            env.step(rng.integers(0, len(self.actions), robots))
            if step % 2_000 == 0:
                gc.collect()
                held.append(resident_mb())
        # A leak grows in every quarter. What the allocator takes once, for what other tests of
        # this process left as well, is in one of them.
        assert 4 * min(np.diff(held)) < GROWTH_MB, held
        env.close()
