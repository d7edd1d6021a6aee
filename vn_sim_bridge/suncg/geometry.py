"""The triangles of a level, of both layouts, as labelled surfaces in the map frame.

- `suncg`: `room/<house>/<modelId>{f,c,w}.obj` and `object/<model>/<model>.obj`, as published;
- `house3d`: one `house/<house>/house.obj` with groups `Model#..`, `Floor#..`, ..., as House3D
  converts it.

As in House3D the backs of triangles are not drawn, persons are left out, and what a material
says of transparency has no effect.
"""

from __future__ import annotations

import abc
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh import read_parts
from vn_sim_bridge.houses.surface import Part, decode_picture, read_bytes
from vn_sim_bridge.notices import say_once
from vn_sim_bridge.render.mesh_scene import Surface
from vn_sim_bridge.suncg.axes import to_map
from vn_sim_bridge.suncg.house_json import HouseFile, Level, Material, Node
from vn_sim_bridge.suncg.labels import Categories

LAYOUTS = ('suncg', 'house3d')
ROLES = {'f': 'floor', 'c': 'ceiling', 'w': 'wall'}
# Groups of House3D's house.obj, by the word before '#'.
GROUPS = {'floor': 'floor', 'ceiling': 'ceiling', 'wall': 'wall', 'wallinside': 'wall',
          'walloutside': 'wall', 'ground': 'ground', 'box': 'box'}
ENDINGS = ('.png', '.jpg', '.jpeg')
MOST_INSTANCES = 65533
# Sides of a box from its middle, in halves of its dimensions, counter-clockwise from outside.
SIDES = np.array([
    [(1, -1, 1), (1, -1, -1), (1, 1, -1), (1, 1, 1)],
    [(-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (-1, 1, -1)],
    [(-1, 1, 1), (1, 1, 1), (1, 1, -1), (-1, 1, -1)],
    [(-1, -1, -1), (1, -1, -1), (1, -1, 1), (-1, -1, 1)],
    [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)],
    [(1, -1, -1), (-1, -1, -1), (-1, 1, -1), (1, 1, -1)]], float)


class Piece(NamedTuple):
    """What belongs together: a model, the floor of a room, ..."""

    role: str  # 'object', 'box', 'floor', 'ceiling', 'wall', 'ground'
    node: Node | None  # None: House3D's file does not say of which
    surfaces: tuple[Surface, ...]  # in the map frame, m

    @property
    def corners(self) -> np.ndarray:
        """[T,3,3] m."""
        if not self.surfaces:
            return np.zeros((0, 3, 3))
        return np.concatenate([surface.corners for surface in self.surfaces])


def layout_of(data: Path, house_id: str) -> str:
    """Which layout a house has, by the files that are there.

    Raises:
        UserError: neither.
    """
    if (data / 'room' / house_id).is_dir():
        return 'suncg'
    if (data / 'house' / house_id / 'house.obj').is_file():
        return 'house3d'
    raise UserError('a SUNCG house has its rooms in room/ID, or is converted to '
                    'house/ID/house.obj for House3D', f'{data}: neither for {house_id}',
                    'copy the folders room, object and texture, or run the conversion')


def read_pieces(data: Path, house: HouseFile, level: Level, categories: Categories,
                layout: str) -> list[Piece]:
    """The pieces of a level.

    Args:
        data: folder with `house`, `room`, `object` and `texture`.
        house, level: what to read.
        categories: classes of its models.
        layout: of LAYOUTS.

    Raises:
        UserError: a file that is missing or broken, a model without a class.
    """
    if layout not in LAYOUTS:
        raise UserError(f'a layout is one of {", ".join(LAYOUTS)}', layout, 'choose one of them')
    if len(level.nodes) > MOST_INSTANCES:
        raise UserError(f'a level has at most {MOST_INSTANCES} nodes',
                        f'{house.path}: {len(level.nodes)}', 'split the house')
    reader = _Published(data, house, level, categories) if layout == 'suncg' else (
        _Converted(data, house, level, categories))
    pieces = [piece for piece in reader.pieces() if piece.surfaces]
    if not pieces:
        raise UserError('a level of a house shows something', f'{house.path}, level '
                        f'{level.number}', 'choose another level')
    return pieces


