"""A scene as indexed convex polygons with textures, baked light and labels, ready for a renderer.

The map frame follows REP 103: x and y span the floor, z is up, metres. A polygon's vertices run
counter-clockwise seen from its front; its back is never drawn.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from vn_nav.errors import UserError

MAX_CORNERS = 15  # of a polygon; clipping at the near plane adds one
MAX_TEXTURE = 2048  # texels a side
LIGHT_SPACING = 0.3  # m between two nodes of a light map
MAX_LIGHT_NODES = 32  # along one side of a light map
FULL_LIGHT = 255


class TextureSet:
    """Square textures, each with its chain of halved pictures (mip-map) down to 4 x 4.

    Args:
        pictures: [H,W,3] uint8 each; resized to the next power of two, at most `MAX_TEXTURE`.
    """

    def __init__(self, pictures):
        chains, self.start, self.side = [], [0], []
        for picture in pictures:
            side = 1 << max(2, math.ceil(math.log2(max(picture.shape[:2]))))
            side = min(side, MAX_TEXTURE)
            self.side.append(side)
            level = picture.astype(np.float32)
            if picture.shape[:2] != (side, side):
                level = cv2.resize(level, (side, side), interpolation=cv2.INTER_AREA)
            while side >= 4:
                texels = np.clip(np.rint(level), 0, 255).astype(np.uint32).reshape(-1, 3)
                chains.append(texels[:, 0] | texels[:, 1] << 8 | texels[:, 2] << 16)
                side //= 2
                level = cv2.resize(level, (max(side, 1),) * 2, interpolation=cv2.INTER_AREA)
            self.start.append(sum(map(len, chains)))
        self.texels = np.concatenate(chains)  # [T] uint32: red, green, blue from the lowest byte


@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything a renderer reads. F polygons in K groups; a group is culled as a whole.

    Light arrives through two baked factors of every surface point, interpolated between the nodes
    of the polygon's light map: *ambient* (how open the surroundings are) and *lamp* (how much of
    the room's lamp arrives). What colour either has is the business of whoever draws.
    """

    vertices: np.ndarray  # [V,3] float32 m
    face_start: np.ndarray  # [F+1] int32 into face_vertices
    face_vertices: np.ndarray  # [I] int32 into vertices
    face_plane: np.ndarray  # [F,4] float32: unit normal n and offset k, n . p = k
    face_uv: np.ndarray  # [F,2,4] float32: u = uv[0,:3] . p + uv[0,3] in texture tiles; v likewise
    face_texture: np.ndarray  # [F] int32 into textures
    face_colour: np.ndarray  # [F,3] float32 reflectance, multiplies the texel
    face_label: np.ndarray  # [F] class, uint8, or uint16 where one is above 255
    face_instance: np.ndarray  # [F] uint16
    face_light: np.ndarray  # [F,2] int32: first node in light, nodes a row
    face_light_map: np.ndarray  # [F,4] float32: column = u * m[0] + m[1], row = v * m[2] + m[3]
    light: np.ndarray  # [L] uint64: a node and its right neighbour, 4 lanes of 16 bits:
    #                    ambient, lamp, ambient, lamp (0 to 255)
    group_start: np.ndarray  # [K+1] int32 into faces
    group_box: np.ndarray  # [K,6] float32: x0, y0, z0, x1, y1, z1 m
    group_room: np.ndarray  # [K] int32: whose lamp shines on it
    textures: TextureSet

    @property
    def triangle_count(self) -> int:
        """Triangles that the polygons would make."""
        return int(np.sum(np.diff(self.face_start) - 2))


def as_labels(classes) -> np.ndarray:
    """Class ids [F] in the narrowest type that holds them.

    Raises:
        UserError: an id that 16 bits cannot hold.
    """
    classes = np.asarray(classes, np.int64)
    most, least = classes.max(initial=0), classes.min(initial=0)
    if least < 0 or most > 0xFFFF:
        raise UserError('class ids lie between 0 and 65535', int(least if least < 0 else most),
                        'number the classes from 0')
    return classes.astype(np.uint8 if most <= 0xFF else np.uint16)


