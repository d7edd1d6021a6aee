"""Networks of the thesis, and random observations for networks."""

import torch

from vn_nav.learning.presets import preset
from vn_nav.observation import Observation
from vn_nav.policy.network import Policy
from vn_nav.robot import DRIVE_ACTIONS


def batch(steps=6, envs=3, goals=2, size=36):
    """Random observations, and episodes that begin here and there."""
    generator = torch.Generator().manual_seed(1)

    def draw(high, *shape, dtype=torch.int64):
        return torch.randint(0, high, shape, generator=generator).to(dtype)
    observation = Observation(
        draw(256, steps, envs, 3, size, size, dtype=torch.uint8),
        draw(256, goals, 3, size, size, dtype=torch.uint8), draw(goals, steps, envs),
        draw(5, steps, envs) - 1, draw(2, steps, envs, dtype=torch.float32))
    starts = torch.zeros(steps, envs, dtype=torch.bool)
    starts[0, 0] = True
    if steps > 4 and envs > 1:
        starts[3, 1] = starts[4, 1] = True
    return observation, starts


def thesis(size, **changes):
    return Policy(preset('thesis', **changes).network(DRIVE_ACTIONS, size))
