"""Pictures of the views that show goals, and what a robot sees of them from where it is."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from vn_nav.arrival import arrived, heading_error
from vn_nav.co_visibility import GRID, co_visible, lift, relative_pose
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.navigation.tasks import View
from vn_sim_bridge.simulator import Frames, Simulator

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
        with_points: also keep where the pictures' points lie, which `co_visibility` compares;
            else the pictures are drawn once more when it is asked.

    Attributes:
        features: [G,F] frozen features, zeros for the grey one; None: the simulator knows none.
    """

    def __init__(self, simulator: Simulator, views: Sequence[View], *, variants: int, size: int,
                 seed: int, label_type: np.dtype, with_points: bool):
        self._simulator, self._views, self.variants = simulator, views, variants
        self._seed = seed
        self._places = np.array([view.place for view in views], np.int64)
        self.poses = np.array([view.pose for view in views]).reshape(-1, 4)
        self.names = (*(view.name for view in views), 'nothing')
        self.blank = count = len(views) * variants
        self.pictures = np.full((count + 1, 3, size, size), 128, np.uint8)
        self.segmentation = np.zeros((count + 1, size, size), label_type)
        self._points: np.ndarray | None = None
        if with_points and simulator.capabilities.depth:
            self._points = self._no_points()
        for part, frames, cameras in self._draw():
            self.pictures[part], self.segmentation[part] = frames.rgb, frames.labels
            if self._points is not None:
                self._points[part] = lift(frames.depth, *cameras())
        self.features = self._frozen_features() if simulator.feature_size else None

    def _draw(self) -> Iterator[tuple[slice, Frames, Callable]]:
        """Which pictures, what they show, and what tells their cameras; some at a time."""
        simulator, seed = self._simulator, self._seed
        for first in range(0, self.blank, BATCH):
            part = slice(first, min(first + BATCH, self.blank))
            view, variant = np.divmod(np.arange(part.start, part.stop), self.variants)
            appearance = simulator.appearance(seed, Stream.GOAL_APPEARANCE, view, variant)
            frames = simulator.view(
                self._places[view], self.poses[view], None, appearance,
                key(seed, Stream.GOAL_APPEARANCE, view, variant, 99),
                [self._views[k].objects for k in view])
            yield part, frames, functools.partial(simulator.cameras, self.poses[view], appearance)

    def _no_points(self) -> np.ndarray:
        return np.full((self.blank + 1, GRID * GRID, 3), np.nan, np.float32)

    def _frozen_features(self) -> np.ndarray:
        rows = self._simulator.features(self._places, self.poses)
        return np.concatenate([np.repeat(rows, self.variants, axis=0),
                               np.zeros((1, rows.shape[1]), np.float32)])

    def other_shown(self, shown: np.ndarray, goal: np.ndarray, place_index: np.ndarray,
                    poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of robots that are shown another picture than their goal's, and where they stand.

        Args:
            shown: [N] pictures; goal: [N] views of the true goals; place_index: [N].
            poses: [N,4] of the robots.

        Returns:
            [N] bool: the picture is of another view. [N] bool: and the robot stands where that was
            taken, as the crow flies.
        """
        view = shown // self.variants
        other = (shown != self.blank) & (view != goal)
        at = np.zeros(len(shown), bool)
        if other.any():
            own = self.poses[view[other]]
            gap = np.hypot(*(poses[other, :2] - own[:, :2]).T)
            at[other] = arrived(gap, heading_error(poses[other, 2], own[:, 2])) & (
                self._places[view[other]] == place_index[other])
        return other, at

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
        if self._points is None:
            self._points = self._no_points()
            for part, frames, cameras in self._draw():
                self._points[part] = lift(frames.depth, *cameras())
        # The grey picture has no points.
        compared = np.where(shown == self.blank, self.blank, picture)
        return co_visible(self._points[compared], depth, *self._simulator.cameras())
