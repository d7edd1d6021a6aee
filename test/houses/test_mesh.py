"""Meshes in and out: the same pictures after a round trip, and one clear error for bad files."""

import dataclasses
import json
import math
import struct

import cv2
import numpy as np
import pytest
import trimesh
from gltf_files import linear, read_glb

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABEL
from vn_sim_bridge.houses.mesh import load_mesh
from vn_sim_bridge.houses.mesh_export import export_mesh
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import uniform_light

FOV = math.radians(90)
CUBE = """
mtllib cube.mtl
v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1
o table_1
usemtl wood
f 1/1 4/2 3/3 2/4\nf 5/1 6/2 7/3 8/4\nf 1/1 2/2 6/3 5/4
f 2/1 3/2 7/3 6/4\nf 3/1 4/2 8/3 7/4\nf 4/1 1/2 5/3 8/4
"""


def write_cube(folder, *, text=CUBE, material='newmtl wood\nKd 1 1 1\nmap_Kd wood.png\n'):
    (folder / 'cube.obj').write_text(text)
    (folder / 'cube.mtl').write_text(material)
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[:8] = (0, 0, 255)  # the upper half is red
    picture[8:] = (0, 255, 0)
    cv2.imwrite(str(folder / 'wood.png'), picture)
    return folder / 'cube.obj'


def look(scene, camera, size=64):
    return [part[0] for part in Rasterizer([scene], size).render(
        np.zeros(1, int), np.array([camera], float), FOV)]


def test_a_house_looks_the_same_after_a_round_trip(tmp_path):
    house = generate_house(7, rooms=3)
    export_mesh(house.scene, tmp_path / 'house.glb')
    scene = load_mesh(tmp_path / 'house.glb')
    assert scene.triangle_count == house.scene.triangle_count
    rng = np.random.default_rng(0)
    cells = house.floor.centres()
    cameras = np.column_stack([cells[rng.integers(len(cells), size=12)], np.ones(12),
                               rng.uniform(-3, 3, 12), rng.uniform(-0.5, 0.5, 12)])
    index = np.zeros(12, int)
    _, depth, labels, _ = Rasterizer([house.scene], 64).render(index, cameras, FOV)
    _, other_depth, other_labels, _ = Rasterizer([scene], 64).render(index, cameras, FOV)
    assert (labels == other_labels).mean() > 0.999
    assert (np.abs(depth - other_depth) < 1e-3 * depth).mean() > 0.999


def test_a_round_trip_keeps_colours_and_pictures(tmp_path):
    scene = generate_house(7, rooms=3).scene
    export_mesh(scene, tmp_path / 'house.glb')
    again = load_mesh(tmp_path / 'house.glb')
    faces = len(scene.face_label)
    light, light_map, lanes = uniform_light(faces)  # baked light is left out
    plain = dataclasses.replace(scene, face_light=light, face_light_map=light_map, light=lanes)
    rng = np.random.default_rng(0)
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    cameras = np.column_stack([rng.uniform(low[0], high[0], 12), rng.uniform(low[1], high[1], 12),
                               np.full(12, 1.5), rng.uniform(-3, 3, 12), np.zeros(12)])
    seen, other = (Rasterizer([s], 64).render(np.zeros(12, int), cameras, FOV)[0].astype(int)
                   for s in (plain, again))
    assert seen.std() > 20 and (np.abs(seen - other) <= 1).mean() > 0.995
    assert {tuple(c) for c in scene.face_colour.round(5).tolist()} == {
        tuple(c) for c in again.face_colour.round(5).tolist()}


def test_an_exported_file_follows_gltf(tmp_path):
    scene = generate_house(7, rooms=1).scene
    export_mesh(scene, tmp_path / 'house.glb')
    document, data = read_glb(tmp_path / 'house.glb')
    shown = {tuple(c) for c in scene.face_colour.astype(float).tolist()}
    written = {tuple(m['pbrMetallicRoughness']['baseColorFactor'][:3])
               for m in document['materials']}
    assert {tuple(round(linear(v), 4) for v in colour) for colour in shown} == {
        tuple(round(v, 4) for v in colour) for colour in written}
    assert document['buffers'] == [{'byteLength': len(data)}]
    assert all(view['byteOffset'] % 4 == 0 for view in document['bufferViews'])
    foreign = trimesh.load_scene(tmp_path / 'house.glb', process=False)  # code other than ours
    assert sum(len(g.faces) for g in foreign.geometry.values()) == scene.triangle_count
    low, high = foreign.bounds  # y up
    assert low[[0, 1]] == pytest.approx(scene.vertices.min(axis=0)[[0, 2]], abs=1e-5)
    assert -high[2] == pytest.approx(scene.vertices.min(axis=0)[1], abs=1e-5)


def test_an_obj_has_its_texture_upright_its_label_and_its_scale(tmp_path):
    scene = load_mesh(write_cube(tmp_path), scale=0.5, up='z')
    rgb, depth, labels, _ = look(scene, (-2.5, 0.0, 0.0, 0.0, 0.0))
    assert depth[32, 32] == pytest.approx(2.0, abs=1e-3)
    assert labels[32, 32] == LABEL['table'] and labels[0, 0] == 0 and depth[0, 0] == 0
    assert (rgb[:, 28, 28:37].T > 60).tolist() == [[True, False, False]] * 9  # red above
    assert (rgb[:, 36, 28:37].T > 60).tolist() == [[False, True, False]] * 9  # green below


