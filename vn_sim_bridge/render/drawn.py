"""What simulators share whose pictures our renderer draws: light, camera, objects, exposure."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import numpy as np

from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.render.randomisation import Appearance, Randomisation, draw_appearance
from vn_sim_bridge.render.sensor import expose
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Objects,
    Placed,
    no_objects,
)


class DrawnSimulator(BaseSimulator):
    """N robots in scenes of triangles, with objects that can be put into them.

    A subclass sets `robot`, `poses`, `place_index` and `num_envs` and calls `_set_up`; it writes
    `move`, `reach`, `_lamps`, `_render`, and `_first_model` and `_room_index` where it has to.
    """

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True, tilt=True,
                                rooms=True, walls=True, placeable_objects=True, appearance=True,
                                other_goals=True)

    def _set_up(self, randomisation: Randomisation | None, objects: int,
                goal_randomisation: Randomisation | None = None) -> None:
        """Stand in standard light, without objects.

        Args:
            randomisation: what `apply_appearance` draws from; None: nothing varies.
            objects: most at a time.
            goal_randomisation: of goal pictures; None: the same.
        """
        self.randomisation = randomisation or Randomisation()
        self.goal_randomisation = goal_randomisation or self.randomisation
        self.objects = no_objects(self.num_envs, objects)
        self._all = np.arange(self.num_envs)
        self._frames: Frames | None = None
        self._appearance = self.appearance(0, Stream.APPEARANCE, self._all, 0 * self._all)

    @property
    @abc.abstractmethod
    def _lamps(self) -> int:
        """How many rooms have lamps of their own."""

    @property
    def _first_model(self) -> int:
        """Number of the first object's scene: those of places come before it."""
        return 1

    def _room_index(self, place_index: int, x: float, y: float) -> int:
        """The room whose lamp shines on a point [m] of a place."""
        return 0

    @abc.abstractmethod
    def _render(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None,
                appearance: Appearance, objects: Objects | None) -> Frames:
        """Pictures from poses [K,4] in places [K], as they are before the camera's faults."""

    def appearance(self, seed: int | np.ndarray, stream: Stream, env, episode) -> Appearance:
        """Light and camera of some episodes, or of some goal pictures."""
        varied = (self.goal_randomisation if stream == Stream.GOAL_APPEARANCE
                  else self.randomisation)
        return draw_appearance(varied, self._lamps, seed, stream, env, episode)

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env, episode) -> None:
        """Draw light and camera of robots [K] anew, by the counters [K] of their episodes."""
        drawn = self.appearance(seed, stream, env, episode)
        for part, rows in zip(self._appearance, drawn, strict=True):
            part[env_ids] = rows

    def set_objects(self, env_id: int, placed: Sequence[Placed]) -> None:
        """Put these objects, and no others, about one robot."""
        self._stand(self.objects, env_id, int(self.place_index[env_id]), placed)

    def _stand(self, objects: Objects, row: int, place_index: int, placed: Sequence[Placed]
               ) -> None:
        objects.scene[row] = -1
        for m, item in enumerate(placed):
            objects.scene[row, m] = self._first_model + item.model
            objects.pose[row, m] = item.x, item.y, 0.0, item.yaw
            objects.room[row, m] = self._room_index(place_index, item.x, item.y)

    def object_models(self) -> np.ndarray:
        """[N,M] int64: which model each object is; -1: absent."""
        return np.where(self.objects.scene >= 0, self.objects.scene - self._first_model, -1)

    def observe(self, env_ids: np.ndarray | None = None,
                keys: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras. All robots: one buffer, valid until the next call.

        Args:
            env_ids: [K] which robots; default all.
            keys: [K] uint64, of the sensor's noise; default: one noise for every call.
        """
        if env_ids is None:
            self._frames = self._draw(self.place_index, self.poses, self._frames,
                                      self._appearance, keys, self.objects)
            return self._frames
        return self._draw(self.place_index[env_ids], self.poses[env_ids], None,
                          Appearance(*(part[env_ids] for part in self._appearance)), keys,
                          Objects(*(part[env_ids] for part in self.objects)))

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Appearance | None = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """Pictures from any poses [K,4] in places [K]; by default in standard light.

        Args:
            out: buffers to fill; keys: as in `observe`.
            appearance: light and camera of each picture.
            placed: the objects in each picture; default none.
        """
        place_index, poses = np.asarray(place_index), np.asarray(poses, float)
        if appearance is None:
            appearance = draw_appearance(Randomisation(), self._lamps, 0, Stream.APPEARANCE,
                                         np.arange(len(poses)), 0)
        objects = None
        if placed is not None:
            objects = no_objects(len(poses), max(map(len, placed)))
            for k, items in enumerate(placed):
                self._stand(objects, k, int(place_index[k]), items)
        return self._draw(place_index, poses, out, appearance, keys, objects)

    def cameras(self, poses: np.ndarray | None = None, appearance: Appearance | None = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Where cameras are and look, [K,5] as `Rasterizer.render` takes them, and their fov [K].

        Args:
            poses: [K,4] of the robots that hold them; default: the robots as they stand now.
            appearance: of each picture; default: that of the robots' episodes.
        """
        robot = self.robot
        poses = self.poses if poses is None else poses
        appearance = appearance or self._appearance
        cameras = np.column_stack([poses[:, :2], robot.camera_height + appearance.height,
                                   poses[:, 2],
                                   poses[:, 3] + robot.camera_pitch + appearance.pitch])
        return cameras, robot.camera_fov + appearance.fov

    def _draw(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None,
              appearance: Appearance, keys: np.ndarray | None, objects: Objects | None) -> Frames:
        frames = self._render(place_index, poses, out, appearance, objects)
        if appearance.noise.any() or appearance.blur.any():
            if keys is None:
                keys = np.arange(len(poses)).astype(np.uint64)
            expose(frames.rgb, appearance.noise, appearance.blur, keys)
        return frames
