"""Wavefront OBJ and MTL as parts: polygons, Kd and map_Kd; colours are display values."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.surface import (
    CLAMP,
    MAX_TRIANGLES,
    REPEAT,
    Part,
    decode_picture,
    find_file,
    read_bytes,
    unwrap,
)

NO_MATERIAL = {'', 'none', '(null)', '(none)'}  # what exporters call none at all
SURFACES = {'cstype', 'curv', 'curv2', 'surf'}  # free forms, which are no polygons
# Options of map_Kd and how many words at most follow each.
OPTIONS = {'-s': 3, '-o': 3, '-t': 3, '-mm': 2, '-clamp': 1, '-blendu': 1, '-blendv': 1, '-cc': 1,
           '-bm': 1, '-boost': 1, '-texres': 1, '-imfchan': 1, '-type': 1, '-colorspace': 1}


@dataclasses.dataclass
class _Material:
    colour: np.ndarray  # [3]
    picture: np.ndarray | None = None  # [H,W,3] uint8
    scale: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(2))
    offset: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    wrap: str = REPEAT


def read_obj(path: Path) -> Iterator[Part]:
    """The polygons of a file, a part for each object, group and material.

    Raises:
        UserError: a broken or missing file, an undefined material, a missing texture.
        ValueError, ...: a file that does not follow the format.
    """
    points: list[list[str]] = []
    coordinates: list[list[str]] = []
    faces: dict[tuple, list[list[str]]] = {}  # with absolute indices
    materials: dict[str, _Material] = {}
    libraries = 0
    place = [None, None, None]  # object, group, material
    own = faces.setdefault(tuple(place), [])
    for line in _lines(path):
        word, _, rest = line.partition(' ')
        if word == 'v':
            points.append(rest.split())
        elif word == 'vt':
            coordinates.append(rest.split()[:2])
        elif word == 'f':
            own.append([_absolute(corner, len(points), len(coordinates))
                        for corner in rest.split()])
        elif word in ('o', 'g', 'usemtl'):
            place['o g usemtl'.split().index(word)] = rest.strip()
            own = faces.setdefault(tuple(place), [])
        elif word == 'mtllib':
            for library in _libraries(path, rest.strip()):
                libraries += 1
                materials.update(_materials(path, library))
        elif word in SURFACES:
            raise UserError('an OBJ file has polygons', f'{path}: {word}',
                            'convert its free-form surfaces to a mesh')
    shape = {len(words) for words in points}
    vertices = np.array([words[:3] for words in points], float).reshape(-1, 3)
    tints = None
    if shape and min(shape) >= 6:
        tints = np.array([words[3:6] for words in points], float)
        tints = np.clip(tints / 255 if tints.max() > 1 else tints, 0, 1)
    uv = np.array([(*words, '0')[:2] for words in coordinates], float).reshape(-1, 2)
    for names, polygons in faces.items():
        if not polygons:
            continue
        material = _named(path, names[2], materials, libraries)
        yield _part(path, names, polygons, vertices, uv, tints, material)


def _text(path: Path) -> str:
    """A text file, in UTF-8 or as older programs write."""
    data = read_bytes(path, 'a mesh file can be read')
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError:
        return data.decode('latin-1')


def _lines(path: Path) -> Iterator[str]:
    """Lines with their first word in front of one space; comments and continuations undone."""
    before = ''
    for line in _text(path).replace('\r\n', '\n').replace('\r', '\n').split('\n'):
        if line.endswith('\\'):
            before += line[:-1] + ' '
            continue
        words = (before + line).split(None, 1)
        before = ''
        if words and not words[0].startswith('#'):
            yield ' '.join(words)


def _absolute(corner: str, points: int, coordinates: int) -> tuple[int, int]:
    """Indices of vertex and texture coordinate (-1: none) of a word such as 3/1/2 or -1//-1."""
    first, _, rest = corner.partition('/')
    second = rest.partition('/')[0]
    vertex = int(first)
    vertex = vertex - 1 if vertex > 0 else points + vertex
    if not second:
        return vertex, -1
    texture = int(second)
    texture = texture - 1 if texture > 0 else coordinates + texture
    return vertex, texture if texture >= 0 else coordinates  # out of range stays so


def _names(text: str) -> list[str]:
    """What a name in the file may stand for."""
    found = []
    for name in (text, text.strip('"'), unquote(text)):
        found += [name, name.replace('\\', '/')]
    return list(dict.fromkeys(found))


def _libraries(path: Path, text: str) -> list[Path]:
    """The files of an mtllib line: one name, with or without spaces, or several."""
    words = text.split()
    if len(words) > 1 and not any((path.parent / name).is_file() for name in _names(text)) and (
            any((path.parent / name).is_file() for word in words for name in _names(word))):
        return [find_file(path, path.parent, _names(word)) for word in words]
    return [find_file(path, path.parent, _names(text))]


