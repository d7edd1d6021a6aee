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

    def part(rows: Tensor | None) -> Tensor | None:
        return None if rows is None else rows[:, columns]
    return Rollout(
        observation, *(part(getattr(rollout, name)) for name in (
            'starts', 'action', 'reward', 'terminated', 'truncated', 'valid')),
        state=(None if rollout.state is None
               else RecurrentState(*(rows[columns] for rows in rollout.state))),
        privileged={key: part(rows) for key, rows in rollout.privileged.items()},
        driven=part(rollout.driven),
        log_probability=part(rollout.log_probability), value=part(rollout.value),
        filter_offsets=part(rollout.filter_offsets))


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
                       *(rows[:-1] for rows in observation[2:5]),
                       extras and {key: rows[:-1] for key, rows in extras.items()})
