"""Polygons with any number of corners as triangles."""

from __future__ import annotations

import numpy as np


def triangles_of(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Triangles [T,3] of polygons, as indices into their corners [sum of sizes,3], in order."""
    starts = np.cumsum(sizes) - sizes
    found = []
    for size in np.unique(sizes):
        first = starts[sizes == size]
        fans = np.array([(0, k, k + 1) for k in range(1, size - 1)])
        triangles = first[:, None, None] + fans
        if size > 3:
            own = points[first[:, None] + np.arange(size)]
            for row in np.nonzero(~_convex(own))[0]:
                triangles[row] = first[row] + _ears(own[row])
        found.append(triangles.reshape(-1, 3))
    return np.concatenate(found)


def _convex(polygons: np.ndarray) -> np.ndarray:
    """Which polygons [P,n,3] turn one way only, [P] bool."""
    edges = np.roll(polygons, -1, axis=1) - polygons
    normal = np.cross(polygons, np.roll(polygons, -1, axis=1)).sum(axis=1)
    turns = (np.cross(edges, np.roll(edges, -1, axis=1)) * normal[:, None]).sum(axis=2)
    return (turns >= -1e-12 * np.abs(turns).max(axis=1, keepdims=True)).all(axis=1)


def _ears(polygon: np.ndarray) -> np.ndarray:
    """Triangles [n-2,3] of a polygon [n,3] that is not convex, by cutting off ears."""
    normal = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)
    keep = np.argsort(np.abs(normal))[:2]  # seen along the largest axis
    flat = polygon[:, keep]

    def area(a, b, c) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    ring = list(range(len(polygon)))
    total = sum(area(flat[0], flat[k], flat[k + 1]) for k in ring[1:-1])
    sign = 1.0 if total >= 0 else -1.0
    found = []
    while len(ring) > 3:
        for k in range(len(ring)):
            a, b, c = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
            if sign * area(flat[a], flat[b], flat[c]) > 0 and not any(
                    min(sign * area(flat[p], flat[q], flat[other])
                        for p, q in ((a, b), (b, c), (c, a))) >= 0
                    for other in ring if other not in (a, b, c)):
                break
        else:
            k = 1  # it crosses itself: any cut is as good
        found.append((ring[k - 1], ring[k], ring[(k + 1) % len(ring)]))
        del ring[k]
    return np.array([*found, ring])
