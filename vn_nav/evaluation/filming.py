"""Films an episode of a policy that searches: what it sees, and what it knows each decision."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import PolicyActor, run_episodes
from vn_nav.evaluation.metrics import Episode
from vn_nav.policy.search.snapshot import Snapshot
from vn_nav.vector_env import MeasuredVectorEnv


@dataclasses.dataclass
class Film:
    """An episode, decision by decision."""

    episode: Episode  # with K decisions, and K + 1 poses
    pictures: np.ndarray  # [K,H,H,3] uint8 RGB, of the camera before each decision
    searches: list[Snapshot]  # K: after each decision, before its move
    goal_picture: np.ndarray  # [H,H,3] uint8 RGB
    plan: dict[str, Any] | None  # of the place, see `vn_nav.report.maps.floor_map`
    fov: float  # of the camera [rad]
    seen: int  # side of the pictures that the policy saw [pixels]
    limit: int  # decisions that the episode had at most


def film_episode(env: MeasuredVectorEnv, actor: PolicyActor, *, seed: int,
                 twin: MeasuredVectorEnv | None = None) -> Film:
    """Drive one episode, the first of a seed.

    Args:
        env: one environment, in which the policy acts.
        actor: the policy, which searches.
        seed: of the episode.
        twin: the same environment with larger pictures, to be looked at; None: those of `env`.

    Raises:
        UserError: another policy, or several environments.
    """
    if env.num_envs != 1:
        raise UserError('an episode is filmed in one environment', env.num_envs, 'make one')
    if actor.snapshot(0) is None:
        raise UserError('the film shows the map of a policy that searches',
                        'a policy without one', 'use a checkpoint of vn_nav train --preset search')
    cameraman = _Cameraman(env, actor, twin or env)
    if twin is not None:
        cameraman.observation, _ = twin.reset(seed=seed)
    (episode,) = run_episodes(env, cameraman, 1, seed=seed, robot=env.robot)
    assert cameraman.goal_picture is not None  # an episode has a decision
    return Film(episode, np.stack(cameraman.pictures), cameraman.searches, cameraman.goal_picture,
                env.places[env.place_index[0]].plan(), env.robot.camera_fov,
                env.goals.shape[-1], env.config.max_decisions)


class _Cameraman:
    """Acts as the policy does, and keeps what it sees and knows; the twin moves along."""

    def __init__(self, env: MeasuredVectorEnv, actor: PolicyActor, twin: MeasuredVectorEnv):
        self._env, self._actor, self._twin = env, actor, twin
        self.observation: dict = {}  # of the twin
        self.pictures: list[np.ndarray] = []
        self.searches: list[Snapshot] = []
        self.goal_picture: np.ndarray | None = None

    def __call__(self, observation: dict, reset: np.ndarray) -> np.ndarray:
        actions = self._actor(observation, reset)
        shown = observation if self._twin is self._env else self.observation
        self.pictures.append(shown['image'][0].transpose(1, 2, 0).copy())
        search = self._actor.snapshot(0)
        assert search is not None  # see `film_episode`
        self.searches.append(search)
        if self.goal_picture is None:
            self.goal_picture = self._twin.goals[int(shown['goal_index'][0])].transpose(1, 2, 0)
        if self._twin is not self._env:
            self.observation = self._twin.step(actions)[0]
        return actions
