"""Triangles seen from above: heights over a grid of cells, what stands in the way, rectangles."""

from __future__ import annotations

import math

import numba
import numpy as np

SAME = 0.05  # m: a rug and its floor are one
SPACING = 0.4  # cells between two samples along an edge


@numba.njit(cache=True)
def _cells_inside(corners, t, x0, y0, cell, rows, columns):
    """Rows and columns that the bounding box of a triangle covers, clipped to the grid."""
    ax, ay = corners[t, 0, 0], corners[t, 0, 1]
    bx, by = corners[t, 1, 0], corners[t, 1, 1]
    cx, cy = corners[t, 2, 0], corners[t, 2, 1]
    first_column = max(int(math.ceil((min(ax, bx, cx) - x0) / cell - 0.5)), 0)
    last_column = min(int(math.floor((max(ax, bx, cx) - x0) / cell - 0.5)), columns - 1)
    first_row = max(int(math.ceil((min(ay, by, cy) - y0) / cell - 0.5)), 0)
    last_row = min(int(math.floor((max(ay, by, cy) - y0) / cell - 0.5)), rows - 1)
    return first_row, last_row, first_column, last_column


@numba.njit(cache=True)
def _height_at(corners, t, x, y):
    """Height of a triangle above or below a point; not a number where it is beside the point."""
    ax, ay = corners[t, 0, 0], corners[t, 0, 1]
    ux, uy = corners[t, 1, 0] - ax, corners[t, 1, 1] - ay
    vx, vy = corners[t, 2, 0] - ax, corners[t, 2, 1] - ay
    area = ux * vy - uy * vx
    if abs(area) < 1e-12:
        return math.nan
    a = ((x - ax) * vy - (y - ay) * vx) / area
    b = (ux * (y - ay) - uy * (x - ax)) / area
    if a < -1e-9 or b < -1e-9 or a + b > 1.0 + 1e-9:
        return math.nan
    return (corners[t, 0, 2] + a * (corners[t, 1, 2] - corners[t, 0, 2])
            + b * (corners[t, 2, 2] - corners[t, 0, 2]))


@numba.njit(cache=True)
def highest(corners, x0, y0, cell, top):
    """Fill `top` [rows,columns] with the greatest height over each cell's centre; -inf: none."""
    rows, columns = top.shape
    top[:] = -np.inf
    for t in range(len(corners)):
        i0, i1, j0, j1 = _cells_inside(corners, t, x0, y0, cell, rows, columns)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                z = _height_at(corners, t, x0 + (j + 0.5) * cell, y0 + (i + 0.5) * cell)
                if z > top[i, j]:
                    top[i, j] = z


@numba.njit(cache=True)
def level_histogram(corners, upward, x0, y0, cell, rows, columns, headroom, z0, height, bare,
                    covered):
    """Count cells of surfaces by height, where a robot has headroom.

    Args:
        upward: [T] bool: which triangles face up.
        headroom: how far above a surface the next one is, at least [m]; `SAME` is still itself.
        z0, height: of the first bin, and of each [m].
        bare, covered: [bins] int64, added to: cells with nothing above, and with something.
    """
    first = np.zeros(rows * columns + 1, np.int64)
    for turn in range(2):
        if turn == 1:
            for k in range(rows * columns):
                first[k + 1] += first[k]
            heights = np.empty(first[-1])
            faces_up = np.empty(first[-1], np.bool_)
            filled = first[:-1].copy()
        for t in range(len(corners)):
            i0, i1, j0, j1 = _cells_inside(corners, t, x0, y0, cell, rows, columns)
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    z = _height_at(corners, t, x0 + (j + 0.5) * cell, y0 + (i + 0.5) * cell)
                    if math.isnan(z):
                        continue
                    k = i * columns + j
                    if turn == 0:
                        first[k + 1] += 1
                    else:
                        heights[filled[k]], faces_up[filled[k]] = z, upward[t]
                        filled[k] += 1
    for k in range(rows * columns):
        own = heights[first[k]:first[k + 1]]
        order = np.argsort(own)
        for at in range(len(own)):
            z = own[order[at]]
            if not faces_up[first[k] + order[at]]:
                continue
            above = at + 1
            while above < len(own) and own[order[above]] <= z + SAME:
                above += 1
            place = int((z - z0) / height)
            if not 0 <= place < len(bare):
                continue
            if above == len(own):
                bare[place] += 1
            elif own[order[above]] > z + headroom:
                covered[place] += 1


@numba.njit(cache=True)
def supported(corners, upward, x0, y0, cell, low, high, out):
    """Mark the cells [rows,columns] with a surface to stand on between two heights."""
    rows, columns = out.shape
    for t in range(len(corners)):
        if not upward[t]:
            continue
        i0, i1, j0, j1 = _cells_inside(corners, t, x0, y0, cell, rows, columns)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                z = _height_at(corners, t, x0 + (j + 0.5) * cell, y0 + (i + 0.5) * cell)
                if low <= z <= high:
                    out[i, j] = True


