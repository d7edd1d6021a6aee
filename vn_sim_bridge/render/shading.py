"""Colour, depth and labels of every pixel: the second half of `rasterizer`.

Inverse depth and texture coordinates come from the polygon's plane equation, so they are
perspective-correct at every pixel.
"""

from __future__ import annotations

import numba
import numpy as np

from vn_sim_bridge.render.pack import EMPTY
from vn_sim_bridge.render.scene import MAX_LIGHT_NODES

BLOCK = 16  # pixels of a row between which light is linear
LAST_NODE = (MAX_LIGHT_NODES - 1) * 16

fast = numba.njit(cache=True, fastmath=True, error_model='numpy')


@fast
def prepare(pack, face, frame, focal, half, cube, lamp, slot):
    """Fill a visible polygon's slot [16]: affine texture coordinates, scale, lit colours."""
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


@fast
def light_at(face_light, face_light_map, light, face, u, v):
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


@fast
def fixed(ambient, lamp, ambient_colour, lamp_colour):
    """A lit colour as 16.16 fixed point, at most 1."""
    return np.int32(min(ambient * ambient_colour + lamp * lamp_colour, np.float32(65535.0)))


@fast
def shade(pack, scene, frames, objects, object_room, cube, lamps, focal, most_faces,
          work, inverse_depth, ident_of_pixel, rgb, depth, labels, instances):
    """Colour, depth and labels of every pixel.

    Works through runs of the same polygon within aligned blocks of `BLOCK` pixels of a row.
    Texture coordinates are exact at every pixel; mip level and light are those of the run's
    ends, light is linear in between.
    """
    size = depth.shape[0]
    half = size * 0.5
    slots, slot_of, code_of, stamp_of, stamp, codes = work
    bits = np.int32(8 * labels.itemsize)  # of a class; known when this is compiled
    classes = np.int32((1 << bits) - 1)
    slots_used = 0
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
        slot_ident = EMPTY
        slot = slots[0]
        face = 0
        light_known = False
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
            if ident != slot_ident:
                slot_ident = ident
                owner = 0  # the scene; m + 1: object m
                if ident < most_faces:
                    face = first_face + ident
                else:
                    owner = ident // most_faces
                    face = (pack.group_start[pack.scene_group[objects[owner - 1]]]
                            + ident - owner * most_faces)
                if stamp_of[ident] != stamp:
                    stamp_of[ident] = stamp
                    slot_of[ident] = slots_used
                    room = pack.face_room[face] if owner == 0 else object_room[owner - 1]
                    prepare(pack, face, frames[owner], focal, half, cube, lamps[room],
                            slots[slots_used])
                    instance = np.int32(pack.face_instance[face]) if owner == 0 else 65536 - owner
                    code_of[ident] = np.int32(instance << bits) | np.int32(pack.face_label[face])
                    slots_used += 1
                slot = slots[np.uint64(slot_of[ident])]
            u_offset, v_offset = slot[3], slot[7]
            u_row = slot[2] + np.float32(row) * slot[1]
            v_row = slot[6] + np.float32(row) * slot[5]
            z = depths[begin]
            if not light_known:
                x = np.float32(begin)
                ambient, lamp = light_at(
                    face_light, face_light_map, light, face,
                    u_offset + z * (u_row + x * slot[0]), v_offset + z * (v_row + x * slot[4]))
                red = fixed(ambient, lamp, slot[10], slot[13])
                green = fixed(ambient, lamp, slot[11], slot[14])
                blue = fixed(ambient, lamp, slot[12], slot[15])
            # A run that goes on in the next block takes its light over from there.
            light_known = end < size and end - begin > 1 and idents[end] == ident
            last = end if light_known else end - 1
            red_step = green_step = blue_step = np.int32(0)
            if last > begin + 1:
                far_z = depths[last]
                x = np.float32(last)
                ambient, lamp = light_at(
                    face_light, face_light_map, light, face,
                    u_offset + far_z * (u_row + x * slot[0]),
                    v_offset + far_z * (v_row + x * slot[4]))
                next_red = fixed(ambient, lamp, slot[10], slot[13])
                next_green = fixed(ambient, lamp, slot[11], slot[14])
                next_blue = fixed(ambient, lamp, slot[12], slot[15])
                share = np.float32(1.0) / np.float32(last - begin)
                red_step = np.int32(np.float32(next_red - red) * share)
                green_step = np.int32(np.float32(next_green - green) * share)
                blue_step = np.int32(np.float32(next_blue - blue) * share)
                z = min(z, far_z)
            # Squared texels under a pixel; a slanted surface packs more of them (z / height is the
            # inverse cosine up to the ray's length). Half its binary exponent is the mip level.
            footprint = slot[8] * z * z * max(np.float32(1.0), z * slot[9])
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
            u_right, v_right = slot[0] * wide, slot[4] * wide
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
            if light_known:
                red, green, blue = next_red, next_green, next_blue
            begin = end
        label_row, instance_row = labels[row], instances[row]
        for column in range(np.uint64(size)):
            codes[column] = code_of[np.uint64(min(idents[column], nothing))]
        for column in range(np.uint64(size)):
            label_row[column] = codes[column] & classes
        for column in range(np.uint64(size)):
            instance_row[column] = np.uint16(codes[column] >> bits)
