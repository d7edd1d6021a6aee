"""What the encoder keeps of goals, computed once for each goal."""

from __future__ import annotations

import torch
from torch import Tensor

from vn_nav.policy.network import Policy


class GoalMaps:
    """What the encoder keeps of the goal of each of N environments, encoded when it changes.

    Valid while the weights stay: make a new one after an update.
    """

    def __init__(self, network: Policy):
        self.network = network
        self._index: Tensor | None = None
        self._maps: Tensor | None = None

    def of(self, goals: Tensor, goal_index: Tensor) -> Tensor:
        """[N,...] for the goals `goals`[goal_index]; the network then takes None as the index."""
        if self._index is None or self._maps is None:  # nothing is kept yet
            self._maps = self.network.encode_goals(goals[goal_index])
        else:
            changed = torch.nonzero(goal_index != self._index).squeeze(1)
            if len(changed):
                self._maps[changed] = self.network.encode_goals(goals[goal_index[changed]])
        self._index = goal_index.clone()
        return self._maps
