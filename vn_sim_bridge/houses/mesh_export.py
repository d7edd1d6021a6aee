"""A scene as a GLB that other programs open."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.surface import linear_from_srgb
from vn_sim_bridge.render.scene import Scene, TextureSet

FLOAT, INDEX = 5126, 5125  # component types


def export_mesh(scene: Scene, path: str | Path) -> None:
    """Write a scene as GLB (y up, as glTF demands); parts are named by class and instance.

    Baked light is left out: glTF viewers light the scene themselves.

    Raises:
        UserError: another ending, or a folder that cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != '.glb':
        raise UserError('a house is exported as .glb', str(path), 'choose such a name')
    if not path.parent.is_dir():
        raise UserError('the folder of the file exists', str(path.parent), 'create it first')
    out = _Glb()
    textures = [out.picture(texture_picture(scene.textures, k))
                for k in range(len(scene.textures.side))]
    parts: dict[tuple, list[int]] = {}
    for face in range(len(scene.face_label)):
        key = (int(scene.face_label[face]), int(scene.face_instance[face]),
               int(scene.face_texture[face]), tuple(map(float, scene.face_colour[face])))
        parts.setdefault(key, []).append(face)
    for number, ((label, instance, texture, colour), faces) in enumerate(parts.items()):
        out.part(f'{LABELS[label]}_{instance}_{number}', f'{LABELS[label]}_{number}',
                 *triangles_of_faces(scene, faces), textures[texture], colour)
    try:
        path.write_bytes(out.bytes())
    except OSError as error:
        raise UserError('the file can be written', f'{path}: {error}',
                        'choose another place') from error


class _Glb:
    """A GLB that grows."""

    def __init__(self):
        self.data = bytearray()
        self.json: dict = {
            'asset': {'version': '2.0', 'generator': 'vn_nav'}, 'scene': 0,
            'scenes': [{'nodes': []}], 'nodes': [], 'meshes': [], 'materials': [],
            'textures': [], 'images': [], 'accessors': [], 'bufferViews': []}

    def _add(self, kind: str, entry: dict) -> int:
        self.json[kind].append(entry)
        return len(self.json[kind]) - 1

    def _view(self, data: bytes) -> int:
        view = self._add('bufferViews', {'buffer': 0, 'byteOffset': len(self.data),
                                         'byteLength': len(data)})
        self.data += data + bytes(-len(data) % 4)
        return view

    def _accessor(self, values: np.ndarray, component: int, kind: str, **more) -> int:
        return self._add('accessors', {
            'bufferView': self._view(values.tobytes()), 'componentType': component,
            'count': len(values), 'type': kind, **more})

    def picture(self, rgb: np.ndarray) -> int:
        """Add a texture, [H,W,3] uint8."""
        data = cv2.imencode('.png', cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
        image = self._add('images', {'mimeType': 'image/png', 'bufferView': self._view(data)})
        return self._add('textures', {'source': image})

    def part(self, name: str, material: str, points: np.ndarray, uv: np.ndarray,
             triangles: np.ndarray, texture: int, colour: tuple[float, ...]) -> None:
        """Add a node: points [V,3] in the map frame, uv [V,2], triangles [T,3]."""
        points = (points[:, [0, 2, 1]] * (1, 1, -1)).astype('<f4')
        attributes = {
            'POSITION': self._accessor(points, FLOAT, 'VEC3', min=points.min(axis=0).tolist(),
                                       max=points.max(axis=0).tolist()),
            'TEXCOORD_0': self._accessor(uv.astype('<f4'), FLOAT, 'VEC2')}
        look = self._add('materials', {'name': material, 'pbrMetallicRoughness': {
            'baseColorTexture': {'index': texture},
            'baseColorFactor': [*linear_from_srgb(colour).tolist(), 1.0],  # factors are linear
            'metallicFactor': 0.0, 'roughnessFactor': 0.9}})
        order = self._accessor(triangles.astype('<u4').reshape(-1), INDEX, 'SCALAR')
        mesh = self._add('meshes', {'name': name, 'primitives': [
            {'attributes': attributes, 'indices': order, 'material': look}]})
        self.json['scenes'][0]['nodes'].append(self._add('nodes', {'name': name, 'mesh': mesh}))

    def bytes(self) -> bytes:
        """The whole file."""
        self.json['buffers'] = [{'byteLength': len(self.data)}]
        text = json.dumps(self.json, separators=(',', ':')).encode()
        text += b' ' * (-len(text) % 4)
        return (struct.pack('<4sII', b'glTF', 2, 12 + 8 + len(text) + 8 + len(self.data))
                + struct.pack('<I4s', len(text), b'JSON') + text
                + struct.pack('<I4s', len(self.data), b'BIN\0') + self.data)


def triangles_of_faces(scene: Scene, faces: list[int]
                       ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [V,3], texture coordinates [V,2] (v downwards) and triangles [T,3] of some faces."""
    points, triangles, uv, count = [], [], [], 0
    for face in faces:
        ids = scene.face_vertices[scene.face_start[face]:scene.face_start[face + 1]]
        corners = scene.vertices[ids].astype(float)
        triangles += [(count, count + k, count + k + 1) for k in range(1, len(ids) - 1)]
        plane = scene.face_uv[face].astype(float)
        points.append(corners)
        uv.append(corners @ plane[:, :3].T + plane[:, 3])
        count += len(ids)
    return np.concatenate(points), np.concatenate(uv), np.array(triangles)


def texture_picture(textures: TextureSet, index: int) -> np.ndarray:
    """One texture of a set, [S,S,3] uint8."""
    side = textures.side[index]
    texels = textures.texels[textures.start[index]:textures.start[index] + side * side]
    return np.stack([texels & 255, texels >> 8 & 255, texels >> 16], axis=-1).astype(
        np.uint8).reshape(side, side, 3)
