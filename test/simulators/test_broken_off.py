"""An episode that a simulator breaks off is truncated: no terminal, and the next one begins."""

import numpy as np

from examples.corridor import CorridorSimulator
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulator import Setup

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
ROTATE = 2


def test_an_episode_that_breaks_off_is_truncated():
    class Fragile(CorridorSimulator):
        broken = np.zeros(2, bool)

        def broken_off(self):
            broken, self.broken = self.broken, np.zeros(2, bool)
            return broken

    simulator = Fragile.open([parse_scene('examples.corridor:8')], Setup(2, ROBOT, 24))
    env = NavigationEnv(EnvConfig(scenes=('examples.corridor:8',), num_envs=2, size=24,
                                  actions=DRIVE_ACTIONS), ROBOT, simulator=simulator)
    env.reset(seed=0)
    env.step(np.full(2, ROTATE))
    simulator.broken = np.array([False, True])
    _, _, terminated, truncated, info = env.step(np.full(2, ROTATE))
    assert truncated.tolist() == [False, True] and not terminated.any()
    simulator.broken = np.array([False, True])  # while the next one begins: it begins
    _, _, terminated, truncated, info = env.step(np.full(2, ROTATE))
    assert info['reset'].tolist() == [False, True] and not (truncated | terminated).any()
    *_, truncated, info = env.step(np.full(2, ROTATE))
    assert not truncated.any() and not info['reset'].any()
    assert info['decisions'].tolist() == [4, 1]
    env.close()
