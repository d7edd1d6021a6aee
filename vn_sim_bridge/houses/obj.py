"""Wavefront OBJ and MTL as parts: polygons, Kd and map_Kd; colours are display values."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.polygons import triangles_of
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
from vn_sim_bridge.notices import say_once

NO_MATERIAL = {'', 'none', '(null)', '(none)'}  # what exporters call none at all
SURFACES = {'cstype', 'curv', 'curv2', 'surf'}  # free forms, which are no polygons
# Options of map_Kd and how many words at most follow each.
OPTIONS = {'-s': 3, '-o': 3, '-t': 3, '-mm': 2, '-clamp': 1, '-blendu': 1, '-blendv': 1, '-cc': 1,
           '-bm': 1, '-boost': 1, '-texres': 1, '-imfchan': 1, '-type': 1, '-colorspace': 1}

OPAQUE = {'d': 1.0, 'tr': 0.0}  # what they are where nothing shines through
SWITCHES = {'-clamp', '-blendu', '-blendv', '-cc'}  # of them: on or off
SHOWN = 60  # letters of a line that an error repeats
MAX_INDEX = 2**31 - 1


@dataclasses.dataclass
class _Material:
    colour: np.ndarray  # [3]
    picture: np.ndarray | None = None  # [H,W,3] uint8
    scale: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(2))
    offset: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    wrap: str = REPEAT


class _Faces(NamedTuple):
    """Polygons with absolute indices of their corners, and the lines that they stand in."""

    polygons: list[list[tuple[int, int]]]
    lines: list[int]


def read_obj(path: Path) -> Iterator[Part]:
    """The polygons of a file, a part for each object, group and material.

    Raises:
        UserError: a broken line or a missing file, an undefined material, a missing texture.
        ValueError, ...: a file that does not follow the format.
    """
    points: list[list[float]] = []
    coordinates: list[list[float]] = []
    faces: dict[tuple, _Faces] = {}
    materials: dict[str, _Material] = {}
    libraries = 0
    place: list[str | None] = [None, None, None]  # object, group, material
    own = faces.setdefault(tuple(place), _Faces([], []))
    for number, line in _lines(path):
        word, _, rest = line.partition(' ')
        try:
            if word == 'v':
                points.append(_numbers(rest, 3))
            elif word == 'vt':
                coordinates.append((_numbers(rest, 1) + [0.0])[:2])
            elif word == 'f':
                corners = [_absolute(corner, len(points), len(coordinates))
                           for corner in rest.split()]
                if len(corners) < 3:
                    raise ValueError('a face has three corners at least')
                own.polygons.append(corners)
                own.lines.append(number)
            elif word in ('o', 'g', 'usemtl'):
                place['o g usemtl'.split().index(word)] = rest.strip()
                own = faces.setdefault(tuple(place), _Faces([], []))
            elif word == 'mtllib':
                for library in _libraries(path, rest.strip(), f'{path}, line {number}: '):
                    libraries += 1
                    materials.update(_materials(path, library))
            elif word in SURFACES:
                raise UserError('an OBJ file has polygons', f'{path}, line {number}: {word}',
                                'convert its free-form surfaces to a mesh')
        except (ValueError, OverflowError) as error:
            raise _broken(path, number, line, error) from error
    vertices = np.array([row[:3] for row in points], float).reshape(-1, 3)
    tints = None
    if points and min(map(len, points)) >= 6:
        tints = np.array([row[3:6] for row in points], float)
        if not np.isfinite(tints).all():
            raise UserError('the colours of vertices are finite', str(path), 'export it again')
        tints = np.clip(tints / 255 if tints.max() > 1 else tints, 0, 1)
    uv = np.array(coordinates, float).reshape(-1, 2)
    for names, drawn in faces.items():
        if not drawn.polygons:
            continue
        material = _named(path, names[2], materials, libraries)
        yield _part(path, names, drawn, vertices, uv, tints, material)


def _broken(path: Path, number: int, line: str, fault: object) -> UserError:
    """The error for a line that is not what its first word says."""
    return UserError('a line of an OBJ or MTL file is as its format says',
                     f'{path}, line {number}: {line[:SHOWN]}: {fault}', 'export it again')


def _numbers(text: str, least: int) -> list[float]:
    """The numbers of a line, so many at least.

    Raises:
        ValueError: there are fewer, or others.
    """
    words = text.split()
    if len(words) < least:
        raise ValueError(f'{len(words)} numbers, where there are {least} at least')
    return [float(word) for word in words]


def _text(path: Path) -> str:
    """A text file, in UTF-8 or as older programs write."""
    data = read_bytes(path, 'a mesh file can be read')
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError:
        return data.decode('latin-1')


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and their numbers, counted from 1; comments and continuations undone.

    The first word of a line stands in front of one space.
    """
    before, first = '', 0
    lines = _text(path).replace('\r\n', '\n').replace('\r', '\n').split('\n')
    for number, line in enumerate(lines, 1):
        first = first or number
        if line.endswith('\\') and number < len(lines):
            before += line[:-1] + ' '
            continue
        words = (before + line).split(None, 1)
        if words and not words[0].startswith('#'):
            yield first, ' '.join(words)
        before, first = '', 0


