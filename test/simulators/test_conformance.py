"""Every simulator of this package, and the one of examples/, keep the contract."""

import functools
import math

import numpy as np
import pytest
from conformance import ROBOT, SIZE, Conformance

from vn_nav.robot import RobotSpec
from vn_sim_bridge.recorded.image_graph import build_graph
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator
from vn_sim_bridge.simulators.recorded import RecordedSimulator


@pytest.mark.slow
class TestHouse(Conformance):
    def make(self, num_envs, size=SIZE):
        return open_simulator(['house:7?rooms=2', 'house:3?rooms=1'],
                              Setup(num_envs, RobotSpec(), size))


class TestCorridor(Conformance):
    def make(self, num_envs, size=SIZE):
        return open_simulator(['examples.corridor:8', 'examples.corridor:5'],
                              Setup(num_envs, ROBOT, size))


@functools.cache
def drive_through_a_corridor():
    """Pictures with depth and poses of a drive through the corridor, as a place."""
    corridor = open_simulator(['examples.corridor:6'], Setup(1, ROBOT, SIZE))
    poses = [[1.0 + 0.1 * k, 0.0, 0.0, 0.0] for k in range(41)]
    for x in (5.0, 4.0, 3.0, 2.0, 1.0):
        poses += [[x, 0.0, math.radians(180 + a), 0.0] for a in range(0, 360, 10)]
        poses += [[x - 0.1 * k, 0.0, math.pi, 0.0] for k in range(11) if x > 1]
    poses = np.array(poses)
    seen = corridor.view(np.zeros(len(poses), int), poses)
    depth = np.clip(seen.depth * (255 / 10), 1, 255).astype(np.uint8)
    return build_graph(seen.rgb, poses[:, :3], np.zeros(len(poses), int), ROBOT, depth=depth,
                       world_version='recorded')


@pytest.mark.slow
class TestRecorded(Conformance):
    contact_slack = 0.11  # robots stand on cells of the floor
    depth_slack = 0.7  # that of the picture which was taken nearest

    def make(self, num_envs, size=SIZE):
        return RecordedSimulator(drive_through_a_corridor(), num_envs, robot=ROBOT)
