"""Draws scenes on the CPU: RGB, metric depth, class and instance labels from one pass.

Per camera: groups of polygons are culled by their boxes against the frustum, then drawn from front
to back; a group whose box lies behind what is drawn already is skipped (8 x 8 pixel tiles keep
the farthest depth). Front faces are near-clipped, projected and scan-converted row by row into a
visibility buffer (polygon and inverse depth). Each pixel is shaded once, run by run of the same
polygon. Inverse depth and texture coordinates come from the polygon's plane equation, so they are
perspective-correct at every pixel. Where two polygons have equal depth the lower index wins,
whatever the order of drawing.

The Warp kernels in `warp_renderer.py` follow the same arithmetic in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.render.pack import (
    CLUSTER,
    EMPTY,
    Lights,
    pack_scenes,
    standard_lights,
)
from vn_sim_bridge.render.scene import MAX_CORNERS, MAX_LIGHT_NODES, Scene
from vn_sim_bridge.simulator import Objects, no_objects

NEAR = 0.03  # m, near plane
TILE = 8  # pixels a side, of the coarse depth that hides groups
BLOCK = 16  # pixels of a row between which light is linear
BINS = 32  # of the front-to-back order
BIN_DEPTH = 0.5  # m
MAX_SIZE = 2048  # pixels a side of a picture
# Two parts of one buffer, a constant distance apart: the compiler sees that they do not overlap.
RIGHT = np.uint64(MAX_SIZE)
LAST_NODE = (MAX_LIGHT_NODES - 1) * 16


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
        kernel = _render_parallel if self.threads > 1 else _render_serial
        before = numba.get_num_threads()
        # Numba fills its configuration when it is imported.
        most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        threads = min(self.threads, most)
        numba.set_num_threads(threads)
        kernel(self.pack, np.ascontiguousarray(scene_index, np.int64),
               np.ascontiguousarray(cameras, np.float64), np.ascontiguousarray(focal),
               lights, objects, self.most_faces, self.most_groups, tuple(out), threads)
        numba.set_num_threads(before)
        return out


# No reassociation and no fused multiply-add: Warp's kernels must find the same pixels.
_exact = numba.njit(cache=True, fastmath={'nnan', 'ninf', 'nsz'}, error_model='numpy')


@_exact
def _frame(camera, out):
    """Position, forward, right and down axes of a camera in the map frame, [12]."""
    cy, sy = math.cos(camera[3]), math.sin(camera[3])
    cp, sp = math.cos(camera[4]), math.sin(camera[4])
    out[0], out[1], out[2] = camera[0], camera[1], camera[2]
    out[3], out[4], out[5] = cp * cy, cp * sy, -sp
    out[6], out[7], out[8] = sy, -cy, 0.0
    out[9], out[10], out[11] = -sp * cy, -sp * sy, -cp


@_exact
def _object_frame(frame, pose, out):
    """The camera's frame as an object at `pose` sees it: its scene stands at its own origin."""
    c, s = math.cos(pose[3]), math.sin(pose[3])
    x, y = frame[0] - pose[0], frame[1] - pose[1]
    out[0], out[1], out[2] = c * x + s * y, c * y - s * x, frame[2] - pose[2]
    for axis in range(3, 12, 3):
        x, y = frame[axis], frame[axis + 1]
        out[axis], out[axis + 1], out[axis + 2] = c * x + s * y, c * y - s * x, frame[axis + 2]