def changed(parts: Sequence[Part], materials: Sequence[Material],
            texture: Callable[[str], np.ndarray]) -> list[Part]:
    """Parts of a model in the materials of its node: number k replaces the one that ends in _k."""
    found = []
    for part in parts:
        number = re.search(r'_(\d+)$', part.names[2] or '')
        if number is None or int(number[1]) >= len(materials):
            found.append(part)
            continue
        own = materials[int(number[1])]
        colour, picture = part.colour, part.picture
        if own.diffuse is not None:
            colour = np.broadcast_to(own.diffuse, (len(part.corners), 3))
        if own.texture is not None:
            if part.uv is None:
                say_once(f'{part.names[0] or part.names[1]} has no texture coordinates: its '
                         f'texture {own.texture} is left out')
            else:
                picture = texture(own.texture)
        found.append(Part(part.names, part.corners, part.uv, colour, picture, False))
    return found


def surfaces_of(parts: Sequence[Part], matrix: np.ndarray, mirrored: bool, scale: float,
                label: int, instance: int) -> tuple[Surface, ...]:
    """Surfaces in the map frame of parts in SUNCG's.

    Args:
        parts: of a model.
        matrix: [4,4] to the house.
        mirrored: it turns the winding.
        scale: m per unit.
        label, instance: of all of it.
    """
    turn = -1 if mirrored else 1
    return tuple(Surface(
        to_map((part.corners @ matrix[:3, :3].T + matrix[:3, 3]) * scale)[:, ::turn],
        None if part.uv is None else part.uv[:, ::turn], part.colour, part.picture, label,
        instance) for part in parts)


class _Reader(abc.ABC):
    def __init__(self, data: Path, house: HouseFile, level: Level, categories: Categories):
        self.data, self.house, self.level, self.categories = data, house, level, categories
        self._parts: dict[Path, list[Part]] = {}
        self._textures: dict[str, np.ndarray] = {}

    def read(self, path: Path) -> list[Part]:
        """The parts of a file, read once."""
        if path not in self._parts:
            self._parts[path] = read_parts(path)
        return self._parts[path]

    def texture(self, name: str) -> np.ndarray:
        """A picture of texture/."""
        if name not in self._textures:
            folder = self.data / 'texture'
            for path in (folder / name, *(folder / f'{name}{end}' for end in ENDINGS)):
                if path.is_file():
                    break
            else:
                raise UserError('every texture that a house names is in texture/',
                                f'{self.house.path}: {name} (.png or .jpg)', 'copy that folder')
            self._textures[name] = decode_picture(path, read_bytes(path, 'a texture can be read'))
        return self._textures[name]

    def box(self, node: Node, instance: int) -> Piece:
        """A cuboid that the file gives by its dimensions."""
        assert node.dimensions is not None
        sides = SIDES * node.dimensions / 2
        corners = sides[:, [[0, 1, 2], [0, 2, 3]]]  # [6,2,3,3]
        white = Material(None, None)
        parts = []
        for k in range(6):
            own = node.materials[min(k, len(node.materials) - 1)] if node.materials else white
            colour = np.broadcast_to(own.diffuse or (1.0, 1.0, 1.0), (2, 3))
            uv = np.array([[[0, 1], [1, 1], [1, 0]], [[0, 1], [1, 0], [0, 0]]], float)
            picture = None if own.texture is None else self.texture(own.texture)
            parts.append(Part((node.id, None, None), corners[k], uv, colour, picture, False))
        return Piece('box', node, surfaces_of(parts, node.transform, self.turned(node),
                                              self.house.scale,
                                              self.categories.of_structure('box'), instance))

    @staticmethod
    def turned(node: Node) -> bool:
        """Whether its transform turns triangles inside out."""
        return node.mirrored or float(np.linalg.det(node.transform[:3, :3])) < 0

    @abc.abstractmethod
    def pieces(self) -> list[Piece]:
        """All that is to be seen."""


