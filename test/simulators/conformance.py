"""What simulators keep beside `contract.py`: inherit one of these, write `make`, and it runs.

`Conformance` is for robots that are put anywhere and move by metres, `OwnConformance` for worlds
with starts and actions of their own.
"""

import numpy as np
import pytest
from contract import GROWTH_MB, ROBOT, SIZE, Contract, resident_mb

from vn_nav.errors import UserError
from vn_sim_bridge.counter_random import Stream, key

__all__ = ['GROWTH_MB', 'ROBOT', 'SIZE', 'Conformance', 'OwnConformance', 'resident_mb']


class Conformance(Contract):
    """Of a simulator whose robots are put anywhere (`teleport`) and drive."""

    contact_slack = 0.02  # m that a robot may still creep towards what it touches

    def test_robots_are_where_they_are_put(self, shared):
        poses = self.put(shared)
        shared.place(np.array([1]), poses[[2]])
        assert np.array_equal(shared.poses[[0, 2, 3]], poses[[0, 2, 3]])
        assert np.array_equal(shared.poses[1], poses[2])
        self.put(shared)
        motion = shared.move(np.zeros((4, 4)))
        assert not motion.collided.any() and not motion.delta.any()
        assert np.allclose(shared.poses, poses)

    def test_moves_are_what_they_say(self, shared):
        for delta in ([0.0, 0.0, 0.5, 0.0], [0.1, 0.0, 0.0, 0.0], [-0.1, 0.0, 0.0, 0.0]):
            before = self.put(shared)
            env_ids = np.array([0, 3])
            motion = shared.move(np.array([delta, delta]), env_ids)
            assert motion.delta.shape == (2, 4) and motion.collided.shape == (2,)
            after = shared.poses
            assert np.array_equal(after[[1, 2]], before[[1, 2]])  # nobody else has moved
            heading = before[env_ids, 2] + motion.delta[:, 2] / 2
            c, s = np.cos(heading), np.sin(heading)
            dx, dy = motion.delta[:, 0], motion.delta[:, 1]
            want = before[env_ids, :2] + np.stack([c * dx - s * dy, s * dx + c * dy], 1)
            assert np.allclose(after[env_ids, :2], want, atol=1e-6)
            turned = after[env_ids, 2] - before[env_ids, 2] - motion.delta[:, 2]
            assert np.allclose(np.sin(turned / 2), 0, atol=1e-6)
            whole = np.abs(motion.delta - delta).max(axis=1) < 1e-6
            assert (whole | motion.collided).all()

    def test_a_move_ends_at_the_first_contact(self, shared):
        self.put(shared)
        for _ in range(200):
            before = shared.poses.copy()
            motion = shared.move(np.array([[0.5, 0.0, 0.0, 0.0]] * 4))
            gone = np.hypot(*(shared.poses[:, :2] - before[:, :2]).T)
            assert np.allclose(gone, np.hypot(*motion.delta[:, :2].T), atol=1e-6)
            assert (gone <= 0.5 + 1e-9).all() and (motion.collided == (gone < 0.5 - 1e-9)).all()
            if motion.collided.all():
                break
        assert motion.collided.all(), 'a place has an end'
        at = shared.poses.copy()
        again = shared.move(np.array([[0.5, 0.0, 0.0, 0.0]] * 4))
        assert again.collided.all()
        assert np.hypot(*again.delta[:, :2].T).max() <= self.contact_slack
        shared.place(np.arange(4), at)

    def test_reach_says_where_a_move_would_end(self, shared):
        poses = self.put(shared)
        headings = np.linspace(-3, 3, 5) if shared.places[0].starts()[1] is None else (
            poses[0, 2] + np.array([0.0, 0.05]))
        ends = shared.reach(0, headings, 0.5)
        assert np.array_equal(shared.poses, poses)  # nobody has moved
        for heading, end in zip(headings, ends, strict=True):
            shared.place(np.array([0]), np.array([[*poses[0, :2], heading, 0.0]]))
            shared.move(np.array([[0.5, 0.0, 0.0, 0.0]]), np.array([0]))
            assert np.allclose(shared.poses[0, :2], end, atol=1e-3)


class OwnConformance(Contract):
    """Of a simulator that begins episodes itself and has actions that are no motions."""

    def test_it_is_such_a_simulator(self, shared):
        can = shared.capabilities
        assert can.own_actions and can.rewards and not can.teleport and not can.continuous

    def test_a_number_begins_the_same_episode_and_no_other(self, shared):
        numbers = key(3, Stream.START_CELL, np.arange(4), 0)
        shared.spawn(np.arange(4), numbers)
        first = shared.observe().rgb.copy()
        self.step(shared, np.arange(4) % len(self.actions))
        after = shared.observe().rgb.copy()
        shared.spawn(np.array([2]), numbers[[2]])
        assert np.array_equal(shared.observe().rgb[2], first[2])
        assert np.array_equal(shared.observe().rgb[[0, 1, 3]], after[[0, 1, 3]])
        shared.spawn(np.array([2, 0]), numbers[[2, 0]])
        assert np.array_equal(shared.observe().rgb[[2, 0]], first[[2, 0]])

    def test_an_action_is_of_some_robots_and_says_what_came_of_it(self, shared):
        self.put(shared)
        before = shared.observe().rgb.copy()
        motion = shared.act(np.array([len(self.actions) - 1, 0]), np.array([3, 1]))
        assert motion.delta.shape == (2, 4) and not motion.delta.any()
        assert motion.collided.shape == (2,) and motion.collided.dtype == bool
        assert motion.reward.shape == (2,) and motion.reward.dtype == np.float32
        assert np.isfinite(motion.reward).all()
        assert motion.ended.shape == (2,) and motion.ended.dtype == bool
        after = shared.observe().rgb
        assert np.array_equal(after[[0, 2]], before[[0, 2]])
        assert np.array_equal(shared.observe(np.array([3, 1])).rgb, after[[3, 1]])
        assert not shared.broken_off()[[0, 2]].any()

    def test_it_puts_nobody_anywhere_and_moves_nobody_by_metres(self, shared):
        poses = self.put(shared)
        with pytest.raises(UserError):
            shared.place(np.arange(4), poses)
        with pytest.raises(UserError):
            shared.move(np.zeros((4, 4)))

    def test_its_rewards_and_ends_pass_through(self):
        """An environment pays and ends what the simulator does, and begins what has ended."""
        env = self.env(2, max_decisions=10_000)
        env.reset(seed=4)
        act, told = env.simulator.act, []

        def listened(actions, env_ids):
            told.append((env_ids, act(actions, env_ids)))
            return told[-1][1]
        env.simulator.act = listened
        rng, over = np.random.default_rng(0), np.zeros(2, bool)
        for _ in range(40):
            told.clear()
            _, reward, terminated, truncated, info = env.step(
                rng.integers(0, len(self.actions), 2))
            paid, ended = np.zeros(2, np.float32), np.zeros(2, bool)
            for env_ids, motion in told:
                paid[env_ids], ended[env_ids] = motion.reward, motion.ended
            assert np.array_equal(reward, paid) and np.array_equal(terminated, ended)
            assert np.array_equal(info['reset'], over), 'the step after an end begins anew'
            over = terminated | truncated
        env.close()
