"""What the renderers read: several scenes as one set of arrays, lights, movable objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.render.scene import MAX_CORNERS, Scene

CLUSTER = 16  # groups whose common box is tested first
EMPTY = np.int32(2**31 - 1)  # index of the polygon where there is none
# Light by the direction that a surface faces: +x, -x, +y, -y, up, down. Six different values let a
# viewer, and a network, tell walls apart.
FACING = np.array([0.98, 0.76, 0.88, 0.68, 1.0, 0.84], np.float32)


class Lights(NamedTuple):
    """How N cameras' scenes are lit; linear factors, exposure included."""

    cube: np.ndarray  # [N,6,3] float32: ambient light on surfaces facing +x, -x, +y, -y, up, down
    lamps: np.ndarray  # [N,R,3] float32: the lamp of each room


class Pack(NamedTuple):
    """The arrays of several scenes, concatenated (see `Scene`)."""

    vertices: np.ndarray
    face_start: np.ndarray
    face_vertices: np.ndarray
    face_plane: np.ndarray
    face_uv: np.ndarray
    face_texture: np.ndarray  # [F,2] int32: first texel, side
    face_colour: np.ndarray
    face_label: np.ndarray
    face_instance: np.ndarray
    face_light: np.ndarray
    face_light_map: np.ndarray
    face_room: np.ndarray  # [F] int32
    light: np.ndarray
    group_start: np.ndarray
    group_box: np.ndarray
    scene_group: np.ndarray  # [scenes+1] int64 into groups
    cluster_box: np.ndarray  # [C,6] float32, around `CLUSTER` groups
    scene_cluster: np.ndarray  # [scenes+1] int64 into clusters
    texels: np.ndarray


def standard_lights(count: int, rooms: int) -> Lights:
    """Daylight and every lamp on, the same for N cameras."""
    cube = np.repeat((0.62 * FACING)[None, :, None], count, axis=0)
    return Lights(np.ascontiguousarray(np.repeat(cube, 3, axis=2), np.float32),
                  np.full((count, rooms, 3), 0.5, np.float32))


def pack_scenes(scenes: Sequence[Scene], label_type: np.dtype | type = np.uint8) -> Pack:
    """Concatenate the scenes' arrays; textures that several scenes share are kept once.

    Raises:
        UserError: a polygon with too many corners, more polygons than an index can count, or a
            class that the type of labels cannot count.
    """
    for scene in scenes:
        if int(np.diff(scene.face_start).max()) > MAX_CORNERS:
            raise UserError(f'a polygon has at most {MAX_CORNERS} corners',
                            int(np.diff(scene.face_start).max()), 'split it')
    most = max((int(scene.face_label.max(initial=0)) for scene in scenes), default=0)
    if most > np.iinfo(label_type).max:
        raise UserError(f'class ids of a {np.dtype(label_type)} are at most '
                        f'{np.iinfo(label_type).max}', most, 'draw with 16-bit labels')
    vertex_base = np.cumsum([0] + [len(s.vertices) for s in scenes])
    face_base = np.cumsum([0] + [len(s.face_label) for s in scenes])
    corner_base = np.cumsum([0] + [len(s.face_vertices) for s in scenes])
    group_base = np.cumsum([0] + [len(s.group_room) for s in scenes])
    light_base = np.cumsum([0] + [len(s.light) for s in scenes])
    if face_base[-1] >= EMPTY // 4:
        raise UserError(f'all scenes together have less than {EMPTY // 4} polygons',
                        int(face_base[-1]), 'load fewer scenes at a time')
    sets = list({id(s.textures): s.textures for s in scenes}.values())
    texel_base = dict(zip(map(id, sets), np.cumsum([0] + [len(t.texels) for t in sets]),
                          strict=False))

    def join(parts, dtype):
        return np.ascontiguousarray(np.concatenate(list(parts)), dtype)

    def texture(scene):
        start = np.array(scene.textures.start[:-1]) + texel_base[id(scene.textures)]
        side = np.array(scene.textures.side)
        return np.stack([start[scene.face_texture], side[scene.face_texture]], axis=1)

    return Pack(
        vertices=join((s.vertices for s in scenes), np.float32),
        face_start=join([*(s.face_start[:-1] + corner_base[i] for i, s in enumerate(scenes)),
                         corner_base[-1:]], np.int32),
        face_vertices=join((s.face_vertices + vertex_base[i] for i, s in enumerate(scenes)),
                           np.int32),
        face_plane=join((s.face_plane for s in scenes), np.float32),
        face_uv=join((s.face_uv for s in scenes), np.float32),
        face_texture=join(map(texture, scenes), np.int32),
        face_colour=join((s.face_colour for s in scenes), np.float32),
        face_label=join((s.face_label for s in scenes), label_type),
        face_instance=join((s.face_instance for s in scenes), np.uint16),
        face_light=join((s.face_light + (light_base[i], 0) for i, s in enumerate(scenes)),
                        np.int32),
        face_light_map=join((s.face_light_map for s in scenes), np.float32),
        face_room=join((np.repeat(s.group_room, np.diff(s.group_start)) for s in scenes),
                       np.int32),
        light=join((s.light for s in scenes), np.uint64),
        group_start=join([*(s.group_start[:-1] + face_base[i] for i, s in enumerate(scenes)),
                          face_base[-1:]], np.int32),
        group_box=join((s.group_box for s in scenes), np.float32),
        scene_group=group_base.astype(np.int64),
        texels=join((t.texels for t in sets), np.uint32),
        cluster_box=join((_clusters(s.group_box) for s in scenes), np.float32),
        scene_cluster=np.cumsum([0] + [-(-len(s.group_room) // CLUSTER) for s in scenes]),
    )


def _clusters(boxes: np.ndarray) -> np.ndarray:
    first = np.arange(0, len(boxes), CLUSTER)
    return np.concatenate([np.minimum.reduceat(boxes[:, :3], first),
                           np.maximum.reduceat(boxes[:, 3:], first)], axis=1)