def test_y_up_is_turned_upright(tmp_path):
    path = tmp_path / 'post.obj'
    path.write_text('o lamp_1\nv 0 0 0\nv 1 0 0\nv 0 5 0\nf 1 2 3\n')
    scene = load_mesh(path)
    assert scene.vertices[:, 2].max() == pytest.approx(5.0)
    assert load_mesh(path, up='z').vertices[:, 1].max() == pytest.approx(5.0)


def test_both_sides_of_an_obj_are_drawn_unless_told_otherwise(tmp_path):
    path = tmp_path / 'sheet.obj'
    path.write_text('o wall_1\nv 2 -9 -9\nv 2 9 -9\nv 2 0 9\nf 1 2 3\n')
    for yaw, x in ((0.0, 0.0), (math.pi, 4.0)):
        assert look(load_mesh(path, up='z'), (x, 0, 0, yaw, 0))[2][32, 32] == LABEL['wall']
    seen = [look(load_mesh(path, up='z', double_sided=False), (x, 0, 0, yaw, 0))[2][32, 32]
            for yaw, x in ((0.0, 0.0), (math.pi, 4.0))]
    assert sorted(seen) == [0, LABEL['wall']]


def test_labels_come_from_patterns_names_or_the_default(tmp_path):
    text = CUBE.replace('o table_1', 'o Mesh.017')
    path = write_cube(tmp_path, text=text)
    with pytest.raises(UserError, match='every part of a mesh has a class'):
        load_mesh(path)
    assert (load_mesh(path, default_label='box').face_label == LABEL['box']).all()
    assert (load_mesh(path, labels={'wood': 'desk'}).face_label == LABEL['desk']).all()
    with pytest.raises(UserError, match='known class'):
        load_mesh(path, default_label='spaceship')


def test_bad_files_are_one_error_that_names_them(tmp_path):
    path = write_cube(tmp_path)
    cases = {}
    cases['missing'] = (tmp_path / 'none.obj', 'exists')
    cases['ending'] = (tmp_path / 'wood.png', 'ends in')
    (tmp_path / 'empty.obj').write_text('# nothing\n')
    cases['empty'] = (tmp_path / 'empty.obj', 'mesh file')
    (tmp_path / 'nan.obj').write_text('o box_1\nv nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n')
    cases['nan'] = (tmp_path / 'nan.obj', 'finite')
    (tmp_path / 'range.obj').write_text('o box_1\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n')
    cases['range'] = (tmp_path / 'range.obj', 'mesh')
    (tmp_path / 'flat.obj').write_text('o box_1\nv 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n')
    cases['flat'] = (tmp_path / 'flat.obj', 'area')
    (tmp_path / 'short.glb').write_bytes(b'glTF\x02\x00')
    cases['short'] = (tmp_path / 'short.glb', 'whole')
    document = json.dumps({'asset': {'version': '2.0'}, 'buffers': [
        {'uri': 'gone.bin', 'byteLength': 4}]}).encode()
    (tmp_path / 'gone.gltf').write_bytes(document)
    cases['reference'] = (tmp_path / 'gone.gltf', 'refers to')
    for file, rule in cases.values():
        with pytest.raises(UserError, match=rule) as caught:
            load_mesh(file)
        assert file.name in str(caught.value)
    (tmp_path / 'wood.png').unlink()
    with pytest.raises(UserError, match='wood.png'):
        load_mesh(path)
    (tmp_path / 'wood.png').write_bytes(b'no picture')
    with pytest.raises(UserError, match='wood.png'):
        load_mesh(path)


def test_a_truncated_glb_is_refused(tmp_path):
    export_mesh(generate_house(1, rooms=1).scene, tmp_path / 'house.glb')
    data = (tmp_path / 'house.glb').read_bytes()
    for keep in (0.1, 0.5, 0.99):
        (tmp_path / 'cut.glb').write_bytes(data[:int(len(data) * keep)])
        with pytest.raises(UserError, match='cut.glb'):
            load_mesh(tmp_path / 'cut.glb')
    marker = data.index(b'\x89PNG')
    (tmp_path / 'cut.glb').write_bytes(data[:marker] + bytes(4) + data[marker + 4:])
    with pytest.raises(UserError, match='cut.glb'):  # a broken embedded texture
        load_mesh(tmp_path / 'cut.glb')
    chunk = struct.unpack_from('<I', data, 12)[0]
    broken = data[:20] + b'{' * chunk + data[20 + chunk:]
    (tmp_path / 'cut.glb').write_bytes(broken)
    with pytest.raises(UserError, match='cut.glb'):
        load_mesh(tmp_path / 'cut.glb')


def test_exports_go_where_they_can(tmp_path):
    scene = generate_house(1, rooms=1).scene
    with pytest.raises(UserError, match='.glb'):
        export_mesh(scene, tmp_path / 'house.stl')
    with pytest.raises(UserError, match='folder'):
        export_mesh(scene, tmp_path / 'no' / 'house.glb')