@_exact
def _nearest_depth(box, frame, slope):
    """Least depth of a box along the optical axis, or -1 where it lies outside the frustum."""
    hx, hy, hz = (box[3] - box[0]) * 0.5, (box[4] - box[1]) * 0.5, (box[5] - box[2]) * 0.5
    x, y, z = (box[0] + hx - frame[0]), (box[1] + hy - frame[1]), (box[2] + hz - frame[2])
    depth = x * frame[3] + y * frame[4] + z * frame[5]
    reach = hx * abs(frame[3]) + hy * abs(frame[4]) + hz * abs(frame[5])
    if depth + reach < NEAR:
        return -1.0
    for axis in (6, 9):
        for sign in (-1.0, 1.0):
            nx = slope * frame[3] + sign * frame[axis]
            ny = slope * frame[4] + sign * frame[axis + 1]
            nz = slope * frame[5] + sign * frame[axis + 2]
            if x * nx + y * ny + z * nz + hx * abs(nx) + hy * abs(ny) + hz * abs(nz) < 0.0:
                return -1.0
    return max(depth - reach, 0.0)


@_exact
def _hidden(box, frame, focal, size, tiles):
    """Whether a box lies wholly behind what is drawn already."""
    half = size * 0.5
    low_x, high_x, low_y, high_y = 1e30, -1e30, 1e30, -1e30
    nearest = 1e30
    for corner in range(8):
        x = (box[3] if corner & 1 else box[0]) - frame[0]
        y = (box[4] if corner & 2 else box[1]) - frame[1]
        z = (box[5] if corner & 4 else box[2]) - frame[2]
        depth = x * frame[3] + y * frame[4] + z * frame[5]
        if depth < NEAR:
            return False
        nearest = min(nearest, depth)
        scale = focal / depth
        column = (x * frame[6] + y * frame[7] + z * frame[8]) * scale + half
        row = (x * frame[9] + y * frame[10] + z * frame[11]) * scale + half
        low_x, high_x = min(low_x, column), max(high_x, column)
        low_y, high_y = min(low_y, row), max(high_y, row)
    inverse = 1.0 / nearest
    last = (size - 1) // TILE
    for i in range(int(max(low_y, 0.0)) // TILE, min(int(max(high_y, 0.0)) // TILE, last) + 1):
        for j in range(int(max(low_x, 0.0)) // TILE, min(int(max(high_x, 0.0)) // TILE, last) + 1):
            if tiles[i, j] <= inverse:
                return False
    return True


@_exact
def _update_tiles(inverse_depth, tiles):
    """The least inverse depth of each tile (0 while a pixel is empty); returns that of all."""
    size = inverse_depth.shape[0]
    tiles[:] = np.float32(1e30)
    whole = size // TILE
    for row in range(size):
        i = row // TILE
        for j in range(whole):
            least = inverse_depth[row, j * TILE]
            for column in range(j * TILE + 1, j * TILE + TILE):
                least = min(least, inverse_depth[row, column])
            tiles[i, j] = min(tiles[i, j], least)
        for column in range(whole * TILE, size):
            tiles[i, whole] = min(tiles[i, whole], inverse_depth[row, column])
    farthest = np.float32(1e30)
    for i in range(tiles.shape[0]):
        for j in range(tiles.shape[1]):
            farthest = min(farthest, tiles[i, j])
    return farthest


@_exact
def _draw_faces(pack, first_face, last_face, first_ident, frame, focal, size, polygon, clipped,
                spans, inverse_depth, ident_of_pixel):
    """Scan-convert consecutive polygons into the visibility buffer."""
    px, py, pz = frame[0], frame[1], frame[2]
    fx, fy, fz = frame[3], frame[4], frame[5]
    rx, ry, rz = frame[6], frame[7], frame[8]
    dx, dy, dz = frame[9], frame[10], frame[11]
    half = size * 0.5
    limit = np.float32(size)
    for face in range(np.uint64(first_face), np.uint64(last_face)):
        ident = np.int32(first_ident + np.int64(face) - first_face)
        nx, ny, nz = pack.face_plane[face, 0], pack.face_plane[face, 1], pack.face_plane[face, 2]
        height = nx * px + ny * py + nz * pz - pack.face_plane[face, 3]
        if height <= 1e-6:
            continue  # the camera sees its back
        count = 0
        behind = 0
        for corner in range(pack.face_start[face], pack.face_start[face + 1]):
            vertex = pack.face_vertices[corner]
            x = pack.vertices[vertex, 0] - px
            y = pack.vertices[vertex, 1] - py
            z = pack.vertices[vertex, 2] - pz
            depth = np.float32(x * fx + y * fy + z * fz)
            polygon[count, 0] = x * rx + y * ry + z * rz
            polygon[count, 1] = x * dx + y * dy + z * dz
            polygon[count, 2] = depth
            count += 1
            if depth < np.float32(NEAR):
                behind += 1
        if behind == count:
            continue
        points = polygon
        if behind > 0:
            kept = 0
            for i in range(count):
                j = i + 1 if i + 1 < count else 0
                zi, zj = polygon[i, 2], polygon[j, 2]
                if zi >= np.float32(NEAR):
                    clipped[kept, 0] = polygon[i, 0]
                    clipped[kept, 1] = polygon[i, 1]
                    clipped[kept, 2] = zi
                    kept += 1
                if (zi >= np.float32(NEAR)) != (zj >= np.float32(NEAR)):
                    t = (np.float32(NEAR) - zi) / (zj - zi)
                    clipped[kept, 0] = polygon[i, 0] + t * (polygon[j, 0] - polygon[i, 0])
                    clipped[kept, 1] = polygon[i, 1] + t * (polygon[j, 1] - polygon[i, 1])
                    clipped[kept, 2] = np.float32(NEAR)
                    kept += 1
            points = clipped
            count = kept
        low_x, high_x = np.float32(1e30), np.float32(-1e30)
        low_y, high_y = np.float32(1e30), np.float32(-1e30)
        for i in range(count):
            scale = np.float32(focal) / points[i, 2]
            x = points[i, 0] * scale + np.float32(half)
            y = points[i, 1] * scale + np.float32(half)
            points[i, 0] = x
            points[i, 1] = y
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
        if high_x <= 0.5 or low_x >= size - 0.5 or high_y <= 0.5 or low_y >= size - 0.5:
            continue
        # Pixels whose centre lies in [low, high): from int(low + 0.5) to below int(high + 0.5).
        first_row = np.int32(max(low_y, np.float32(0.0)) + np.float32(0.5))
        last_row = np.int32(min(high_y, limit) + np.float32(0.5))
        if first_row >= last_row:
            continue
        for row in range(np.uint64(first_row), np.uint64(last_row)):
            spans[row] = limit
            spans[row + RIGHT] = np.float32(0.0)
        for i in range(count):
            j = i + 1 if i + 1 < count else 0
            x0, y0, x1, y1 = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
            if y0 == y1:
                continue
            if y0 > y1:
                x0, x1 = x1, x0
                y0, y1 = y1, y0
            start = np.int32(min(max(y0, np.float32(0.0)), limit) + np.float32(0.5))
            stop = np.int32(min(max(y1, np.float32(0.0)), limit) + np.float32(0.5))
            gradient = (x1 - x0) / (y1 - y0)
            y0 -= np.float32(0.5)  # of a row's centre; kept apart from x0, which it may dwarf
            for row in range(np.uint64(start), np.uint64(stop)):
                x = x0 + (np.float32(np.int32(row)) - y0) * gradient
                spans[row] = min(spans[row], x)
                spans[row + RIGHT] = max(spans[row + RIGHT], x)
        # 1 / depth is affine in the pixel: n . direction / -height.
        across = (nx * rx + ny * ry + nz * rz) / (-height * focal)
        along = (nx * dx + ny * dy + nz * dz) / (-height * focal)
        base = ((nx * fx + ny * fy + nz * fz) / -height + (0.5 - half) * across
                + (0.5 - half) * along)
        slope_x = np.float32(across)
        for row in range(np.uint64(first_row), np.uint64(last_row)):
            begin = np.int32(max(spans[row], np.float32(0.0)) + np.float32(0.5))
            end = np.int32(min(spans[row + RIGHT], limit) + np.float32(0.5))
            row_value = np.float32(base + np.int32(row) * along)
            inverses, idents = inverse_depth[row], ident_of_pixel[row]
            for column in range(np.uint64(begin), np.uint64(max(begin, end))):
                value = row_value + np.float32(np.int32(column)) * slope_x
                old, other = inverses[column], idents[column]
                wins = (value > old) | ((value == old) & (ident < other))
                inverses[column] = value if wins else old
                idents[column] = ident if wins else other


@_exact
def _see(pack, scene, frames, objects, focal, size, most_faces, work, inverse_depth,
         ident_of_pixel):
    """Fill the visibility buffer of one camera."""
    near, seen, order, bin_start, tiles, polygon, clipped, spans = work
    frame = frames[0]
    slope = size * 0.5 / focal
    first, last = pack.scene_group[scene], pack.scene_group[scene + 1]
    bin_start[:] = 0
    found = 0
    for cluster in range(pack.scene_cluster[scene], pack.scene_cluster[scene + 1]):
        if _nearest_depth(pack.cluster_box[cluster], frame, slope) < 0.0:
            continue
        begin = first + (cluster - pack.scene_cluster[scene]) * CLUSTER
        for group in range(begin, min(begin + CLUSTER, last)):
            depth = _nearest_depth(pack.group_box[group], frame, slope)
            if depth >= 0.0:
                near[found] = depth
                seen[found] = group
                found += 1
                bin_start[min(int(depth / BIN_DEPTH), BINS - 1) + 1] += 1
    for k in range(BINS):
        bin_start[k + 1] += bin_start[k]
    for k in range(found):
        place = min(int(near[k] / BIN_DEPTH), BINS - 1)
        order[bin_start[place]] = k
        bin_start[place] += 1
    base = np.int64(pack.group_start[first])
    fresh = 0
    known = False
    horizon = 1e30  # m: everything that can be seen is nearer
    for k in range(found):
        group, depth = seen[order[k]], near[order[k]]
        if depth > 1.0:
            if fresh >= 12 or (not known and fresh > 0):
                farthest = _update_tiles(inverse_depth, tiles)
                if farthest > np.float32(0.0):
                    horizon = 1.0 / farthest
                fresh = 0
                known = True
            if depth > horizon:
                continue
            if known and _hidden(pack.group_box[group], frame, focal, size, tiles):
                continue
        begin = np.int64(pack.group_start[group])
        _draw_faces(pack, begin, np.int64(pack.group_start[group + 1]), begin - base, frame, focal,
                    size, polygon, clipped, spans, inverse_depth, ident_of_pixel)
        fresh += 1
    for m in range(objects.shape[0]):
        if objects[m] < 0:
            continue
        first, last = pack.scene_group[objects[m]], pack.scene_group[objects[m] + 1]
        for group in range(first, last):
            if _nearest_depth(pack.group_box[group], frames[m + 1], slope) < 0.0:
                continue
            begin = np.int64(pack.group_start[group])
            _draw_faces(pack, begin, np.int64(pack.group_start[group + 1]),
                        (m + 1) * most_faces + begin - pack.group_start[first], frames[m + 1],
                        focal, size, polygon, clipped, spans, inverse_depth, ident_of_pixel)


_shading = numba.njit(cache=True, fastmath=True, error_model='numpy')


@_shading
def _prepare(pack, face, frame, focal, half, cube, lamp, slot):
    """What shading needs of a visible polygon: affine texture coordinates, lit colours, [16]."""
    px, py, pz = frame[0], frame[1], frame[2]
    nx, ny, nz = pack.face_plane[face, 0], pack.face_plane[face, 1], pack.face_plane[face, 2]
    height = nx * px + ny * py + nz * pz - pack.face_plane[face, 3]
    for k in range(2):
        ux, uy, uz = pack.face_uv[face, k, 0], pack.face_uv[face, k, 1], pack.face_uv[face, k, 2]
        right = (ux * frame[6] + uy * frame[7] + uz * frame[8]) / focal
        down = (ux * frame[9] + uy * frame[10] + uz * frame[11]) / focal
        slot[4 * k] = right
        slot[4 * k + 1] = down
        slot[4 * k + 2] = (ux * frame[3] + uy * frame[4] + uz * frame[5]
                           + (0.5 - half) * (right + down))
        slot[4 * k + 3] = ux * px + uy * py + uz * pz + pack.face_uv[face, k, 3]
    # Texels per metre over pixels per metre at depth 1, squared.
    ux, uy, uz = pack.face_uv[face, 0, 0], pack.face_uv[face, 0, 1], pack.face_uv[face, 0, 2]
    texels = pack.face_texture[face, 1] / focal
    slot[8] = (ux * ux + uy * uy + uz * uz) * texels * texels
    slot[9] = 1.0 / height
    for channel in range(3):
        ambient = (
            nx * nx * cube[0 if nx > 0 else 1, channel]
            + ny * ny * cube[2 if ny > 0 else 3, channel]
            + nz * nz * cube[4 if nz > 0 else 5, channel])
        # Light factors come as 0 to 255 * 256; a lit colour leaves as 16.16 fixed point.
        colour = pack.face_colour[face, channel] * np.float32(65536.0 / (255 * 256))
        slot[10 + channel] = colour * ambient
        slot[13 + channel] = colour * lamp[channel]


@_shading
def _light_at(face_light, face_light_map, light, face, u, v):
    """Ambient and lamp factor (0 to 65280 each) of a surface point, bilinear in sixteenths."""
    width = face_light[face, 1]
    limit = np.float32(width - 1) * np.float32(16.0)
    x = u * face_light_map[face, 0] + face_light_map[face, 1]
    y = v * face_light_map[face, 2] + face_light_map[face, 3]
    i = np.int32(max(min(x * np.float32(16.0), limit), np.float32(0.0)))
    j = np.int32(max(min(y * np.float32(16.0), np.float32(LAST_NODE)), np.float32(0.0)))
    node = np.uint64(face_light[face, 0] + (j >> 4) * width + (i >> 4))
    wx, wy = np.uint64(i & 15), np.uint64(j & 15)
    # A sum of four lanes of 16 bits, none of which can overflow: 255 * 16 * 16 < 65536.
    mixed = light[node] * (np.uint64(16) - wy) + light[node + np.uint64(width)] * wy
    sums = ((mixed & np.uint64(0xFFFFFFFF)) * (np.uint64(16) - wx)
            + (mixed >> np.uint64(32)) * wx)
    return (np.float32(np.int32(sums & np.uint64(0xFFFF))),
            np.float32(np.int32(sums >> np.uint64(16))))


@_shading
def _fixed(ambient, lamp, ambient_colour, lamp_colour):
    """A lit colour as 16.16 fixed point, at most 1."""
    return np.int32(min(ambient * ambient_colour + lamp * lamp_colour, np.float32(65535.0)))


@_shading
def _shade(pack, scene, frames, objects, object_room, cube, lamps, focal, most_faces,
           work, inverse_depth, ident_of_pixel, rgb, depth, labels, instances):
    """Colour, depth and labels of every pixel.

    Works through runs of the same polygon within aligned blocks of `BLOCK` pixels of a row.
    Texture coordinates are exact at every pixel; mip level and light are those of the run's ends,
    light linear in between.
    """
    size = depth.shape[0]
    half = size * 0.5
    slots, slot_of, code_of, stamp_of, stamp, codes = work
    bits = np.int32(8 * labels.itemsize)  # of a class; known when this is compiled
    classes = np.int32((1 << bits) - 1)
    used = 0
    nothing = np.int32(len(code_of) - 1)  # the entry of pixels that show none
    code_of[nothing] = 0
    first_face = pack.group_start[pack.scene_group[scene]]
    face_light, face_light_map, light = pack.face_light, pack.face_light_map, pack.light
    for row in range(size):
        idents = ident_of_pixel[row]
        inverses, depths = inverse_depth[row], depth[row]
        reds, greens, blues = rgb[0, row], rgb[1, row], rgb[2, row]
        for column in range(np.uint64(size)):
            depths[column] = np.float32(1.0) / max(inverses[column], np.float32(1e-9))
        begin = 0
        known = EMPTY
        s = slots[0]
        face = 0
        lit = False
        red = green = blue = next_red = next_green = next_blue = np.int32(0)
        while begin < size:
            ident = idents[begin]
            block_end = min((begin // BLOCK + 1) * BLOCK, size)
            end = begin + 1
            while end < block_end and idents[end] == ident:
                end += 1
            if ident == EMPTY:
                for column in range(begin, end):
                    reds[column] = 0
                    greens[column] = 0
                    blues[column] = 0
                    depths[column] = 0.0
                begin = end
                continue
            if ident != known:
                known = ident
                which = 0
                if ident < most_faces:
                    face = first_face + ident
                else:
                    which = ident // most_faces
                    face = (pack.group_start[pack.scene_group[objects[which - 1]]]
                            + ident - which * most_faces)
                if stamp_of[ident] != stamp:
                    stamp_of[ident] = stamp
                    slot_of[ident] = used
                    room = pack.face_room[face] if which == 0 else object_room[which - 1]
                    _prepare(pack, face, frames[which], focal, half, cube, lamps[room],
                             slots[used])
                    thing = np.int32(pack.face_instance[face]) if which == 0 else 65536 - which
                    code_of[ident] = np.int32(thing << bits) | np.int32(pack.face_label[face])
                    used += 1
                s = slots[np.uint64(slot_of[ident])]
            u_offset, v_offset = s[3], s[7]
            u_row = s[2] + np.float32(row) * s[1]
            v_row = s[6] + np.float32(row) * s[5]
            z = depths[begin]
            if not lit:
                x = np.float32(begin)
                ambient, lamp = _light_at(
                    face_light, face_light_map, light, face,
                    u_offset + z * (u_row + x * s[0]), v_offset + z * (v_row + x * s[4]))
                red = _fixed(ambient, lamp, s[10], s[13])
                green = _fixed(ambient, lamp, s[11], s[14])
                blue = _fixed(ambient, lamp, s[12], s[15])
            # A run that goes on in the next block takes its light over from there.
            lit = end < size and end - begin > 1 and idents[end] == ident
            last = end if lit else end - 1
            red_step = green_step = blue_step = np.int32(0)
            if last > begin + 1:
                far_z = depths[last]
                x = np.float32(last)
                ambient, lamp = _light_at(
                    face_light, face_light_map, light, face,
                    u_offset + far_z * (u_row + x * s[0]), v_offset + far_z * (v_row + x * s[4]))
                next_red = _fixed(ambient, lamp, s[10], s[13])
                next_green = _fixed(ambient, lamp, s[11], s[14])
                next_blue = _fixed(ambient, lamp, s[12], s[15])
                share = np.float32(1.0) / np.float32(last - begin)
                red_step = np.int32(np.float32(next_red - red) * share)
                green_step = np.int32(np.float32(next_green - green) * share)
                blue_step = np.int32(np.float32(next_blue - blue) * share)
                z = min(z, far_z)
            # Squared texels under a pixel; a slanted surface packs more of them (z / height is the
            # inverse cosine up to the ray's length). Half its binary exponent is the mip level.
            footprint = s[8] * z * z * max(np.float32(1.0), z * s[9])
            side = pack.face_texture[face, 1]
            whole = side * side
            exponent = (np.float32(footprint).view(np.int32) >> 23) - 127
            level = max(0, (exponent + 1) >> 1)
            side = max(side >> min(level, 16), 4)
            texel_start = pack.face_texture[face, 0] + (whole - side * side) // 3 * 4
            wide = np.float32(side)
            mask = np.int32(side - 1)
            u_offset, v_offset, u_row, v_row = (u_offset * wide, v_offset * wide, u_row * wide,
                                                v_row * wide)
            u_right, v_right = s[0] * wide, s[4] * wide
            x = np.float32(begin)
            for column in range(np.uint64(begin), np.uint64(end)):
                z = depths[column]
                # Coordinates are not negative on the polygon (see SceneBuilder): this rounds down.
                i = np.int32(u_offset + z * (u_row + x * u_right)) & mask
                j = np.int32(v_offset + z * (v_row + x * v_right)) & mask
                texel = np.int32(pack.texels[np.uint64(texel_start + j * side + i)])
                reds[column] = np.uint8(((texel & 255) * red + 32768) >> 16)
                greens[column] = np.uint8((((texel >> 8) & 255) * green + 32768) >> 16)
                blues[column] = np.uint8(((texel >> 16) * blue + 32768) >> 16)
                red += red_step
                green += green_step
                blue += blue_step
                x += np.float32(1.0)
            if lit:
                red, green, blue = next_red, next_green, next_blue
            begin = end
        label_row, instance_row = labels[row], instances[row]
        for column in range(np.uint64(size)):
            codes[column] = code_of[np.uint64(min(idents[column], nothing))]
        for column in range(np.uint64(size)):
            label_row[column] = codes[column] & classes
        for column in range(np.uint64(size)):
            instance_row[column] = np.uint16(codes[column] >> bits)


@_exact
def _workspace(size, most_groups):
    tiles = (size + TILE - 1) // TILE
    return (np.empty(most_groups), np.empty(most_groups, np.int64),
            np.empty(most_groups, np.int64),
            np.empty(BINS + 1, np.int64), np.empty((tiles, tiles), np.float32),
            np.empty((MAX_CORNERS + 2, 3), np.float32), np.empty((MAX_CORNERS + 2, 3), np.float32),
            np.empty(2 * MAX_SIZE, np.float32))


@_exact
def _render_range(begin, end, pack, scene_index, cameras, focal, lights, objects, most_faces,
                  most_groups, out):
    rgb, depth, labels, instances = out
    size = depth.shape[1]
    count = objects.scene.shape[1]
    # One slot for each pixel at most, and one entry for each polygon that can be drawn: these
    # buffers cannot overflow.
    idents = (count + 1) * most_faces
    work = _workspace(size, most_groups)
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
        _frame(cameras[n], frames[0])
        for m in range(count):
            _object_frame(frames[0], objects.pose[n, m], frames[m + 1])
        _see(pack, scene_index[n], frames, objects.scene[n], focal[n], size, most_faces, work,
             inverse_depth, ident_of_pixel)
        _shade(pack, scene_index[n], frames, objects.scene[n], objects.room[n], lights.cube[n],
               lights.lamps[n], focal[n], most_faces,
               (slots, slot_of, code_of, stamp_of, np.int32(n - begin + 1), codes),
               inverse_depth, ident_of_pixel, rgb[n], depth[n], labels[n], instances[n])


@_exact
def _render_serial(pack, scene_index, cameras, focal, lights, objects, most_faces, most_groups,
                   out, threads):
    # A twin of _render_parallel without a thread pool, which a busy or forked process is glad of.
    _render_range(0, len(cameras), pack, scene_index, cameras, focal, lights, objects, most_faces,
                  most_groups, out)


@numba.njit(cache=True, fastmath={'nnan', 'ninf', 'nsz'}, error_model='numpy', parallel=True)
def _render_parallel(pack, scene_index, cameras, focal, lights, objects, most_faces, most_groups,
                     out, threads):
    count = len(cameras)
    chunks = min(count, threads * 4)
    for chunk in numba.prange(chunks):
        _render_range(count * chunk // chunks, count * (chunk + 1) // chunks, pack, scene_index,
                      cameras, focal, lights, objects, most_faces, most_groups, out)
