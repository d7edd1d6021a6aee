"""Textured triangle meshes as scenes: OBJ, GLB and glTF, read by trimesh (`vn_nav[mesh]`)."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import struct
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABEL, LABELS
from vn_sim_bridge.scene import Scene, TextureSet, uniform_light

GROUP = 64  # triangles culled together
MAX_TRIANGLES = 8_000_000
MAX_BYTES = 4 << 30
MAX_PIXELS = 1 << 28  # of one texture
PICTURES = ('.png', '.jpg', '.jpeg', '.bmp', '.tga', '.tif', '.tiff', '.webp')
SUFFIXES = ('.obj', '.glb', '.gltf')


def load_mesh(path: str | Path, *, labels: dict[str, str] | None = None,
              default_label: str | None = None, up: str | None = None, scale: float = 1.0,
              double_sided: bool | None = None) -> Scene:
    """Read a mesh file as a scene; z is up, metres.

    The class of a part comes from the first of `labels` whose regular expression is found in the
    name of its node, geometry or material; else from a class that the node's name begins with
    ('chair_3' is a chair); else it is `default_label`.

    Args:
        path: an .obj, .glb or .gltf file.
        labels: {regular expression: class}, see `labels.LABELS`.
        default_label: class of parts that nothing else names; default: such parts are an error.
        up: 'y' or 'z', the axis that points up in the file; default y, as glTF demands.
        scale: metres per unit of the file.
        double_sided: draw both sides of every triangle; default: as glTF's materials say, and yes
            for OBJ, which does not say.

    Raises:
        UserError: a file that is missing, broken, huge, unlabelled, or refers to one that is.
    """
    path = Path(path)
    try:
        import PIL.Image  # noqa: F401
        import trimesh
    except ImportError as error:
        raise UserError('meshes are read by the package trimesh', str(error),
                        'pip install "vn_nav[mesh]"') from error
    _check_file(path)
    for name in {**(labels or {}), **({'default': default_label} if default_label else {})
                 }.values():
        if name not in LABEL:
            raise UserError('a label is a known class', f'{path}: {name!r}',
                            f'the classes are {", ".join(LABELS[1:])}')
    if up not in (None, 'y', 'z'):
        raise UserError("the axis that points up is 'y' or 'z'", up, 'choose one of them')
    if not (math.isfinite(scale) and scale > 0):
        raise UserError('the scale is positive', scale, 'give metres per unit of the file')
    try:
        loaded = trimesh.load_scene(path, process=False, allow_remote=False)
        parts = list(_parts(loaded, path, labels or {}, default_label, double_sided))
    except UserError:
        raise
    except Exception as error:
        # Whatever the reader trips over is a broken file, not a reason for a traceback.
        raise UserError('a mesh file is whole and follows its format',
                        f'{path}: {type(error).__name__}: {error}', 'export it again') from error
    if not parts:
        raise UserError('a mesh file has triangles', str(path), 'export the geometry, too')
    return _scene(parts, path, up or 'y', scale)


def _check_file(path: Path) -> None:
    """The file and everything it refers to exists, before anything is read in earnest."""
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f'a mesh file ends in {", ".join(SUFFIXES)}', str(path),
                        'convert it, for instance with Blender')
    if not path.is_file():
        raise UserError('a mesh file exists', str(path), 'correct the path')
    if path.stat().st_size > MAX_BYTES:
        raise UserError(f'a mesh file has at most {MAX_BYTES >> 30} GiB',
                        f'{path}: {path.stat().st_size / (1 << 30):.1f} GiB', 'decimate it')
    if path.suffix.lower() == '.obj':
        references = _obj_references(path)
    else:
        references = _gltf_references(path)
    for name in references:
        if not (path.parent / name).is_file():
            raise UserError(f'every file that {path} refers to exists', name,
                            'copy it beside the mesh, or export the mesh with embedded textures')
        if Path(name).suffix.lower() in PICTURES:
            _check_picture(path.parent / name, (path.parent / name).read_bytes())


def _check_picture(name, data: bytes) -> None:
    """A texture can be decoded: readers leave out those that cannot without a word."""
    import PIL.Image
    try:
        with PIL.Image.open(io.BytesIO(data)) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise UserError(f'a texture has at most {MAX_PIXELS} pixels',
                                f'{name}: {picture.width} x {picture.height}', 'make it smaller')
            picture.load()
    except (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError) as error:
        raise UserError('a texture is a whole picture', f'{name}: {error}',
                        'export it again') from error


def _lines(path: Path):
    try:
        yield from path.read_text(errors='replace').splitlines()
    except OSError as error:
        raise UserError('a mesh file can be read', f'{path}: {error}',
                        'check its permissions') from error


def _obj_references(path: Path) -> list[str]:
    found = []
    for line in _lines(path):
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0] == 'mtllib':
            found.append(words[1].strip())
            library = path.parent / found[-1]
            if library.is_file():
                for entry in _lines(library):
                    words = entry.split()
                    if len(words) >= 2 and words[0].lower() == 'map_kd':
                        found.append(str(Path(found[0]).parent / words[-1]))
    return found


def _gltf_references(path: Path) -> list[str]:
    data, blob = path.read_bytes(), None
    try:
        if path.suffix.lower() == '.glb':
            magic, _, length, chunk, kind = struct.unpack_from('<4sII I4s', data)
            if magic != b'glTF' or kind != b'JSON' or length != len(data):
                raise ValueError(f'header says {length} bytes, the file has {len(data)}')
            data = data[20:20 + chunk]
            blob = path.read_bytes()[20 + chunk + 8:]
        document = json.loads(data)
        views = document.get('bufferViews', [])
        for image in document.get('images', []):
            if blob is not None and 'bufferView' in image:
                view = views[image['bufferView']]
                first = view.get('byteOffset', 0)
                _check_picture(f'{path}, an embedded texture',
                               blob[first:first + view['byteLength']])
        entries = [*document.get('buffers', []), *document.get('images', [])]
        return [unquote(entry['uri']) for entry in entries
                if not entry.get('uri', 'data:').startswith('data:')]
    except (ValueError, KeyError, IndexError, struct.error, AttributeError, TypeError) as error:
        raise UserError('a mesh file is whole and follows its format', f'{path}: {error}',
                        'export it again') from error


def _parts(loaded, path: Path, labels, default_label, double_sided):
    """Per geometry in the scene: corners [T,3,3], uv [T,3,2] or None, colour, picture, label."""
    instance = 0
    for node in loaded.graph.nodes_geometry:
        matrix, geometry_name = loaded.graph[node]
        mesh = loaded.geometry[geometry_name]
        if not hasattr(mesh, 'faces') or len(mesh.faces) == 0:
            continue  # point clouds and lines have no surface
        vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.asarray(mesh.faces)
        if not np.isfinite(vertices).all():
            raise UserError('the vertices of a mesh are finite', f'{path}: {node}',
                            'repair the mesh')
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise UserError('the faces of a mesh refer to its vertices', f'{path}: {node}',
                            'repair the mesh')
        if np.linalg.det(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]  # a mirrored instance
        material = getattr(mesh.visual, 'material', None)
        label = _label(path, (node, geometry_name, getattr(material, 'name', None)), labels,
                       default_label)
        uv, picture, colours = _surface(mesh, material, path, node)
        corners = vertices[faces]
        uv = None if uv is None else uv[faces]
        colours = colours[faces].mean(axis=1) if colours.ndim == 2 else np.tile(
            colours, (len(faces), 1))
        instance = instance % 65534 + 1
        yield corners, uv, colours, picture, label, instance
        both = double_sided
        if both is None:
            both = path.suffix.lower() == '.obj' or bool(getattr(material, 'doubleSided', False))
        if both:
            yield (corners[:, ::-1], None if uv is None else uv[:, ::-1], colours, picture, label,
                   instance)


def _label(path, names, labels, default_label) -> int:
    names = [name for name in names if name]
    for pattern, label in labels.items():
        if any(re.search(pattern, name) for name in names):
            return LABEL[label]
    for name in names:
        word = re.sub(r'[\W\d]*$', '', name.lower().split('#')[0]).rstrip('_')
        if word in LABEL:
            return LABEL[word]
    if default_label is None:
        raise UserError('every part of a mesh has a class', f'{path}: {" / ".join(names)}',
                        'name it in labels, or give a default_label')
    return LABEL[default_label]


def _surface(mesh, material, path, node):
    """Texture coordinates [V,2] or None, picture or None, and colours [3] or [V,3] in [0,1]."""
    uv = getattr(mesh.visual, 'uv', None)
    picture = getattr(material, 'baseColorTexture', None) or getattr(material, 'image', None)
    colour = np.ones(3)
    factor = getattr(material, 'baseColorFactor', None)
    if factor is None and picture is None:
        factor = getattr(material, 'diffuse', None)
    if factor is not None:
        factor = np.asarray(factor, float)[:3]
        colour = factor / 255.0 if factor.max() > 1.0 else factor
    elif material is None and mesh.visual.defined:
        colour = np.asarray(mesh.visual.vertex_colors, float)[:, :3] / 255.0
    if picture is not None and (uv is None or len(uv) != len(mesh.vertices)):
        raise UserError('a textured mesh has texture coordinates', f'{path}: {node}',
                        'unwrap it, or remove the texture')
    if picture is None:
        return None, None, colour
    if not np.isfinite(uv).all():
        raise UserError('texture coordinates are finite', f'{path}: {node}', 'repair the mesh')
    return np.asarray(uv, float), picture, colour


def _scene(parts, path: Path, up: str, scale: float) -> Scene:
    total = sum(len(part[0]) for part in parts)
    if total > MAX_TRIANGLES:
        raise UserError(f'a mesh has at most {MAX_TRIANGLES} triangles, both sides counted',
                        f'{path}: {total}', 'decimate it')
    pictures: dict[tuple, int] = {}
    images = [np.full((4, 4, 3), 255, np.uint8)]
    texture = []
    for part in parts:
        if part[3] is None:
            texture.append(0)
            continue
        picture = np.asarray(part[3].convert('RGB'))
        key = (picture.shape, hashlib.sha256(picture.tobytes()).digest())  # many parts share one
        if key not in pictures:
            pictures[key] = len(images)
            images.append(picture)
        texture.append(pictures[key])
    corners = np.concatenate([part[0] for part in parts]) * scale
    if up == 'y':
        corners = corners[..., [0, 2, 1]] * (1, -1, 1)
    counts = [len(part[0]) for part in parts]
    uv = np.concatenate([np.zeros((len(part[0]), 3, 2)) if part[1] is None else part[1]
                         for part in parts])
    colour = np.concatenate([part[2] for part in parts])
    texture, label, instance = (np.repeat(values, counts) for values in (
        texture, [part[4] for part in parts], [part[5] for part in parts]))
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_1, edge_2)
    area = np.linalg.norm(normal, axis=1)
    solid = area > 1e-12  # the others cover nothing
    if not solid.any():
        raise UserError('a mesh file has triangles with an area', str(path), 'check its scale')
    order = np.nonzero(solid)[0]
    order = order[np.argsort(_morton(corners[order].mean(axis=1)), kind='stable')]
    corners, uv, normal, area, edge_1, edge_2 = (
        values[order] for values in (corners, uv, normal, area, edge_1, edge_2))
    count = len(order)
    uv[..., 1] = 1.0 - uv[..., 1]  # pictures begin at the top
    uv += 1.0 - np.floor(uv.min(axis=1, keepdims=True))  # see SceneBuilder
    face_uv = np.empty((count, 2, 4))
    square = (area**2)[:, None]
    for k in range(2):
        gradient = ((uv[:, 1, k] - uv[:, 0, k])[:, None] * np.cross(edge_2, normal)
                    + (uv[:, 2, k] - uv[:, 0, k])[:, None] * np.cross(normal, edge_1)) / square
        face_uv[:, k, :3] = gradient
        face_uv[:, k, 3] = uv[:, 0, k] - (gradient * corners[:, 0]).sum(axis=1)
    unit = normal / area[:, None]
    group_start = np.append(np.arange(0, count, GROUP), count)
    boxes = np.concatenate([
        np.minimum.reduceat(corners.min(axis=1), group_start[:-1]) - 1e-4,
        np.maximum.reduceat(corners.max(axis=1), group_start[:-1]) + 1e-4], axis=1)
    face_light, light_map, light = uniform_light(count)
    return Scene(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        face_start=np.arange(0, 3 * count + 1, 3, dtype=np.int32),
        face_vertices=np.arange(3 * count, dtype=np.int32),
        face_plane=np.column_stack([unit, (unit * corners[:, 0]).sum(axis=1)]).astype(np.float32),
        face_uv=face_uv.astype(np.float32),
        face_texture=texture[order].astype(np.int32),
        face_colour=colour[order].astype(np.float32),
        face_label=label[order].astype(np.uint8),
        face_instance=instance[order].astype(np.uint16),
        face_light=face_light, face_light_map=light_map, light=light,
        group_start=group_start.astype(np.int32),
        group_box=boxes.astype(np.float32),
        group_room=np.zeros(len(boxes), np.int32),
        textures=TextureSet(images),
    )


def _morton(points: np.ndarray) -> np.ndarray:
    """Place along a curve that keeps neighbours together, [N] uint64."""
    low = points.min(axis=0)
    size = max(float((points.max(axis=0) - low).max()), 1e-9)
    cells = np.clip((points - low) / size * 1023, 0, 1023).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


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
    try:
        import trimesh
        from PIL import Image
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial
    except ImportError as error:
        raise UserError('meshes are written by the package trimesh', str(error),
                        'pip install "vn_nav[mesh]"') from error
    parts: dict[tuple, list[int]] = {}
    for face in range(len(scene.face_label)):
        colour = tuple(int(c) for c in np.rint(scene.face_colour[face] * 255))
        key = (int(scene.face_label[face]), int(scene.face_instance[face]),
               int(scene.face_texture[face]), colour)
        parts.setdefault(key, []).append(face)
    pictures = [Image.fromarray(_picture(scene.textures, k))
                for k in range(len(scene.textures.side))]
    out = trimesh.Scene()
    for number, ((label, instance, texture, colour), faces) in enumerate(parts.items()):
        points, triangles, uv = [], [], []
        for face in faces:
            ids = scene.face_vertices[scene.face_start[face]:scene.face_start[face + 1]]
            corners = scene.vertices[ids].astype(float)
            first = sum(map(len, points))
            triangles += [(first, first + k, first + k + 1) for k in range(1, len(ids) - 1)]
            points.append(corners)
            plane = scene.face_uv[face].astype(float)
            uv.append(corners @ plane[:, :3].T + plane[:, 3])
        points, uv = np.concatenate(points), np.concatenate(uv)
        material = PBRMaterial(
            name=f'{LABELS[label]}_{number}', baseColorTexture=pictures[texture],
            baseColorFactor=[*colour, 255], metallicFactor=0.0, roughnessFactor=0.9)
        mesh = trimesh.Trimesh(
            points[:, [0, 2, 1]] * (1, 1, -1), triangles, process=False,
            visual=TextureVisuals(np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), material))
        name = f'{LABELS[label]}_{instance}_{number}'
        out.add_geometry(mesh, node_name=name, geom_name=name)
    path.write_bytes(out.export(file_type='glb'))


def _picture(textures: TextureSet, index: int) -> np.ndarray:
    side = textures.side[index]
    texels = textures.texels[textures.start[index]:textures.start[index] + side * side]
    return np.stack([texels & 255, texels >> 8 & 255, texels >> 16], axis=-1).astype(
        np.uint8).reshape(side, side, 3)
