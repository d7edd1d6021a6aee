"""glTF 2.0 by the letter: right values for files written byte by byte; else one error."""

import base64
import math

import numpy as np
import pytest
from gltf_files import (
    BYTE,
    FLOAT,
    SHORT,
    SQUARE,
    SQUARE_FACES,
    SQUARE_UV,
    UBYTE,
    USHORT,
    Gltf,
    linear,
    png,
)

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABEL
from vn_sim_bridge.houses.mesh import load_mesh
from vn_sim_bridge.render.rasterizer import Rasterizer

GREY = np.full((4, 4, 3), 128, np.uint8)
# Four colours, each a quarter: red, green / blue, white.
QUARTERS = np.zeros((16, 16, 3), np.uint8)
QUARTERS[:8, :8, 0] = QUARTERS[:8, 8:, 1] = QUARTERS[8:, :8, 2] = 255
QUARTERS[8:, 8:] = 255


def look(scene, *, back=False, x=0.0):
    """Colour and class in the middle of the picture, from 3 m in front of the square."""
    sign = -1 if back else 1
    camera = (x, -3.0 * sign, 0.0, sign * math.pi / 2, 0)
    rgb, _, labels, _ = (part[0] for part in Rasterizer([scene], 33).render(
        np.zeros(1, int), np.array([camera]), math.radians(60)))
    return rgb[:, 16, 16].astype(float), labels[16, 16]


def coordinates(scene):
    """Texture coordinates {corner (x, z) in the map: (u, v)}, whole tiles taken off."""
    found = {}
    for face in range(len(scene.face_label)):
        ids = scene.face_vertices[scene.face_start[face]:scene.face_start[face + 1]]
        for point in scene.vertices[ids].astype(float):
            uv = scene.face_uv[face, :, :3] @ point + scene.face_uv[face, :, 3]
            found[round(point[0], 3), round(point[2], 3)] = tuple(np.mod(uv, 1.0).round(4))
    return found


EXPECTED = {(x, y): uv for (x, y, _), uv in zip(SQUARE, SQUARE_UV, strict=True)}


def assert_coordinates(scene, expected):
    found = coordinates(scene)
    assert found.keys() == expected.keys()
    for corner, uv in expected.items():
        assert found[corner] == pytest.approx(uv, abs=1e-3), corner


# Accessors


@pytest.mark.parametrize('component, most', [(FLOAT, 1), (UBYTE, 255), (USHORT, 65535)])
def test_texture_coordinates_of_every_kind(tmp_path, component, most):
    file = Gltf()
    rows = [tuple(v * most if most == 1 else round(v * most) for v in row) for row in SQUARE_UV]
    more = {} if most == 1 else {'normalized': True}
    uv = file.accessor(rows, component, **more)
    file.node(file.square(material=file.material(texture=file.texture(QUARTERS)), TEXCOORD_0=uv))
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    for corner, expected in EXPECTED.items():
        assert coordinates(scene)[corner] == pytest.approx(expected, abs=0.003)
    assert len(scene.textures.side) == 2


def test_whole_numbers_are_normalised_unless_the_file_is_quantised(tmp_path):
    file = Gltf()
    file.node(file.square(material=file.material(texture=file.texture(GREY)),
                          TEXCOORD_0=file.accessor([(0, 0), (1, 0), (1, 1), (0, 1)], USHORT)))
    with pytest.raises(UserError, match='not normalised'):
        load_mesh(file.write(tmp_path / 'a.glb'))

    file = Gltf()
    file.json['extensionsUsed'] = file.json['extensionsRequired'] = ['KHR_mesh_quantization']
    position = file.accessor([tuple(64 * v for v in row) for row in SQUARE], BYTE)
    uv = file.accessor([tuple(round(32767 * v) for v in row) for row in SQUARE_UV], SHORT,
                       normalized=True)
    file.node(file.square(material=file.material(texture=file.texture(QUARTERS)),
                          POSITION=position, TEXCOORD_0=uv), scale=[1 / 64] * 3)
    assert_coordinates(load_mesh(file.write(tmp_path / 'b.glb')), EXPECTED)