@numba.njit(cache=True)
def _clip(points, count, height, keep_above, out):
    """The part of a polygon [count,3] above or below a height; its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        a, b = points[i, 2] - height, points[j, 2] - height
        if not keep_above:
            a, b = -a, -b
        if a >= 0.0:
            for k in range(3):
                out[kept, k] = points[i, k]
            kept += 1
        if (a >= 0.0) != (b >= 0.0):
            share = a / (a - b)
            for k in range(3):
                out[kept, k] = points[i, k] + share * (points[j, k] - points[i, k])
            kept += 1
    return kept


@numba.njit(cache=True)
def _touch(x, y, kind, x0, y0, cell, cells, bounds):
    """Mark the cell of a point, and stretch what is known to stand in it."""
    i, j = int(math.floor((y - y0) / cell)), int(math.floor((x - x0) / cell))
    if not (0 <= i < cells.shape[0] and 0 <= j < cells.shape[1]):
        return
    if cells[i, j] < 0:
        cells[i, j] = kind
        bounds[i, j, 0] = bounds[i, j, 2] = x
        bounds[i, j, 1] = bounds[i, j, 3] = y
        return
    bounds[i, j, 0] = min(bounds[i, j, 0], x)
    bounds[i, j, 1] = min(bounds[i, j, 1], y)
    bounds[i, j, 2] = max(bounds[i, j, 2], x)
    bounds[i, j, 3] = max(bounds[i, j, 3], y)


@numba.njit(cache=True)
def standing(corners, kinds, low, high, x0, y0, cell, cells, bounds):
    """Mark the cells in which something is between two heights.

    Args:
        corners: [T,3,3] m; kinds: [T] int32 >= 0, what each triangle is.
        low, high: m.
        cells: [rows,columns] int32, -1 where nothing is yet: gets the kind of the first triangle.
        bounds: [rows,columns,4] float64: x0, y0, x1, y1 of what is in each cell.
    """
    polygon, part, other = np.empty((8, 3)), np.empty((8, 3)), np.empty((8, 3))
    for t in range(len(corners)):
        least = min(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        most = max(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        if least > high or most < low:
            continue
        for i in range(3):
            for k in range(3):
                polygon[i, k] = corners[t, i, k]
        count = _clip(polygon, 3, low, True, part)
        count = _clip(part, count, high, False, other)
        for i in range(count):
            j = i + 1 if i + 1 < count else 0
            ax, ay = other[i, 0], other[i, 1]
            dx, dy = other[j, 0] - ax, other[j, 1] - ay
            steps = int(math.hypot(dx, dy) / (SPACING * cell)) + 1
            for k in range(steps + 1):
                _touch(ax + dx * k / steps, ay + dy * k / steps, kinds[t], x0, y0, cell, cells,
                       bounds)
        for k in range(1, count - 1):  # a fan: cells wholly inside have no edge of it
            part[0], part[1], part[2] = other[0], other[k], other[k + 1]
            fan = part[:3].copy().reshape(1, 3, 3)
            i0, i1, j0, j1 = _cells_inside(fan, 0, x0, y0, cell, cells.shape[0], cells.shape[1])
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    x, y = x0 + (j + 0.5) * cell, y0 + (i + 0.5) * cell
                    if not math.isnan(_height_at(fan, 0, x, y)):
                        _touch(x, y, kinds[t], x0, y0, cell, cells, bounds)


@numba.njit(cache=True)
def rectangles(cells):
    """Cover the cells of each kind (-1: none) with few rectangles.

    Returns:
        [R,5] int64: first row, first column, last row, last column, kind.
    """
    rows, columns = cells.shape
    taken = np.zeros((rows, columns), np.bool_)
    found = []
    for i in range(rows):
        j = 0
        while j < columns:
            kind = cells[i, j]
            if kind < 0 or taken[i, j]:
                j += 1
                continue
            right = j
            while right + 1 < columns and cells[i, right + 1] == kind and not taken[i, right + 1]:
                right += 1
            down = i
            while down + 1 < rows:
                whole = True
                for k in range(j, right + 1):
                    if cells[down + 1, k] != kind or taken[down + 1, k]:
                        whole = False
                        break
                if not whole:
                    break
                down += 1
            taken[i:down + 1, j:right + 1] = True
            found.append((i, j, down, right, np.int64(kind)))
            j = right + 1
    out = np.empty((len(found), 5), np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4] = found[k]
    return out


@numba.njit(cache=True)
def extents(found, bounds):
    """What really stands in rectangles of cells [R,5]: x0, y0, x1, y1 [R,4]."""
    out = np.empty((len(found), 4))
    for k in range(len(found)):
        out[k] = np.inf, np.inf, -np.inf, -np.inf
        for i in range(found[k, 0], found[k, 2] + 1):
            for j in range(found[k, 1], found[k, 3] + 1):
                out[k, 0] = min(out[k, 0], bounds[i, j, 0])
                out[k, 1] = min(out[k, 1], bounds[i, j, 1])
                out[k, 2] = max(out[k, 2], bounds[i, j, 2])
                out[k, 3] = max(out[k, 3], bounds[i, j, 3])
    return out


@numba.njit(cache=True)
def near_rectangles(x0, y0, cell, rects, reach, out):
    """Mark the cells [rows,columns] whose centre is within `reach` [m] of a rectangle."""
    rows, columns = out.shape
    for k in range(len(rects)):
        i0 = max(int(math.floor((rects[k, 1] - reach - y0) / cell - 0.5)), 0)
        i1 = min(int(math.ceil((rects[k, 3] + reach - y0) / cell - 0.5)), rows - 1)
        j0 = max(int(math.floor((rects[k, 0] - reach - x0) / cell - 0.5)), 0)
        j1 = min(int(math.ceil((rects[k, 2] + reach - x0) / cell - 0.5)), columns - 1)
        for i in range(i0, i1 + 1):
            y = y0 + (i + 0.5) * cell
            dy = max(max(rects[k, 1] - y, y - rects[k, 3]), 0.0)
            for j in range(j0, j1 + 1):
                x = x0 + (j + 0.5) * cell
                dx = max(max(rects[k, 0] - x, x - rects[k, 2]), 0.0)
                if math.hypot(dx, dy) <= reach:
                    out[i, j] = True
