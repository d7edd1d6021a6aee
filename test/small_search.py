"""A small policy that searches, with random weights, and its checkpoint."""

import torch

from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.simulators.house import WORLD_VERSION

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)


def small_search(seed=0):
    """What it sees means nothing: it wanders by its map."""
    torch.manual_seed(seed)
    return build_policy(NetworkConfig(
        actions=ROBOT.action_names, moves=ROBOT.moves, size=48, architecture='search',
        channels=(8, 12, 8), features=24, blocks=1, view=ROBOT.camera_fov,
        footprint=ROBOT.footprint_radius))


def write_small_search(folder, **info):
    """Its checkpoint, of the standard robot in house 7 with two rooms."""
    save_checkpoint(folder, small_search(), {
        'world_version': WORLD_VERSION, 'camera_fov_deg': 90.0, 'camera_height': 1.0,
        'scenes': ['house:7?rooms=2'], 'stop_threshold': 0.999} | info)
    return folder