def test_sparse_accessors_strides_and_offsets(tmp_path):
    file = Gltf()
    # Interleaved: position, 4 bytes of something, coordinates.
    rows = b''.join(file.pack([(*p, 9.0, *uv)], FLOAT) for p, uv in zip(
        ((0, 0, 0),) * 4, SQUARE_UV, strict=True))
    view = file.view(b'\x01' * 8 + rows, byteStride=24)
    indices = file.view(file.pack([(0,), (1,), (2,), (3,)], UBYTE))
    values = file.view(file.pack(SQUARE, FLOAT))
    sparse = {'count': 4, 'indices': {'bufferView': indices, 'componentType': UBYTE},
              'values': {'bufferView': values}}
    common = {'componentType': FLOAT, 'count': 4}
    texture = file.material(texture=file.texture(QUARTERS))
    uv = file.add('accessors', {'bufferView': view, 'byteOffset': 24, 'type': 'VEC2', **common})
    for place in ({'bufferView': view, 'byteOffset': 8}, {}):  # or zeros
        position = file.add('accessors', {'type': 'VEC3', 'sparse': sparse, **place, **common})
        file.json.pop('nodes', None)
        file.node(file.square(material=texture, POSITION=position, TEXCOORD_0=uv))
        assert_coordinates(load_mesh(file.write(tmp_path / 'a.glb')), EXPECTED)
    sparse['indices']['bufferView'] = file.view(file.pack([(0,), (1,), (2,), (4,)], UBYTE))
    with pytest.raises(UserError, match='whole'):
        load_mesh(file.write(tmp_path / 'b.glb'))


@pytest.mark.parametrize('change', [
    lambda j: j['accessors'][0].update(count=5), lambda j: j['accessors'][0].update(count=10**12),
    lambda j: j['accessors'][0].update(byteOffset=-4),
    lambda j: j['accessors'][0].update(bufferView=-1),
    lambda j: j['bufferViews'][0].update(byteLength=10**9),
    lambda j: j['bufferViews'][0].update(byteStride=4),
    lambda j: j['buffers'][0].update(byteLength=10**9),
    lambda j: j['nodes'][0].update(mesh=-1), lambda j: j['nodes'][0].update(children=[0]),
    lambda j: j.update(scene=3), lambda j: j['scenes'][0].update(nodes=[0, 0]),
    lambda j: j['meshes'][0]['primitives'][0].update(mode=9),
    lambda j: j['meshes'][0]['primitives'][0].update(material=7),
    lambda j: j['nodes'][0].update(rotation=[0, 0, 0, 0]),
    lambda j: j['asset'].update(version='1.0'),
])
def test_broken_structure_is_one_error(tmp_path, change):
    file = Gltf()
    file.node(file.square())
    file.json['buffers'] = [{'byteLength': len(file.data)}]
    file.json['scenes'] = [{'nodes': [0]}]
    change(file.json)
    with pytest.raises(UserError, match='a.glb'):
        load_mesh(file.write(tmp_path / 'a.glb'))


# Colours


@pytest.mark.parametrize('factor, shown', [
    (linear(0.5), 0.5), (0.5, 0.7354), (0.0, 0.0), (1.0, 1.0), (linear(0.02), 0.02)])
def test_factors_are_linear(tmp_path, factor, shown):
    scenes = []
    for value in (factor, 1.0):
        file = Gltf()
        file.node(file.square(material=file.material(factor=(value, 1.0, value))))
        scenes.append(load_mesh(file.write(tmp_path / 'a.glb')))
    assert scenes[0].face_colour == pytest.approx(np.tile((shown, 1.0, shown), (2, 1)), abs=2e-4)
    seen, white = (look(scene)[0] for scene in scenes)
    assert seen[0] / white[0] == pytest.approx(shown, abs=0.01) and seen[1] == white[1]


@pytest.mark.parametrize('component, most, width', [
    (FLOAT, 1, 3), (FLOAT, 1, 4), (UBYTE, 255, 4), (USHORT, 65535, 3)])
