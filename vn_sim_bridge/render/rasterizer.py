"""Draws scenes on the CPU: RGB, metric depth, class and instance labels from one pass.

For each camera `visibility` finds the polygon that each pixel shows; `shading` then computes every
pixel once, run by run of the same polygon.

The Warp kernels in `warp_visibility.py` and `warp_shading.py` follow the same arithmetic in the
same order.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Sequence

import numba
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.render import shading, visibility
from vn_sim_bridge.render.pack import EMPTY, Lights, pack_scenes, standard_lights
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.render.shading import shade
from vn_sim_bridge.render.visibility import (
    MAX_SIZE,
    camera_frame,
    exact,
    exact_parallel,
    fill_visibility,
    object_frame,
    visibility_workspace,
)
from vn_sim_bridge.simulator import Objects, no_objects


class Rasterizer:
    """Renders N cameras, each in one of several scenes.

    Args:
        scenes: the scenes; cameras refer to them by index.
        size: side of the square pictures [pixels].
        threads: Numba threads used by `render`.
        label_type: of the class ids, uint8 or uint16.
    """

    def __init__(self, scenes: Sequence[Scene], size: int, *, threads: int = 1,
                 label_type: np.dtype | type = np.uint8):
        if not 1 <= size <= MAX_SIZE:
            raise UserError(f'pictures have 1 to {MAX_SIZE} pixels a side', size, 'choose fewer')
        self.size = size
        self.threads = threads
        self.label_type = np.dtype(label_type)
        self.pack = pack_scenes(scenes, self.label_type)
        self.rooms = 1 + int(self.pack.face_room.max())
        self.most_faces = max(len(scene.face_label) for scene in scenes)
        self.most_groups = max(len(scene.group_room) for scene in scenes)

    def render(self, scene_index: np.ndarray, cameras: np.ndarray, fov,
               out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None, *,
               lights: Lights | None = None, objects: Objects | None = None):
        """Draw every camera.

        Args:
            scene_index: [N] int64.
            cameras: [N,5] float64: x, y, z [m], yaw (left), pitch (down) [rad] in the map frame.
            fov: horizontal and vertical field of view [rad], one or [N].
            out: buffers to fill instead of allocating, as returned.
            lights: default `standard_lights`; objects: default none.

        Returns:
            rgb [N,3,S,S] uint8, depth [N,S,S] float32 m along the optical axis (0 where nothing
            is seen), labels [N,S,S] of `label_type`, instances [N,S,S] uint16 (object m:
            65535 - m).
        """
        count, size = len(cameras), self.size
        if out is None:
            out = (np.empty((count, 3, size, size), np.uint8),
                   np.empty((count, size, size), np.float32),
                   np.empty((count, size, size), self.label_type),
                   np.empty((count, size, size), np.uint16))
        # One type for every call: the kernels are compiled once, and a robot never waits for it.
        lights = Lights(*(np.ascontiguousarray(part, np.float32) for part in (
            lights or standard_lights(count, self.rooms))))
        objects = objects or no_objects(count)
        objects = Objects(np.ascontiguousarray(objects.scene, np.int64),
                          np.ascontiguousarray(objects.pose, np.float64),
                          np.ascontiguousarray(objects.room, np.int64))
        focal = np.broadcast_to(size / 2 / np.tan(np.asarray(fov, float) / 2), (count,))
        arguments = (self.pack, np.ascontiguousarray(scene_index, np.int64),
                     np.ascontiguousarray(cameras, np.float64), np.ascontiguousarray(focal),
                     lights, objects, self.most_faces, self.most_groups, tuple(out))
        if self.threads == 1:  # without a thread pool, which a busy or forked process is glad of
            _draw(0, count, *arguments)
            return out
        before = numba.get_num_threads()
        # Numba fills its configuration when it is imported.
        most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        threads = min(self.threads, most)
        numba.set_num_threads(threads)
        _draw_in_parallel(threads, count, *arguments)
        numba.set_num_threads(before)
        return out


# Numba compiles the functions that a function calls into it, but its cache on disk notices changes
# only in the file of the function itself. So the functions below hold a digest of the other files:
# what a function holds is part of the cache's key.
_CALLED_FILES = hashlib.sha256(
    (inspect.getsource(shading) + inspect.getsource(visibility)).encode()).hexdigest()


def _make_draw(called_files: str) -> Callable:
    """The function that draws cameras `begin` to `end`."""

    @exact
    def draw(begin, end, pack, scene_index, cameras, focal, lights, objects, most_faces,
             most_groups, out):
        called_files  # noqa: B018  # held for the cache's key
        rgb, depth, labels, instances = out
        size = depth.shape[1]
        count = objects.scene.shape[1]
        # One slot for each pixel at most, and one entry for each polygon that can be drawn: these
        # buffers cannot overflow.
        idents = (count + 1) * most_faces
        work = visibility_workspace(size, most_groups)
        slots = np.empty((min(idents, size * size), 16), np.float32)
        slot_of = np.empty(idents, np.int32)
        code_of = np.empty(idents + 1, np.int32)
        stamp_of = np.zeros(idents, np.int32)
        codes = np.empty(size, np.int32)
        frames = np.empty((count + 1, 12))
        inverse_depth = np.empty((size, size), np.float32)
        ident_of_pixel = np.empty((size, size), np.int32)
        for n in range(begin, end):
            inverse_depth[:] = np.float32(0.0)
            ident_of_pixel[:] = EMPTY
            camera_frame(cameras[n], frames[0])
            for m in range(count):
                object_frame(frames[0], objects.pose[n, m], frames[m + 1])
            fill_visibility(pack, scene_index[n], frames, objects.scene[n], focal[n], size,
                            most_faces, work, inverse_depth, ident_of_pixel)
            shade(pack, scene_index[n], frames, objects.scene[n], objects.room[n],
                  lights.cube[n], lights.lamps[n], focal[n], most_faces,
                  (slots, slot_of, code_of, stamp_of, np.int32(n - begin + 1), codes),
                  inverse_depth, ident_of_pixel, rgb[n], depth[n], labels[n], instances[n])
    return draw


def _make_draw_in_parallel(called_files: str) -> Callable:
    """The function that draws all cameras, in some ranges for each thread."""

    @exact_parallel
    def draw_in_parallel(threads, count, pack, scene_index, cameras, focal, lights, objects,
                         most_faces, most_groups, out):
        called_files  # noqa: B018  # held for the cache's key
        chunks = min(count, threads * 4)
        for chunk in numba.prange(chunks):
            _draw(count * chunk // chunks, count * (chunk + 1) // chunks, pack, scene_index,
                  cameras, focal, lights, objects, most_faces, most_groups, out)
    return draw_in_parallel


_draw = _make_draw(_CALLED_FILES)
_draw_in_parallel = _make_draw_in_parallel(_CALLED_FILES)
