"""glTF files for tests, byte by byte: `struct` and `json`, no library that could share a fault."""

import json
import struct

import cv2
import numpy as np

FLOAT, BYTE, UBYTE, SHORT, USHORT, UINT = 5126, 5120, 5121, 5122, 5123, 5125
LETTERS = {FLOAT: 'f', BYTE: 'b', UBYTE: 'B', SHORT: 'h', USHORT: 'H', UINT: 'I'}
TYPES = {1: 'SCALAR', 2: 'VEC2', 3: 'VEC3', 4: 'VEC4', 16: 'MAT4'}
# A square of 2 m in the plane z = 0 (y up), whose front looks along +z; u to the right, v down.
SQUARE = ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))
SQUARE_UV = ((0.125, 0.875), (0.875, 0.875), (0.875, 0.125), (0.125, 0.125))
SQUARE_FACES = (0, 1, 2, 0, 2, 3)


def png(rgb) -> bytes:
    """A picture [H,W,3] as PNG."""
    return cv2.imencode('.png', np.ascontiguousarray(np.array(rgb, np.uint8)[..., ::-1]))[
        1].tobytes()


class Gltf:
    """A document that grows; `json` may be changed before it is written."""

    def __init__(self):
        self.data = b''
        self.json = {'asset': {'version': '2.0'}, 'accessors': [], 'bufferViews': []}

    def add(self, kind, entry) -> int:
        """Append to one of the document's arrays; the index."""
        self.json.setdefault(kind, []).append(entry)
        return len(self.json[kind]) - 1

    def view(self, data: bytes, **more) -> int:
        """A buffer view of its own."""
        self.data += bytes(-len(self.data) % 4)
        index = self.add('bufferViews', {'buffer': 0, 'byteOffset': len(self.data),
                                         'byteLength': len(data), **more})
        self.data += data
        return index

    def pack(self, rows, component) -> bytes:
        """Rows of numbers, little endian."""
        return b''.join(struct.pack('<' + LETTERS[component] * len(row), *row) for row in rows)

    def accessor(self, rows, component=FLOAT, **more) -> int:
        """An accessor of rows of numbers, or of numbers."""
        rows = [row if isinstance(row, (tuple, list)) else (row,) for row in rows]
        return self.add('accessors', {
            'bufferView': self.view(self.pack(rows, component)), 'componentType': component,
            'count': len(rows), 'type': TYPES[len(rows[0])], **more})

    def texture(self, rgb, **more) -> int:
        """A texture with its picture embedded."""
        image = self.add('images', {'mimeType': 'image/png', 'bufferView': self.view(png(rgb))})
        return self.add('textures', {'source': image, **more})

    def material(self, *, factor=None, texture=None, info=None, **more) -> int:
        """A material with a base colour."""
        own = {}
        if factor is not None:
            own['baseColorFactor'] = [*factor, 1.0]
        if texture is not None:
            own['baseColorTexture'] = {'index': texture, **(info or {})}
        return self.add('materials', {'pbrMetallicRoughness': own, **more})

    def square(self, *, material=None, faces=SQUARE_FACES, points=SQUARE, **attributes) -> int:
        """A mesh of one primitive; `attributes` are accessors."""
        primitive = {'attributes': {'POSITION': self.accessor(points), **attributes}}
        if faces is not None:
            primitive['indices'] = self.accessor(faces, USHORT)
        if material is not None:
            primitive['material'] = material
        return self.add('meshes', {'primitives': [primitive]})

    def node(self, mesh=None, **more) -> int:
        """A node, called wall_N."""
        index = len(self.json.get('nodes', []))
        own = {} if mesh is None else {'mesh': mesh}
        return self.add('nodes', {'name': f'wall_{index}', **own, **more})

    def write(self, path):
        """As GLB, or as glTF with a data URI's place taken by a file."""
        if 'scenes' not in self.json and self.json.get('nodes'):
            self.json['scenes'] = [{'nodes': list(range(len(self.json['nodes'])))}]
        data = self.data + bytes(-len(self.data) % 4)
        buffers = self.json.setdefault('buffers', [{}])
        buffers[0].setdefault('byteLength', len(data))
        if path.suffix == '.gltf':
            buffers[0].setdefault('uri', path.stem + '.bin')
            path.with_suffix('.bin').write_bytes(data)
            path.write_text(json.dumps(self.json))
            return path
        text = json.dumps(self.json).encode()
        text += b' ' * (-len(text) % 4)
        path.write_bytes(struct.pack('<4sII', b'glTF', 2, 28 + len(text) + len(data))
                         + struct.pack('<I4s', len(text), b'JSON') + text
                         + struct.pack('<I4s', len(data), b'BIN\0') + data)
        return path


def read_glb(path) -> tuple[dict, bytes]:
    """JSON and binary chunk."""
    data = path.read_bytes()
    size = struct.unpack_from('<I', data, 12)[0]
    return json.loads(data[20:20 + size]), data[28 + size:]


def linear(value: float) -> float:
    """A display value as light (IEC 61966-2-1), written down from the standard."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
