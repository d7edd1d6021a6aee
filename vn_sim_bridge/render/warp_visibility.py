"""Which polygon each pixel shows, on a Warp device: `visibility` as kernels.

An atomic maximum of inverse depth and polygon index finds the nearest polygon. Coverage follows
the arithmetic of the Numba renderer operation by operation, in the same precision and order, so
that labels agree to the pixel.
"""

from __future__ import annotations

import warp as wp

from vn_sim_bridge.render.scene import MAX_CORNERS
from vn_sim_bridge.render.visibility import NEAR

wp.set_module_options({'enable_backward': False, 'fast_math': False})

BAND = 16  # rows that one thread scan-converts
_near = wp.constant(wp.float64(NEAR))
_near_32 = wp.constant(wp.float32(NEAR))
_band = wp.constant(BAND)
_all_bits = wp.constant(wp.uint32(0xFFFFFFFF))
_low_half = wp.constant(wp.uint64(0xFFFFFFFF))
Frame = wp.types.vector(12, wp.float64)  # a camera, see `visibility.camera_frame`
_points = wp.types.vector(3 * (MAX_CORNERS + 2), wp.float32)
_rows = wp.types.vector(BAND, wp.float32)


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
    """As `visibility.camera_frame`."""
    cy, sy = wp.cos(cameras[n, 3]), wp.sin(cameras[n, 3])
    cp, sp = wp.cos(cameras[n, 4]), wp.sin(cameras[n, 4])
    return Frame(cameras[n, 0], cameras[n, 1], cameras[n, 2], cp * cy, cp * sy, -sp, sy, -cy,
                 wp.float64(0.0), -sp * cy, -sp * sy, -cp)


@wp.func
def object_frame(frame: Frame, pose: wp.array3d(dtype=wp.float64), n: int, m: int):
    """As `visibility.object_frame`."""
    c, s = wp.cos(pose[n, m, 3]), wp.sin(pose[n, m, 3])
    x, y = frame[0] - pose[n, m, 0], frame[1] - pose[n, m, 1]
    return Frame(
        c * x + s * y, c * y - s * x, frame[2] - pose[n, m, 2],
        c * frame[3] + s * frame[4], c * frame[4] - s * frame[3], frame[5],
        c * frame[6] + s * frame[7], c * frame[7] - s * frame[6], frame[8],
        c * frame[9] + s * frame[10], c * frame[10] - s * frame[9], frame[11])


@wp.func
def in_frustum(pack: DevicePack, group: int, frame: Frame, slope: wp.float64):
    """As `visibility.nearest_depth`, but only yes or no."""
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
def draw_face(pack: DevicePack, face: int, ident: int, frame: Frame, focal: wp.float64,
              size: int, band: int, n: int, visible: wp.array3d(dtype=wp.uint64)):
    """As `visibility.draw_faces`, for the rows of one band."""
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
