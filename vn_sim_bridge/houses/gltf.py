"""GLB and glTF 2.0 as parts: nodes, materials, primitives, by the specification's own rules."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.gltf_data import GltfData
from vn_sim_bridge.houses.surface import (
    CLAMP,
    MIRROR,
    REPEAT,
    Part,
    compressed,
    srgb_from_linear,
    unwrap,
)
from vn_sim_bridge.notices import say_once

WRAPS = {10497: REPEAT, 33071: CLAMP, 33648: MIRROR}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; smaller ones are points and lines
DRACO = 'KHR_draco_mesh_compression'
UNEQUAL = 0.1  # between the colours of a triangle's vertices: to be seen, when they are averaged


class _Texture(NamedTuple):
    picture: np.ndarray  # [H,W,3] uint8
    coordinates: int  # which TEXCOORD
    matrix: np.ndarray  # [2,3] of the coordinates
    wrap: tuple[str, str]


class _Material(NamedTuple):
    name: str | None
    factor: np.ndarray  # [3] linear
    texture: _Texture | None
    both_sides: bool


class _Primitive(NamedTuple):
    points: np.ndarray  # [V,3], morphed
    faces: np.ndarray  # [T,3] int64
    attributes: dict  # indices of accessors
    material: _Material


def read_gltf(path: Path) -> Iterator[Part]:
    """The triangles of the file's own scene (its `scene`, else the first one).

    Skins and morph targets are drawn in the pose that the nodes have; animations, lights and
    transparency are left out.

    Raises:
        UserError, or another exception: see `GltfData`.
    """
    data = GltfData(path)
    if data.json.get('animations'):
        say_once(f'{path.name}: animations are left out; nodes are where the file puts them')
    nodes = data.json.get('nodes', [])
    poses = _poses(nodes)
    materials: dict[int | None, _Material] = {}
    for index in _shown(data, nodes):
        node = nodes[index]
        if 'mesh' not in node:
            continue
        mesh = data.get('meshes', node['mesh'])
        for number in range(len(mesh['primitives'])):
            name = node.get('name') or f'node {index}'
            primitive = _primitive(data, mesh, node, number, materials)
            if primitive is None:
                continue
            if 'skin' in node:
                yield _part(data, node, mesh, primitive, name, None,
                            _skinned(data, node, primitive, poses))
                continue
            for matrix in _instances(data, node):
                matrix = poses[index] @ matrix
                points = primitive.points @ matrix[:3, :3].T + matrix[:3, 3]
                yield _part(data, node, mesh, primitive, name, matrix, points)


def _poses(nodes: list[dict]) -> list[np.ndarray]:
    """Global transforms [4,4] of all nodes, which are trees."""
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get('children', ()):
            if child in parents or not 0 <= child < len(nodes):
                raise ValueError(f'node {child!r} is the child of several nodes, or of none')
            parents[child] = index
    own = [_local(node) for node in nodes]
    found: dict[int, np.ndarray] = {}
    waiting = [index for index in range(len(nodes)) if index not in parents]
    while waiting:
        index = waiting.pop()
        above = parents.get(index)
        found[index] = own[index] if above is None else found[above] @ own[index]
        waiting.extend(nodes[index].get('children', ()))
    if len(found) < len(nodes):
        raise ValueError('nodes are in a circle')
    return [found[index] for index in range(len(nodes))]


def _local(node: dict) -> np.ndarray:
    """A node's transform [4,4]."""
    if 'matrix' in node:
        matrix = np.array(node['matrix'], float).reshape(4, 4).T
    else:
        matrix = _compose(node.get('translation', (0, 0, 0)), node.get('rotation', (0, 0, 0, 1)),
                          node.get('scale', (1, 1, 1)))
    if not np.isfinite(matrix).all():
        raise ValueError('a transform is not finite')
    return matrix


def _compose(translation, rotation, scale) -> np.ndarray:
    """[4,4] of a translation, a quaternion x, y, z, w and factors."""
    length = float(np.linalg.norm(rotation))
    if not 1e-6 < length < math.inf:
        raise ValueError(f'a rotation is {list(rotation)}')
    x, y, z, w = np.array(rotation, float) / length
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]) * np.array(scale)
    matrix[:3, 3] = translation
    return matrix


def _shown(data: GltfData, nodes: list[dict]) -> list[int]:
    """Indices of the nodes that the scene shows, each before its children."""
    scenes = data.json.get('scenes', [])
    if scenes:
        waiting = list(data.get('scenes', data.json.get('scene', 0)).get('nodes', ()))
    else:  # a library: everything
        children = {child for node in nodes for child in node.get('children', ())}
        waiting = [index for index in range(len(nodes)) if index not in children]
    found: list[int] = []
    waiting.reverse()
    while waiting:
        index = waiting.pop()
        node = data.get('nodes', index)
        if not node.get('extensions', {}).get('KHR_node_visibility', {}).get('visible', True):
            continue
        found.append(index)
        waiting.extend(reversed(node.get('children', ())))
    if len(set(found)) < len(found):
        raise ValueError('a scene names a node twice')
    return found


