"""Measures a policy in a vector environment, beside random actions and the shortest path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.policy.network import Policy
from vn_nav.policy.runtime import BatchedPolicy
from vn_nav.robot import RobotSpec

Actor = Callable[[dict, np.ndarray], np.ndarray]  # (observation, reset [N]) -> actions [N]


def run_episodes(env, actor: Actor, episodes: int, *, seed: int, robot: RobotSpec
                 ) -> list[Episode]:
    """Run a fixed number of episodes in each environment (early finishers would flatter).

    Args:
        env: as `NavigationEnv`; its rewards should be the sparse ones.
        actor: chooses the actions.
        episodes: at least this many; rounded up to the same number in each environment.
        seed: of the environment: equal seeds give equal starts.
        robot: for the duration of actions at its default limits.
    """
    count = env.num_envs
    each = -(-episodes // count)
    durations = np.array([robot.with_actions(env.action_names).nominal_duration(a)
                          for a in range(len(env.action_names))])
    found: list[list[Episode]] = [[] for _ in range(count)]
    collisions, seconds, reward = np.zeros(count, int), np.zeros(count), np.zeros(count)
    observation, info = env.reset(seed=seed)
    while any(len(own) < each for own in found):
        actions = actor(observation, info['reset'])
        observation, rewards, terminated, truncated, info = env.step(actions)
        acting = ~info['reset']
        collisions += info['collided'] & acting
        seconds += np.where(acting, durations[actions], 0)
        reward += rewards
        for n in np.nonzero(terminated | truncated)[0]:
            found[n].append(Episode(
                success=bool(info['success'][n]), start_distance=float(info['start_distance'][n]),
                path_length=float(info['path_length'][n]), decisions=int(info['decisions'][n]),
                collisions=int(collisions[n]), seconds=float(seconds[n]),
                stop_distance=float(info['distance'][n]),
                stop_heading=float(info['heading_error'][n]), reward=float(reward[n]),
                goal=env.goal_rooms[info['goal'][n]]))
            collisions[n], seconds[n], reward[n] = 0, 0.0, 0.0
    return [episode for own in found for episode in own[:each]]


def random_actor(env, seed: int) -> Actor:
    """Uniform random actions."""
    rng = np.random.default_rng(seed)
    return lambda observation, reset: rng.integers(0, len(env.action_names), env.num_envs)


def policy_actor(env, network: Policy, decoding: str, seed: int) -> Actor:
    """A trained policy."""
    policy = BatchedPolicy(network, env.num_envs, decoding=decoding, seed=seed)
    return lambda observation, reset: policy.act(observation, env.goals, reset)


def evaluate(env, network: Policy, *, decoding: str, episodes: int = 100, controls: bool = True,
             seed: int = 10_000, robot: RobotSpec | None = None) -> dict[str, dict]:
    """All figures of a policy, and its controls on the same starts.

    Returns:
        {'right goal' | 'other decoding' | 'wrong goal' | 'blank goal' | 'random' |
        'shortest path': summary}; without controls only the first.
    """
    robot = robot or RobotSpec()

    def measure(actor: Actor, shown: str = 'right') -> dict:
        env.set_shown_goal(shown)
        return summarise(run_episodes(env, actor, episodes, seed=seed, robot=robot))

    def act(rule: str) -> Actor:
        return policy_actor(env, network, rule, seed)

    results = {f'right goal, {decoding}': measure(act(decoding))}
    if controls:
        other = 'greedy' if decoding == 'sample' else 'sample'
        results |= {
            f'right goal, {other}': measure(act(other)),
            'wrong goal': measure(act(decoding), 'wrong'),
            'blank goal': measure(act(decoding), 'blank'),
            'random actions': measure(random_actor(env, seed)),
            'shortest path': measure(lambda observation, reset: env.oracle_actions()),
        }
    env.set_shown_goal('right')
    return results