def _absolute(corner: str, points: int, coordinates: int) -> tuple[int, int]:
    """Indices of vertex and texture coordinate (-1: none) of a word such as 3/1/2 or -1//-1.

    Raises:
        ValueError: no such word; an index of 0, or from the end and beyond the beginning.
    """
    first, _, rest = corner.partition('/')
    second = rest.partition('/')[0]
    return _index(first, points), _index(second, coordinates) if second else -1


def _index(word: str, count: int) -> int:
    number = int(word)
    if not -count <= number <= MAX_INDEX or number == 0:
        raise ValueError(f'the index {number} of {count} so far')
    return number - 1 if number > 0 else count + number


def _names(text: str) -> list[str]:
    """What a name in the file may stand for."""
    found = []
    for name in (text, text.strip('"'), unquote(text)):
        found += [name, name.replace('\\', '/')]
    return list(dict.fromkeys(found))


def _libraries(path: Path, text: str, where: str) -> list[Path]:
    """The files of an mtllib line: one name, with or without spaces, or several."""
    if not text:
        raise ValueError('it names no file')
    words = text.split()
    if len(words) > 1 and not any((path.parent / name).is_file() for name in _names(text)) and (
            any((path.parent / name).is_file() for word in words for name in _names(word))):
        return [find_file(path, path.parent, _names(word), where) for word in words]
    return [find_file(path, path.parent, _names(text), where)]


def _materials(mesh: Path, library: Path) -> dict[str, _Material]:
    """What an MTL file defines."""
    found: dict[str, _Material] = {}
    own = None
    for number, line in _lines(library):
        word, _, rest = line.partition(' ')
        word = word.lower()
        try:
            if word == 'newmtl':
                if not rest.strip():
                    raise ValueError('it has no name')
                own = found[rest.strip()] = _Material(np.ones(3))
            elif word == 'map_d' or (
                    word in OPAQUE and _numbers(rest.replace('-halo', ''), 1)[0] != OPAQUE[word]):
                say_once(f'{library.name}: transparency ({word}) is left out; surfaces are opaque')
            elif word not in ('kd', 'map_kd'):
                continue
            elif own is None:
                raise ValueError('no newmtl stands before it')
            elif word == 'kd':
                own.colour = _colour(rest)
            else:
                _texture(mesh, library, rest.strip(), own, f'{library}, line {number}: ')
        except ValueError as error:
            raise _broken(library, number, line, error) from error
    return found


def _colour(text: str) -> np.ndarray:
    """The display values [3] of a Kd line: red, green and blue, or one for all."""
    if text.split()[:1] in (['spectral'], ['xyz']):
        raise ValueError('Kd is red, green, blue')
    values = _numbers(text, 1)
    if len(values) == 2 or not np.isfinite(values[:3]).all():
        raise ValueError('a colour is one number or three')
    return np.clip((values * 3)[:3] if len(values) == 1 else values[:3], 0.0, 1.0)


