"""Textured triangle meshes as scenes: OBJ, GLB and glTF."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.gltf import read_gltf
from vn_sim_bridge.houses.labels import LABEL, LABELS
from vn_sim_bridge.houses.obj import read_obj
from vn_sim_bridge.houses.surface import MAX_TRIANGLES, Part
from vn_sim_bridge.render.mesh_scene import Surface, mesh_scene
from vn_sim_bridge.render.scene import Scene

Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # turns y up into z up
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
    for name in {**(labels or {}), **({'default': default_label} if default_label else {})
                 }.values():
        if name not in LABEL:
            raise UserError('a label is a known class', f'{path}: {name!r}',
                            f'the classes are {", ".join(LABELS[1:])}')
    if up not in (None, 'y', 'z'):
        raise UserError("the axis that points up is 'y' or 'z'", up, 'choose one of them')
    if not (math.isfinite(scale) and scale > 0):
        raise UserError('the scale is positive', scale, 'give metres per unit of the file')
    parts = read_parts(path, double_sided=double_sided)
    class_ids = [_label(path, part.names, labels or {}, default_label) for part in parts]
    return _scene(parts, class_ids, path, up or 'y', scale, double_sided)


def read_parts(path: Path, *, double_sided: bool | None = None) -> list[Part]:
    """The triangles of a mesh file, in its own axes and units.

    Args:
        path: an .obj, .glb or .gltf file.
        double_sided: see `load_mesh`; for the limit of triangles.

    Raises:
        UserError: as `load_mesh`, less what it says of classes.
    """
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
    try:
        parts = _within(READERS[path.suffix.lower()](path), path, double_sided)
    except UserError:
        raise
    except Exception as error:
        # Whatever a reader trips over is a broken file, not a reason for a traceback.
        raise UserError('a mesh file is whole and follows its format',
                        f'{path}: {_words(error)}', 'export it again') from error
    if not parts:
        raise UserError('a mesh file has triangles', str(path), 'export the geometry, too')
    return parts


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
    turn = Z_UP if up == 'y' else np.eye(3)
    return mesh_scene([
        Surface(part.corners * scale @ turn.T, part.uv, part.colour, part.picture, label,
                instance % 65534 + 1, _both(part, double_sided))
        for instance, (part, label) in enumerate(zip(parts, class_ids, strict=True))], str(path))