class _Published(_Reader):
    """SUNCG's own folders."""

    def pieces(self) -> list[Piece]:
        found: list[Piece] = []
        for number, node in enumerate(self.level.nodes, 1):
            if node.type == 'Object':
                if not self.categories.model(node.model).person:
                    found.append(self._object(node, number))
            elif node.type == 'Box':
                found.append(self.box(node, number))
            else:
                found += self._room(node, number)
        return found

    def _object(self, node: Node, number: int) -> Piece:
        name = f'{node.model}_0.obj' if node.state == 1 else f'{node.model}.obj'
        path = self.data / 'object' / node.model / name
        if not path.is_file():
            raise UserError('every model of a house is in object/', f'{self.house.path}: '
                            f'{node.model}: no {path}', 'copy that folder')
        parts = changed(self.read(path), node.materials, self.texture)
        return Piece('object', node, surfaces_of(
            parts, node.transform, self.turned(node), self.house.scale,
            self.categories.of_model(node.model), number))

    def _room(self, node: Node, number: int) -> list[Piece]:
        found = []
        for letter in 'fcw' if node.type == 'Room' else 'f':
            if letter in node.hidden:
                continue
            path = self.data / 'room' / self.house.id / f'{node.model}{letter}.obj'
            if not path.is_file():
                # Some houses of the data set have rooms that are open to one side.
                say_once(f'{self.house.path}: {node.type} {node.id} has no {path.name}; it is '
                         'not drawn')
                continue
            role = 'ground' if node.type == 'Ground' else ROLES[letter]
            parts = changed(self.read(path), node.materials, self.texture)
            found.append(Piece(role, node, surfaces_of(
                parts, np.eye(4), False, self.house.scale, self.categories.of_structure(role),
                number)))
        return found


class _Converted(_Reader):
    """House3D's one file a house."""

    def pieces(self) -> list[Piece]:
        path = self.data / 'house' / self.house.id / 'house.obj'
        if not path.is_file():
            raise UserError('a house that was converted for House3D has a house.obj', str(path),
                            'run the conversion, or choose layout=suncg')
        nodes = {node.id: node for node in self.level.nodes}
        numbers = {node.id: number for number, node in enumerate(self.level.nodes, 1)}
        found: list[Piece] = []
        for part in self.read(path):
            name = part.names[1] or part.names[0] or ''
            word, _, rest = name.partition('#')
            if word == 'Model':
                found += self._model(rest, part, numbers)
                continue
            role = GROUPS.get(word.lower())
            if role is None:
                say_once(f'{path}: the group {name} is drawn as a box')
                role = 'box'
            place = re.match(r'(\d+)(?:_(\d+))?', rest)
            if (int(place[1]) if place else 0) != self.level.number:
                continue
            node = nodes.get('_'.join(place.groups())) if place and place[2] else None
            found.append(Piece(role, node, surfaces_of(
                [part], np.eye(4), False, self.house.scale,
                self.categories.of_structure(role),
                numbers[node.id] if node else len(numbers) + 1)))
        return found

    def _model(self, model: str, part: Part, numbers: dict[str, int]) -> list[Piece]:
        """Triangles of a model, which may stand in several places, each of its own node."""
        if self.categories.model(model).person:
            return []
        nodes = [(level.number, node) for level in self.house.levels for node in level.nodes
                 if node.type == 'Object' and node.model == model]
        if not nodes:
            raise UserError("every model of House3D's house.obj is in house.json",
                            f'{self.house.path}: {model}', 'convert the house again')
        middle = part.corners.mean(axis=1)
        gaps = np.stack([np.linalg.norm(np.maximum(np.maximum(
            node.low - middle, middle - node.high), 0), axis=1) for _, node in nodes])
        # Where boxes overlap: the one whose centre is nearer.
        gaps += 1e-6 * np.stack([np.linalg.norm(middle - (node.low + node.high) / 2, axis=1)
                                 for _, node in nodes])
        owner = gaps.argmin(axis=0)
        label = self.categories.of_model(model)
        found = []
        for k, (level, node) in enumerate(nodes):
            own = owner == k
            if level != self.level.number or not own.any():
                continue
            kept = Part(part.names, part.corners[own], None if part.uv is None else part.uv[own],
                        part.colour[own], part.picture, False)
            found.append(Piece('object', node, surfaces_of(
                [kept], np.eye(4), False, self.house.scale, label, numbers[node.id])))
        return found