def test_vertex_colours_multiply_the_material(tmp_path, component, most, width):
    own = (0.6, 0.2, 1.0, 0.5)[:width]
    rows = [tuple(v if most == 1 else round(v * most) for v in own)] * 4
    more = {} if most == 1 else {'normalized': True}
    for factor in (None, (0.5, 1.0, 0.25)):
        file = Gltf()
        file.node(file.square(material=None if factor is None else file.material(factor=factor),
                              COLOR_0=file.accessor(rows, component, **more)))
        scene = load_mesh(file.write(tmp_path / 'a.glb'))
        light = np.array(own[:3]) * (factor or (1, 1, 1))
        shown = [v * 12.92 if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055 for v in light]
        assert scene.face_colour == pytest.approx(np.tile(shown, (2, 1)), abs=3e-3)


def test_a_texture_is_multiplied_by_factor_and_vertex_colour(tmp_path):
    file = Gltf()
    white = np.full((4, 4, 3), 255, np.uint8)
    file.node(file.square(
        material=file.material(texture=file.texture(white), factor=(linear(0.5),) * 3),
        TEXCOORD_0=file.accessor(SQUARE_UV), COLOR_0=file.accessor([(1.0, 1.0, 0.0)] * 4)))
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert scene.face_colour == pytest.approx(np.tile((0.5, 0.5, 0.0), (2, 1)), abs=1e-6)


def test_specular_and_glossiness(tmp_path):
    file = Gltf()
    name = 'KHR_materials_pbrSpecularGlossiness'
    file.json['extensionsUsed'] = file.json['extensionsRequired'] = [name]
    material = file.add('materials', {'extensions': {name: {
        'diffuseFactor': [linear(0.5), 1, 1, 1],
        'diffuseTexture': {'index': file.texture(QUARTERS)}}}})
    file.node(file.square(material=material, TEXCOORD_0=file.accessor(SQUARE_UV)))
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert scene.face_colour[0] == pytest.approx((0.5, 1, 1)) and scene.face_texture[0] == 1


# Textures


def textured(tmp_path, info=None, uv=SQUARE_UV, *, second=None, picture=QUARTERS, sampler=None):
    file = Gltf()
    attributes = {'TEXCOORD_0': file.accessor(uv)}
    if second is not None:
        attributes['TEXCOORD_1'] = file.accessor(second)
    more = {} if sampler is None else {'sampler': file.add('samplers', sampler)}
    texture = file.texture(picture, **more)
    file.node(file.square(material=file.material(texture=texture, info=info), **attributes))
    return load_mesh(file.write(tmp_path / 'a.glb'))


def test_the_pictures_first_row_is_at_v_0(tmp_path):
    scene = textured(tmp_path, uv=[(0.1, 0.4), (0.4, 0.4), (0.4, 0.1), (0.1, 0.1)])
    rgb, label = look(scene)
    assert label == LABEL['wall'] and rgb[0] > 100 and rgb[1] == rgb[2] == 0  # red, upper left


def test_the_second_set_of_coordinates(tmp_path):
    first = [(0.5, 0.5)] * 4
    assert_coordinates(textured(tmp_path, {'texCoord': 1}, first, second=SQUARE_UV), EXPECTED)
    own = {'texCoord': 0, 'extensions': {'KHR_texture_transform': {'texCoord': 1}}}
    assert_coordinates(textured(tmp_path, own, first, second=SQUARE_UV), EXPECTED)
    with pytest.raises(UserError, match='TEXCOORD_1'):
        textured(tmp_path, {'texCoord': 1})


@pytest.mark.parametrize('transform, wanted', [
    ({'offset': [0.5, 0.25]}, lambda u, v: (u + 0.5, v + 0.25)),
    ({'scale': [0.5, 0.25]}, lambda u, v: (u / 2, v / 4)),
    ({'offset': [0, 1], 'scale': [1, -1]}, lambda u, v: (u, 1 - v)),
    # The example of the extension: the lower left quarter, turned clockwise by a quarter.
    ({'offset': [0, 1], 'rotation': math.pi / 2, 'scale': [0.5, 0.5]},
     lambda u, v: (v / 2, 1 - u / 2)),
    ({'offset': [0.1, 0.2], 'rotation': 0.3, 'scale': [0.6, 0.9]},
     lambda u, v: (0.1 + math.cos(0.3) * 0.6 * u + math.sin(0.3) * 0.9 * v,
                   0.2 - math.sin(0.3) * 0.6 * u + math.cos(0.3) * 0.9 * v)),
])
def test_texture_transforms(tmp_path, transform, wanted):
    scene = textured(tmp_path, {'extensions': {'KHR_texture_transform': transform}})
    expected = {corner: tuple(value % 1.0 for value in wanted(*uv))
                for corner, uv in EXPECTED.items()}
    assert_coordinates(scene, expected)


