"""Light that houses come with: ambient occlusion and the reach of each room's lamp.

Both are found by marching rays through a grid of solid cells: coarse, but quick enough to bake a
house in a fraction of a second.
"""

from __future__ import annotations

import math

import numba
import numpy as np

CELL = 0.08  # m, side of a grid cell
OCCLUSION_REACH = 1.3  # m: what is farther away darkens nothing
AMBIENT_RAYS = 24
LAMP_RADIUS = 0.25  # m: its size softens the shadows
LAMP_RAYS = 6
LAMP_FALLOFF = 2.2  # m^2: irradiance = falloff / (falloff + distance^2)
INDIRECT = 0.25  # of the lamp's light that arrives from everywhere


def light_baker(lamps: np.ndarray, low: np.ndarray, high: np.ndarray):
    """A function that bakes light, for `SceneBuilder.build`.

    Args:
        lamps: [R,3] position of each room's lamp [m].
        low, high: [3] bounds of the house [m].
    """
    lamps = np.asarray(lamps, float)
    shape = np.ceil((np.asarray(high) - low) / CELL).astype(int) + 3
    origin = np.asarray(low, float) - CELL

    def bake(points, normals, rooms, starts, vertices):
        solid = np.zeros(tuple(shape), np.bool_)
        _voxelise(starts.astype(np.int64), vertices.astype(float), origin, solid)
        out = np.empty((len(points), 2))
        _bake(points, normals, rooms.astype(np.int64), lamps, _directions(AMBIENT_RAYS), solid,
              origin, out)
        return out

    return bake


def _directions(count: int) -> np.ndarray:
    """Evenly spread unit vectors over the sphere (Fibonacci lattice), [2 * count,3]."""
    k = np.arange(2 * count) + 0.5
    z = 1 - k / count
    angle = math.pi * (1 + math.sqrt(5)) * k
    radius = np.sqrt(np.maximum(0, 1 - z * z))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


@numba.njit(cache=True)
def _voxelise(starts, vertices, origin, solid):
    """Mark every cell that a polygon touches, by sampling its fan of triangles."""
    for face in range(len(starts) - 1):
        first, last = starts[face], starts[face + 1]
        for corner in range(first + 1, last - 1):
            ax, ay, az = vertices[first]
            bx, by, bz = (vertices[corner, 0] - ax, vertices[corner, 1] - ay,
                          vertices[corner, 2] - az)
            cx, cy, cz = (vertices[corner + 1, 0] - ax, vertices[corner + 1, 1] - ay,
                          vertices[corner + 1, 2] - az)
            n = 2 + int(math.sqrt(bx * bx + by * by + bz * bz) / (0.7 * CELL))
            m = 2 + int(math.sqrt(cx * cx + cy * cy + cz * cz) / (0.7 * CELL))
            for i in range(n + 1):
                for j in range(m + 1):
                    s, t = i / n, j / m
                    if s + t > 1.0 + 1e-9:
                        break
                    x = int((ax + s * bx + t * cx - origin[0]) / CELL)
                    y = int((ay + s * by + t * cy - origin[1]) / CELL)
                    z = int((az + s * bz + t * cz - origin[2]) / CELL)
                    if (0 <= x < solid.shape[0] and 0 <= y < solid.shape[1]
                            and 0 <= z < solid.shape[2]):
                        solid[x, y, z] = True


@numba.njit(cache=True)
def _march(px, py, pz, dx, dy, dz, length, solid, origin):
    """Distance to the first solid cell, or `length`. The surface's own cells do not count."""
    step = 0.75 * CELL
    travelled = step
    escaped = False
    while travelled < length:
        x = int((px + travelled * dx - origin[0]) / CELL)
        y = int((py + travelled * dy - origin[1]) / CELL)
        z = int((pz + travelled * dz - origin[2]) / CELL)
        if not (0 <= x < solid.shape[0] and 0 <= y < solid.shape[1] and 0 <= z < solid.shape[2]):
            return length
        if solid[x, y, z]:
            if escaped or travelled > 3.0 * CELL:
                return travelled
        else:
            escaped = True
        travelled += step
    return length


@numba.njit(cache=True)
def _bake(points, normals, rooms, lamps, directions, solid, origin, out):
    for p in range(len(points)):
        nx, ny, nz = normals[p]
        px = points[p, 0] + nx * 1.1 * CELL
        py = points[p, 1] + ny * 1.1 * CELL
        pz = points[p, 2] + nz * 1.1 * CELL
        total, open_sky = 0.0, 0.0
        for k in range(len(directions)):
            dx, dy, dz = directions[k]
            cosine = dx * nx + dy * ny + dz * nz
            if cosine <= 0.05:
                continue
            total += cosine
            distance = _march(px, py, pz, dx, dy, dz, OCCLUSION_REACH, solid, origin)
            share = distance / OCCLUSION_REACH
            open_sky += cosine * share * (2.0 - share)
        out[p, 0] = open_sky / total if total > 0.0 else 1.0
        lamp = 0.0
        for k in range(LAMP_RAYS):
            angle = 2.0 * math.pi * k / LAMP_RAYS
            lx = lamps[rooms[p], 0] + LAMP_RADIUS * math.cos(angle) - px
            ly = lamps[rooms[p], 1] + LAMP_RADIUS * math.sin(angle) - py
            lz = lamps[rooms[p], 2] - pz
            distance = math.sqrt(lx * lx + ly * ly + lz * lz)
            cosine = (lx * nx + ly * ny + lz * nz) / max(distance, 1e-6)
            if cosine <= 0.0:
                continue
            reach = distance - 0.3  # the lamp's own body casts no shadow
            if _march(px, py, pz, lx / distance, ly / distance, lz / distance, reach, solid,
                      origin) >= reach:
                lamp += cosine * LAMP_FALLOFF / (LAMP_FALLOFF + distance * distance)
        lamp = lamp / LAMP_RAYS
        out[p, 1] = min(1.0, INDIRECT * out[p, 0] + (1.0 - INDIRECT) * 1.6 * lamp)
