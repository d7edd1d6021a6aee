"""The bytes of a glTF 2.0 file: container, buffers, accessors, pictures, checked before use."""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
import struct
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.surface import (
    MAX_TRIANGLES,
    compressed,
    decode_picture,
    find_file,
    read_bytes,
)
from vn_sim_bridge.notices import say_once

COMPONENTS = {5120: 'i1', 5121: 'u1', 5122: '<i2', 5123: '<u2', 5125: '<u4', 5126: '<f4'}
WIDTHS = {'SCALAR': 1, 'VEC2': 2, 'VEC3': 3, 'VEC4': 4, 'MAT4': 16}
MOST = 3 * MAX_TRIANGLES  # elements of an accessor
MESHOPT = ('EXT_meshopt_compression', 'KHR_meshopt_compression')
COMPRESSED = {'KHR_draco_mesh_compression': 'Draco', 'KHR_texture_basisu': 'KTX2',
              **dict.fromkeys(MESHOPT, 'meshopt')}
# What a file may require: read here, or without a meaning for surfaces in plain light.
EXTENSIONS = {
    'KHR_texture_transform', 'KHR_mesh_quantization', 'KHR_materials_pbrSpecularGlossiness',
    'EXT_mesh_gpu_instancing', 'EXT_texture_webp', 'KHR_node_visibility',
    'KHR_materials_unlit', 'KHR_materials_anisotropy', 'KHR_materials_clearcoat',
    'KHR_materials_dispersion', 'KHR_materials_emissive_strength', 'KHR_materials_ior',
    'KHR_materials_iridescence', 'KHR_materials_sheen', 'KHR_materials_specular',
    'KHR_materials_transmission', 'KHR_materials_volume', 'KHR_materials_variants',
    'KHR_lights_punctual', 'KHR_animation_pointer', 'KHR_xmp_json_ld',
}