def test_a_quarter_by_transform_looks_like_that_quarter(tmp_path):
    whole = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
    for (x, y), colour in {(0, 0): (1, 0, 0), (0.5, 0): (0, 1, 0), (0, 0.5): (0, 0, 1)}.items():
        info = {'extensions': {'KHR_texture_transform': {'offset': [x, y], 'scale': [0.5, 0.5]}}}
        rgb, _ = look(textured(tmp_path, info, whole))
        assert (rgb > 60).astype(int).tolist() == list(colour)


CLAMP, MIRROR = 33071, 33648


@pytest.mark.parametrize('wrap, uv, colour', [
    # The middle of the square shows the middle of these coordinates.
    (10497, (1.25, 0.25), (1, 0, 0)), (CLAMP, (1.25, 0.25), (0, 1, 0)),
    (CLAMP, (-0.75, 0.75), (0, 0, 1)), (MIRROR, (1.25, 0.25), (0, 1, 0)),
    (MIRROR, (0.25, -0.25), (1, 0, 0)), (CLAMP, (0.25, 3.25), (0, 0, 1)),
])
def test_what_lies_beside_a_texture(tmp_path, wrap, uv, colour):
    (u, v), d = uv, 0.125
    rows = [(u - d, v + d), (u + d, v + d), (u + d, v - d), (u - d, v - d)]
    rgb, _ = look(textured(tmp_path, uv=rows, sampler={'wrapS': wrap, 'wrapT': wrap}))
    assert (rgb > 60).astype(int).tolist() == list(colour)


def test_a_clamped_texture_far_from_its_coordinates_is_one_error(tmp_path):
    with pytest.raises(UserError, match='clamped'):
        textured(tmp_path, uv=[(0, 0), (1e9, 0), (1e9, 1), (0, 1)],
                 sampler={'wrapS': CLAMP, 'wrapT': CLAMP})


def test_sixteen_bits_of_grey(tmp_path):
    import cv2
    file = Gltf()
    data = cv2.imencode('.png', np.full((4, 4), 0x8080, np.uint16))[1].tobytes()
    image = file.add('images', {'bufferView': file.view(data), 'mimeType': 'image/png'})
    file.node(file.square(material=file.material(texture=file.add('textures', {'source': image})),
                          TEXCOORD_0=file.accessor(SQUARE_UV)))
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert scene.textures.texels[scene.textures.start[1]] == 0x808080


@pytest.mark.parametrize('name, uri', [
    ('wood 1.png', 'wood%201.png'), ('wood 1.png', 'wood 1.png'), ('100%25.png', '100%25.png'),
    ('h\u00f6lz.png', 'h%C3%B6lz.png')])
def test_names_of_files(tmp_path, name, uri):
    file = Gltf()
    image = file.add('images', {'uri': uri})
    file.node(file.square(material=file.material(texture=file.add('textures', {'source': image})),
                          TEXCOORD_0=file.accessor(SQUARE_UV)))
    file.json['buffers'] = [{'uri': 'my%20data.bin'}]
    path = file.write(tmp_path / 'a.gltf')
    path.with_suffix('.bin').rename(tmp_path / 'my data.bin')
    with pytest.raises(UserError, match='refers to'):
        load_mesh(path)
    (tmp_path / name).write_bytes(png(QUARTERS))
    assert load_mesh(path).face_texture[0] == 1


