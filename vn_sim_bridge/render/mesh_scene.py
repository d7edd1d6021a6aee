"""Triangles with textures and labels as a scene that the renderers draw."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.notices import say_once
from vn_sim_bridge.render.scene import MAX_TEXTURE, Scene, TextureSet, as_labels, uniform_light

GROUP = 64  # triangles culled together
SMALLEST = 1e-12  # m^2, twice the area: what is smaller covers nothing
MOST_LABELS, MOST_INSTANCES = 65536, 65536  # that a pixel can name


class Surface(NamedTuple):
    """T triangles with one texture, in the map frame."""

    corners: np.ndarray  # [T,3,3] m, counter-clockwise seen from the front
    uv: np.ndarray | None  # [T,3,2], v downwards, repeating; None: no texture
    colour: np.ndarray  # [3] or [T,3] display values, multiply the texture
    picture: np.ndarray | None  # [H,W,3] uint8; the same object for the same texture
    label: int | np.ndarray  # class id, or one of each triangle
    instance: int | np.ndarray
    both_sides: bool = False


def mesh_scene(surfaces: Sequence[Surface], name: str, *, most_texels: int | None = None,
               lamp: float = 1.0) -> Scene:
    """The scene of some surfaces, in groups of neighbours; lit alike everywhere.

    Args:
        surfaces: what is to be seen.
        name: of the mesh, for errors.
        most_texels: textures are halved until all have no more together; None: as they are.
        lamp: how much of a lamp's light arrives.

    Raises:
        UserError: nothing with an area, or more classes or instances than a pixel can name.
    """
    images, numbers = _images(surfaces)
    pieces: list[tuple] = []  # corners, uv, colour, texture, label, instance
    for surface in surfaces:
        count = len(surface.corners)
        uv = np.zeros((count, 3, 2)) if surface.uv is None else surface.uv
        colour = np.broadcast_to(surface.colour, (count, 3))
        texture = 0 if surface.picture is None else numbers[id(surface.picture)]
        own = [np.broadcast_to(value, count)
               for value in (texture, surface.label, surface.instance)]
        pieces.append((surface.corners, uv, colour, *own))
        if surface.both_sides:
            pieces.append((surface.corners[:, ::-1], uv[:, ::-1], colour, *own))
    if not pieces:
        raise UserError('a mesh has triangles', name, 'export the geometry, too')
    corners, uv, colour, textures, labels, instances = (
        np.concatenate([piece[k] for piece in pieces]) for k in range(6))
    for what, ids, most in (('classes', labels, MOST_LABELS),
                            ('instances', instances, MOST_INSTANCES)):
        if ids.min() < 0 or ids.max() >= most:
            raise UserError(f'a mesh has at most {most} {what}', f'{name}: number {ids.max()}',
                            'merge some of them')
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_1, edge_2)
    area = np.linalg.norm(normal, axis=1)
    order = np.nonzero(area > SMALLEST)[0]
    if not len(order):
        raise UserError('a mesh file has triangles with an area', name,
                        'check its scale, and the scales of its nodes')
    order = order[np.argsort(_morton(corners[order].mean(axis=1)), kind='stable')]
    corners, uv, normal, area, edge_1, edge_2 = (
        values[order] for values in (corners, uv, normal, area, edge_1, edge_2))
    count = len(order)
    unit = normal / area[:, None]
    group_start = np.append(np.arange(0, count, GROUP), count)
    boxes = np.concatenate([
        np.minimum.reduceat(corners.min(axis=1), group_start[:-1]) - 1e-4,
        np.maximum.reduceat(corners.max(axis=1), group_start[:-1]) + 1e-4], axis=1)
    face_light, light_map, light = uniform_light(count, lamp)
    return Scene(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        face_start=np.arange(0, 3 * count + 1, 3, dtype=np.int32),
        face_vertices=np.arange(3 * count, dtype=np.int32),
        face_plane=np.column_stack([unit, (unit * corners[:, 0]).sum(axis=1)]).astype(np.float32),
        face_uv=_planes_of_uv(corners, uv, normal, area, edge_1, edge_2),
        face_texture=textures[order].astype(np.int32),
        face_colour=colour[order].astype(np.float32),
        face_label=as_labels(labels[order]),
        face_instance=instances[order].astype(np.uint16),
        face_light=face_light, face_light_map=light_map, light=light,
        group_start=group_start.astype(np.int32),
        group_box=boxes.astype(np.float32),
        group_room=np.zeros(len(boxes), np.int32),
        textures=TextureSet(_smaller(images, most_texels, name)),
    )


def _planes_of_uv(corners, uv, normal, area, edge_1, edge_2) -> np.ndarray:
    """[T,2,4] texture coordinates as functions of the position, not negative on the triangle."""
    uv = uv + (1.0 - np.floor(uv.min(axis=1, keepdims=True)))  # see SceneBuilder
    planes = np.empty((len(corners), 2, 4))
    square = (area**2)[:, None]
    for k in range(2):
        gradient = ((uv[:, 1, k] - uv[:, 0, k])[:, None] * np.cross(edge_2, normal)
                    + (uv[:, 2, k] - uv[:, 0, k])[:, None] * np.cross(normal, edge_1)) / square
        planes[:, k, :3] = gradient
        planes[:, k, 3] = uv[:, 0, k] - (gradient * corners[:, 0]).sum(axis=1)
    return planes.astype(np.float32)


def _images(surfaces: Sequence[Surface]) -> tuple[list[np.ndarray], dict[int, int]]:
    """The pictures, white first, and the number of each by identity."""
    images = [np.full((4, 4, 3), 255, np.uint8)]
    known: dict[tuple, int] = {}  # many parts share a picture
    numbers: dict[int, int] = {}  # the same by identity: hashing a large one takes a while
    for picture in (surface.picture for surface in surfaces):
        if picture is None or id(picture) in numbers:
            continue
        key = (picture.shape, hashlib.sha256(np.ascontiguousarray(picture).data).digest())
        if key not in known:
            known[key] = len(images)
            images.append(picture)
        numbers[id(picture)] = known[key]
    return images, numbers


def _smaller(images: list[np.ndarray], most: int | None, name: str) -> list[np.ndarray]:
    """Pictures with at most so many texels together; the largest are halved first."""
    if most is None:
        return images
    side = MAX_TEXTURE
    while side > 16 and sum(min(max(image.shape[:2]), side)**2 for image in images) > most:
        side //= 2
    if any(max(image.shape[:2]) > side for image in images):
        say_once(f'{name}: textures are drawn with at most {side} pixels a side')
    return [_at_most(image, side) for image in images]


def _at_most(image: np.ndarray, side: int) -> np.ndarray:
    """A picture whose longer side has no more pixels."""
    longer = max(image.shape[:2])
    if longer <= side:
        return image
    width, height = (max(round(length * side / longer), 1) for length in image.shape[1::-1])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


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