def _instances(data: GltfData, node: dict) -> list[np.ndarray]:
    """Transforms [4,4] of a node's copies, in its own frame."""
    if 'EXT_mesh_gpu_instancing' not in node.get('extensions', {}):
        return [np.eye(4)]
    attributes = node['extensions']['EXT_mesh_gpu_instancing']['attributes']
    rows = {name: data.accessor(attributes[name], (kind,)) for name, kind in (
        ('TRANSLATION', 'VEC3'), ('ROTATION', 'VEC4'), ('SCALE', 'VEC3')) if name in attributes}
    counts = {len(values) for values in rows.values()}
    if len(counts) != 1:
        raise ValueError('instances need as many translations as rotations and scales')
    (count,) = counts
    defaults = {'TRANSLATION': (0, 0, 0), 'ROTATION': (0, 0, 0, 1), 'SCALE': (1, 1, 1)}
    return [_compose(*(rows[name][k] if name in rows else default
                       for name, default in defaults.items())) for k in range(count)]


def _primitive(data: GltfData, mesh: dict, node: dict, number: int, materials: dict
               ) -> _Primitive | None:
    """A primitive's triangles; None: it has points or lines."""
    entry = mesh['primitives'][number]
    mode = entry.get('mode', TRIANGLES)
    if mode < TRIANGLES or 'POSITION' not in entry['attributes']:
        return None
    attributes = entry['attributes']
    if DRACO in entry.get('extensions', {}):
        place = data.get('accessors', attributes['POSITION'])
        if 'bufferView' not in place and 'sparse' not in place:
            raise compressed('Draco', DRACO, data.path)
    points = data.accessor(attributes['POSITION'], ('VEC3',))
    weights = node.get('weights', mesh.get('weights', ()))
    for weight, target in zip(weights, entry.get('targets', ()), strict=False):
        if weight and 'POSITION' in target:
            points = points + weight * _rows(data, target['POSITION'], ('VEC3',), len(points))
    order = (data.accessor(entry['indices'], ('SCALAR',), whole=True)[:, 0]
             if 'indices' in entry else np.arange(len(points)))
    if order.min() < 0 or order.max() >= len(points):
        raise UserError('the faces of a mesh refer to its vertices',
                        f'{data.path}: {node.get("name")}', 'repair the mesh')
    if mode == TRIANGLES:
        if len(order) % 3:
            raise ValueError(f'{len(order)} indices make no triangles')
        faces = order.reshape(-1, 3)
    elif mode == STRIP:
        faces = np.column_stack([order[:-2], order[1:-1], order[2:]])
        faces[1::2] = faces[1::2][:, [1, 0, 2]]
    elif mode == FAN:
        faces = np.column_stack([np.full(max(len(order) - 2, 0), order[0]), order[1:-1],
                                 order[2:]])
    else:
        raise ValueError(f'a primitive of mode {mode!r}')
    if not len(faces):
        return None
    index = entry.get('material')
    if index not in materials:
        materials[index] = _material(data, index)
    return _Primitive(points, faces, attributes, materials[index])


def _rows(data: GltfData, index: int, types: tuple[str, ...], count: int, *,
          whole: bool = False) -> np.ndarray:
    """An accessor with a row for each of `count` vertices."""
    values = data.accessor(index, types, whole=whole)
    if len(values) != count:
        raise ValueError(f'accessor {index} has {len(values)} values for {count} vertices')
    return values


def _skinned(data: GltfData, node: dict, primitive: _Primitive, poses) -> np.ndarray:
    """Vertices [V,3] where the joints hold them; the node's own transform has no meaning."""
    skin, count = data.get('skins', node['skin']), len(primitive.points)
    joints = np.array([poses[joint] for joint in skin['joints']])
    if 'inverseBindMatrices' in skin:
        inverse = data.accessor(skin['inverseBindMatrices'], ('MAT4',)).reshape(-1, 4, 4)
        joints = joints @ inverse[:len(joints)].transpose(0, 2, 1)
    points = np.column_stack([primitive.points, np.ones(count)])
    moved, total = np.zeros((count, 3)), np.zeros((count, 1))
    for number in range(8):
        if f'JOINTS_{number}' not in primitive.attributes:
            break
        which = _rows(data, primitive.attributes[f'JOINTS_{number}'], ('VEC4',), count,
                      whole=True)
        share = _rows(data, primitive.attributes[f'WEIGHTS_{number}'], ('VEC4',), count)
        for k in range(4):
            moved += share[:, k:k + 1] * np.einsum('vij,vj->vi', joints[which[:, k]],
                                                   points)[:, :3]
        total += share.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ValueError('a skinned vertex has no weights')
    return moved / total


