"""Which polygon each pixel of a camera shows, and how deep: the first half of `rasterizer`.

Groups of polygons are culled by their boxes against the frustum, then drawn from front to back; a
group whose box lies behind what is drawn already is skipped (tiles of pixels keep the farthest
depth). Front faces are near-clipped, projected and scan-converted row by row into a visibility
buffer (polygon and inverse depth). Where two polygons have equal depth the lower index wins,
whatever the order of drawing.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vn_sim_bridge.render.pack import CLUSTER
from vn_sim_bridge.render.scene import MAX_CORNERS

NEAR = 0.03  # m, near plane
TILE = 8  # pixels a side, of the coarse depth that hides groups
BINS = 32  # of the front-to-back order
BIN_DEPTH = 0.5  # m
ALWAYS_DRAWN = 1.0  # m: a nearer group is not compared with what is drawn already
GROUPS_AN_UPDATE = 12  # drawn before the tiles are updated again
MAX_SIZE = 2048  # pixels a side of a picture
# The right ends of a row's spans follow the left ones in one buffer, a constant distance apart: so
# the compiler sees that they do not overlap.
RIGHT_ENDS = np.uint64(MAX_SIZE)

# No reassociation and no fused multiply-add: Warp's kernels must find the same pixels.
exact = numba.njit(cache=True, fastmath={'nnan', 'ninf', 'nsz'}, error_model='numpy')
exact_parallel = numba.njit(cache=True, fastmath={'nnan', 'ninf', 'nsz'}, error_model='numpy',
                            parallel=True)


@exact
def camera_frame(camera, out):
    """Position, forward, right and down axes of a camera in the map frame, [12]."""
    cy, sy = math.cos(camera[3]), math.sin(camera[3])
    cp, sp = math.cos(camera[4]), math.sin(camera[4])
    out[0], out[1], out[2] = camera[0], camera[1], camera[2]
    out[3], out[4], out[5] = cp * cy, cp * sy, -sp
    out[6], out[7], out[8] = sy, -cy, 0.0
    out[9], out[10], out[11] = -sp * cy, -sp * sy, -cp


@exact
def object_frame(frame, pose, out):
    """The camera's frame as an object at `pose` sees it: its scene stands at its own origin."""
    c, s = math.cos(pose[3]), math.sin(pose[3])
    x, y = frame[0] - pose[0], frame[1] - pose[1]
    out[0], out[1], out[2] = c * x + s * y, c * y - s * x, frame[2] - pose[2]
    for axis in range(3, 12, 3):
        x, y = frame[axis], frame[axis + 1]
        out[axis], out[axis + 1], out[axis + 2] = c * x + s * y, c * y - s * x, frame[axis + 2]


@exact
def nearest_depth(box, frame, slope):
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


@exact
def is_hidden(box, frame, focal, size, tiles):
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


@exact
def update_tiles(inverse_depth, tiles):
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


