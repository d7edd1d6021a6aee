"""What the readers of mesh files hand on: parts with corners, texture coordinates, colours.

Colours here are display values (sRGB, 0 to 1), as pictures hold them and as scenes are drawn: a
texel times a colour is what the camera shows in full light. glTF's factors are linear; texel and
factor are multiplied after each has been converted, which differs from the exact product by at
most 0.02.
"""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError

MAX_TRIANGLES = 8_000_000
MAX_BYTES = 4 << 30  # of one file
MAX_PIXELS = 1 << 28  # of one texture
REPEAT, CLAMP, MIRROR = 'repeat', 'clamp', 'mirror'  # what lies beside a texture
OVERSHOOT = 1e-3  # of texture coordinates, which exporters' rounding leaves


@dataclasses.dataclass(frozen=True)
class Part:
    """T triangles of one material, in the axes and units of their file."""

    names: tuple[str | None, ...]  # of node or object, geometry or group, material
    corners: np.ndarray  # [T,3,3] counter-clockwise seen from the front
    uv: np.ndarray | None  # [T,3,2], v downwards; None: no texture
    colour: np.ndarray  # [T,3] display values
    picture: np.ndarray | None  # [H,W,3] uint8
    both_sides: bool


def srgb_from_linear(values) -> np.ndarray:
    """Display values of linear ones, both 0 to 1 (IEC 61966-2-1)."""
    values = np.clip(np.asarray(values, float), 0.0, 1.0)
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)


def linear_from_srgb(values) -> np.ndarray:
    """The inverse of `srgb_from_linear`."""
    values = np.clip(np.asarray(values, float), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def read_bytes(path: Path, rule: str) -> bytes:
    """A whole file.

    Raises:
        UserError: too large, or not to be read.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UserError(f'a mesh file has at most {MAX_BYTES >> 30} GiB',
                            f'{path}: {path.stat().st_size / (1 << 30):.1f} GiB', 'decimate it')
        return path.read_bytes()
    except OSError as error:
        raise UserError(rule, f'{path}: {error}', 'check its permissions') from error


def find_file(mesh: Path, folder: Path, names: list[str], where: str = '') -> Path:
    """The first of a referred file's possible names (spaces, %20, backslashes) that exists.

    Args:
        mesh: what is read.
        folder: in which the names are looked for.
        names: with the one of the error first.
        where: file and line for the error.

    Raises:
        UserError: none does.
    """
    for name in names:
        if name and (folder / name).is_file():
            return folder / name
    raise UserError(f'every file that {mesh} refers to exists', where + names[0],
                    'copy it beside the mesh, or export the mesh with embedded textures')


def decode_picture(name: str | Path, data: bytes) -> np.ndarray:
    """A texture, [H,W,3] uint8; transparency is left out, an orientation tag has no meaning.

    Raises:
        UserError: no whole picture, or too many pixels.
    """
    import PIL.Image
    if data[:6] == b'\xabKTX 2':
        raise compressed('KTX2', 'KHR_texture_basisu', name)
    try:
        with PIL.Image.open(io.BytesIO(data)) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise UserError(f'a texture has at most {MAX_PIXELS} pixels',
                                f'{name}: {picture.width} x {picture.height}', 'make it smaller')
            picture.load()
            if picture.mode.startswith('I'):  # 16 bits of grey: converting would cut them off
                grey = (np.clip(np.asarray(picture), 0, 65535) / 257).round().astype(np.uint8)
                return np.repeat(grey[:, :, None], 3, axis=2)
            return np.asarray(picture.convert('RGB'))
    except (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError) as error:
        raise UserError('a texture is a whole picture', f'{name}: {error}',
                        'export it again') from error


COMMANDS = {'KTX2': 'ktxdecompress'}  # of gltf-transform; the others: copy


def compressed(what: str, extension: str, name: str | Path) -> UserError:
    """The error for a compression that is not read, with the command that undoes it."""
    return UserError(f'a mesh file is not compressed with {what} ({extension})', str(name),
                     f'gltf-transform {COMMANDS.get(what, "copy")} IN.glb OUT.glb (npm install '
                     '--global @gltf-transform/cli), or export it without')


def unwrap(picture: np.ndarray, uv: np.ndarray, wrap: tuple[str, str], name: str
           ) -> tuple[np.ndarray, np.ndarray]:
    """A picture that repeats, and coordinates in it, for one that is clamped or mirrored.

    Args:
        picture: [H,W,3] uint8.
        uv: [T,3,2].
        wrap: along u and along v.
        name: for errors.

    Raises:
        UserError: coordinates far outside, which would need too many pixels.
    """
    for axis, mode in enumerate(wrap):
        along = uv[..., axis]
        low, high = along.min(), along.max()
        if mode == REPEAT or (low >= -OVERSHOOT and high <= 1 + OVERSHOOT):
            if mode != REPEAT:
                uv = uv.copy()
                # 1 would be the first texel again.
                uv[..., axis] = np.clip(along, 0.0, 1.0 - 1e-6)
            continue
        first, last = ((0, 2) if mode == MIRROR else
                       (min(0, math.floor(low)), max(1, math.ceil(high))))
        side = picture.shape[1 - axis]
        if picture.shape[0] * picture.shape[1] * (last - first) > MAX_PIXELS:
            raise UserError('texture coordinates stay near a texture that is clamped',
                            f'{name}: {low:g} to {high:g}', 'let it repeat, or unwrap it again')
        edges = [(0, 0)] * 3
        edges[1 - axis] = (-first * side, (last - 1) * side)
        picture = np.pad(picture, edges, 'symmetric' if mode == MIRROR else 'edge')
        uv = uv.copy()
        uv[..., axis] = (along - first) / (last - first)
    return picture, uv