def _texture(mesh: Path, library: Path, text: str, material: _Material, where: str) -> None:
    """Read the options and the file of a map_Kd line."""
    while (option := text.partition(' ')[0].lower()) in OPTIONS:
        words = text.split()[1:]
        values: list[str] = []
        for word in words[:min(OPTIONS[option], len(words) - 1)]:  # the last one is the file's
            if OPTIONS[option] > 1 and not _is_number(word):
                break
            values.append(word)
        for _ in (option, *values):
            text = (text.split(None, 1) + [''])[1]
        if not values:
            raise ValueError(f'{option} has no value, or no file behind it')
        if option in SWITCHES and values[0].lower() not in ('on', 'off'):
            raise ValueError(f'{option} is on or off')
        if option == '-s':
            material.scale = _pair(values, 1.0)
        elif option == '-o':
            material.offset = _pair(values, 0.0)
        elif option == '-clamp' and values[0].lower() == 'on':
            material.wrap = CLAMP
        elif (option == '-mm' and [float(v) for v in values] != [0.0, 1.0]) or (
                option == '-t' and any(float(v) for v in values)):
            raise UserError('a texture is drawn as its picture shows it',
                            f'{where}map_Kd {option} {" ".join(values)}',
                            'change the picture instead')
    if not text:
        raise ValueError('it names no file')
    file = find_file(mesh, library.parent, _names(text), where)
    material.picture = decode_picture(file, read_bytes(file, 'a texture can be read'))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _pair(values: list[str], default: float) -> np.ndarray:
    """The first two of up to three numbers, along u and v."""
    found = np.array([float(v) for v in values[:2]] + [default] * (2 - len(values[:2])))
    if not np.isfinite(found).all():
        raise ValueError('its numbers are finite')
    return found


def _named(path: Path, name: str | None, materials: dict, libraries: int) -> _Material:
    """The material of that name; without a library a name is only a name."""
    if name in materials:
        return materials[name]
    if libraries and name is not None and name.lower() not in NO_MATERIAL:
        raise UserError('every material that faces use is defined in an MTL file',
                        f'{path}: usemtl {name}', 'export the materials again')
    return _Material(np.ones(3))


def _part(path: Path, names: tuple, faces: _Faces, vertices: np.ndarray, uv: np.ndarray, tints,
          material: _Material) -> Part:
    where = f'{path}: {names[0] or names[1] or names[2] or "a face"}'
    corners = [corner for polygon in faces.polygons for corner in polygon]
    index = np.array(corners, np.int64).reshape(-1, 2)
    sizes = np.array([len(polygon) for polygon in faces.polygons])
    beyond = (index >= (len(vertices), len(uv))).any(axis=1)
    if beyond.any():  # only now it is known how many there are
        row = int(np.searchsorted(np.cumsum(sizes), np.argmax(beyond), side='right'))
        raise UserError('the faces of a mesh refer to its vertices',
                        f'{path}, line {faces.lines[row]}: one of {len(vertices)} vertices and '
                        f'{len(uv)} texture coordinates that is not there', 'repair the mesh')
    if (sizes - 2).sum() > MAX_TRIANGLES:
        raise UserError(f'a mesh has at most {MAX_TRIANGLES} triangles', where, 'decimate it')
    if not np.isfinite(vertices[index[:, 0]]).all():
        raise UserError('the vertices of a mesh are finite', where, 'repair the mesh')
    picked = triangles_of(sizes, vertices[index[:, 0]])
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
    elif (index[:, 1] >= 0).all():  # for whoever puts another material on it
        own = uv[chosen[..., 1]] * (1, -1) + (0, 1)
        if not np.isfinite(own).all():
            own = None
    return Part(names, vertices[chosen[..., 0]], own, colour, picture, True)
