"""Parts of rollouts: some environments, the goals that occur, the rows to learn from."""

from __future__ import annotations

import torch
from torch import Tensor

from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation
from vn_nav.policy.network import RecurrentState


def select(rollout: Rollout, columns: Tensor, few_goals: bool = True) -> Rollout:
    """Some environments of a rollout, with only the goals that occur in them, or with all.

    Pictures stay channels last in memory. To find the goals, the host waits for the device.
    """
    seen = rollout.observation
    # index_select copies whole pictures; plain indexing takes ten times as long.
    image = seen.image.permute(0, 1, 3, 4, 2).index_select(1, columns).permute(0, 1, 4, 2, 3)
    extras = seen.extras and {key: rows[:, columns] for key, rows in seen.extras.items()}
    observation = Observation(image, seen.goals, seen.goal_index[:, columns],
                              seen.last_action[:, columns], seen.last_reward[:, columns], extras)
    if few_goals:
        observation = few_goals_of(observation)

    def part(rows: Tensor) -> Tensor:
        return rows[:, columns]

    def if_known(rows: Tensor | None) -> Tensor | None:
        return None if rows is None else part(rows)
    return Rollout(
        observation, starts=part(rollout.starts), action=part(rollout.action),
        reward=part(rollout.reward), terminated=part(rollout.terminated),
        truncated=part(rollout.truncated), valid=part(rollout.valid),
        state=(None if rollout.state is None
               else RecurrentState(*(rows[columns] for rows in rollout.state))),
        privileged={key: part(rows) for key, rows in rollout.privileged.items()},
        driven=if_known(rollout.driven),
        log_probability=if_known(rollout.log_probability), value=if_known(rollout.value),
        filter_offsets=if_known(rollout.filter_offsets))


def few_goals_of(observation: Observation) -> Observation:
    """With only the goals that occur in it."""
    used, index = torch.unique(observation.goal_index, return_inverse=True)
    return observation._replace(goals=observation.goals[used], goal_index=index)


def own_frames(rollout: Rollout) -> Tensor:
    """[T,B] frames in which the policy itself acted."""
    return rollout.valid if rollout.driven is None else rollout.valid & ~rollout.driven


def acting_rows(observation: Observation) -> Observation:
    """All rows but the last, which only bootstraps."""
    extras = observation.extras
    return Observation(observation.image[:-1], observation.goals,
                       observation.goal_index[:-1], observation.last_action[:-1],
                       observation.last_reward[:-1],
                       extras and {key: rows[:-1] for key, rows in extras.items()})
