"""The renderer on a Warp device (`vn_nav[gpu]`): the same pictures as `rasterizer.py`, on a GPU.

Three launches: polygons into a visibility buffer (`warp_visibility`), shading (`warp_shading`) and
the sensor (`warp_sensor`). All outputs stay on the device; `wp.to_torch` shares them with PyTorch
without a copy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from vn_sim_bridge.render.pack import pack_scenes
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.render.shading import BLOCK
from vn_sim_bridge.render.warp_sensor import expose
from vn_sim_bridge.render.warp_shading import shade
from vn_sim_bridge.render.warp_visibility import BAND, DevicePack, draw_objects, draw_scenes


class WarpRenderer:
    """Renders N cameras on a Warp device.

    Args:
        scenes: the scenes; cameras refer to them by index.
        size: side of the square pictures [pixels].
        count: N, fixed: all buffers are made once.
        objects: most movable objects a camera.
        device: Warp device, such as 'cuda:0' or 'cpu'.
    """

    def __init__(self, scenes: Sequence[Scene], size: int, count: int, *, objects: int = 0,
                 device: str = 'cuda:0'):
        self.size, self.count, self.objects, self.device = size, count, objects, device
        host = pack_scenes(scenes)
        self.rooms = 1 + int(host.face_room.max())
        self.most_faces = max(len(scene.face_label) for scene in scenes)
        self.most_groups = max(len(scene.group_room) for scene in scenes)
        self.pack = DevicePack()
        for name in host._fields:
            if hasattr(self.pack, name):
                setattr(self.pack, name, wp.array(getattr(host, name), device=device))
        shape = (count, size, size)

        def empty(dtype, shape):
            return wp.zeros(shape, dtype=dtype, device=device)
        self._visible = empty(wp.uint64, shape)
        self._raw = empty(wp.uint8, (count, 3, size, size))
        self.rgb = empty(wp.uint8, (count, 3, size, size))
        self.depth = empty(wp.float32, shape)
        self.labels = empty(wp.uint8, shape)
        self.instances = empty(wp.uint16, shape)

    def render(self, scene_index: wp.array, cameras: wp.array, focal: wp.array, cube: wp.array,
               lamps: wp.array, *, object_scene: wp.array, object_pose: wp.array,
               object_room: wp.array, noise: wp.array | None = None,
               blur: wp.array | None = None, keys: wp.array | None = None) -> None:
        """Draw every camera into `rgb`, `depth`, `labels` and `instances`.

        Args:
            scene_index: [N] int64; cameras: [N,5] float64; focal: [N] float64 pixels.
            cube, lamps: as in `pack.Lights`.
            object_scene, object_pose, object_room: as in `Objects`.
            noise, blur, keys: [N], as in `sensor.expose`; all or none.
        """
        count, size = self.count, self.size
        bands, blocks = -(-size // BAND), -(-size // BLOCK)
        self._visible.zero_()
        wp.launch(draw_scenes, (count, self.most_groups, bands), [
            self.pack, scene_index, cameras, focal, size, self._visible], device=self.device)
        if self.objects:
            wp.launch(draw_objects, (count, self.objects, bands), [
                self.pack, object_scene, object_pose, cameras, focal, size, self.most_faces,
                self._visible], device=self.device)
        target = self.rgb if noise is None else self._raw
        wp.launch(shade, (count, size, blocks), [
            self.pack, scene_index, cameras, focal, cube, lamps, object_scene, object_pose,
            object_room, size, self.most_faces, self._visible, target, self.depth, self.labels,
            self.instances], device=self.device)
        if noise is not None:
            wp.launch(expose, (count, 3, size), [self._raw, noise, blur, keys, self.rgb],
                      device=self.device)

    def render_arrays(self, scene_index: np.ndarray, cameras: np.ndarray, fov, lights, objects,
                      noise=None, blur=None, keys=None):
        """As `rasterizer.Rasterizer.render`, from NumPy to NumPy: for tests and comparisons."""
        def put(values, dtype):
            return wp.array(np.ascontiguousarray(values, dtype), device=self.device)
        focal = np.broadcast_to(self.size / 2 / np.tan(np.asarray(fov, float) / 2), (self.count,))
        effects = {} if noise is None else {
            'noise': put(noise, np.float32), 'blur': put(blur, np.float32),
            'keys': put(keys, np.uint64)}
        self.render(put(scene_index, np.int64), put(cameras, np.float64), put(focal, np.float64),
                    put(lights.cube, np.float32), put(lights.lamps, np.float32),
                    object_scene=put(objects.scene, np.int64),
                    object_pose=put(objects.pose, np.float64),
                    object_room=put(objects.room, np.int64), **effects)
        return tuple(part.numpy() for part in (self.rgb, self.depth, self.labels, self.instances))
