"""Parts of mesh files as surfaces in the map frame, with classes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh import Z_UP, read_parts
from vn_sim_bridge.houses.surface import Part
from vn_sim_bridge.meshes.vocabulary import OTHER, Vocabulary
from vn_sim_bridge.render.mesh_scene import MOST_INSTANCES, Surface

MAP = np.eye(4)  # glTF's axes (y up) to the map's (z up)
MAP[:3, :3] = Z_UP
LEVEL = 0.8  # of a normal's z: floor or ceiling


def surfaces_of(parts: Sequence[Part], matrix: np.ndarray, labels: Sequence[int],
                instances: Sequence[int]) -> list[Surface]:
    """Surfaces of a file's parts.

    Args:
        parts: of a file.
        matrix: [4,4] from its axes and units to the map frame.
        labels, instances: of each part.
    """
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    found = []
    for part, label, instance in zip(parts, labels, instances, strict=True):
        corners = part.corners @ matrix[:3, :3].T + matrix[:3, 3]
        uv = part.uv
        if mirrored:
            corners, uv = corners[:, ::-1], None if uv is None else uv[:, ::-1]
        found.append(Surface(corners, uv, part.colour, part.picture, label,
                             instance % (MOST_INSTANCES - 2) + 1, part.both_sides))
    return found


def named_surfaces(path: Path, matrix: np.ndarray, vocabulary: Vocabulary, first: int = 0, *,
                   known: int | None = None, instance: int | None = None) -> list[Surface]:
    """The surfaces of a file, with the classes that the names of its nodes begin with.

    Args:
        path: of the file.
        matrix: [4,4] to the map frame.
        vocabulary: of the simulator.
        first: number of the first instance; each part is one.
        known: the class of all of it, where it is known.
        instance: of all of it, where it is one object.

    Raises:
        UserError: see `read_parts`.
    """
    parts = read_parts(path)
    labels = [known if known is not None else _class_of(part, vocabulary) for part in parts]
    instances = [first + k if instance is None else instance for k in range(len(parts))]
    return surfaces_of(parts, matrix, labels, instances)


def _class_of(part: Part, vocabulary: Vocabulary) -> int:
    found = vocabulary.of_names(part.names)
    return vocabulary.id(OTHER) if found is None else found


def by_direction(surfaces: Sequence[Surface], vocabulary: Vocabulary) -> list[Surface]:
    """Architecture without classes: what looks up is floor, down ceiling, the rest wall.

    Surfaces that have a class already keep it.
    """
    other, found = vocabulary.id(OTHER), []
    floor, ceiling, wall = (vocabulary.id(name) for name in ('floor', 'ceiling', 'wall'))
    for surface in surfaces:
        if isinstance(surface.label, np.ndarray) or surface.label != other:
            found.append(surface)
            continue
        corners = surface.corners
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        up = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
        labels = np.where(up > LEVEL, floor, np.where(up < -LEVEL, ceiling, wall))
        found.append(surface._replace(label=labels))
    return found


def axes(up: Sequence[float], front: Sequence[float], where: str) -> np.ndarray:
    """[3,3] that turns `up` into y and `front` into -z, as Habitat's world has them.

    Raises:
        UserError: axes that are not at right angles.
    """
    above, ahead = np.array(up, float), np.array(front, float)
    lengths = float(np.linalg.norm(above)), float(np.linalg.norm(ahead))
    if above.shape != (3,) or ahead.shape != (3,) or min(lengths) < 1e-6 or (
            abs(above @ ahead) > 1e-3 * lengths[0] * lengths[1]):
        raise UserError('up and front of an asset are at right angles',
                        f'{where}: {above.tolist()}, {ahead.tolist()}',
                        'correct its configuration')
    above, ahead = above / lengths[0], ahead / lengths[1]
    return np.stack([np.cross(ahead, above), above, -ahead])