def _materials(mesh: Path, library: Path) -> dict[str, _Material]:
    """What an MTL file defines."""
    found: dict[str, _Material] = {}
    own = None
    for line in _lines(library):
        word, _, rest = line.partition(' ')
        if word == 'newmtl':
            own = found[rest.strip()] = _Material(np.ones(3))
        elif word.lower() == 'kd' and own is not None:
            values = rest.split()
            if values[0] in ('spectral', 'xyz'):
                raise UserError('Kd is red, green, blue', f'{library}: {line}',
                                'export the material again')
            own.colour = np.clip(np.array((values * 3)[:3] if len(values) == 1 else values[:3],
                                          float), 0, 1)
        elif word.lower() == 'map_kd' and own is not None:
            _texture(mesh, library, rest.strip(), own)
    return found


def _texture(mesh: Path, library: Path, text: str, material: _Material) -> None:
    """Read the options and the file of a map_Kd line."""
    while (option := text.split(None, 1)[0].lower()) in OPTIONS:
        text = text.split(None, 1)[1]
        values: list[str] = []
        while len(values) < OPTIONS[option] and len(text.split(None, 1)) == 2:
            word, rest = text.split(None, 1)
            if OPTIONS[option] > 1 and not _is_number(word):
                break
            values.append(word)
            text = rest
        if option == '-s':
            material.scale = _pair(values, 1.0)
        elif option == '-o':
            material.offset = _pair(values, 0.0)
        elif option == '-clamp' and values == ['on']:
            material.wrap = CLAMP
        elif (option == '-mm' and [float(v) for v in values] != [0.0, 1.0]) or (
                option == '-t' and any(float(v) for v in values)):
            raise UserError('a texture is drawn as its picture shows it',
                            f'{library}: map_Kd {option} {" ".join(values)}',
                            'change the picture instead')
    file = find_file(mesh, library.parent, _names(text))
    material.picture = decode_picture(file, read_bytes(file, 'a texture can be read'))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _pair(values: list[str], default: float) -> np.ndarray:
    """The first two of up to three numbers, along u and v."""
    return np.array([float(v) for v in values[:2]] + [default] * (2 - len(values[:2])))


def _named(path: Path, name: str | None, materials: dict, libraries: int) -> _Material:
    """The material of that name; without a library a name is only a name."""
    if name in materials:
        return materials[name]
    if libraries and name is not None and name.lower() not in NO_MATERIAL:
        raise UserError('every material that faces use is defined in an MTL file',
                        f'{path}: usemtl {name}', 'export the materials again')
    return _Material(np.ones(3))


def _part(path: Path, names: tuple, polygons: list, vertices: np.ndarray, uv: np.ndarray, tints,
          material: _Material) -> Part:
    where = f'{path}: {names[0] or names[1] or names[2] or "a face"}'
    corners = [corner for polygon in polygons for corner in polygon]
    index = np.array(corners, np.int64).reshape(-1, 2)
    sizes = np.array([len(polygon) for polygon in polygons])
    if sizes.min() < 3 or index[:, 0].min() < 0 or index[:, 0].max() >= len(vertices) or (
            index[:, 1].max() >= len(uv)):
        raise UserError('the faces of a mesh refer to its vertices, three at least', where,
                        'repair the mesh')
    if (sizes - 2).sum() > MAX_TRIANGLES:
        raise UserError(f'a mesh has at most {MAX_TRIANGLES} triangles', where, 'decimate it')
    if not np.isfinite(vertices[index[:, 0]]).all():
        raise UserError('the vertices of a mesh are finite', where, 'repair the mesh')
    picked = _triangles(sizes, vertices[index[:, 0]])
    chosen = index[picked]  # [T,3,2]
    colour = np.broadcast_to(material.colour, (len(picked), 3))
    if tints is not None:
        colour = colour * tints[chosen[..., 0]].mean(axis=1)
    own = picture = None
    if material.picture is not None:
        if (index[:, 1] < 0).any():
            raise UserError('a textured mesh has texture coordinates', where,
                            'unwrap it, or remove the texture')
        own = uv[chosen[..., 1]] * material.scale + material.offset
        if not np.isfinite(own).all():
            raise UserError('texture coordinates are finite', where, 'repair the mesh')
        own[..., 1] = 1.0 - own[..., 1]  # v points up in OBJ
        picture, own = unwrap(material.picture, own, (material.wrap,) * 2, where)
    return Part(names, vertices[chosen[..., 0]], own, colour, picture, True)


def _triangles(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
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