def test_data_uris(tmp_path):
    file = Gltf()
    text = 'data:image/png;base64,' + base64.b64encode(png(QUARTERS)).decode()
    image = file.add('images', {'uri': text})
    file.node(file.square(material=file.material(texture=file.add('textures', {'source': image})),
                          TEXCOORD_0=file.accessor(SQUARE_UV)))
    file.json['buffers'] = [{'uri': 'data:application/octet-stream;base64,'
                             + base64.b64encode(file.data).decode(),
                             'byteLength': len(file.data)}]
    assert load_mesh(file.write(tmp_path / 'a.gltf')).face_texture[0] == 1
    file.json['buffers'][0]['uri'] += '!'
    with pytest.raises(UserError, match='whole'):
        load_mesh(file.write(tmp_path / 'a.gltf'))


@pytest.mark.parametrize('change', [
    lambda j: j['textures'][0].pop('source'), lambda j: j['textures'][0].update(source=4),
    lambda j: j['materials'][0]['pbrMetallicRoughness']['baseColorTexture'].update(index=2),
    lambda j: j['images'][0].pop('bufferView')])
def test_a_missing_texture_is_an_error_and_not_white(tmp_path, change):
    file = Gltf()
    file.node(file.square(material=file.material(texture=file.texture(QUARTERS)),
                          TEXCOORD_0=file.accessor(SQUARE_UV)))
    change(file.json)
    with pytest.raises(UserError, match='a.glb'):
        load_mesh(file.write(tmp_path / 'a.glb'))


# Extensions


@pytest.mark.parametrize('name, words', [
    ('VENDOR_new_surfaces', 'VENDOR_new_surfaces'),
    ('KHR_draco_mesh_compression', 'Draco .*gltf-transform copy'),
    ('EXT_meshopt_compression', 'meshopt .*gltf-transform copy'),
    ('KHR_meshopt_compression', 'meshopt .*gltf-transform copy'),
    ('KHR_texture_basisu', 'KTX2 .*gltf-transform ktxdecompress')])
def test_what_is_required_and_not_known_is_refused_by_name(tmp_path, name, words):
    file = Gltf()
    file.node(file.square())
    file.json['extensionsUsed'] = file.json['extensionsRequired'] = [name]
    with pytest.raises(UserError, match=words) as caught:
        load_mesh(file.write(tmp_path / 'a.glb'))
    assert name in str(caught.value) and 'scale' not in str(caught.value)
    del file.json['extensionsRequired']  # used, and the plain data are there
    assert load_mesh(file.write(tmp_path / 'a.glb')).triangle_count == 2


@pytest.mark.parametrize('asset, words', [
    ({'version': '2.0'}, None), ({'version': '2.7'}, None),
    ({'version': '2.0', 'minVersion': '2.0'}, None),
    ({'version': '2.1', 'minVersion': '2.0'}, None),
    ({'version': '2.0', 'minVersion': '1.0'}, None),
    ({'version': '2.1', 'minVersion': '2.1'}, "minVersion '2.1'"),
    ({'version': '2.0', 'minVersion': '3.0'}, "minVersion '3.0'"),
    ({'version': '2.0', 'minVersion': '2.10'}, "minVersion '2.10'"),
    ({'version': '2.0', 'minVersion': 'new'}, "minVersion 'new'"),
    ({'version': '2.0', 'minVersion': None}, "minVersion 'None'"),
    ({'version': '1.0'}, "version '1.0'"), ({'version': '3.0'}, "version '3.0'"),
    ({'version': '2'}, "version '2'"), ({'version': '2.x'}, "version '2.x'"),
    ({'version': '20.0'}, "version '20.0'"), ({}, 'no version'), (None, 'no version'),
    ([], 'no version'), ('2.0', 'no version')])
def test_what_demands_more_than_2_0_is_refused(tmp_path, asset, words):
    file = Gltf()
    file.node(file.square())
    file.json['asset'] = asset
    if asset is None:
        del file.json['asset']
    path = file.write(tmp_path / 'a.glb')
    if words is None:
        assert load_mesh(path).triangle_count == 2
        return
    with pytest.raises(UserError, match='glTF 2.0') as caught:
        load_mesh(path)
    assert words in caught.value.received and 'Error' not in str(caught.value)


@pytest.mark.parametrize('version', [1, 3])
def test_another_version_of_the_container_is_refused(tmp_path, version):
    file = Gltf()
    file.node(file.square())
    path = file.write(tmp_path / 'a.glb')
    data = bytearray(path.read_bytes())
    data[4] = version
    path.write_bytes(data)
    with pytest.raises(UserError, match=f'glTF 2.0; .*GLB version {version}'):
        load_mesh(path)


