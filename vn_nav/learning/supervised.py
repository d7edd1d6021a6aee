"""Losses of a pre-training on drives: image heads, goal poses, and what a memory is read for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from vn_nav.learning import pairs
from vn_nav.learning.auxiliary import FAR, POSE_OVERLAP, image_target, pose_loss
from vn_nav.learning.hindsight import Drives, Windows, fill_windows
from vn_nav.learning.pixel_change import average_pool_target
from vn_nav.learning.returns import masked_mean
from vn_nav.observation import Observation
from vn_nav.policy.heads import Pose
from vn_nav.policy.network import Latents, Policy
from vn_nav.policy.network_config import IMAGE_HEADS

# What an image head needs in addition to the picture: an array of `DriveSet`.
NEEDS = {'depth': 'depth', 'segmentation': 'labels', 'goal_segmentation': 'labels'}
BY_WINDOW = ('cloning', 'arrival', 'distance')  # what needs a memory, and so windows of steps
PARTS = (*IMAGE_HEADS, 'goal_pose', *BY_WINDOW)
FIGURES = ('action_accuracy', 'bearing_deg', 'bearing_within_30', 'heading_deg', 'distance_m',
           'overlap_accuracy')


class Guess(NamedTuple):
    """What is best said without a look at any picture: the figures' baseline."""

    action: int | None  # the most frequent one; None: there is none
    goal_pose: np.ndarray  # [4] the mean of pairs that overlap
    co_visible: bool  # whether most pairs do


class Batch(NamedTuple):
    """What a step of the optimiser learns from."""

    rows: np.ndarray | None  # [K] pictures, if there are pairs,
    goals: np.ndarray | None  # [K] and the partner of each
    windows: np.ndarray | None  # [W,3], if there are any, see `hindsight.draw_windows`


class Tally:
    """Losses of several batches, and what was said of poses."""

    def __init__(self):
        self._sums: dict[str, list] = {}  # by part: loss times count, count
        self._right = 0  # actions
        self._acted: list[int] = []  # how often each was driven
        self._poses: list[Tensor] = []  # [K,10]: x, y, cos, sin, logit as said; the pose, overlap

    def add(self, part: str, loss: Tensor, count: int) -> None:
        """Count a mean loss over so many rows."""
        total = self._sums.setdefault(part, [0.0, 0])
        total[0] += float(loss.detach()) * count
        total[1] += count

    def add_actions(self, right: Tensor, action: Tensor) -> None:
        """Count the actions [K] that were driven, and which [K] of them would have been chosen."""
        self._right += int(right.sum())
        counts = torch.bincount(action.cpu(), minlength=len(self._acted)).tolist()
        before = self._acted + [0] * (len(counts) - len(self._acted))
        self._acted = [a + b for a, b in zip(before, counts, strict=True)]

    def add_poses(self, said: Pose, goal_pose: Tensor, overlap: Tensor) -> None:
        """Keep K poses and their labels."""
        self._poses.append(torch.cat([
            said.position.detach(), said.heading.detach(), said.co_visible.detach()[:, None],
            goal_pose, overlap[:, None]], dim=1).cpu())

    def figures(self, weight: Callable[[str], float]) -> dict[str, float]:
        """`loss` (the weighted sum), the loss of each part, and `FIGURES` as far as known."""
        means = {part: total / count for part, (total, count) in self._sums.items() if count}
        loss = sum(weight(part) * mean for part, mean in means.items()) if means else math.nan
        row = {'loss': loss, **{f'{part}_loss': mean for part, mean in means.items()}}
        if 'cloning' in means:
            row['action_accuracy'] = self._right / self._sums['cloning'][1]
        if self._poses:
            table = torch.cat(self._poses)
            table = table[table[:, 9] >= 0]
            row |= pairs.errors(Pose(table[:, :2], table[:, 2:4], table[:, 4]), {
                'goal_pose': table[:, 5:9].numpy(), 'overlap': table[:, 9].numpy()})
        return row

    def baseline(self, guess: Guess) -> dict[str, float]:
        """`FIGURES` of a guess, on the same steps and pairs."""
        row = {}
        if sum(self._acted) and guess.action is not None:
            own = self._acted[guess.action] if guess.action < len(self._acted) else 0
            row['action_accuracy'] = own / sum(self._acted)
        if self._poses:
            table = torch.cat(self._poses)
            table = table[table[:, 9] >= 0]
            said = torch.from_numpy(guess.goal_pose).float().expand(len(table), 4)
            sign = torch.full((len(table),), 1.0 if guess.co_visible else -1.0)
            row |= pairs.errors(Pose(said[:, :2], said[:, 2:], sign), {
                'goal_pose': table[:, 5:9].numpy(), 'overlap': table[:, 9].numpy()})
        return row

    def state_dict(self) -> dict:
        """Plain values and tensors."""
        return {'sums': self._sums, 'right': self._right, 'acted': self._acted,
                'poses': torch.cat(self._poses) if self._poses else None}

    def load_state_dict(self, state: dict) -> None:
        """Go on where `state_dict` was taken."""
        self._sums, self._right = state['sums'], state['right']
        self._acted = state.get('acted', [])
        self._poses = [] if state['poses'] is None else [state['poses']]