class GltfData:
    """A GLB or glTF file.

    Args:
        path: of the file.

    Raises:
        UserError: another version, an extension that cannot be done without and is unknown here.
        ValueError, KeyError, TypeError, ...: a file that does not follow the format.
    """

    def __init__(self, path: Path):
        self.path, self._blob = path, None
        text = read_bytes(path, 'a mesh file can be read')
        if path.suffix.lower() == '.glb':
            text, self._blob = _chunks(text, path)
        self.json = json.loads(text)
        if not isinstance(self.json, dict):
            raise ValueError('its JSON is no object')
        _check_version(self.json.get('asset'), path)
        for name in self.json.get('extensionsRequired', ()):
            if name in COMPRESSED:
                raise compressed(COMPRESSED[name], name, path)
            if name not in EXTENSIONS:
                raise UserError('a mesh file requires extensions that are known here',
                                f'{path}: {name}', 'export it without this extension')
        unknown = set(self.json.get('extensionsUsed', ())) - EXTENSIONS - set(COMPRESSED)
        if unknown:
            say_once(f'{path.name}: optional extensions are left out: '
                     f'{", ".join(sorted(map(str, unknown)))}')
        self._quantised = 'KHR_mesh_quantization' in self.json.get('extensionsUsed', ())
        for entry in (*self.json.get('buffers', ()), *self.json.get('images', ())):
            if not entry.get('uri', 'data:').startswith('data:'):
                self._file(entry['uri'])
        self._buffers: dict[int, bytes] = {}
        self._pictures: dict[int, np.ndarray] = {}

    def get(self, kind: str, index: int) -> dict:
        """Entry `index` of an array such as 'nodes'.

        Raises:
            ValueError: there is no such entry.
        """
        entries = self.json.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f'{kind} {index!r} of {len(entries)}')
        return entries[index]

    def _uri(self, uri: str) -> tuple[str, bytes]:
        """What it points at: a name for errors, and the bytes."""
        if uri.startswith('data:'):
            head, _, body = uri.partition(',')
            try:
                data = (base64.b64decode(unquote(body), validate=True)
                        if head.endswith(';base64') else unquote_to_bytes(body))
            except binascii.Error as error:
                raise ValueError(f'a data URI: {error}') from error
            return f'{self.path}, embedded', data
        found = self._file(uri)
        return str(found), read_bytes(found, 'a file that a mesh refers to can be read')

    def _file(self, uri: str) -> Path:
        # A URI; but some write the bare name of a file.
        return find_file(self.path, self.path.parent, [unquote(uri), uri])

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            entry = self.get('buffers', index)
            if 'uri' in entry:
                name, data = self._uri(entry['uri'])
            elif index == 0 and self._blob is not None:
                name, data = str(self.path), self._blob
            elif found := set(MESHOPT) & set(entry.get('extensions', {})):
                raise compressed('meshopt', found.pop(), self.path)
            else:
                raise ValueError(f'buffer {index} has no data')
            if len(data) < entry['byteLength']:
                raise ValueError(f'{name}: buffer {index} has {len(data)} bytes of '
                                 f'{entry["byteLength"]}')
            self._buffers[index] = data
        return self._buffers[index]

    def _view(self, index: int) -> tuple[memoryview, int | None]:
        """The bytes of a buffer view, and its stride."""
        view = self.get('bufferViews', index)
        data = self._buffer(view['buffer'])
        first, size = view.get('byteOffset', 0), view['byteLength']
        if first < 0 or size < 0 or first + size > len(data):
            raise ValueError(f'bufferView {index} leaves its buffer')
        return memoryview(data)[first:first + size], view.get('byteStride')

    def _array(self, where: dict, component: int, width: int, count: int) -> np.ndarray:
        """[count,width] out of `bufferView` and `byteOffset`."""
        data, stride = self._view(where['bufferView'])
        kind, first = np.dtype(COMPONENTS[component]), where.get('byteOffset', 0)
        stride = kind.itemsize * width if stride is None else stride
        end = first + stride * (count - 1) + kind.itemsize * width
        if first < 0 or stride < kind.itemsize * width or end > len(data):
            raise ValueError(f'an accessor leaves bufferView {where["bufferView"]}')
        return np.ndarray((count, width), kind, data, first, (stride, kind.itemsize))

    def accessor(self, index: int, types: tuple[str, ...], *, whole: bool = False) -> np.ndarray:
        """The values of an accessor, [count,width] float64, or int64 with `whole`.

        Args:
            index: of the accessor.
            types: that it may have, such as 'VEC3'.
            whole: these are numbers of vertices or joints: normalised has no meaning.
        """
        entry = self.get('accessors', index)
        count, component = entry['count'], entry['componentType']
        if entry['type'] not in types or component not in COMPONENTS:
            raise ValueError(f'accessor {index} is {entry["type"]} of {component}')
        if not isinstance(count, int) or not 1 <= count <= MOST:
            raise ValueError(f'accessor {index} has {count!r} elements; at most {MOST}')
        width = WIDTHS[entry['type']]
        values = (self._array(entry, component, width, count).copy() if 'bufferView' in entry
                  else np.zeros((count, width), COMPONENTS[component]))
        if 'sparse' in entry:
            sparse = entry['sparse']
            some, at, new = sparse['count'], sparse['indices'], sparse['values']
            rows = self._array(at, at['componentType'], 1, some)[:, 0].astype(np.int64)
            if rows.min() < 0 or rows.max() >= count:
                raise ValueError(f'accessor {index} replaces elements that it does not have')
            values[rows] = self._array(new, component, width, some)
        if whole:
            if values.dtype.kind not in 'iu':
                raise ValueError(f'accessor {index} has no whole numbers')
            return values.astype(np.int64)
        if values.dtype.kind in 'iu':
            if entry.get('normalized', False):
                return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
            if not self._quantised:
                raise ValueError(f'accessor {index} has whole numbers that are not normalised')
        return values.astype(float)

    def picture(self, index: int) -> np.ndarray:
        """An image, [H,W,3] uint8."""
        if index not in self._pictures:
            entry = self.get('images', index)
            data: bytes | memoryview
            if 'uri' in entry:
                name, data = self._uri(entry['uri'])
            else:
                data, _ = self._view(entry['bufferView'])
                name = f'{self.path}, embedded texture {index}'
            self._pictures[index] = decode_picture(name, bytes(data))
        return self._pictures[index]


def _check_version(asset: object, path: Path) -> None:
    """Refuse what is not glTF 2.0, or demands more of its reader.

    A later 2.x may be read by what the reader knows, if the file does not name a higher
    `minVersion`.
    """
    if not isinstance(asset, dict) or 'version' not in asset:
        raise _other_version(path, 'no version (asset.version)')
    for key, most in (('version', math.inf), ('minVersion', 0)):
        version = str(asset.get(key, '2.0'))
        found = re.fullmatch(r'([0-9]{1,9})\.([0-9]{1,9})', version)
        if (found is None or int(found[1]) > 2 or int(found[1]) < 2 and key == 'version'
                or int(found[1]) == 2 and int(found[2]) > most):
            raise _other_version(path, f'asset.{key} {version[:20]!r}')


def _other_version(path: Path, received: str) -> UserError:
    return UserError('a mesh file is glTF 2.0', f'{path}: {received}',
                     'export it again, for instance from Blender')


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB."""
    magic, version, length = struct.unpack_from('<4sII', data)
    if magic == b'glTF' and version != 2:
        raise _other_version(path, f'GLB version {version}')
    if magic != b'glTF' or length != len(data):
        raise ValueError(f'header says {length} bytes, the file has {len(data)}')
    found, at = [], 12
    while at < length:
        size, kind = struct.unpack_from('<I4s', data, at)
        if at + 8 + size > length:
            raise ValueError('a chunk leaves the file')
        found.append((kind, data[at + 8:at + 8 + size]))
        at += 8 + size
    if not found or found[0][0] != b'JSON':
        raise ValueError('its first chunk is not JSON')
    return found[0][1], next((body for kind, body in found[1:2] if kind == b'BIN\0'), None)