def test_compressed_data_without_a_plain_copy_are_refused_by_name(tmp_path):
    file = Gltf()
    file.node(file.square())
    primitive = file.json['meshes'][0]['primitives'][0]
    primitive['extensions'] = {'KHR_draco_mesh_compression': {'bufferView': 0, 'attributes': {}}}
    assert load_mesh(file.write(tmp_path / 'a.glb')).triangle_count == 2
    del file.json['accessors'][0]['bufferView']
    with pytest.raises(UserError, match='Draco'):
        load_mesh(file.write(tmp_path / 'a.glb'))

    file = Gltf()
    file.node(file.square())
    file.json['buffers'] = [{}, {'byteLength': len(file.data), 'extensions': {
        'EXT_meshopt_compression': {'fallback': True}}}]
    for view in file.json['bufferViews']:
        view['buffer'] = 1
    with pytest.raises(UserError, match='meshopt'):
        load_mesh(file.write(tmp_path / 'a.glb'))

    file = Gltf()
    image = file.add('images', {'mimeType': 'image/ktx2', 'bufferView': file.view(
        b'\xabKTX 20\xbb\r\n\x1a\n' + bytes(64))})
    texture = file.add('textures', {'extensions': {'KHR_texture_basisu': {'source': image}}})
    file.node(file.square(material=file.material(texture=texture),
                          TEXCOORD_0=file.accessor(SQUARE_UV)))
    with pytest.raises(UserError, match='KTX2'):
        load_mesh(file.write(tmp_path / 'a.glb'))
    file.json['textures'][0]['source'] = image  # a picture of that kind under the plain name
    with pytest.raises(UserError, match='KTX2'):
        load_mesh(file.write(tmp_path / 'a.glb'))
    file.json['textures'][0]['source'] = file.json['textures'][
        file.texture(QUARTERS)]['source']  # beside it a plain copy
    assert load_mesh(file.write(tmp_path / 'a.glb')).face_texture[0] == 1


def test_instances(tmp_path):
    file = Gltf()
    name = 'EXT_mesh_gpu_instancing'
    file.json['extensionsUsed'] = file.json['extensionsRequired'] = [name]
    attributes = {'TRANSLATION': file.accessor([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)]),
                  'SCALE': file.accessor([(1.0, 1.0, 1.0), (-2.0, 2.0, 2.0)])}
    file.node(file.square(), translation=[1, 0, 0],
              extensions={name: {'attributes': attributes}})
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert scene.triangle_count == 4
    assert (scene.vertices[:, 0].min(), scene.vertices[:, 0].max()) == (0, 8)
    assert look(scene, x=1.0)[1] == look(scene, x=6.0)[1] == LABEL['wall']  # both fronts


# Nodes