@exact
def draw_faces(pack, first_face, last_face, first_ident, frame, focal, size, polygon, clipped,
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
            spans[row + RIGHT_ENDS] = np.float32(0.0)
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
                spans[row + RIGHT_ENDS] = max(spans[row + RIGHT_ENDS], x)
        # 1 / depth is affine in the pixel: n . direction / -height.
        across = (nx * rx + ny * ry + nz * rz) / (-height * focal)
        along = (nx * dx + ny * dy + nz * dz) / (-height * focal)
        base = ((nx * fx + ny * fy + nz * fz) / -height + (0.5 - half) * across
                + (0.5 - half) * along)
        slope_x = np.float32(across)
        for row in range(np.uint64(first_row), np.uint64(last_row)):
            begin = np.int32(max(spans[row], np.float32(0.0)) + np.float32(0.5))
            end = np.int32(min(spans[row + RIGHT_ENDS], limit) + np.float32(0.5))
            row_value = np.float32(base + np.int32(row) * along)
            inverses, idents = inverse_depth[row], ident_of_pixel[row]
            for column in range(np.uint64(begin), np.uint64(max(begin, end))):
                value = row_value + np.float32(np.int32(column)) * slope_x
                old, other = inverses[column], idents[column]
                wins = (value > old) | ((value == old) & (ident < other))
                inverses[column] = value if wins else old
                idents[column] = ident if wins else other


@exact
def fill_visibility(pack, scene, frames, objects, focal, size, most_faces, work, inverse_depth,
                    ident_of_pixel):
    """Fill the visibility buffer of one camera."""
    depth_of, group_of, order, bin_start, tiles, polygon, clipped, spans = work
    frame = frames[0]
    slope = size * 0.5 / focal
    first, last = pack.scene_group[scene], pack.scene_group[scene + 1]
    bin_start[:] = 0
    count = 0
    for cluster in range(pack.scene_cluster[scene], pack.scene_cluster[scene + 1]):
        if nearest_depth(pack.cluster_box[cluster], frame, slope) < 0.0:
            continue
        begin = first + (cluster - pack.scene_cluster[scene]) * CLUSTER
        for group in range(begin, min(begin + CLUSTER, last)):
            depth = nearest_depth(pack.group_box[group], frame, slope)
            if depth >= 0.0:
                depth_of[count] = depth
                group_of[count] = group
                count += 1
                bin_start[min(int(depth / BIN_DEPTH), BINS - 1) + 1] += 1
    for k in range(BINS):
        bin_start[k + 1] += bin_start[k]
    for k in range(count):
        depth_bin = min(int(depth_of[k] / BIN_DEPTH), BINS - 1)
        order[bin_start[depth_bin]] = k
        bin_start[depth_bin] += 1
    first_face = np.int64(pack.group_start[first])
    drawn_since_update = 0
    tiles_known = False
    farthest_depth = 1e30  # m: everything that can be seen is nearer
    for k in range(count):
        group, depth = group_of[order[k]], depth_of[order[k]]
        if depth > ALWAYS_DRAWN:
            if drawn_since_update >= GROUPS_AN_UPDATE or (
                    not tiles_known and drawn_since_update > 0):
                farthest = update_tiles(inverse_depth, tiles)
                if farthest > np.float32(0.0):
                    farthest_depth = 1.0 / farthest
                drawn_since_update = 0
                tiles_known = True
            if depth > farthest_depth:
                continue
            if tiles_known and is_hidden(pack.group_box[group], frame, focal, size, tiles):
                continue
        begin = np.int64(pack.group_start[group])
        draw_faces(pack, begin, np.int64(pack.group_start[group + 1]), begin - first_face, frame,
                   focal, size, polygon, clipped, spans, inverse_depth, ident_of_pixel)
        drawn_since_update += 1
    for m in range(objects.shape[0]):
        if objects[m] < 0:
            continue
        first, last = pack.scene_group[objects[m]], pack.scene_group[objects[m] + 1]
        for group in range(first, last):
            if nearest_depth(pack.group_box[group], frames[m + 1], slope) < 0.0:
                continue
            begin = np.int64(pack.group_start[group])
            draw_faces(pack, begin, np.int64(pack.group_start[group + 1]),
                       (m + 1) * most_faces + begin - pack.group_start[first], frames[m + 1],
                       focal, size, polygon, clipped, spans, inverse_depth, ident_of_pixel)


@exact
def visibility_workspace(size, most_groups):
    """The buffers of `fill_visibility`."""
    tiles = (size + TILE - 1) // TILE
    return (np.empty(most_groups), np.empty(most_groups, np.int64),
            np.empty(most_groups, np.int64),
            np.empty(BINS + 1, np.int64), np.empty((tiles, tiles), np.float32),
            np.empty((MAX_CORNERS + 2, 3), np.float32), np.empty((MAX_CORNERS + 2, 3), np.float32),
            np.empty(2 * MAX_SIZE, np.float32))
