"""The smallest task that needs both pictures, as a vector environment like `NavigationEnv`.

A red and a green bar stand left and right of the robot, which side is which drawn anew; the goal
picture shows one of the two. Turning to that bar ends the episode with reward 1, turning to the
other one with reward 0. Some turns slip: nothing happens but that the bars come closer, and after
`LIMIT` decisions the episode is cut off. Either picture alone tells nothing: without looking at
both, half of the turns are right.
"""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from vn_nav.learning.rollout import Collector
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.network import Policy

ACTIONS = ('left', 'right')
LIMIT = 2  # decisions
SLIP = 0.3  # probability that a turn has no effect
RED, GREEN = (235, 0, 0), (0, 235, 0)
RIGHT, BLANK = 'right', 'blank'
# All that auxiliary tasks may ask for.
KEYS = ('depth', 'segmentation', 'goal_segmentation', 'goal_pose', 'overlap', 'arrived',
        'distance', 'explorer_action', 'oracle_action')


class TwoBars:
    """N robots, each before its two bars; NEXT_STEP autoreset.

    Args:
        num_envs: N.
        size: side of the pictures [pixels].
    """

    action_names = ACTIONS
    world_version = 'two bars'
    restorable = False

    def __init__(self, num_envs: int = 16, size: int = 36):
        self.num_envs, self.size = num_envs, size
        self.goals = np.full((3, 3, size, size), 15, np.uint8)
        self.goal_segmentation = np.zeros((3, size, size), np.uint8)
        self.blank_goal = 2
        self.goals[2] = 128
        bar = slice(size // 6, size - size // 6)
        for kind, colour in enumerate((RED, GREEN)):
            self.goals[kind, :, :, bar] = np.reshape(colour, (3, 1, 1))
            self.goal_segmentation[kind, :, bar] = 1 + kind
        self.single_observation_space = spaces.Dict({
            'image': spaces.Box(0, 255, (3, size, size), np.uint8),
            'goal_index': spaces.Discrete(3),
            'last_action': spaces.Discrete(len(ACTIONS) + 1, start=-1),
            'last_reward': spaces.Box(-np.inf, np.inf, (), np.float32),
        })
        self.single_action_space = spaces.Discrete(len(ACTIONS))
        self.mode, self.tau = RIGHT, 1.0
        self.red_left, self.done = np.zeros((2, num_envs), bool)
        self.goal, self.step_count, self.last_action, self.facing, self.grey = np.zeros(
            (5, num_envs), np.int64)
        self.last_reward = np.zeros(num_envs, np.float32)

    def set_difficulty(self, tau: float) -> None:
        """Later episodes have bars as far away, and so as small, as tau in (0, 1] says."""
        self.tau = tau

    def set_shown_goal(self, mode: str) -> None:
        """Show the goal ('right'), or a grey picture ('blank')."""
        self.mode = mode

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self._begin(np.arange(self.num_envs))
        self.done[:] = False
        none = np.zeros(self.num_envs, bool)
        return self._result(~none, none)

    def step(self, actions):
        reset, acting = self.done.copy(), ~self.done
        self._begin(np.nonzero(reset)[0])
        turned = acting & (self.random.random(self.num_envs) >= SLIP)
        success = turned & (actions == self._wanted())
        self.facing[turned] = 1 + np.asarray(actions)[turned]
        self.step_count[acting] += 1
        self.last_action[acting] = np.asarray(actions)[acting]
        reward = success.astype(np.float32)
        self.last_reward[acting] = reward[acting]
        truncated = acting & ~turned & (self.step_count >= LIMIT)
        self.done = turned | truncated
        observation, info = self._result(reset, success)
        return observation, reward, turned, truncated, info

    def _begin(self, env_ids) -> None:
        n = len(env_ids)
        self.red_left[env_ids] = self.random.integers(0, 2, n) > 0
        self.goal[env_ids] = self.random.integers(0, 2, n)
        self.grey[env_ids] = self.random.integers(0, 20, n)
        self.step_count[env_ids] = self.facing[env_ids] = 0
        self.last_action[env_ids], self.last_reward[env_ids] = -1, 0.0

    def _wanted(self) -> np.ndarray:
        """[N] the right turn: the red bar is wanted and on the left, or neither."""
        return np.where((self.goal == 0) == self.red_left, 0, 1)

    def _labels(self) -> np.ndarray:
        """[N,S,S] 0 nothing, 1 red, 2 green."""
        side = self.size
        labels = np.zeros((self.num_envs, side, side), np.uint8)
        width = round(side * (0.48 - 0.12 * self.tau))
        left = np.where(self.red_left, 1, 2)[:, None, None]
        ahead = self.facing == 0
        for n in np.nonzero(ahead)[0]:
            near = 4 - 2 * self.step_count[n]
            labels[n, near:side - near, 2:2 + width] = left[n]
            labels[n, near:side - near, side - 2 - width:side - 2] = 3 - left[n]
        bar = slice(side // 6, side - side // 6)
        labels[~ahead, :, bar] = np.where(self.facing[~ahead, None, None] == 1, left[~ahead],
                                          3 - left[~ahead])
        return labels

    def _result(self, reset: np.ndarray, success: np.ndarray):
        labels = self._labels()
        noise = self.random.integers(0, 20, (self.num_envs, 3, self.size, self.size))
        image = np.where(labels[:, None] == 0, self.grey[:, None, None, None],
                         np.array([(0, 0, 0), RED, GREEN])[labels].transpose(0, 3, 1, 2))
        shown = (self.goal if self.mode == RIGHT
                 else np.full(self.num_envs, self.blank_goal)).astype(np.int64)
        observation = {'image': (image + noise).astype(np.uint8), 'goal_index': shown,
                       'last_action': self.last_action.copy(),
                       'last_reward': self.last_reward.copy()}
        wanted = self._wanted()
        side = np.where(self.facing > 0, 0, 1 - 2 * wanted).astype(np.float32)
        pose = np.stack([1.0 - np.abs(side), side, 1.0 - np.abs(side), side], axis=1)
        info = {'reset': reset, 'success': success, 'collided': np.zeros(self.num_envs, bool),
                'depth': np.where(labels > 0, 1.0, 4.0).astype(np.float32),
                'segmentation': labels, 'goal_segmentation': self.goal_segmentation[shown],
                'goal_pose': pose.astype(np.float32),
                'overlap': np.where((self.facing == 0) | success, 1.0, 0.0).astype(np.float32),
                'arrived': success.copy(),
                'distance': np.where(success, 0.0, 1.0).astype(np.float32),
                'explorer_action': wanted, 'oracle_action': wanted.copy()}
        return observation, info


def collected(network: Policy, steps: int = 9, envs: int = 6, seed: int = 0, rollouts: int = 1):
    """The last of some rollouts of a network in `TwoBars`, with everything that tasks need."""
    env = TwoBars(envs, network.config.size)
    collector = Collector(env, network, torch.Generator().manual_seed(seed), KEYS)
    collector.begin(seed)
    for _ in range(rollouts):
        rollout, _ = collector.collect(steps)
    return rollout


def success(network: Policy, turns: int, mode: str = RIGHT, seed: int = 99) -> float:
    """Share of a sampling policy's turns that are right; as many of them in every environment."""
    env = TwoBars(32, network.config.size)
    env.set_shown_goal(mode)
    policy = BatchedPolicy(network, env.num_envs, seed=seed)
    observation, info = env.reset(seed=seed)
    rights = [[] for _ in range(env.num_envs)]
    while min(map(len, rights)) < turns // env.num_envs:
        actions = policy.act(observation, env.goals, info['reset'])
        observation, _, terminated, _, info = env.step(actions)
        for n in np.nonzero(terminated)[0]:
            rights[n].append(bool(info['success'][n]))
    return float(np.mean([ends[:turns // env.num_envs] for ends in rights]))
