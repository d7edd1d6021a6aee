"""The renderer as Warp kernels (`vn_nav[gpu]`): the same pictures as `rasterizer.py`, on a GPU.

Three launches: polygons into a visibility buffer (atomic maximum of inverse depth and polygon
index), shading, and the sensor. Coverage follows the arithmetic of the Numba renderer operation by
operation, in the same precision and order, so that labels agree to the pixel; texture coordinates
and light may differ in the last bit. All outputs stay on the device; `wp.to_torch` shares them
with PyTorch without a copy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from vn_sim_bridge.render.pack import pack_scenes
from vn_sim_bridge.render.scene import MAX_CORNERS, Scene
from vn_sim_bridge.render.shading import BLOCK, LAST_NODE
from vn_sim_bridge.render.visibility import NEAR

BAND = 16  # rows that one thread scan-converts
_near = wp.constant(wp.float64(NEAR))
_near_32 = wp.constant(wp.float32(NEAR))
_band = wp.constant(BAND)
_block = wp.constant(BLOCK)
_last_node = wp.constant(wp.float32(LAST_NODE))
_all_bits = wp.constant(wp.uint32(0xFFFFFFFF))
_low_half = wp.constant(wp.uint64(0xFFFFFFFF))
_mix_0 = wp.constant(wp.uint32(0x9E3779B1))
_mix_1 = wp.constant(wp.uint32(0x85EBCA6B))
_mix_2 = wp.constant(wp.uint32(0xC2B2AE35))
_points = wp.types.vector(3 * (MAX_CORNERS + 2), wp.float32)
_rows = wp.types.vector(BAND, wp.float32)
_frame_type = wp.types.vector(12, wp.float64)
_slot_type = wp.types.vector(16, wp.float32)

wp.set_module_options({'enable_backward': False, 'fast_math': False})


@wp.struct
class DevicePack:
    """The arrays of `pack.Pack` on a device."""

    vertices: wp.array2d(dtype=wp.float32)
    face_start: wp.array(dtype=wp.int32)
    face_vertices: wp.array(dtype=wp.int32)
    face_plane: wp.array2d(dtype=wp.float32)
    face_uv: wp.array3d(dtype=wp.float32)
    face_texture: wp.array2d(dtype=wp.int32)
    face_colour: wp.array2d(dtype=wp.float32)
    face_label: wp.array(dtype=wp.uint8)
    face_instance: wp.array(dtype=wp.uint16)
    face_light: wp.array2d(dtype=wp.int32)
    face_light_map: wp.array2d(dtype=wp.float32)
    face_room: wp.array(dtype=wp.int32)
    light: wp.array(dtype=wp.uint64)
    group_start: wp.array(dtype=wp.int32)
    group_box: wp.array2d(dtype=wp.float32)
    scene_group: wp.array(dtype=wp.int64)
    texels: wp.array(dtype=wp.uint32)


@wp.func
def camera_frame(cameras: wp.array2d(dtype=wp.float64), n: int):
    """As `rasterizer._frame`."""
    cy, sy = wp.cos(cameras[n, 3]), wp.sin(cameras[n, 3])
    cp, sp = wp.cos(cameras[n, 4]), wp.sin(cameras[n, 4])
    return _frame_type(cameras[n, 0], cameras[n, 1], cameras[n, 2], cp * cy, cp * sy, -sp, sy, -cy,
                       wp.float64(0.0), -sp * cy, -sp * sy, -cp)


@wp.func
def object_frame(frame: _frame_type, pose: wp.array3d(dtype=wp.float64), n: int, m: int):
    """As `rasterizer._object_frame`."""
    c, s = wp.cos(pose[n, m, 3]), wp.sin(pose[n, m, 3])
    x, y = frame[0] - pose[n, m, 0], frame[1] - pose[n, m, 1]
    return _frame_type(
        c * x + s * y, c * y - s * x, frame[2] - pose[n, m, 2],
        c * frame[3] + s * frame[4], c * frame[4] - s * frame[3], frame[5],
        c * frame[6] + s * frame[7], c * frame[7] - s * frame[6], frame[8],
        c * frame[9] + s * frame[10], c * frame[10] - s * frame[9], frame[11])


@wp.func
def in_frustum(pack: DevicePack, group: int, frame: _frame_type, slope: wp.float64):
    """As `rasterizer._nearest_depth`, but only yes or no."""
    half = wp.float64(0.5)
    lx, ly, lz = pack.group_box[group, 0], pack.group_box[group, 1], pack.group_box[group, 2]
    hx = wp.float64(pack.group_box[group, 3] - lx) * half
    hy = wp.float64(pack.group_box[group, 4] - ly) * half
    hz = wp.float64(pack.group_box[group, 5] - lz) * half
    x = wp.float64(lx) + hx - frame[0]
    y = wp.float64(ly) + hy - frame[1]
    z = wp.float64(lz) + hz - frame[2]
    depth = x * frame[3] + y * frame[4] + z * frame[5]
    if depth + hx * wp.abs(frame[3]) + hy * wp.abs(frame[4]) + hz * wp.abs(frame[5]) < _near:
        return False
    for side in range(4):
        axis = 6 + 3 * (side // 2)
        sign = wp.float64(1.0) - wp.float64(2.0) * wp.float64(side % 2)
        nx = slope * frame[3] + sign * frame[axis]
        ny = slope * frame[4] + sign * frame[axis + 1]
        nz = slope * frame[5] + sign * frame[axis + 2]
        if (x * nx + y * ny + z * nz + hx * wp.abs(nx) + hy * wp.abs(ny) + hz * wp.abs(nz)
                < wp.float64(0.0)):
            return False
    return True


@wp.func
def draw_face(pack: DevicePack, face: int, ident: int, frame: _frame_type, focal: wp.float64,
              size: int, band: int, n: int, visible: wp.array3d(dtype=wp.uint64)):
    """As `rasterizer._draw_face`, for the rows of one band."""
    half = wp.float64(size) * wp.float64(0.5)
    nx = wp.float64(pack.face_plane[face, 0])
    ny = wp.float64(pack.face_plane[face, 1])
    nz = wp.float64(pack.face_plane[face, 2])
    height = (nx * frame[0] + ny * frame[1] + nz * frame[2]
              - wp.float64(pack.face_plane[face, 3]))
    if height <= wp.float64(1.0e-6):
        return
    polygon = _points()
    count = int(0)
    behind = int(0)
    for corner in range(pack.face_start[face], pack.face_start[face + 1]):
        vertex = pack.face_vertices[corner]
        x = wp.float64(pack.vertices[vertex, 0]) - frame[0]
        y = wp.float64(pack.vertices[vertex, 1]) - frame[1]
        z = wp.float64(pack.vertices[vertex, 2]) - frame[2]
        depth = wp.float32(x * frame[3] + y * frame[4] + z * frame[5])
        polygon[3 * count] = wp.float32(x * frame[6] + y * frame[7] + z * frame[8])
        polygon[3 * count + 1] = wp.float32(x * frame[9] + y * frame[10] + z * frame[11])
        polygon[3 * count + 2] = depth
        count += 1
        if depth < _near_32:
            behind += 1
    if behind == count:
        return
    points = _points()
    if behind > 0:
        kept = int(0)
        for i in range(count):
            j = int(0)
            if i + 1 < count:
                j = i + 1
            zi, zj = polygon[3 * i + 2], polygon[3 * j + 2]
            if zi >= _near_32:
                points[3 * kept] = polygon[3 * i]
                points[3 * kept + 1] = polygon[3 * i + 1]
                points[3 * kept + 2] = zi
                kept += 1
            if (zi >= _near_32) != (zj >= _near_32):
                t = (_near_32 - zi) / (zj - zi)
                points[3 * kept] = polygon[3 * i] + t * (polygon[3 * j] - polygon[3 * i])
                points[3 * kept + 1] = (polygon[3 * i + 1]
                                        + t * (polygon[3 * j + 1] - polygon[3 * i + 1]))
                points[3 * kept + 2] = _near_32
                kept += 1
        count = kept
    else:
        points = polygon
    limit = wp.float32(size)
    low_x, high_x = wp.float32(1.0e30), wp.float32(-1.0e30)
    low_y, high_y = wp.float32(1.0e30), wp.float32(-1.0e30)
    for i in range(count):
        scale = wp.float32(focal) / points[3 * i + 2]
        column_x = points[3 * i] * scale + wp.float32(half)
        row_y = points[3 * i + 1] * scale + wp.float32(half)
        points[3 * i] = column_x
        points[3 * i + 1] = row_y
        low_x, high_x = wp.min(low_x, column_x), wp.max(high_x, column_x)
        low_y, high_y = wp.min(low_y, row_y), wp.max(high_y, row_y)
    if (high_x <= 0.5 or low_x >= limit - 0.5 or high_y <= 0.5 or low_y >= limit - 0.5):
        return
    first_row = wp.max(wp.int32(wp.max(low_y, 0.0) + 0.5), band * _band)
    last_row = wp.min(wp.int32(wp.min(high_y, limit) + 0.5), wp.min((band + 1) * _band, size))
    if first_row >= last_row:
        return
    left, right = _rows(), _rows()
    for row in range(_band):
        left[row] = limit
    for i in range(count):
        j = int(0)
        if i + 1 < count:
            j = i + 1
        x0, y0, x1, y1 = points[3 * i], points[3 * i + 1], points[3 * j], points[3 * j + 1]
        if y0 != y1:
            if y0 > y1:
                x0, y0, x1, y1 = points[3 * j], points[3 * j + 1], points[3 * i], points[3 * i + 1]
            start = wp.max(wp.int32(wp.min(wp.max(y0, 0.0), limit) + 0.5), first_row)
            stop = wp.min(wp.int32(wp.min(wp.max(y1, 0.0), limit) + 0.5), last_row)
            gradient = (x1 - x0) / (y1 - y0)
            centre = y0 - 0.5
            for row in range(start, stop):
                edge = x0 + (wp.float32(row) - centre) * gradient
                k = row - band * _band
                left[k] = wp.min(left[k], edge)
                right[k] = wp.max(right[k], edge)
    across = (nx * frame[6] + ny * frame[7] + nz * frame[8]) / (-height * focal)
    along = (nx * frame[9] + ny * frame[10] + nz * frame[11]) / (-height * focal)
    middle = wp.float64(0.5) - half
    base = ((nx * frame[3] + ny * frame[4] + nz * frame[5]) / -height + middle * across
            + middle * along)
    slope_x = wp.float32(across)
    low_bits = wp.uint64(_all_bits - wp.uint32(ident))
    for row in range(first_row, last_row):
        k = row - band * _band
        begin = wp.int32(wp.max(left[k], 0.0) + 0.5)
        end = wp.int32(wp.min(right[k], limit) + 0.5)
        row_value = wp.float32(base + wp.float64(row) * along)
        for column in range(begin, end):
            value = row_value + wp.float32(column) * slope_x
            if value > 0.0:
                # Positive numbers order as their bits do; the lower polygon wins a tie.
                bits = (wp.uint64(wp.cast(value, wp.uint32)) << wp.uint64(32)) | low_bits
                wp.atomic_max(visible, n, row, column, bits)


@wp.kernel
def draw_scenes(pack: DevicePack, scene_index: wp.array(dtype=wp.int64),
                cameras: wp.array2d(dtype=wp.float64), focal: wp.array(dtype=wp.float64),
                size: int, visible: wp.array3d(dtype=wp.uint64)):
    """One thread: one group of polygons, one camera, one band of rows."""
    n, g, band = wp.tid()
    scene = wp.int32(scene_index[n])
    first = wp.int32(pack.scene_group[scene])
    group = first + g
    if group >= wp.int32(pack.scene_group[scene + 1]):
        return
    frame = camera_frame(cameras, n)
    if not in_frustum(pack, group, frame, wp.float64(size) * wp.float64(0.5) / focal[n]):
        return
    base = pack.group_start[first]
    for face in range(pack.group_start[group], pack.group_start[group + 1]):
        draw_face(pack, face, face - base, frame, focal[n], size, band, n, visible)


@wp.kernel
def draw_objects(pack: DevicePack, object_scene: wp.array2d(dtype=wp.int64),
                 object_pose: wp.array3d(dtype=wp.float64), cameras: wp.array2d(dtype=wp.float64),
                 focal: wp.array(dtype=wp.float64), size: int, most_faces: int,
                 visible: wp.array3d(dtype=wp.uint64)):
    """One thread: one object, one camera, one band of rows."""
    n, m, band = wp.tid()
    scene = wp.int32(object_scene[n, m])
    if scene < 0:
        return
    frame = object_frame(camera_frame(cameras, n), object_pose, n, m)
    slope = wp.float64(size) * wp.float64(0.5) / focal[n]
    first = wp.int32(pack.scene_group[scene])
    base = pack.group_start[first]
    for group in range(first, wp.int32(pack.scene_group[scene + 1])):
        if in_frustum(pack, group, frame, slope):
            for face in range(pack.group_start[group], pack.group_start[group + 1]):
                draw_face(pack, face, (m + 1) * most_faces + face - base, frame, focal[n], size,
                          band, n, visible)


@wp.func
def prepare(pack: DevicePack, face: int, frame: _frame_type, focal: wp.float64, half: wp.float64,
            cube: wp.array3d(dtype=wp.float32), lamps: wp.array3d(dtype=wp.float32), n: int,
            room: int):
    """As `rasterizer._prepare`."""
    slot = _slot_type()
    nx, ny, nz = pack.face_plane[face, 0], pack.face_plane[face, 1], pack.face_plane[face, 2]
    height = (wp.float64(nx) * frame[0] + wp.float64(ny) * frame[1] + wp.float64(nz) * frame[2]
              - wp.float64(pack.face_plane[face, 3]))
    for k in range(2):
        ux = wp.float64(pack.face_uv[face, k, 0])
        uy = wp.float64(pack.face_uv[face, k, 1])
        uz = wp.float64(pack.face_uv[face, k, 2])
        right = (ux * frame[6] + uy * frame[7] + uz * frame[8]) / focal
        down = (ux * frame[9] + uy * frame[10] + uz * frame[11]) / focal
        slot[4 * k] = wp.float32(right)
        slot[4 * k + 1] = wp.float32(down)
        slot[4 * k + 2] = wp.float32(ux * frame[3] + uy * frame[4] + uz * frame[5]
                                     + (wp.float64(0.5) - half) * (right + down))
        slot[4 * k + 3] = wp.float32(ux * frame[0] + uy * frame[1] + uz * frame[2]
                                     + wp.float64(pack.face_uv[face, k, 3]))
    ux = wp.float64(pack.face_uv[face, 0, 0])
    uy = wp.float64(pack.face_uv[face, 0, 1])
    uz = wp.float64(pack.face_uv[face, 0, 2])
    texels = wp.float64(pack.face_texture[face, 1]) / focal
    slot[8] = wp.float32((ux * ux + uy * uy + uz * uz) * texels * texels)
    slot[9] = wp.float32(wp.float64(1.0) / height)
    side_x, side_y, side_z = int(1), int(3), int(5)
    if nx > 0.0:
        side_x = int(0)
    if ny > 0.0:
        side_y = int(2)
    if nz > 0.0:
        side_z = int(4)
    for channel in range(3):
        ambient = (nx * nx * cube[n, side_x, channel] + ny * ny * cube[n, side_y, channel]
                   + nz * nz * cube[n, side_z, channel])
        colour = pack.face_colour[face, channel] * wp.float32(65536.0 / 65280.0)
        slot[10 + channel] = colour * ambient
        slot[13 + channel] = colour * lamps[n, room, channel]
    return slot


@wp.func
def light_at(pack: DevicePack, face: int, u: wp.float32, v: wp.float32):
    """As `rasterizer._light_at`."""
    width = pack.face_light[face, 1]
    limit = wp.float32(width - 1) * 16.0
    x = u * pack.face_light_map[face, 0] + pack.face_light_map[face, 1]
    y = v * pack.face_light_map[face, 2] + pack.face_light_map[face, 3]
    i = wp.int32(wp.max(wp.min(x * 16.0, limit), 0.0))
    j = wp.int32(wp.max(wp.min(y * 16.0, _last_node), 0.0))
    node = pack.face_light[face, 0] + (j >> 4) * width + (i >> 4)
    wx, wy = wp.uint64(i & 15), wp.uint64(j & 15)
    mixed = (pack.light[node] * (wp.uint64(16) - wy) + pack.light[node + width] * wy)
    light = ((mixed & _low_half) * (wp.uint64(16) - wx)
             + (mixed >> wp.uint64(32)) * wx)
    return wp.vec2(wp.float32(wp.int32(light & wp.uint64(0xFFFF))),
                   wp.float32(wp.int32(light >> wp.uint64(16))))


@wp.func
def fixed(light: wp.vec2, ambient_colour: wp.float32, lamp_colour: wp.float32):
    """As `rasterizer._fixed`."""
    return wp.int32(wp.min(light[0] * ambient_colour + light[1] * lamp_colour, 65535.0))


@wp.func
def ident_at(visible: wp.array3d(dtype=wp.uint64), n: int, row: int, column: int):
    """Index of the polygon at a pixel; -1: none."""
    bits = visible[n, row, column]
    if bits == wp.uint64(0):
        return wp.int32(-1)
    return wp.int32(_all_bits - wp.uint32(bits & _low_half))


@wp.func
def depth_at(visible: wp.array3d(dtype=wp.uint64), n: int, row: int, column: int):
    """Depth at a pixel."""
    inverse = wp.cast(wp.uint32(visible[n, row, column] >> wp.uint64(32)), wp.float32)
    return wp.float32(1.0) / wp.max(inverse, wp.float32(1.0e-9))


@wp.kernel
def shade(pack: DevicePack, scene_index: wp.array(dtype=wp.int64),
          cameras: wp.array2d(dtype=wp.float64), focal: wp.array(dtype=wp.float64),
          cube: wp.array3d(dtype=wp.float32), lamps: wp.array3d(dtype=wp.float32),
          object_scene: wp.array2d(dtype=wp.int64), object_pose: wp.array3d(dtype=wp.float64),
          object_room: wp.array2d(dtype=wp.int64), size: int, most_faces: int,
          visible: wp.array3d(dtype=wp.uint64), rgb: wp.array4d(dtype=wp.uint8),
          depth: wp.array3d(dtype=wp.float32), labels: wp.array3d(dtype=wp.uint8),
          instances: wp.array3d(dtype=wp.uint16)):
    """One thread: one block of a row of one picture. As `rasterizer._shade`."""
    n, row, block = wp.tid()
    begin = block * _block
    block_end = wp.min(begin + _block, size)
    half = wp.float64(size) * wp.float64(0.5)
    own_frame = camera_frame(cameras, n)
    first_face = pack.group_start[wp.int32(pack.scene_group[wp.int32(scene_index[n])])]
    while begin < block_end:
        ident = ident_at(visible, n, row, begin)
        end = begin + 1
        while end < block_end and ident_at(visible, n, row, end) == ident:
            end += 1
        if ident < 0:
            for column in range(begin, end):
                for channel in range(3):
                    rgb[n, channel, row, column] = wp.uint8(0)
                depth[n, row, column] = wp.float32(0.0)
                labels[n, row, column] = wp.uint8(0)
                instances[n, row, column] = wp.uint16(0)
        else:
            which = ident // most_faces
            face = int(0)
            room = int(0)
            instance = wp.uint16(0)
            frame = own_frame
            if which == 0:
                face = first_face + ident
                room = pack.face_room[face]
                instance = pack.face_instance[face]
            else:
                m = which - 1
                group = wp.int32(pack.scene_group[wp.int32(object_scene[n, m])])
                face = pack.group_start[group] + ident - which * most_faces
                room = wp.int32(object_room[n, m])
                instance = wp.uint16(65536 - which)
                frame = object_frame(own_frame, object_pose, n, m)
            s = prepare(pack, face, frame, focal[n], half, cube, lamps, n, room)
            u_offset, v_offset = s[3], s[7]
            u_row = s[2] + wp.float32(row) * s[1]
            v_row = s[6] + wp.float32(row) * s[5]
            z = depth_at(visible, n, row, begin)
            x = wp.float32(begin)
            light = light_at(pack, face, u_offset + z * (u_row + x * s[0]),
                             v_offset + z * (v_row + x * s[4]))
            red = fixed(light, s[10], s[13])
            green = fixed(light, s[11], s[14])
            blue = fixed(light, s[12], s[15])
            last = end - 1
            if end < size and end - begin > 1:
                if ident_at(visible, n, row, end) == ident:
                    last = end
            red_step, green_step, blue_step = wp.int32(0), wp.int32(0), wp.int32(0)
            if last > begin + 1:
                far_z = depth_at(visible, n, row, last)
                far_x = wp.float32(last)
                light = light_at(pack, face, u_offset + far_z * (u_row + far_x * s[0]),
                                 v_offset + far_z * (v_row + far_x * s[4]))
                share = wp.float32(1.0) / wp.float32(last - begin)
                red_step = wp.int32(wp.float32(fixed(light, s[10], s[13]) - red) * share)
                green_step = wp.int32(wp.float32(fixed(light, s[11], s[14]) - green) * share)
                blue_step = wp.int32(wp.float32(fixed(light, s[12], s[15]) - blue) * share)
                z = wp.min(z, far_z)
            footprint = s[8] * z * z * wp.max(wp.float32(1.0), z * s[9])
            side = pack.face_texture[face, 1]
            whole = side * side
            exponent = (wp.cast(footprint, wp.int32) >> 23) - 127
            level = wp.max(0, (exponent + 1) >> 1)
            side = wp.max(side >> wp.min(level, 16), 4)
            texel_start = pack.face_texture[face, 0] + (whole - side * side) // 3 * 4
            wide = wp.float32(side)
            mask = side - 1
            u_offset, v_offset, u_row, v_row = (u_offset * wide, v_offset * wide, u_row * wide,
                                                v_row * wide)
            u_right, v_right = s[0] * wide, s[4] * wide
            label = pack.face_label[face]
            for column in range(begin, end):
                z = depth_at(visible, n, row, column)
                x = wp.float32(column)
                i = wp.int32(u_offset + z * (u_row + x * u_right)) & mask
                j = wp.int32(v_offset + z * (v_row + x * v_right)) & mask
                texel = wp.int32(pack.texels[texel_start + j * side + i])
                rgb[n, 0, row, column] = wp.uint8(((texel & 255) * red + 32768) >> 16)
                rgb[n, 1, row, column] = wp.uint8((((texel >> 8) & 255) * green + 32768) >> 16)
                rgb[n, 2, row, column] = wp.uint8(((texel >> 16) * blue + 32768) >> 16)
                depth[n, row, column] = z
                labels[n, row, column] = label
                instances[n, row, column] = instance
                red += red_step
                green += green_step
                blue += blue_step
        begin = end


@wp.kernel
def expose(source: wp.array4d(dtype=wp.uint8), noise: wp.array(dtype=wp.float32),
           blur: wp.array(dtype=wp.float32), keys: wp.array(dtype=wp.uint64),
           rgb: wp.array4d(dtype=wp.uint8)):
    """One thread: one row of one channel. As `sensor.expose`, from one buffer into another."""
    n, channel, row = wp.tid()
    width = source.shape[3]
    span = wp.min(wp.int32(wp.rint(blur[n] * wp.float32(width))), 63)
    before = span // 2
    total = wp.int32(0)
    if span > 1:
        for k in range(-before, span - before):
            total += wp.int32(source[n, channel, row, wp.clamp(k, 0, width - 1)])
    scale = wp.int32(wp.float64(noise[n]) / wp.float64(147.8) * wp.float64(65536.0))
    key = wp.uint32((keys[n] ^ (keys[n] >> wp.uint64(32))) & _low_half)
    for column in range(width):
        value = wp.int32(source[n, channel, row, column])
        if span > 1:
            value = total // span
            total += wp.int32(source[n, channel, row, wp.min(column + span - before, width - 1)])
            total -= wp.int32(source[n, channel, row, wp.max(column - before, 0)])
        if noise[n] > 0.0:
            index = wp.uint32((channel * source.shape[2] + row) * width + column)
            bits = (index * _mix_0) ^ key
            bits = (bits ^ (bits >> wp.uint32(16))) * _mix_1
            bits = (bits ^ (bits >> wp.uint32(13))) * _mix_2
            bits = bits ^ (bits >> wp.uint32(16))
            noisy = (wp.int32(bits & wp.uint32(255)) + wp.int32((bits >> wp.uint32(8))
                     & wp.uint32(255)) + wp.int32((bits >> wp.uint32(16)) & wp.uint32(255))
                     + wp.int32(bits >> wp.uint32(24)) - 510)
            value = wp.clamp(value + ((noisy * scale + 32768) >> 16), 0, 255)
        rgb[n, channel, row, column] = wp.uint8(value)


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