class SceneBuilder:
    """Collects polygons, group by group.

    Args:
        textures: what the polygons' texture indices mean.
    """

    def __init__(self, textures: TextureSet):
        self.textures = textures
        self.room = 0  # of the polygons that follow
        self._vertices: list[np.ndarray] = []
        self._starts = [0]
        self._planes: list[tuple] = []
        self._uvs: list[np.ndarray] = []
        self._textures: list[int] = []
        self._colours: list[np.ndarray] = []
        self._labels: list[int] = []
        self._instances: list[int] = []
        self._patches: list[tuple] = []  # per face: corner, axis_u, axis_v [m], u and v scales
        self._groups = [0]
        self._rooms: list[int] = []

    def polygon(self, points, *, texture: int, colour, label: int, instance: int,
                tile: float = 1.0, fit: bool = False) -> None:
        """Add one convex planar polygon.

        Args:
            points: [n,3] vertices [m], counter-clockwise seen from the front; 3 <= n <= 15.
            texture: index into the textures.
            colour: three factors in [0,1].
            label: class id; instance: instance id.
            tile: metres that one repetition of the texture covers.
            fit: stretch the texture over the whole polygon once instead of tiling.

        Raises:
            UserError: points that are no such polygon.
        """
        points = np.asarray(points, float)
        if not 3 <= len(points) <= MAX_CORNERS or not np.isfinite(points).all():
            raise UserError(f'a polygon has 3 to {MAX_CORNERS} finite points', points.tolist(),
                            'repair the mesh')
        edge_u = points[1] - points[0]
        normal = _cross(edge_u, points[2] - points[1])
        length = math.sqrt(normal @ normal)
        if length < 1e-9:
            raise UserError('the first three points of a polygon span a plane', points.tolist(),
                            'repair the mesh')
        normal = normal / length
        offset = float(normal @ points[0])
        if np.abs(points @ normal - offset).max() > 1e-3:
            raise UserError('the points of a polygon lie in one plane (within 1 mm)',
                            points.tolist(), 'split it into triangles')
        # Texture axes: u runs horizontally in the plane, v downwards (or along y on floors).
        if fit:
            axis_u = edge_u / math.sqrt(edge_u @ edge_u)
        elif abs(normal[2]) > 0.9:
            axis_u = np.array([1.0, 0.0, 0.0])
        else:
            axis_u = np.array([-normal[1], normal[0], 0.0])
            axis_u /= math.sqrt(axis_u @ axis_u)
        axis_v = _cross(axis_u, normal)
        along_u, along_v = points @ axis_u, points @ axis_v
        first_u, first_v = along_u.min(), along_v.min()
        size_u, size_v = along_u.max() - first_u, along_v.max() - first_v
        scale_u, scale_v = (size_u, size_v) if fit else (tile, tile)
        # A whole number of tiles keeps coordinates on the polygon between 1 and its size + 2: a
        # renderer may then round down by cutting off.
        origin_u = (first_u if fit else scale_u * math.floor(first_u / scale_u)) - scale_u
        origin_v = (first_v if fit else scale_v * math.floor(first_v / scale_v)) - scale_v
        self._uvs.append(np.array([[*(axis_u / scale_u), -origin_u / scale_u],
                                   [*(axis_v / scale_v), -origin_v / scale_v]]))
        corner = normal * offset + axis_u * first_u + axis_v * first_v
        self._patches.append((corner, axis_u * size_u, axis_v * size_v,
                              scale_u / size_u, (origin_u - first_u) / size_u,
                              scale_v / size_v, (origin_v - first_v) / size_v))
        self._vertices.append(points)
        self._starts.append(self._starts[-1] + len(points))
        self._planes.append((*normal, offset))
        self._textures.append(texture)
        self._colours.append(np.asarray(colour, float))
        self._labels.append(label)
        self._instances.append(instance)

    def end_group(self) -> None:
        """Close the group of polygons added since the last call; empty groups vanish."""
        if len(self._labels) > self._groups[-1]:
            self._groups.append(len(self._labels))
            self._rooms.append(self.room)

    def build(self, bake=None) -> Scene:
        """The finished scene.

        Args:
            bake: gives ambient and lamp factors of surface points: called with positions [M,3],
                normals [M,3], rooms [M] and the vertices of all polygons, returns [M,2] in [0,1].
                Without it every surface is fully lit.
        """
        self.end_group()
        starts = np.array(self._starts, np.int32)
        vertices = np.concatenate(self._vertices).astype(np.float32)
        planes = np.array(self._planes, np.float32)
        boxes = []
        for first, last in zip(self._groups[:-1], self._groups[1:], strict=True):
            points = vertices[starts[first]:starts[last]]
            boxes.append((*(points.min(0) - 1e-4), *(points.max(0) + 1e-4)))
        faces = len(self._labels)
        rooms = np.repeat(np.array(self._rooms, np.int32), np.diff(self._groups))
        if bake is None:
            face_light, light_map, light = uniform_light(faces)
        else:
            face_light, light_map, light = self._light(planes, rooms, bake, starts, vertices)
        return Scene(
            vertices=vertices,
            face_start=starts,
            face_vertices=np.arange(len(vertices), dtype=np.int32),
            face_plane=planes,
            face_uv=np.array(self._uvs, np.float32),
            face_texture=np.array(self._textures, np.int32),
            face_colour=np.array(self._colours, np.float32),
            face_label=as_labels(self._labels),
            face_instance=np.array(self._instances, np.uint16),
            face_light=face_light,
            face_light_map=light_map,
            light=light,
            group_start=np.array(self._groups, np.int32),
            group_box=np.array(boxes, np.float32),
            group_room=np.array(self._rooms, np.int32),
            textures=self.textures,
        )

    def _light(self, planes, rooms, bake, starts, vertices):
        """A grid of light nodes over every polygon's bounding rectangle."""
        corner, side_u, side_v = (np.array([patch[i] for patch in self._patches])
                                  for i in range(3))
        factors = np.array([patch[3:] for patch in self._patches])
        nodes = np.stack([np.linalg.norm(side_u, axis=1), np.linalg.norm(side_v, axis=1)], axis=1)
        nodes = np.clip(np.rint(nodes / LIGHT_SPACING).astype(int) + 1, 2, MAX_LIGHT_NODES)
        count = nodes.prod(axis=1)
        first = np.cumsum(np.concatenate([[0], count]))
        face = np.repeat(np.arange(len(count)), count)
        index = np.arange(first[-1]) - first[face]
        column, row = index % nodes[face, 0], index // nodes[face, 0]
        # Nodes on the rim look from just inside: out of the neighbouring walls.
        share = np.stack([column / (nodes[face, 0] - 1), row / (nodes[face, 1] - 1)], axis=1)
        length = np.stack([np.linalg.norm(side_u, axis=1), np.linalg.norm(side_v, axis=1)], 1)
        inset = np.minimum(0.06 / np.maximum(length[face], 1e-6), 0.3)
        share = np.clip(share, inset, 1 - inset)
        points = corner[face] + share[:, :1] * side_u[face] + share[:, 1:] * side_v[face]
        values = bake(points, planes[face, :3].astype(float), rooms[face], starts, vertices)
        lanes = np.rint(np.clip(values, 0, 1) * FULL_LIGHT).astype(np.uint64)
        pair = lanes[:, 0] | lanes[:, 1] << np.uint64(16)
        neighbour = np.where(column < nodes[face, 0] - 1, np.roll(pair, -1), pair)
        light = pair | neighbour << np.uint64(32)
        light_map = np.stack([factors[:, 0] * (nodes[:, 0] - 1), factors[:, 1] * (nodes[:, 0] - 1),
                              factors[:, 2] * (nodes[:, 1] - 1),
                              factors[:, 3] * (nodes[:, 1] - 1)], axis=1)
        # One spare row: a renderer reads the row below the last node, with weight 0.
        spare = np.zeros(MAX_LIGHT_NODES + 1, np.uint64)
        return (np.stack([first[:-1], nodes[:, 0]], 1).astype(np.int32),
                light_map.astype(np.float32), np.concatenate([light, spare]))


def uniform_light(faces: int, lamp: float = 1.0):
    """Light arrays of F polygons that are lit alike everywhere; `lamp` is how much of it comes."""
    full = np.uint64(FULL_LIGHT * (1 | 1 << 32) | round(FULL_LIGHT * lamp) * (1 << 16 | 1 << 48))
    return (np.tile(np.array([[0, 2]], np.int32), (faces, 1)), np.zeros((faces, 4), np.float32),
            np.full(4, full, np.uint64))


def _cross(a, b) -> np.ndarray:
    # np.cross spends most of its time on checking shapes.
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                     a[0] * b[1] - a[1] * b[0]])