class Objective:
    """The losses of a network on batches out of drives.

    Args:
        network: with a head for each part but the cloning.
        drives: what the rows of a batch belong to.
        parts: some of `PARTS`.
        window: steps of a window.
    """

    def __init__(self, network: Policy, drives: Drives, parts: Sequence[str], window: int):
        self.network, self.drives = network, drives
        self.parts, self.window = tuple(parts), window
        self.paired = any(part not in BY_WINDOW for part in parts)
        self.windowed = any(part in BY_WINDOW for part in parts)

    def losses(self, batch: Batch, tally: Tally) -> dict[str, Tensor]:
        """Losses by part; counted in the tally."""
        losses: dict[str, Tensor] = {}
        poses: list[tuple[Pose, np.ndarray, np.ndarray]] = []
        if batch.rows is not None and batch.goals is not None:
            latents = self._look_once(batch.rows, batch.goals)
            if latents.pose is not None:
                poses.append((latents.pose, batch.rows, batch.goals))
            for name in self.parts:
                if name in IMAGE_HEADS:
                    losses[name] = self._image_loss(name, latents.maps, batch, tally)
        if batch.windows is not None:
            windows = fill_windows(self.drives, batch.windows, self.window)
            latents = self._look(windows.rows, windows.goal, windows.starts, windows.last_action)
            steps = windows.valid
            rows, goals = windows.rows[steps], np.broadcast_to(windows.goal, steps.shape)[steps]
            own = self._tensor(steps.reshape(-1))
            losses |= self._memory_losses(
                latents.hidden.flatten(0, 1)[own],
                self.network.read(latents).logits.flatten(0, 1)[own], windows, rows, goals, tally)
            if latents.pose is not None:
                poses.append((Pose(*(part[own] for part in latents.pose)), rows, goals))
        if 'goal_pose' in self.parts and poses:
            losses['goal_pose'] = self._pose_loss(poses, tally)
        return losses

    def guess(self, rows: np.ndarray, goals: np.ndarray, action: np.ndarray) -> Guess:
        """The best guess by pairs [K] and by actions [M] to learn from, negative where none is."""
        poses = self.drives.label(rows, goals).goal_pose
        shown = self.drives.co_visibility(rows, goals)
        sees, known = shown >= POSE_OVERLAP, shown >= 0
        mean = poses[sees if sees.any() else slice(None)].mean(axis=0)
        counts = np.bincount(action[action >= 0])
        return Guess(int(counts.argmax()) if len(counts) else None, mean,
                     bool(sees[known].mean() > 0.5) if known.any() else False)

    def _look_once(self, rows: np.ndarray, goals: np.ndarray) -> Latents:
        """Latents of pictures [K] towards goals [K], each by itself."""
        return self._look(rows[None], goals, np.ones((1, len(rows)), bool),
                          np.full((1, len(rows)), -1))

    def _look(self, rows: np.ndarray, goals: np.ndarray, starts: np.ndarray,
              last_action: np.ndarray) -> Latents:
        """Latents of rows [T,B] towards goals [B]."""
        image = self.drives.pictures('image', rows.reshape(-1))
        seen = Observation(
            self._tensor(image).unflatten(0, rows.shape),
            self._tensor(self.drives.pictures('image', goals)),
            self._tensor(np.tile(np.arange(len(goals)), (len(rows), 1))),
            self._tensor(last_action), torch.zeros(rows.shape, device=self.network.device))
        return self.network.latents(seen, self._tensor(starts))[0]

    def _image_loss(self, name: str, maps: Tensor, batch: Batch, tally: Tally) -> Tensor:
        """Mean squared error of an image head (thesis, 4.4), over the pictures that have its key.

        A cell of a depth picture weighs by the share of its pixels whose depth is known.
        """
        network, key = self.network, NEEDS.get(name, 'image')
        rows = batch.goals if name == 'goal_segmentation' else batch.rows
        assert rows is not None  # pictures are drawn of pairs
        known = np.ones(len(rows), bool) if key == 'image' else self.drives.has[key][rows]
        count = int(known.sum())
        if not count:
            return torch.zeros((), device=network.device)
        shown = self._tensor(self.drives.pictures(key, rows[known]))
        target = image_target(network, name, shown)
        weight: Tensor | float = 1.0
        if name == 'depth':
            weight = average_pool_target((shown > 0).float().unsqueeze(1), network.target_side,
                                         network.cell)
            target = target / weight.clamp(min=1e-6)  # the mean took unknown pixels for zeros
        drawn = network.heads[name](maps[self._tensor(known)])
        loss = ((drawn - target) ** 2 * weight).mean()
        tally.add(name, loss, count)
        return loss

    def _memory_losses(self, hidden: Tensor, logits: Tensor, windows: Windows, rows: np.ndarray,
                       goals: np.ndarray, tally: Tally) -> dict[str, Tensor]:
        """Losses of what memory [K,H] and actor [K,A] say at the valid steps."""
        network, losses = self.network, {}
        if 'cloning' in self.parts:
            acts, action = (self._tensor(part[windows.valid])
                            for part in (windows.acts, windows.action))
            losses['cloning'] = masked_mean(
                F.cross_entropy(logits, action, reduction='none'), acts)
            tally.add('cloning', losses['cloning'], int(acts.sum()))
            tally.add_actions((logits.argmax(1) == action)[acts], action[acts])
        labels = self.drives.label(rows, goals)
        if 'arrival' in self.parts:
            losses['arrival'] = F.binary_cross_entropy_with_logits(
                network.heads['arrival'](hidden), self._tensor(labels.arrived).float())
            tally.add('arrival', losses['arrival'], len(rows))
        if 'distance' in self.parts:
            wanted = torch.log1p(self._tensor(labels.distance).clamp(0, FAR))
            losses['distance'] = F.smooth_l1_loss(network.heads['distance'](hidden), wanted)
            tally.add('distance', losses['distance'], len(rows))
        return losses

    def _pose_loss(self, poses: list[tuple[Pose, np.ndarray, np.ndarray]], tally: Tally) -> Tensor:
        """Of all pairs of a batch that have a label, those of windows included."""
        said = Pose(*(torch.cat(part) for part in zip(*(p for p, *_ in poses), strict=True)))
        rows, goals = (np.concatenate([entry[k] for entry in poses]) for k in (1, 2))
        truth = self._tensor(self.drives.label(rows, goals).goal_pose)
        overlap = self._tensor(self.drives.co_visibility(rows, goals))
        known = overlap >= 0
        loss = pose_loss(*said, truth, overlap, known)
        tally.add('goal_pose', loss, int(known.sum()))
        tally.add_poses(said, truth, overlap)
        return loss

    def _tensor(self, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(rows)).to(self.network.device)
