"""Pictures of the views that show goals, and what a robot sees of them from where it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vn_nav.co_visibility import GRID, co_visible, lift, relative_pose
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.navigation.tasks import View
from vn_sim_bridge.simulator import Simulator

BATCH = 256  # pictures drawn at a time: few need little memory


class GoalViews:
    """The pictures of all views, each in some lights of its own; the last one is plain grey.

    Picture number view * variants + variant shows a view in one of its lights.

    Args:
        simulator: draws the pictures.
        views: where goals are seen from.
        variants: lights of each view.
        size: side of the pictures [pixels].
        seed: of the lights.
        label_type: of the segmentations' class ids.
        with_points: also keep where the pictures' points lie, which `co_visibility` compares.

    Attributes:
        features: [G,F] frozen features, zeros for the grey one; None: the simulator knows none.
    """

    def __init__(self, simulator: Simulator, views: Sequence[View], *, variants: int, size: int,
                 seed: int, label_type: np.dtype, with_points: bool):
        self._simulator, self.variants = simulator, variants
        self.poses = np.array([view.pose for view in views]).reshape(-1, 4)
        self.names = (*(view.name for view in views), 'nothing')
        self.blank = count = len(views) * variants
        self.pictures = np.full((count + 1, 3, size, size), 128, np.uint8)
        self.segmentation = np.zeros((count + 1, size, size), label_type)
        with_points = with_points and simulator.capabilities.depth
        self._points = np.full((count + 1 if with_points else 0, GRID * GRID, 3), np.nan,
                               np.float32)
        for first in range(0, count, BATCH):
            part = slice(first, min(first + BATCH, count))
            view, variant = np.divmod(np.arange(part.start, part.stop), variants)
            poses = self.poses[view]
            appearance = simulator.appearance(seed, Stream.GOAL_APPEARANCE, view, variant)
            frames = simulator.view(
                np.array([views[k].place for k in view]), poses, None, appearance,
                key(seed, Stream.GOAL_APPEARANCE, view, variant, 99),
                [views[k].objects for k in view])
            self.pictures[part], self.segmentation[part] = frames.rgb, frames.labels
            if with_points:
                self._points[part] = lift(frames.depth, *simulator.cameras(poses, appearance))
        self.features = self._frozen_features(views) if simulator.feature_size else None

    def _frozen_features(self, views: Sequence[View]) -> np.ndarray:
        rows = self._simulator.features(np.array([view.place for view in views]), self.poses)
        return np.concatenate([np.repeat(rows, self.variants, axis=0),
                               np.zeros((1, rows.shape[1]), np.float32)])

    def relative_poses(self, picture: np.ndarray) -> np.ndarray:
        """The views of pictures [N] as the robots see them, [N,4] float32; zeros without views."""
        if not len(self.poses):
            return np.zeros((len(picture), 4), np.float32)
        # From where the robot's own picture was taken: a little beside it in some simulators.
        return relative_pose(self._simulator.seen_from, self.poses[picture // self.variants])

    def co_visibility(self, picture: np.ndarray, shown: np.ndarray, depth: np.ndarray
                      ) -> np.ndarray:
        """The share of what pictures [N] show that the robots' pictures show too, [N] float32.

        Args:
            picture: [N] of the true goals.
            shown: [N] what the robots are given: 0 is the share of a blank one.
            depth: [N,H,W] of the robots' pictures [m].
        """
        if not len(self.poses):
            return np.zeros(len(picture), np.float32)
        if not self._simulator.capabilities.depth:
            shares = self._simulator.co_visibility(self.poses[picture // self.variants])
            return np.where(shown == self.blank, np.float32(0), shares)
        # The grey picture has no points.
        compared = np.where(shown == self.blank, self.blank, picture)
        return co_visible(self._points[compared], depth, *self._simulator.cameras())
