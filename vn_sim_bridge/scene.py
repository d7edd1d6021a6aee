"""A scene as indexed convex polygons with textures and labels, ready for a renderer.

The map frame follows REP 103: x and y span the floor, z is up, metres. A polygon's vertices run
counter-clockwise seen from its front; its back is never drawn.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vn_nav.errors import UserError

TEXTURE_SIZE = 64  # texels a side; a power of two
MIP_LEVELS = 5  # 64, 32, 16, 8, 4


@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything a renderer reads. F polygons in K groups; a group is culled as a whole."""

    vertices: np.ndarray  # [V,3] float32 m
    face_start: np.ndarray  # [F+1] int32 into face_vertices
    face_vertices: np.ndarray  # [I] int32 into vertices
    face_plane: np.ndarray  # [F,4] float32: unit normal n and offset k, n . p = k
    face_uv: np.ndarray  # [F,2,4] float32: u = uv[0,:3] . p + uv[0,3] in texture tiles; v likewise
    face_texture: np.ndarray  # [F] int32 into the texture library
    face_colour: np.ndarray  # [F,3] float32, multiplies the texel; light included
    face_label: np.ndarray  # [F] uint8 class
    face_instance: np.ndarray  # [F] uint16
    group_start: np.ndarray  # [K+1] int32 into faces
    group_sphere: np.ndarray  # [K,4] float32: centre, radius m

    @property
    def triangle_count(self) -> int:
        """Triangles that the polygons would make."""
        return int(np.sum(np.diff(self.face_start) - 2))


class SceneBuilder:
    """Collects polygons, group by group. Light by facing is baked into the colours."""

    # Light that a surface receives by the direction it faces: +x, -x, +y, -y, up, down. Six
    # different values let a viewer, and a network, tell walls apart.
    FACING = (0.98, 0.76, 0.88, 0.68, 1.0, 0.84)

    def __init__(self):
        self._vertices: list[np.ndarray] = []
        self._starts = [0]
        self._planes: list[tuple] = []
        self._uvs: list[np.ndarray] = []
        self._textures: list[int] = []
        self._colours: list[np.ndarray] = []
        self._labels: list[int] = []
        self._instances: list[int] = []
        self._groups = [0]

    def polygon(self, points, *, texture: int, colour, label: int, instance: int,
                tile: float = 1.0, fit: bool = False) -> None:
        """Add one convex planar polygon.

        Args:
            points: [n,3] vertices [m], counter-clockwise seen from the front; n >= 3.
            texture: index into the texture library.
            colour: three factors in [0,1].
            label: class id; instance: instance id.
            tile: metres that one repetition of the texture covers.
            fit: stretch the texture over the whole polygon once instead of tiling.
        """
        points = np.asarray(points, float)
        edge_u = points[1] - points[0]
        normal = np.cross(edge_u, points[2] - points[1])
        length = np.linalg.norm(normal)
        if len(points) < 3 or length < 1e-9 or not np.isfinite(points).all():
            raise UserError('a polygon has at least three points that span a plane',
                            points.tolist(), 'repair the mesh')
        normal = normal / length
        offset = float(normal @ points[0])
        if np.abs(points @ normal - offset).max() > 1e-3:
            raise UserError('the points of a polygon lie in one plane (within 1 mm)',
                            points.tolist(), 'split it into triangles')
        # Texture axes: u runs horizontally in the plane, v downwards (or along y on floors).
        if fit:
            axis_u = edge_u / np.linalg.norm(edge_u)
        elif abs(normal[2]) > 0.9:
            axis_u = np.array([1.0, 0.0, 0.0])
        else:
            axis_u = np.cross([0.0, 0.0, 1.0], normal)
            axis_u /= np.linalg.norm(axis_u)
        axis_v = np.cross(axis_u, normal)
        if fit:
            along_u, along_v = points @ axis_u, points @ axis_v
            scale_u, scale_v = np.ptp(along_u), np.ptp(along_v)
            origin_u, origin_v = along_u.min(), along_v.min()
        else:
            scale_u = scale_v = tile
            origin_u = origin_v = 0.0
        uv = np.array([[*(axis_u / scale_u), -origin_u / scale_u],
                       [*(axis_v / scale_v), -origin_v / scale_v]])
        positive, negative = np.maximum(normal, 0) ** 2, np.maximum(-normal, 0) ** 2
        light = sum(self.FACING[2 * i] * positive[i] + self.FACING[2 * i + 1] * negative[i]
                    for i in range(3))
        self._vertices.append(points)
        self._starts.append(self._starts[-1] + len(points))
        self._planes.append((*normal, offset))
        self._uvs.append(uv)
        self._textures.append(texture)
        self._colours.append(np.asarray(colour, float) * light)
        self._labels.append(label)
        self._instances.append(instance)

    def end_group(self) -> None:
        """Close the group of polygons added since the last call; empty groups vanish."""
        if len(self._labels) > self._groups[-1]:
            self._groups.append(len(self._labels))

    def build(self) -> Scene:
        """The finished scene."""
        self.end_group()
        starts = np.array(self._starts, np.int32)
        vertices = np.concatenate(self._vertices).astype(np.float32)
        spheres = []
        for first, last in zip(self._groups[:-1], self._groups[1:], strict=True):
            points = vertices[starts[first]:starts[last]]
            centre = (points.min(0) + points.max(0)) / 2
            spheres.append((*centre, np.linalg.norm(points - centre, axis=1).max() + 1e-3))
        return Scene(
            vertices=vertices,
            face_start=starts,
            face_vertices=np.arange(len(vertices), dtype=np.int32),
            face_plane=np.array(self._planes, np.float32),
            face_uv=np.array(self._uvs, np.float32),
            face_texture=np.array(self._textures, np.int32),
            face_colour=np.array(self._colours, np.float32),
            face_label=np.array(self._labels, np.uint8),
            face_instance=np.array(self._instances, np.uint16),
            group_start=np.array(self._groups, np.int32),
            group_sphere=np.array(spheres, np.float32),
        )
