"""Rows of environments whose episodes have given lengths, for a replay memory."""

import torch

from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Rollout
from vn_nav.observation import Observation

SIZE, ENVS, GOALS = 6, 3, 5
GOAL_TABLE = torch.arange(GOALS, dtype=torch.uint8)[:, None, None, None].expand(
    GOALS, 3, SIZE, SIZE).contiguous()
GOAL_CLASSES = (100 + torch.arange(GOALS, dtype=torch.uint8))[:, None, None].expand(
    GOALS, SIZE, SIZE).contiguous()


def draws(seed=0):
    return torch.Generator().manual_seed(seed)


class Stream:
    """Rows of environments whose episodes have given lengths, one after the other.

    Row t of environment e shows a picture with the bytes of t and e; an episode of n decisions
    takes n + 1 rows, the last of them no frame. Every third episode is cut off; the others earn
    1 or -1 at their end.
    """

    def __init__(self, lengths, rows):
        envs = len(lengths)
        t = torch.arange(rows)[:, None].expand(rows, envs)
        env = torch.arange(envs).expand(rows, envs)
        self.starts, self.valid, self.terminated, self.truncated = (
            torch.zeros(4, rows, envs, dtype=torch.bool))
        self.begin, self.end = torch.zeros(2, rows, envs, dtype=torch.int64)
        self.last_reward = torch.zeros(rows, envs)
        self.goal_index, self.last_action = torch.zeros(2, rows, envs, dtype=torch.int64)
        self.valid |= True
        for e, cycle in enumerate(lengths):
            row = number = 0
            while row < rows:
                n = cycle[number % len(cycle)]
                last = row + n
                episode = slice(row, last + 1)
                self.starts[row, e] = True
                self.begin[episode, e], self.end[episode, e] = row, last
                self.goal_index[episode, e] = (number + e) % GOALS
                self.last_action[episode, e] = (t[episode, e] - 1) % 4
                self.last_action[row, e] = -1
                if last < rows:
                    self.valid[last, e] = False
                if last - 1 < rows:
                    ends = self.truncated if number % 3 == 2 else self.terminated
                    ends[last - 1, e] = True
                if last < rows and number % 3 != 2:
                    self.last_reward[last, e] = 1.0 if number % 2 == 0 else -1.0
                row, number = last + 1, number + 1
        self.action = t % 4
        self.reward = t + 1000.0 * env + 0.5  # shaped: shows nothing of the task's reward
        code = torch.stack([t % 256, t // 256, env], dim=-1).to(torch.uint8)
        self.image = code[:, :, None, None].expand(rows, envs, SIZE, SIZE, 3).permute(
            0, 1, 4, 2, 3)
        self.segmentation = ((7 * t + env) % 256).to(torch.uint8)[..., None, None].expand(
            rows, envs, SIZE, SIZE)
        self.depth = ((t % 50) / 5.0 + env / 10)[..., None, None].expand(rows, envs, SIZE, SIZE)

    def rollout(self, first, steps):
        now, seen = slice(first, first + steps), slice(first, first + steps + 1)
        return Rollout(
            Observation(self.image[seen], GOAL_TABLE, self.goal_index[seen],
                        self.last_action[seen], self.last_reward[seen]),
            self.starts[seen], self.action[now], self.reward[now], self.terminated[now],
            self.truncated[now], self.valid[now], None,
            {'depth': self.depth[seen], 'segmentation': self.segmentation[seen]})

    def fill(self, replay, rows, steps=7, first=0):
        """Extend a memory by rows first..first+rows-1; the remainder is a shorter rollout."""
        for begin in range(first, first + rows, steps):
            replay.extend(self.rollout(begin, min(steps, first + rows - begin)))
        return replay


def memory(capacity=60, **options):
    return Replay(capacity, ENVS, SIZE, GOAL_TABLE, goal_segmentation=GOAL_CLASSES, **options)


LENGTHS = ((13, 1, 4), (2, 30, 9), (45, 3))


def decode(image):
    """Row and environment [...] that a picture [...,3,S,S] shows."""
    code = image[..., 0, 0].long()
    return code[..., 0] + 256 * code[..., 1], code[..., 2]