@pytest.mark.parametrize('node, front', [
    ({}, True), ({'scale': [-1, 1, 1]}, True), ({'scale': [-1, -1, -1]}, False),
    ({'scale': [1, 1, -1]}, False), ({'rotation': [0, 1, 0, 0]}, False),
    ({'matrix': [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, True)])
def test_mirrored_nodes_keep_their_front(tmp_path, node, front):
    """The front looks where the transform carries its normal, whatever the winding becomes."""
    file = Gltf()
    child = file.node(file.square())
    file.json['scenes'] = [{'nodes': [file.node(None, children=[child], **node)]}]
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    seen = [look(scene, back=back)[1] == LABEL['wall'] for back in (False, True)]
    assert seen == [front, not front]
    file.json['meshes'][0]['primitives'][0]['material'] = file.material(doubleSided=True)
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert all(look(scene, back=back)[1] == LABEL['wall'] for back in (False, True))
    assert load_mesh(tmp_path / 'a.glb', double_sided=False).triangle_count == 2


def test_transforms_are_chained(tmp_path):
    file = Gltf()
    half = math.sqrt(0.5)
    inner = file.node(file.square(), translation=[1, 0, 0])
    outer = file.node(None, children=[inner], rotation=[0, 0, half, half], scale=[2, 2, 2],
                      translation=[0, 10, 0])  # a quarter turn to the left around z
    file.json['scenes'] = [{'nodes': [outer]}]
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    # x 0 to 2 becomes the height 10 to 14; y -1 to 1 becomes x -2 to 2.
    assert scene.vertices.min(axis=0) == pytest.approx((-2, 0, 10), abs=1e-5)
    assert scene.vertices.max(axis=0) == pytest.approx((2, 0, 14), abs=1e-5)


def test_the_files_own_scene_is_read(tmp_path):
    file = Gltf()
    mesh = file.square()
    first = file.node(mesh, translation=[10, 0, 0])
    second = file.node(mesh, translation=[20, 0, 0])
    hidden = file.node(mesh, translation=[30, 0, 0],
                       extensions={'KHR_node_visibility': {'visible': False}})
    file.json['scenes'] = [{'nodes': [first]}, {'nodes': [second, hidden]}]
    for scene, centre in ((None, 10), (0, 10), (1, 20)):
        if scene is not None:
            file.json['scene'] = scene
        found = load_mesh(file.write(tmp_path / 'a.glb'))
        assert found.triangle_count == 2 and found.vertices[:, 0].mean() == centre
    del file.json['scene'], file.json['scenes']
    file.json['scenes'] = []  # a library
    assert load_mesh(file.write(tmp_path / 'a.glb')).triangle_count == 4


def test_strips_fans_points_and_meshes_without_indices(tmp_path):
    for mode, faces, triangles in ((4, None, 1), (5, (0, 1, 3, 2), 2), (6, (0, 1, 2, 3), 2)):
        file = Gltf()
        points = SQUARE[:3] if faces is None else SQUARE
        file.node(file.square(faces=faces, points=points))
        primitives = file.json['meshes'][0]['primitives']
        primitives[0]['mode'] = mode
        primitives.append({**primitives[0], 'mode': 1})  # lines have no surface
        scene = load_mesh(file.write(tmp_path / 'a.glb'))
        assert scene.triangle_count == triangles
        assert (scene.face_plane[:, 1] < -0.99).all()  # every front towards the viewer
        assert look(scene, x=0.3)[1] == LABEL['wall']


def test_morph_targets_and_skins_are_in_their_pose(tmp_path):
    file = Gltf()
    mesh = file.square()
    target = file.accessor([(4.0, 0.0, 0.0)] * 4)
    file.json['meshes'][mesh]['primitives'][0]['targets'] = [{'POSITION': target}]
    file.json['meshes'][mesh]['weights'] = [0.5]
    node = file.node(mesh)
    assert load_mesh(file.write(tmp_path / 'a.glb')).vertices[:, 0].mean() == 2
    file.json['nodes'][node]['weights'] = [0.25]
    assert load_mesh(file.write(tmp_path / 'a.glb')).vertices[:, 0].mean() == 1

    file = Gltf()
    back = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -1, 0, 0, 1]  # column by column: 1 m to the left
    skin = file.add('skins', {'joints': [0, 1], 'inverseBindMatrices': file.accessor(
        [[float(v) for v in back]] * 2)})
    file.node(None, translation=[3, 0, 0])
    file.node(None, translation=[0, 0, 7])
    mesh = file.square(JOINTS_0=file.accessor([(0, 1, 0, 0)] * 4, UBYTE),
                       WEIGHTS_0=file.accessor([(0.5, 0.5, 0.0, 0.0)] * 4))
    file.node(mesh, skin=skin, translation=[100, 0, 0])  # which has no meaning
    scene = load_mesh(file.write(tmp_path / 'a.glb'))
    assert scene.vertices.mean(axis=0) == pytest.approx((0.5, -3.5, 0), abs=1e-6)


def test_names_give_the_class(tmp_path):
    file = Gltf()
    file.node(file.square(), name='Mesh.003')
    file.json['meshes'][0]['name'] = 'chair_3'
    assert (load_mesh(file.write(tmp_path / 'a.glb')).face_label == LABEL['chair']).all()
    assert len(SQUARE_FACES) == 6 and load_mesh(
        tmp_path / 'a.glb', labels={'Mesh': 'desk'}).face_label[0] == LABEL['desk']
