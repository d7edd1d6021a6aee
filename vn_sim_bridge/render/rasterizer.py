"""Draws scenes on the CPU: RGB, metric depth, class and instance labels from one pass.

Per environment: groups are culled by bounding sphere, front faces are near-clipped and projected,
convex polygons are scan-converted row by row into a visibility buffer (face and inverse depth),
then each pixel is shaded once from its winning face. Inverse depth and texture coordinates come
from the face's plane equation, so they are perspective-correct at every pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_sim_bridge.houses.textures import texture_library
from vn_sim_bridge.scene import MIP_LEVELS, TEXTURE_SIZE, Scene

NEAR = 0.03  # m, near plane
MAX_POLYGON = 16  # vertices of a polygon after near clipping

_LEVEL_OFFSET = np.cumsum([0] + [(TEXTURE_SIZE >> i) ** 2 for i in range(MIP_LEVELS)])[:-1]
_LEVEL_OFFSET = _LEVEL_OFFSET.astype(np.int64)


class Rasterizer:
    """Renders N cameras, each in one of several scenes.

    Args:
        scenes: the scenes; cameras refer to them by index.
        size: side of the square pictures [pixels].
        threads: Numba threads used by `render`.
    """

    def __init__(self, scenes: Sequence[Scene], size: int, *, threads: int = 1):
        self.size = size
        self.threads = threads
        self._pack = _pack(scenes)
        for scene in scenes:
            if int(np.diff(scene.face_start).max()) + 1 > MAX_POLYGON:
                raise ValueError(f'a polygon has at most {MAX_POLYGON - 1} vertices; split it')

    def render(self, scene_index: np.ndarray, cameras: np.ndarray, fov: float,
               out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None):
        """Draw every camera.

        Args:
            scene_index: [N] int64.
            cameras: [N,5] float64: x, y, z [m], yaw (left), pitch (down) [rad] in the map frame.
            fov: horizontal and vertical field of view [rad].
            out: buffers to fill instead of allocating, as returned.

        Returns:
            rgb [N,3,S,S] uint8, depth [N,S,S] float32 m along the optical axis (0 where nothing
            is seen), labels [N,S,S] uint8, instances [N,S,S] uint16.
        """
        count, size = len(cameras), self.size
        if out is None:
            out = (np.empty((count, 3, size, size), np.uint8),
                   np.empty((count, size, size), np.float32),
                   np.empty((count, size, size), np.uint8),
                   np.empty((count, size, size), np.uint16))
        before = numba.get_num_threads()
        numba.set_num_threads(min(self.threads, numba.config.NUMBA_NUM_THREADS))
        kernel = _render_parallel if self.threads > 1 else _render_serial
        kernel(*self._pack, np.ascontiguousarray(scene_index, np.int64),
               np.ascontiguousarray(cameras, np.float64), size / 2 / math.tan(fov / 2), *out)
        numba.set_num_threads(before)
        return out


def _pack(scenes: Sequence[Scene]) -> tuple:
    """Concatenate the scenes' arrays, with each scene's first group and first face."""
    vertex_base = np.cumsum([0] + [len(s.vertices) for s in scenes])
    face_base = np.cumsum([0] + [len(s.face_label) for s in scenes])
    corner_base = np.cumsum([0] + [len(s.face_vertices) for s in scenes])
    group_base = np.cumsum([0] + [len(s.group_sphere) for s in scenes])
    face_start = [s.face_start[:-1] + corner_base[i] for i, s in enumerate(scenes)]
    group_start = [s.group_start[:-1] + face_base[i] for i, s in enumerate(scenes)]

    def join(parts, dtype):
        return np.ascontiguousarray(np.concatenate(parts), dtype)

    return (
        join([s.vertices for s in scenes], np.float32),
        join([*face_start, corner_base[-1:]], np.int64),
        join([s.face_vertices + vertex_base[i] for i, s in enumerate(scenes)], np.int64),
        join([s.face_plane for s in scenes], np.float32),
        join([s.face_uv for s in scenes], np.float32),
        join([s.face_texture for s in scenes], np.int32),
        join([s.face_colour for s in scenes], np.float32),
        join([s.face_label for s in scenes], np.uint8),
        join([s.face_instance for s in scenes], np.uint16),
        join([*group_start, face_base[-1:]], np.int64),
        join([s.group_sphere for s in scenes], np.float32),
        group_base.astype(np.int64),
        int(max(len(s.face_label) for s in scenes)),
        texture_library(),
    )


@numba.njit(cache=True, fastmath=True, error_model='numpy')
def _visible_faces(vertices, face_start, face_vertices, face_plane, face_uv, group_start,
                   group_sphere, first_group, last_group, camera, focal, size, slots,
                   slot_face, inverse_depth, slot_of_pixel):
    """Fill the visibility buffer; returns the number of drawn faces ("slots")."""
    px, py, pz = camera[0], camera[1], camera[2]
    cy, sy = math.cos(camera[3]), math.sin(camera[3])
    cp, sp = math.cos(camera[4]), math.sin(camera[4])
    # Camera axes in the map frame: forward, right, down.
    fx, fy, fz = cp * cy, cp * sy, -sp
    rx, ry = sy, -cy
    dx, dy, dz = -sp * cy, -sp * sy, -cp
    half = size * 0.5
    slope = half / focal  # tangent of half the field of view
    norm = math.sqrt(1.0 + slope * slope)
    polygon = np.empty((MAX_POLYGON, 3), np.float32)
    clipped = np.empty((MAX_POLYGON, 3), np.float32)
    left = np.empty(size, np.float32)
    right = np.empty(size, np.float32)
    used = 0
    for group in range(first_group, last_group):
        gx = group_sphere[group, 0] - px
        gy = group_sphere[group, 1] - py
        gz = group_sphere[group, 2] - pz
        radius = group_sphere[group, 3]
        forward = gx * fx + gy * fy + gz * fz
        if forward + radius < NEAR:
            continue
        reach = forward * slope + radius * norm
        if abs(gx * rx + gy * ry) > reach or abs(gx * dx + gy * dy + gz * dz) > reach:
            continue
        for face in range(group_start[group], group_start[group + 1]):
            nx, ny, nz = face_plane[face, 0], face_plane[face, 1], face_plane[face, 2]
            height = nx * px + ny * py + nz * pz - face_plane[face, 3]
            if height <= 1e-6:
                continue  # the camera sees its back
            count = 0
            behind = 0
            for corner in range(face_start[face], face_start[face + 1]):
                vertex = face_vertices[corner]
                x = vertices[vertex, 0] - px
                y = vertices[vertex, 1] - py
                z = vertices[vertex, 2] - pz
                depth = x * fx + y * fy + z * fz
                polygon[count, 0] = x * rx + y * ry
                polygon[count, 1] = x * dx + y * dy + z * dz
                polygon[count, 2] = depth
                count += 1
                if depth < NEAR:
                    behind += 1
            if behind == count:
                continue
            points = polygon
            if behind > 0:
                kept = 0
                for i in range(count):
                    j = i + 1 if i + 1 < count else 0
                    zi, zj = polygon[i, 2], polygon[j, 2]
                    if zi >= NEAR:
                        for axis in range(3):
                            clipped[kept, axis] = polygon[i, axis]
                        kept += 1
                    if (zi >= NEAR) != (zj >= NEAR):
                        t = (NEAR - zi) / (zj - zi)
                        clipped[kept, 0] = polygon[i, 0] + t * (polygon[j, 0] - polygon[i, 0])
                        clipped[kept, 1] = polygon[i, 1] + t * (polygon[j, 1] - polygon[i, 1])
                        clipped[kept, 2] = NEAR
                        kept += 1
                points = clipped
                count = kept
            low_x = np.float32(1e30)
            high_x = np.float32(-1e30)
            low_y = np.float32(1e30)
            high_y = np.float32(-1e30)
            for i in range(count):
                scale = np.float32(focal) / points[i, 2]
                x = points[i, 0] * scale + np.float32(half)
                y = points[i, 1] * scale + np.float32(half)
                points[i, 0] = x
                points[i, 1] = y
                low_x = min(low_x, x)
                high_x = max(high_x, x)
                low_y = min(low_y, y)
                high_y = max(high_y, y)
            if high_x <= 0.5 or low_x >= size - 0.5 or high_y <= 0.5 or low_y >= size - 0.5:
                continue
            # Rows whose centre (row + 0.5) lies in [low_y, high_y).
            first_row = max(0, int(math.ceil(max(low_y, np.float32(-1.0)) - 0.5)))
            last_row = min(size, int(math.ceil(min(high_y, np.float32(size + 1.0)) - 0.5)))
            if first_row >= last_row:
                continue
            for row in range(first_row, last_row):
                left[row] = 1e30
                right[row] = -1e30
            for i in range(count):
                j = i + 1 if i + 1 < count else 0
                x0, y0, x1, y1 = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
                if y0 == y1:
                    continue
                if y0 > y1:
                    x0, x1 = x1, x0
                    y0, y1 = y1, y0
                start = max(first_row, int(math.ceil(max(y0, np.float32(-1.0)) - 0.5)))
                stop = min(last_row, int(math.ceil(min(y1, np.float32(size + 1.0)) - 0.5)))
                gradient = (x1 - x0) / (y1 - y0)
                for row in range(start, stop):
                    x = x0 + (np.float32(row + 0.5) - y0) * gradient
                    left[row] = min(left[row], x)
                    right[row] = max(right[row], x)
            # 1 / depth is affine in the pixel: n . direction / -height.
            across = (nx * rx + ny * ry) / (-height * focal)
            along = (nx * dx + ny * dy + nz * dz) / (-height * focal)
            centre = (nx * fx + ny * fy + nz * fz) / -height
            base = centre + (0.5 - half) * across + (0.5 - half) * along
            slope_x = np.float32(across)
            drawn = False
            for row in range(first_row, last_row):
                begin = int(math.ceil(max(left[row], np.float32(0.0)) - 0.5))
                end = int(math.ceil(min(right[row], np.float32(size)) - 0.5))
                row_value = np.float32(base + row * along)
                for column in range(begin, end):
                    value = row_value + column * slope_x
                    if value > inverse_depth[row, column]:
                        inverse_depth[row, column] = value
                        slot_of_pixel[row, column] = used
                        drawn = True
            if drawn:
                slot_face[used] = face
                slots[used, 0] = across
                slots[used, 1] = along
                slots[used, 2] = base
                for k in range(2):
                    ux, uy, uz = face_uv[face, k, 0], face_uv[face, k, 1], face_uv[face, k, 2]
                    right_u = (ux * rx + uy * ry) / focal
                    down_u = (ux * dx + uy * dy + uz * dz) / focal
                    slots[used, 3 + 4 * k] = right_u
                    slots[used, 4 + 4 * k] = down_u
                    slots[used, 5 + 4 * k] = (ux * fx + uy * fy + uz * fz
                                              + (0.5 - half) * (right_u + down_u))
                    slots[used, 6 + 4 * k] = ux * px + uy * py + uz * pz + face_uv[face, k, 3]
                # Texels per metre over pixels per metre at depth 1, squared; and the height above
                # the plane, for the slant of the surface.
                density = math.sqrt(face_uv[face, 0, 0] ** 2 + face_uv[face, 0, 1] ** 2
                                    + face_uv[face, 0, 2] ** 2) * TEXTURE_SIZE / focal
                slots[used, 11] = density * density
                slots[used, 12] = height
                used += 1
    return used


@numba.njit(cache=True, fastmath=True, error_model='numpy')
def _shade(size, slots, slot_face, inverse_depth, slot_of_pixel, face_texture, face_colour,
           face_label, face_instance, textures, level_offset, rgb, depth, labels, instances):
    """Colour, depth and labels of every pixel from the visibility buffer."""
    for row in range(size):
        for column in range(size):
            slot = slot_of_pixel[row, column]
            if slot < 0:
                rgb[0, row, column] = 0
                rgb[1, row, column] = 0
                rgb[2, row, column] = 0
                depth[row, column] = 0.0
                labels[row, column] = 0
                instances[row, column] = 0
                continue
            face = slot_face[slot]
            z = np.float32(1.0) / inverse_depth[row, column]
            u = slots[slot, 6] + z * (slots[slot, 5] + column * slots[slot, 3]
                                      + row * slots[slot, 4])
            v = slots[slot, 10] + z * (slots[slot, 9] + column * slots[slot, 7]
                                       + row * slots[slot, 8])
            # Squared texels under this pixel; a slanted surface packs more of them (z / height is
            # the inverse cosine up to the ray's length).
            footprint = slots[slot, 11] * z * z * max(np.float32(1.0), z / slots[slot, 12])
            level = 0
            while footprint > np.float32(2.0) and level < MIP_LEVELS - 1:
                footprint *= np.float32(0.25)
                level += 1
            side = TEXTURE_SIZE >> level
            mask = side - 1
            i = int(math.floor(u * side)) & mask
            j = int(math.floor(v * side)) & mask
            texel = level_offset[level] + j * side + i
            texture = face_texture[face]
            for channel in range(3):
                value = textures[texture, texel, channel] * face_colour[face, channel]
                rgb[channel, row, column] = np.uint8(min(value + np.float32(0.5),
                                                         np.float32(255.0)))
            depth[row, column] = z
            labels[row, column] = face_label[face]
            instances[row, column] = face_instance[face]


@numba.njit(cache=True, fastmath=True, error_model='numpy')
def _render_one(vertices, face_start, face_vertices, face_plane, face_uv, face_texture,
                face_colour, face_label, face_instance, group_start, group_sphere, scene_group,
                most_faces, textures, scene, camera, focal, level_offset,
                rgb, depth, labels, instances):
    size = depth.shape[0]
    # One slot per face of the largest scene: the buffer cannot overflow.
    slots = np.empty((most_faces, 13), np.float32)
    slot_face = np.empty(most_faces, np.int32)
    inverse_depth = np.zeros((size, size), np.float32)
    slot_of_pixel = np.full((size, size), -1, np.int32)
    _visible_faces(vertices, face_start, face_vertices, face_plane, face_uv, group_start,
                   group_sphere, scene_group[scene], scene_group[scene + 1], camera, focal, size,
                   slots, slot_face, inverse_depth, slot_of_pixel)
    _shade(size, slots, slot_face, inverse_depth, slot_of_pixel, face_texture, face_colour,
           face_label, face_instance, textures, level_offset, rgb, depth, labels, instances)


@numba.njit(cache=True, fastmath=True, error_model='numpy')
def _render_serial(vertices, face_start, face_vertices, face_plane, face_uv, face_texture,
                   face_colour, face_label, face_instance, group_start, group_sphere, scene_group,
                   most_faces, textures, scene_index, cameras, focal, rgb, depth, labels,
                   instances):
    # A twin of _render_parallel without a thread pool, which a busy or forked process is glad of.
    for n in range(len(cameras)):
        _render_one(vertices, face_start, face_vertices, face_plane, face_uv, face_texture,
                    face_colour, face_label, face_instance, group_start, group_sphere,
                    scene_group, most_faces, textures, scene_index[n], cameras[n], focal,
                    _LEVEL_OFFSET, rgb[n], depth[n], labels[n], instances[n])


@numba.njit(cache=True, fastmath=True, error_model='numpy', parallel=True)
def _render_parallel(vertices, face_start, face_vertices, face_plane, face_uv, face_texture,
                     face_colour, face_label, face_instance, group_start, group_sphere,
                     scene_group, most_faces, textures, scene_index, cameras, focal, rgb, depth,
                     labels, instances):
    for n in numba.prange(len(cameras)):
        _render_one(vertices, face_start, face_vertices, face_plane, face_uv, face_texture,
                    face_colour, face_label, face_instance, group_start, group_sphere,
                    scene_group, most_faces, textures, scene_index[n], cameras[n], focal,
                    _LEVEL_OFFSET, rgb[n], depth[n], labels[n], instances[n])