def _material(data: GltfData, index: int | None) -> _Material:
    if index is None:
        return _Material(None, np.ones(3), None, False)
    entry = data.get('materials', index)
    extensions = entry.get('extensions', {})
    if entry.get('alphaMode', 'OPAQUE') != 'OPAQUE':
        say_once(f'{data.path.name}: transparency (alphaMode) is left out; surfaces are opaque')
    if 'emissiveTexture' in entry or any(entry.get('emissiveFactor', ())):
        say_once(f'{data.path.name}: light that surfaces give off (emissive) is left out')
    if 'KHR_materials_pbrSpecularGlossiness' in extensions:
        own = extensions['KHR_materials_pbrSpecularGlossiness']
        factor, texture = own.get('diffuseFactor'), own.get('diffuseTexture')
    else:
        own = entry.get('pbrMetallicRoughness', {})
        factor, texture = own.get('baseColorFactor'), own.get('baseColorTexture')
    factor = np.array((1, 1, 1, 1) if factor is None else factor, float)
    if factor.shape != (4,) or not np.isfinite(factor).all():
        raise ValueError(f'material {index} has colour {factor.tolist()}')
    return _Material(entry.get('name'), factor[:3],
                     None if texture is None else _texture(data, texture),
                     bool(entry.get('doubleSided', False)))


def _texture(data: GltfData, info: dict) -> _Texture:
    entry = data.get('textures', info['index'])
    source, extensions = entry.get('source'), entry.get('extensions', {})
    if source is None:
        source = extensions.get('EXT_texture_webp', {}).get('source')
    if source is None and 'KHR_texture_basisu' in extensions:
        raise compressed('KTX2', 'KHR_texture_basisu', data.path)
    if source is None:
        raise UserError('a texture has a picture', f'{data.path}: texture {info["index"]} '
                        f'({", ".join(extensions) or "no source"})', 'export it as PNG or JPEG')
    sampler = data.get('samplers', entry['sampler']) if 'sampler' in entry else {}
    own = info.get('extensions', {}).get('KHR_texture_transform', {})
    (u, v), angle = own.get('scale', (1, 1)), own.get('rotation', 0.0)
    # v points down: counter-clockwise, as the extension's example has it.
    cosine, sine = math.cos(angle), math.sin(angle)
    matrix = np.array([[cosine * u, sine * v, 0.0], [-sine * u, cosine * v, 0.0]])
    matrix[:, 2] = own.get('offset', (0, 0))
    return _Texture(data.picture(source), own.get('texCoord', info.get('texCoord', 0)), matrix,
                    (WRAPS[sampler.get('wrapS', 10497)], WRAPS[sampler.get('wrapT', 10497)]))


def _part(data: GltfData, node: dict, mesh: dict, primitive: _Primitive, name: str,
          matrix: np.ndarray | None, points: np.ndarray) -> Part:
    """The triangles where they stand, with their colours."""
    material, faces = primitive.material, primitive.faces
    where = f'{data.path}: {name}'
    colour = np.broadcast_to(material.factor, (len(faces), 3))
    if 'COLOR_0' in primitive.attributes:
        vertex = _rows(data, primitive.attributes['COLOR_0'], ('VEC3', 'VEC4'), len(points))
        own = vertex[:, :3][faces]
        if (own.max(axis=1) - own.min(axis=1)).max() > UNEQUAL:
            say_once(f'{data.path.name}: colours of vertices (COLOR_0) are averaged over each '
                     'triangle')
        colour = colour * own.mean(axis=1)
    uv = picture = None
    if material.texture is not None:
        texture = material.texture
        key = f'TEXCOORD_{texture.coordinates}'
        if key not in primitive.attributes:
            raise UserError('a textured mesh has texture coordinates', f'{where} has no {key}',
                            'unwrap it, or remove the texture')
        uv = _rows(data, primitive.attributes[key], ('VEC2',), len(points))[faces]
        if not np.isfinite(uv).all():
            raise UserError('texture coordinates are finite', where, 'repair the mesh')
        uv = uv @ texture.matrix[:, :2].T + texture.matrix[:, 2]
        picture, uv = unwrap(texture.picture, uv, texture.wrap, where)
    corners = points[faces]
    if matrix is not None and np.linalg.det(matrix[:3, :3]) < 0:  # mirrored
        corners = corners[:, ::-1]
        uv = None if uv is None else uv[:, ::-1]
    return Part((node.get('name'), mesh.get('name'), material.name), corners, uv,
                srgb_from_linear(colour), picture, material.both_sides)
