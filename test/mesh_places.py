"""Meshes for tests: boxes and floors of triangles, and the triangles of embedded houses."""

import numpy as np

from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.render.mesh_scene import Surface

WALL, FLOOR, CEILING, TABLE, DOOR = (LABELS.index(name) for name in (
    'wall', 'floor', 'ceiling', 'table', 'door'))


def quad(a, b, c, d):
    """Two triangles of a quadrilateral, counter-clockwise seen from the front."""
    return np.array([[a, b, c], [a, c, d]], float)


def box(x0, y0, z0, x1, y1, z1):
    """The twelve triangles of a box, seen from outside."""
    p = [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0),
         (x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)]
    return np.concatenate([quad(*(p[k] for k in side)) for side in (
        (3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))])


def flat(x0, y0, x1, y1, z=0.0, up=True):
    """A floor, or a ceiling."""
    corners = (x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)
    return quad(*(corners if up else corners[::-1]))


def surface(corners, label, instance=1, colour=(0.8, 0.7, 0.6), **more):
    """Triangles of one class without a texture."""
    return Surface(corners, more.pop('uv', None), np.array(colour), more.pop('picture', None),
                   label, instance, **more)


def room_surfaces(z=0.0, width=6.0, depth=4.0):
    """A room with a ceiling, four walls of 0.1 m, and a table; its corner is the origin."""
    w, d, h = width, depth, z + 2.5
    walls = [box(-.1, -.1, z, w + .1, 0, h), box(-.1, d, z, w + .1, d + .1, h),
             box(-.1, 0, z, 0, d, h), box(w, 0, z, w + .1, d, h)]
    return [surface(flat(0, 0, w, d, z), FLOOR, 1),
            surface(flat(0, 0, w, d, h, False), CEILING, 2),
            *(surface(wall, WALL, 3 + k, (.6, .6 + .1 * k, .5)) for k, wall in enumerate(walls)),
            surface(box(2, 1, z + .7, 3, 2, z + .75), TABLE, 8, (.5, .2, .1))]


def together(surfaces):
    """Corners [T,3,3] and labels [T] of some surfaces."""
    return (np.concatenate([s.corners for s in surfaces]),
            np.concatenate([np.full(len(s.corners), s.label) for s in surfaces]))


def house_surfaces(house):
    """The triangles of an embedded house, a surface for each class and instance; no textures."""
    scene, parts = house.scene, {}
    for face in range(len(scene.face_label)):
        ids = scene.face_vertices[scene.face_start[face]:scene.face_start[face + 1]]
        points = scene.vertices[ids].astype(float)
        key = int(scene.face_label[face]), int(scene.face_instance[face])
        parts.setdefault(key, []).extend(
            (points[0], points[k], points[k + 1]) for k in range(1, len(points) - 1))
    return [surface(np.array(corners), label, instance)
            for (label, instance), corners in parts.items()]
