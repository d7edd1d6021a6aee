"""Textured triangle meshes as scenes: OBJ, GLB and glTF."""

from __future__ import annotations

import hashlib
import math
import re
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.gltf import read_gltf
from vn_sim_bridge.houses.labels import LABEL, LABELS
from vn_sim_bridge.houses.obj import read_obj
from vn_sim_bridge.houses.surface import MAX_TRIANGLES, Part
from vn_sim_bridge.render.scene import Scene, TextureSet, as_labels, uniform_light

GROUP = 64  # triangles culled together
READERS = {'.obj': read_obj, '.glb': read_gltf, '.gltf': read_gltf}


def load_mesh(path: str | Path, *, labels: dict[str, str] | None = None,
              default_label: str | None = None, up: str | None = None, scale: float = 1.0,
              double_sided: bool | None = None) -> Scene:
    """Read a mesh file as a scene; z is up, metres.

    The class of a part comes from the first of `labels` whose regular expression is found in the
    name of its node, geometry or material; else from a class that the node's name begins with
    ('chair_3' is a chair); else it is `default_label`.

    Of a glTF file its own scene is read. What cannot be drawn as the file means it is an error;
    animations, lights, normals and transparency alone are left out.

    Args:
        path: an .obj, .glb or .gltf file.
        labels: {regular expression: class}, see `labels.LABELS`.
        default_label: class of parts that nothing else names; default: such parts are an error.
        up: 'y' or 'z', the axis that points up in the file; default y, as glTF demands.
        scale: metres per unit of the file.
        double_sided: draw both sides of every triangle; default: as glTF's materials say, and yes
            for OBJ, which does not say.

    Raises:
        UserError: a file that is missing, broken, huge, unlabelled, compressed, or requires an
            extension that is unknown here; or one that it refers to.
    """
    path = Path(path)
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise UserError('textures are read by the package pillow', str(error),
                        'pip install "vn_nav[mesh]"') from error
    if path.suffix.lower() not in READERS:
        raise UserError(f'a mesh file ends in {", ".join(READERS)}', str(path),
                        'convert it, for instance with Blender')
    if not path.is_file():
        raise UserError('a mesh file exists', str(path), 'correct the path')
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
        parts = _within(READERS[path.suffix.lower()](path), path, double_sided)
        class_ids = [_label(path, part.names, labels or {}, default_label) for part in parts]
    except UserError:
        raise
    except Exception as error:
        # Whatever a reader trips over is a broken file, not a reason for a traceback.
        raise UserError('a mesh file is whole and follows its format',
                        f'{path}: {_words(error)}', 'export it again') from error
    if not parts:
        raise UserError('a mesh file has triangles', str(path), 'export the geometry, too')
    return _scene(parts, class_ids, path, up or 'y', scale, double_sided)


def _words(error: Exception) -> str:
    """What a reader tripped over, without the names of Python's exceptions."""
    if isinstance(error, KeyError):
        return f'{error} is missing'
    return str(error) if isinstance(error, ValueError) else (
        f'a value is not what the format has there ({error})')


def _within(parts, path: Path, double_sided: bool | None) -> list[Part]:
    """The parts, as long as they are finite and not too many."""
    found, total = [], 0
    for part in parts:
        total += len(part.corners) * (1 + _both(part, double_sided))
        if total > MAX_TRIANGLES:
            raise UserError(f'a mesh has at most {MAX_TRIANGLES} triangles, both sides counted',
                            f'{path}: {total} or more', 'decimate it')
        if not np.isfinite(part.corners).all():
            raise UserError('the vertices of a mesh are finite', f'{path}: {part.names[0]}',
                            'repair the mesh')
        found.append(part)
    return found


def _both(part: Part, double_sided: bool | None) -> bool:
    return part.both_sides if double_sided is None else double_sided


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
        raise UserError('every part of a mesh has a class',
                        f'{path}: {" / ".join(names) or "a part without a name"}',
                        'name it in labels, or give a default_label')
    return LABEL[default_label]


def _scene(parts: list[Part], class_ids: list[int], path: Path, up: str, scale: float,
           double_sided: bool | None) -> Scene:
    images = [np.full((4, 4, 3), 255, np.uint8)]
    known: dict[tuple, int] = {}  # many parts share a picture
    numbers: dict[int, int] = {}  # the same by identity: hashing a large one takes a while
    pieces: list[tuple] = []  # corners, uv, colour, texture, label, instance
    for instance, (part, label) in enumerate(zip(parts, class_ids, strict=True)):
        texture = 0
        if part.picture is not None:
            if id(part.picture) not in numbers:
                key = (part.picture.shape,
                       hashlib.sha256(np.ascontiguousarray(part.picture).data).digest())
                if key not in known:
                    known[key] = len(images)
                    images.append(part.picture)
                numbers[id(part.picture)] = known[key]
            texture = numbers[id(part.picture)]
        uv = np.zeros((len(part.corners), 3, 2)) if part.uv is None else part.uv
        ids = texture, label, instance % 65534 + 1
        pieces.append((part.corners, uv, part.colour, *ids))
        if _both(part, double_sided):
            pieces.append((part.corners[:, ::-1], uv[:, ::-1], part.colour, *ids))
    counts = [len(piece[0]) for piece in pieces]
    corners, uv, colour = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    textures, labels, instances = (np.repeat([piece[k] for piece in pieces], counts)
                                   for k in range(3, 6))
    corners = corners * scale
    if up == 'y':
        corners = corners[..., [0, 2, 1]] * (1, -1, 1)
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_1, edge_2)
    area = np.linalg.norm(normal, axis=1)
    solid = area > 1e-12  # the others cover nothing
    if not solid.any():
        raise UserError('a mesh file has triangles with an area', str(path),
                        'check its scale, and the scales of its nodes')
    order = np.nonzero(solid)[0]
    order = order[np.argsort(_morton(corners[order].mean(axis=1)), kind='stable')]
    corners, uv, normal, area, edge_1, edge_2 = (
        values[order] for values in (corners, uv, normal, area, edge_1, edge_2))
    count = len(order)
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
        face_texture=textures[order].astype(np.int32),
        face_colour=colour[order].astype(np.float32),
        face_label=as_labels(labels[order]),
        face_instance=instances[order].astype(np.uint16),
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
