"""Co-visibility: what two views share, against independent computations."""

import math

import numpy as np
import pytest

from vn_nav.co_visibility import FARTHEST, GRID, co_visible, lift, relative_pose
from vn_nav.scenes import house_scenes
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation


@pytest.fixture(scope='module')
def env():
    env = NavigationEnv(EnvConfig(scenes=house_scenes((7, 8)), num_envs=8, size=48,
                                  randomisation=load_randomisation('standard'),
                                  privileged=('goal_pose', 'overlap', 'depth')))
    env.reset(seed=0)
    return env


def test_the_relative_pose_undoes_a_drive():
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, y, yaw, ahead, left, turn = rng.uniform(-3, 3, 6)
        towards = np.array([math.cos(yaw), math.sin(yaw)])
        aside = np.array([-towards[1], towards[0]])
        goal = np.array([x, y]) + ahead * towards + left * aside
        found = relative_pose(np.array([[x, y, yaw, 0.1]]), np.array([[*goal, yaw + turn, 0.0]]))
        assert found.dtype == np.float32
        assert np.allclose(found[0], [ahead, left, math.cos(turn), math.sin(turn)], atol=1e-5)


def look(env, poses, seed=0):
    """Depth, cameras and fields of view from poses in the houses of the environments."""
    which = np.arange(len(poses))
    dress = env.simulator.appearance(seed, Stream.APPEARANCE, which, 0)
    frames = env.simulator.view(env.place_index, poses, None, dress)
    return frames.depth.copy(), *env.simulator.cameras(poses, dress)


def test_a_view_shares_everything_with_itself_and_nothing_with_its_back(env):
    poses = env.goal_poses[np.arange(8) % len(env.goal_poses)].copy()
    poses[:, :2] = env.simulator.poses[:, :2]
    depth, cameras, fov = look(env, poses)
    points = lift(depth, cameras, fov)
    assert (co_visible(points, depth, cameras, fov) == 1.0).all()
    other, cameras, fov = look(env, poses, seed=1)  # another fov, height and pitch
    assert co_visible(points, other, cameras, fov).min() > 0.85
    poses[:, 2] += math.pi
    behind, cameras, fov = look(env, poses)
    assert (co_visible(points, behind, cameras, fov) == 0.0).all()


def test_points_lie_on_the_surfaces_that_are_seen(env):
    depth, cameras, fov = look(env, env.simulator.poses)
    points = lift(depth, cameras, fov)
    assert points.shape == (8, GRID * GRID, 3)
    assert points[..., 2].min() > -1e-3 and points[..., 2].max() < 2.6 + 1e-3
    assert not np.isnan(points).any()
    depth[0], depth[1] = 0.0, FARTHEST + 0.1
    points = lift(depth, cameras, fov)
    assert np.isnan(points[:2]).all() and not np.isnan(points[2:]).any()
    assert (co_visible(points, depth, cameras, fov)[:2] == 0).all()


def brute_force(goal_camera, goal_fov, goal_depth, camera, fov, depth):
    """The definition, point by point, by angles and rotations instead of axes."""
    def rotation(camera):
        cy, sy, cp, sp = (f(camera[k]) for k in (3, 4) for f in (math.cos, math.sin))
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        return yaw @ pitch  # of (ahead, left, up)
    size, seen, known = len(depth), 0, 0
    for i in range(GRID):
        for j in range(GRID):
            row, column = (int((k + 0.5) * size / GRID) for k in (i, j))
            z = float(goal_depth[row, column])
            if not 0 < z <= FARTHEST:
                continue
            known += 1
            unit = 2 * math.tan(goal_fov / 2) / size
            local = z * np.array([1, -(column + 0.5 - size / 2) * unit,
                                  -(row + 0.5 - size / 2) * unit])
            point = goal_camera[:3] + rotation(goal_camera) @ local
            ahead, left, up = rotation(camera).T @ (point - camera[:3])
            if ahead <= 0:
                continue
            unit = 2 * math.tan(fov / 2) / size
            row, column = (math.floor(size / 2 - k / ahead / unit) for k in (up, left))
            if 0 <= row < size and 0 <= column < size:
                seen += abs(ahead - depth[row, column]) <= 0.1 * ahead + 0.05
    return seen / known


def test_the_environment_reports_the_share_that_brute_force_counts(env):
    env.set_difficulty(0.2)
    observation, info = env.reset(seed=3)
    variants, positive = env.config.pictures_per_goal, 0
    for _ in range(6):
        view, variant = np.divmod(observation['goal_index'], variants)
        assert np.array_equal(view, info['goal'])
        dress = env.simulator.appearance(3, Stream.APPEARANCE, np.arange(8), env._episode)
        goal_dress = env.simulator.appearance(0, Stream.GOAL_APPEARANCE, view, variant)
        goals = env.goal_poses[view]
        goal_depth = env.simulator.view(env.place_index, goals, None, goal_dress).depth
        goal_cameras, goal_fov = env.simulator.cameras(goals, goal_dress)
        cameras, fov = env.simulator.cameras(info['pose'], dress)
        for n in range(8):
            expected = brute_force(goal_cameras[n], goal_fov[n], goal_depth[n], cameras[n],
                                   fov[n], info['depth'][n])
            assert info['overlap'][n] == pytest.approx(expected, abs=1.5 / 64)
            positive += expected > 0
        observation, _, _, _, info = env.step(env.oracle_actions())
    assert positive > 12
