"""Colour, depth and labels of every pixel, on a Warp device: `shading` as a kernel.

Texture coordinates and light may differ from the Numba renderer's in the last bit.
"""

from __future__ import annotations

import warp as wp

from vn_sim_bridge.render.shading import BLOCK, LAST_NODE
from vn_sim_bridge.render.warp_visibility import (
    DevicePack,
    Frame,
    camera_frame,
    depth_at,
    ident_at,
    object_frame,
)

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_block = wp.constant(BLOCK)
_last_node = wp.constant(wp.float32(LAST_NODE))
_low_half = wp.constant(wp.uint64(0xFFFFFFFF))
_slot_type = wp.types.vector(16, wp.float32)


@wp.func
def prepare(pack: DevicePack, face: int, frame: Frame, focal: wp.float64, half: wp.float64,
            cube: wp.array3d(dtype=wp.float32), lamps: wp.array3d(dtype=wp.float32), n: int,
            room: int):
    """As `shading.prepare`."""
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
    """As `shading.light_at`."""
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
    """As `shading.fixed`."""
    return wp.int32(wp.min(light[0] * ambient_colour + light[1] * lamp_colour, 65535.0))


@wp.kernel
def shade(pack: DevicePack, scene_index: wp.array(dtype=wp.int64),
          cameras: wp.array2d(dtype=wp.float64), focal: wp.array(dtype=wp.float64),
          cube: wp.array3d(dtype=wp.float32), lamps: wp.array3d(dtype=wp.float32),
          object_scene: wp.array2d(dtype=wp.int64), object_pose: wp.array3d(dtype=wp.float64),
          object_room: wp.array2d(dtype=wp.int64), size: int, most_faces: int,
          visible: wp.array3d(dtype=wp.uint64), rgb: wp.array4d(dtype=wp.uint8),
          depth: wp.array3d(dtype=wp.float32), labels: wp.array3d(dtype=wp.uint8),
          instances: wp.array3d(dtype=wp.uint16)):
    """One thread: one block of a row of one picture. As `shading.shade`."""
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
            slot = prepare(pack, face, frame, focal[n], half, cube, lamps, n, room)
            u_offset, v_offset = slot[3], slot[7]
            u_row = slot[2] + wp.float32(row) * slot[1]
            v_row = slot[6] + wp.float32(row) * slot[5]
            z = depth_at(visible, n, row, begin)
            x = wp.float32(begin)
            light = light_at(pack, face, u_offset + z * (u_row + x * slot[0]),
                             v_offset + z * (v_row + x * slot[4]))
            red = fixed(light, slot[10], slot[13])
            green = fixed(light, slot[11], slot[14])
            blue = fixed(light, slot[12], slot[15])
            last = end - 1
            if end < size and end - begin > 1:
                if ident_at(visible, n, row, end) == ident:
                    last = end
            red_step, green_step, blue_step = wp.int32(0), wp.int32(0), wp.int32(0)
            if last > begin + 1:
                far_z = depth_at(visible, n, row, last)
                far_x = wp.float32(last)
                light = light_at(pack, face, u_offset + far_z * (u_row + far_x * slot[0]),
                                 v_offset + far_z * (v_row + far_x * slot[4]))
                share = wp.float32(1.0) / wp.float32(last - begin)
                red_step = wp.int32(wp.float32(fixed(light, slot[10], slot[13]) - red) * share)
                green_step = wp.int32(wp.float32(fixed(light, slot[11], slot[14]) - green) * share)
                blue_step = wp.int32(wp.float32(fixed(light, slot[12], slot[15]) - blue) * share)
                z = wp.min(z, far_z)
            footprint = slot[8] * z * z * wp.max(wp.float32(1.0), z * slot[9])
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
            u_right, v_right = slot[0] * wide, slot[4] * wide
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
