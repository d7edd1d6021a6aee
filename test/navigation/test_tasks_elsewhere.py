"""The tasks in a simulator that is no house: what they need of it, and no more."""

import numpy as np
import pytest
from other_corridors import Placing, Roomy, register

from vn_nav.errors import UserError
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def make(scene, task, **options):
    return NavigationEnv(EnvConfig(**{
        'scenes': (scene,), 'num_envs': 3, 'size': 24, 'task': task, 'max_decisions': 60,
        'noise': False} | options))


def drive(env, steps):
    """Episodes that ended well on the shortest way, and the rewards."""
    ended = total = 0
    env.reset(seed=0)
    for _ in range(steps):
        _, reward, terminated, _, _ = env.step(env.oracle_actions())
        ended, total = ended + int(terminated.sum()), total + float(reward.sum())
    return ended, total


def test_an_object_is_a_goal(monkeypatch):
    register(monkeypatch, 'placing', Placing)
    env = make('placing:8', 'object', objects=2)
    ended, total = drive(env, 60)
    assert ended == total and ended >= 3
    assert set(env.goal_rooms) == {'cone', 'flag', 'lamp', 'nothing'}
    assert ((env.simulator.object_models() >= 0).sum(axis=1) == 2).all()
    env.close()


def test_what_is_touched_is_collected(monkeypatch):
    register(monkeypatch, 'placing', Placing)
    env = make('placing:8', 'collect', objects=4)
    env.reset(seed=1)
    first = env.simulator.object_models().copy()
    assert (np.sort(first) == [0, 0, 1, 1]).all()
    for n in range(3):  # onto a flag, which is the first of the task
        where = env.simulator.objects.pose[n, np.argmin(first[n]), :2]
        env.simulator.place(np.array([n]), np.array([[*where, 0.0, 0.0]]))
    reward = env.step(np.full(3, env.action_names.index('rotate_left')))[1]
    assert (reward >= 1).any() and ((env.simulator.object_models() < 0).sum(axis=1) >= 1).all()
    env.close()


def test_a_room_is_a_goal(monkeypatch):
    register(monkeypatch, 'roomy', Roomy)
    env = make('roomy:8', 'room')
    ended, total = drive(env, 40)
    assert ended == total and ended >= 3 and set(env.goal_rooms) == {'kitchen', 'hall', 'nothing'}
    env.close()
    seeing = make('roomy:8', 'room', room_must_see=True)
    assert seeing.task.classes == {'kitchen': [0], 'hall': [2]}
    seeing.close()


@pytest.mark.parametrize('task', ['object', 'collect', 'room'])
def test_who_cannot_is_refused_in_a_line(task):
    with pytest.raises(UserError, match='needs a simulator that (places objects|knows rooms)'):
        make('examples.corridor:5', task)
