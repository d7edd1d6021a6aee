"""GoalTracker: the goal is where dead reckoning says, and the policy refuses other robots."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from vn_nav.co_visibility import relative_pose
from vn_nav.errors import UserError
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.memory import GoalTracker
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions((*DRIVE_ACTIONS, 'left'))
STEPS = 30
SURE, UNSURE = 4.0, -6.0  # logits of the overlap


@pytest.fixture
def drive():
    """Actions of two robots, and where the goal truly stands after each: [T,2], [T,2,4]."""
    rng = np.random.default_rng(0)
    actions = rng.integers(0, len(ROBOT.actions), (STEPS, 2))
    actions[0] = -1
    poses, goals = np.array([[1.0, 2.0, 0.3, 0], [0.0, 0.0, -2.0, 0]]), np.array(
        [[4.0, 1.0, 1.0, 0], [-2.0, 1.5, 3.0, 0]])
    truth = []
    for row in actions:
        for pose, action in zip(poses, row, strict=True):
            if action >= 0:
                dx, dy, dyaw = ROBOT.moves[action]
                c, s = math.cos(pose[2]), math.sin(pose[2])
                pose[:3] += c * dx - s * dy, s * dx + c * dy, dyaw
        truth.append(relative_pose(poses, goals))
    return torch.from_numpy(actions), torch.from_numpy(np.array(truth))


def track(looks, logits, actions, starts=None, estimate=None):
    starts = torch.zeros(actions.shape, dtype=torch.bool) if starts is None else starts
    estimate = torch.zeros(actions.shape[1], 5) if estimate is None else estimate
    return GoalTracker(ROBOT.moves)(looks[..., :2], looks[..., 2:], logits, actions, starts,
                                    estimate)


def test_a_goal_seen_once_stays_where_it_is(drive):
    actions, truth = drive
    looks, logits = torch.randn_like(truth), torch.full((STEPS, 2), UNSURE)
    looks[0], logits[0] = truth[0], SURE
    seen, estimate = track(looks, logits, actions)
    assert torch.allclose(estimate[:, :4], truth[-1], atol=2e-3)
    sure = seen[..., 4]
    assert (sure[0] > 0.98).all() and (sure[1:] <= sure[:-1]).all() and (sure[-1] > 0.9).all()
    expected = (truth[..., :2] / 3).clamp(-2, 2)
    assert torch.allclose(seen[..., :2] / sure[..., None], expected, atol=2e-3)
    assert torch.allclose(seen[..., 2:4] / sure[..., None], truth[..., 2:], atol=2e-3)


def test_a_sure_look_corrects_a_wrong_estimate_and_doubtful_ones_make_no_goal(drive):
    actions, truth = drive
    looks, logits = truth + 3.0, torch.full((STEPS, 2), -3.0)
    logits[-1], looks[-1] = SURE, truth[-1]
    seen, estimate = track(looks, logits, actions)
    assert (seen[:-1, :, 4] < 0.1).all()
    assert torch.allclose(estimate[:, :4], truth[-1], atol=0.01)


def test_looks_are_weighed_by_their_confidence(drive):
    actions, truth = drive
    looks, logits = truth.clone(), torch.full((STEPS, 2), 0.0)
    looks[1::2, :, 0] += 1.0  # every other look is a metre off
    looks[::2, :, 0] -= 1.0
    _, estimate = track(looks, logits, actions)
    assert ((estimate[:, :4] - truth[-1]).abs() < 0.35).all()


def test_an_episode_begins_without_a_goal(drive):
    actions, truth = drive
    looks, logits = truth.clone(), torch.full((STEPS, 2), UNSURE)
    logits[:5] = SURE
    starts = torch.zeros(STEPS, 2, dtype=torch.bool)
    starts[9, 0] = True
    actions = actions.clone()
    actions[9, 0] = -1
    seen, _ = track(looks, logits, actions, starts)
    assert seen[8, 0, 4] > 0.9 and seen[9, 0, 4] < 0.01
    assert (seen[8:10, 1, 4] > 0.9).all()


def test_a_policy_that_counts_on_its_moves_refuses_another_robot(tmp_path):
    robot = RobotSpec().with_actions(DRIVE_ACTIONS)
    network = Policy(NetworkConfig(
        DRIVE_ACTIONS, size=36, architecture='matching', channels=(4, 8, 4), features=16,
        hidden=8, heads=('goal_pose',), pose_to_memory=True, moves=robot.moves))
    save_checkpoint(tmp_path / 'model', network, {
        'world_version': '2', 'camera_fov_deg': 90, 'camera_height': 1.0})
    config = load_checkpoint(tmp_path / 'model').config
    assert config == network.config
    assert RobotSpec().with_actions(config.actions, config.moves).moves == robot.moves
    first, *others = RobotSpec().actions
    slower = dataclasses.replace(RobotSpec(), actions=(dataclasses.replace(first, dx=0.25),
                                                       *others))
    with pytest.raises(UserError, match='how far forward moves'):
        slower.with_actions(config.actions, config.moves)
    slower.with_actions(config.actions)  # a policy that does not count on them drives it
    with pytest.raises(UserError, match='a move .* for each action'):
        dataclasses.replace(config, moves=robot.moves[:2])
    with pytest.raises(UserError, match='with pose_to_memory'):
        dataclasses.replace(config, pose_to_memory=False)
