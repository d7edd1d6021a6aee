"""What a policy would have done on a recorded drive, compared with what was done.

The policy is shown the pictures at which the robot's actions began, one after the other as its
memory wants them, and receives what was done, not what it would have done: each of its answers is
to the situation that was there.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vn_nav.bags.dataset import DriveSet, Wanted
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.mapping.pose_graph import between
from vn_nav.bags.roles import Topics
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.robot import RobotSpec

if TYPE_CHECKING:  # it takes torch along
    from vn_nav.policy.checkpoint import LoadedCheckpoint

MAX_LISTED_STEPS = 300  # steps that are listed, at most
MAX_SHOWN_DISAGREEMENTS = 8  # disagreements with their pictures
STOP, OTHER, END = 'stop', 'fits none', 'episode ends'


class Judged(NamedTuple):
    """A step, and the policy's answer there."""

    episode: int
    step: int  # of the episode
    done: str  # an action's name, `OTHER` or `END`
    would: str  # an action's name or `STOP`
    sure: float  # probability of the action that it prefers, or of arrival
    done_sure: float  # probability of what was done; nan where that is no action


class Disagreement(NamedTuple):
    """A step at which something else was done, with what the policy saw."""

    judged: Judged
    image: np.ndarray  # [S,S,3] uint8
    goal: np.ndarray  # [S,S,3] uint8
    hindsight: bool  # the goal is the episode's last picture: none was shown


@dataclasses.dataclass
class Agreement:
    """The policy's answers along a drive. A actions of the policy."""

    rows: tuple[str, ...]  # what was done: the actions, `OTHER`, `END`
    columns: tuple[str, ...]  # what the policy would have done: the actions, and `STOP` if it can
    table: np.ndarray  # [rows, columns] steps
    steps: list[Judged]  # the first `MAX_LISTED_STEPS`
    worst: list[Disagreement]  # the largest first
    hindsight: int  # episodes whose last picture stood in for a goal
    done_sure: float  # mean probability of the actions that were done; nan: there were none

    @property
    def counted(self) -> int:
        """Steps at which one of the policy's actions was done."""
        return int(self.table[:-2].sum())

    @property
    def share(self) -> float:
        """Of them, those at which it would have done the same; nan: there were none."""
        same = sum(self.table[k, k] for k in range(len(self.rows) - 2))
        return same / self.counted if self.counted else math.nan


def judge(bag: str | Path, checkpoint: LoadedCheckpoint, robot: RobotSpec, topics: Topics
          ) -> Agreement:
    """Let a policy see a drive.

    Pictures are decoded into a temporary folder, a few kilobytes a step: memory is bounded by an
    episode's figures.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        checkpoint: of the policy.
        robot: that drove, with the policy's actions.
        topics: names in the bag.

    Raises:
        UserError: see `load_drives`.
    """
    robot = dataclasses.replace(
        robot, camera_fov=math.radians(checkpoint.info['camera_fov_deg']))
    with tempfile.TemporaryDirectory() as cache:
        drives = load_drives(bag, Wanted(robot, checkpoint.config.size, topics), cache)
        return _judge(drives, checkpoint)


def _judge(drives: DriveSet, checkpoint: LoadedCheckpoint) -> Agreement:
    import torch
    torch.set_num_threads(1)
    actions = checkpoint.config.actions
    threshold = checkpoint.info['stop_threshold']
    rows = (*actions, OTHER, END)
    columns = (*actions, *((STOP,) if threshold is not None else ()))
    found = Agreement(rows, columns, np.zeros((len(rows), len(columns)), np.int64), [], [], 0, 0.0)
    for steps in drives.episodes():
        shown = drives.goal[steps][drives.goal[steps] >= 0]
        goal = drives.goals[shown[-1]] if len(shown) else drives.image[steps.stop - 1]
        found.hindsight += not len(shown)
        for row, judged in zip(range(steps.start, steps.stop),
                               _episode(drives, steps, goal, checkpoint, threshold), strict=True):
            found.table[rows.index(judged.done), columns.index(judged.would)] += 1
            if len(found.steps) < MAX_LISTED_STEPS:
                found.steps.append(judged)
            if judged.done in actions:
                found.done_sure += judged.done_sure
                if judged.would != judged.done:
                    _keep_worst(found.worst, Disagreement(
                        judged, _upright(drives.image[row]), _upright(goal), not len(shown)))
    found.done_sure = found.done_sure / found.counted if found.counted else math.nan
    return found


def _episode(drives: DriveSet, steps: slice, goal: np.ndarray, checkpoint: LoadedCheckpoint,
             threshold: float | None):
    """The policy's answer at each step of an episode."""
    import torch

    from vn_nav.policy.batched import BatchedPolicy
    policy, actions = BatchedPolicy(checkpoint.network, 1, 'greedy'), checkpoint.config.actions
    goals, before = np.array(goal)[None], NO_ACTION
    # By odometry, or by the commands, in the frame of the episode, as a simulator observes it.
    own = drives.pose[steps]
    poses = dict(zip(range(steps.start, steps.stop), between(own[:1], own), strict=True))
    for row in range(steps.start, steps.stop):
        # After a motion that is none of its actions the memory is emptied, as in pre-training.
        observation = {'image': np.array(drives.image[row])[None],
                       'goal_index': np.zeros(1, np.int64),
                       'last_action': np.array([before], np.int64),
                       'last_reward': np.zeros(1, np.float32), 'odometry': poses[row][None]}
        best = int(policy.act(observation, goals, np.array([before == NO_ACTION]))[0])
        assert policy.logits is not None  # it has just acted
        sure = torch.softmax(policy.logits[0].float(), -1).numpy()
        before = int(drives.action[row])
        done = (actions[before] if before != NO_ACTION
                else END if row == steps.stop - 1 else OTHER)
        arrived = threshold is not None and float(policy.arrival[0]) > threshold
        yield Judged(int(drives.episode[row]), row - steps.start, done,
                     STOP if arrived else actions[best],
                     float(policy.arrival[0]) if arrived else float(sure[best]),
                     float(sure[before]) if before != NO_ACTION else math.nan)


def _keep_worst(worst: list[Disagreement], new: Disagreement) -> None:
    worst.append(new)
    worst.sort(key=lambda d: d.judged.done_sure - d.judged.sure)
    del worst[MAX_SHOWN_DISAGREEMENTS:]


def _upright(picture: np.ndarray) -> np.ndarray:
    """[3,S,S] as [S,S,3], in memory of its own."""
    return np.ascontiguousarray(np.array(picture).transpose(1, 2, 0))
